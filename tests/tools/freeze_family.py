"""Records of the SOUP family: how a scene of a new version is made and stored.

Run as `python tests/tools/freeze_family.py SCENE SIZE FILE`.
"""

import io
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.family.frozen import STORED, Frozen
from benchmarks.family.instances import case_of, rounded
from soup_nlp.arrays import Float
from soup_nlp.config.problem import Problem, dump_problem, make_problem
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.files import write_bytes
from soup_nlp.storage.progress import Watch


def family_problem(scene: str, size: int) -> Problem:
    """The problem of a rendered scene and size with true flow and default options."""
    source = {"kind": "scene", "scene": scene, "seed": 0, "width": 1024, "height": 436}
    return make_problem(
        {
            "name": scene,
            "input": source,
            "segmentation": {"superpixels": size},
            "flow": {"source": "truth"},
            # 0.2 pixels where surfaces bend, as in the records of all sizes, see `case_of`
            "energy": {"weights": {"prior": 0.0015}} if scene == "sheet" else {},
            "solver": {"presolve_tol": 1e-8, "tol": 1e-8, "max_iter": 60},
        }
    )


def freeze(scene: str, size: int, path: Path) -> None:
    """Segment, propose and solve a scene at a size, and write its record."""
    problem = family_problem(scene, size)
    proposed = record_of(prepare(problem, log=print))
    # solve the numbers of the record, which are rounded
    case = case_of(proposed)
    own = case.data, case.weights, case.formulation(), case.options
    solution = solve_soup(case.soup, *own, watch=Watch(say=print))
    print(solution)
    # Ipopt's answer, a minimum of the smoothed energy, even where the proposal is delivered, whose
    # exact energy may be lower with true flow
    answer = MatrixLayout(case.data.share, case.formulation().gauge).unpack(solution.stages[-1].x)
    save_frozen(path, replace(proposed, minimum=encoded(answer.retracted())))


def record_of(case: Case) -> Frozen:
    """The record of a case with the proposal as best known point."""
    start, data, seg = case.start, case.data, case.segmentation
    edges = len(seg.edges)
    proposal = encoded(start.soup).astype(np.float32).astype(float)
    return Frozen(
        text=dump_problem(case.problem),
        labels=seg.labels,
        component=start.component,
        surface=start.surface,
        error=start.error.astype(np.float32).astype(float),
        bending=start.bending,
        pair_weight=seg.pair_weight,
        prior_weight=rounded(data.prior_weight[:edges]),
        edge_share=data.edge_weight[:edges] / seg.edge_weight,
        pair_share=data.pair_weight / seg.pair_weight,
        orient_share=data.orient_weight / 2.0,
        proposal=proposal,
        minimum=proposal,
    )


def encoded(soup: Soup) -> Float:
    """(N, 10) numbers of a soup with proper rotations."""
    # of the quaternion with w > 0, rotations between two frames are far from 180 degrees
    turn = Rotation.from_matrix(soup.R).as_quat(canonical=True)[:, :3]
    return np.column_stack([soup.distance, soup.n, turn, soup.translation])


def save_frozen(path: Path, record: Frozen) -> None:
    """Write a record, whole or not at all; the same record gives the same bytes."""
    arrays: dict[str, NDArray[Any]] = {
        "problem": np.frombuffer(record.text.encode(), np.uint8),
        "labels": np.diff(record.labels, axis=1, prepend=0).astype(np.int16),
        **{name: np.asarray(getattr(record, name), kind) for name, kind in STORED.items()},
    }
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_LZMA) as archive:
        for name, value in arrays.items():
            part = io.BytesIO()
            np.save(part, value, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), part.getvalue(), zipfile.ZIP_LZMA)
    write_bytes(path, target.getvalue())


if __name__ == "__main__":
    freeze(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
