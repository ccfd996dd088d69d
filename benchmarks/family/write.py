"""Writing of the family: .nl files, best known points, index, README; answers of solvers."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pandas as pd
from typing_extensions import TypedDict

from benchmarks.family.frozen import RECORDS, load_frozen
from benchmarks.family.instances import VERSION, Instance, build_instance, case_of, parse_name
from benchmarks.family.sol import write_sol
from benchmarks.table import markdown
from soup_nlp import Pair, __version__
from soup_nlp.errors import DataError
from soup_nlp.export.compare import Labelled, make_task
from soup_nlp.export.nl import NLFile, write_nl
from soup_nlp.export.program import file_orders
from soup_nlp.export.sol import read_sol
from soup_nlp.export.solvers import Task
from soup_nlp.export.verify import Limits, Residuals, examine
from soup_nlp.model.nlp import NLP
from soup_nlp.storage.files import read_json, write_json, write_text

Entry = dict[str, Any]

REACHED = 1e-4
"""Relative distance up to which an objective has reached the best known one."""
INDEX = "index.json"


class _Best(TypedDict):
    objective: float


class _Named(TypedDict):
    name: str
    best_known: _Best


class _Index(TypedDict):
    """Contents of index.json, as far as they are read back."""

    instances: list[_Named]


@cache
def published() -> dict[str, Any]:
    """Published data of this version: checksums, and solvers that reached the best known points."""
    return dict(json.loads((RECORDS / "published.json").read_text(encoding="utf-8")))


def write_family(
    folder: Path, chosen: Sequence[Instance], say: Callable[[str], object] = print
) -> list[Entry]:
    """Write instances with their index into a new folder or into that of an earlier set.

    Returns:
        Entries of the index. "published" says whether the bytes are those of the published
        version; None if that version has no such instance.
    """
    if folder.is_dir() and any(folder.iterdir()) and not (folder / INDEX).is_file():
        raise DataError(
            "folder holds other files", where=folder, expected="a new or empty folder, or a set"
        )
    folder.mkdir(parents=True, exist_ok=True)
    entries, pairs = [], dict[str, Pair]()
    members_of = defaultdict(list)
    for instance in chosen:
        members_of[instance.scene, instance.size].append(instance)
    for (scene, size), members in members_of.items():
        record = load_frozen(scene, size)
        # scenes of all sizes have one pair
        pairs[scene] = pairs.get(scene) or record.problem.load_pair()
        case = case_of(record, pairs[scene])
        for instance in members:
            nlp = build_instance(case, record, instance.formulation, instance.start)[0]
            file = write_nl(folder / f"{instance.name}.nl", nlp)
            best = build_instance(case, record, instance.formulation, "best")[0]
            message = f"SOUP {VERSION}: best known point of {instance.problem}"
            r, sol = examine(best, best.x0, None), folder / f"{instance.problem}.sol"
            write_sol(sol, best.x0, r.lam_g, file.variables, file.rows, message)
            entry = _entry(instance, len(case), nlp, best.value(best.x0), r, file)
            changed = "  NOT the published bytes" * (entry["published"] is False)
            say(f"{file.path.name:<52} n {nlp.nx:>6}  m {nlp.ng:>6}{changed}")
            entries.append(entry)
    index = {"set": "SOUP", "version": VERSION, "generator": f"soup_nlp {__version__}"}
    write_json(folder / INDEX, {**index, "instances": entries})
    write_text(folder / "README.md", readme(entries))
    copyfile(RECORDS / "LICENSE.txt", folder / "LICENSE.txt")
    return entries


def _entry(
    instance: Instance, superpixels: int, nlp: NLP, best: float, r: Residuals, file: NLFile
) -> Entry:
    sha = published()["sha256"].get(instance.name)
    solved = dict(published()["solved"].get(instance.problem, {}))
    runs = solved.pop("runs", {}).get(instance.start, {})
    return {
        **{"name": instance.name, "file": file.path.name, **vars(instance)},
        "superpixels": superpixels,
        **nlp.sizes(),
        "bounded_variables": int((np.isfinite(nlp.lbx) | np.isfinite(nlp.ubx)).sum()),
        **file.counts,
        "best_known": {
            "objective": _short(best),
            "sol": f"{instance.problem}.sol",
            **{k: _short(getattr(r, k), 2) for k in ("primal", "dual", "complementarity")},
            **solved,
        },
        "runs": runs,
        "objective_at_start": _short(nlp.value(nlp.x0)),
        "bytes": file.size,
        "sha256": file.sha256,
        "published": None if sha is None else sha == file.sha256,
    }


def _short(value: Any, digits: int = 9) -> float:
    """A number rounded to significant digits; further ones depend on the processor."""
    return float(f"{float(value):.{digits}g}")


def readme(entries: Sequence[Entry]) -> str:
    """README of the folder, for the entries of its index."""
    scenes = ", ".join(dict.fromkeys(e["scene"] for e in entries))
    sizes = ", ".join(str(n) for n in sorted({e["size"] for e in entries}))
    head = (RECORDS / "README.md").read_text(encoding="utf-8")
    head = head.format(scenes=scenes, sizes=sizes, package=__version__, version=VERSION)
    rows = [
        {
            "file": e["file"],
            **{"n": e["variables"], "m": e["constraints"]},
            **{"Jacobian": e["jacobian_nonzeros"], "Hessian": e["hessian_nonzeros"]},
            "start": f"{e['objective_at_start']:.6g}",
            "best known": f"{e['best_known']['objective']:.8g}",
            "reached by": "{} of {} solvers".format(
                *(len(e["best_known"].get(k, [])) for k in ("reached_by", "tried_by"))
            ),
            "SHA-256": f"{e['sha256'][:16]}...",
        }
        for e in entries
    ]
    table = markdown(pd.DataFrame(rows).set_index("file"))
    return f"{head}\n{table}\n\nNonzeros of the Hessian are of its upper triangle.\n"


# --- answers of solvers --------------------------------------------------------------------------


def check_sol(path: Path) -> tuple[str, bool]:
    """Read `<name>.sol`, the answer to the instance of that name, and recompute its values.

    The instance is built again; neither the .nl file nor a value of the solver is used.

    Returns:
        What was found, and whether the point is verified.
    """
    instance = parse_name(path.stem)
    record = load_frozen(instance.scene, instance.size)
    case = case_of(record)
    nlp = build_instance(case, record, instance.formulation, instance.start)[0]
    best = nlp.value(build_instance(case, record, instance.formulation, "best")[0].x0)
    sol = read_sol(path, *file_orders(nlp))
    with np.errstate(all="ignore"):
        objective, r = nlp.value(sol.x), examine(nlp, sol.x, sol.lam_g)
    gap = (objective - best) / best
    text = (
        f"{sol}: {'verified' if r.optimal else 'not verified'}\n"
        f"objective   {objective:.9g}, best known {best:.9g}, gap {gap:+.2e}\n"
        f"residuals   primal {r.primal:.1e}  dual {r.dual:.1e}  complementarity"
        f" {r.complementarity:.1e}  (unscaled; multipliers: {r.multipliers})"
    )
    return text, r.optimal


def family_tasks(folder: Path) -> Iterator[Labelled]:
    """The tasks of all instances in a folder, for `export.compare.compare`."""
    for entry in read_json(folder / INDEX, "index of the family", _Index)["instances"]:
        instance = parse_name(entry["name"])
        label = {
            "problem": f"{instance.scene} {instance.start}",
            "identity": VERSION,
            "superpixels": instance.size,
            "formulation": instance.formulation,
            "start": instance.start,
            "name": entry["name"],
            "best_known": entry["best_known"]["objective"],
            "energy_limit": 1e300,
        }
        yield label, partial(_task, instance)


def _task(instance: Instance, limits: Limits) -> Task:
    record = load_frozen(instance.scene, instance.size)
    case = case_of(record)
    parts = case, record, instance.formulation, instance.start
    return make_task(case, *build_instance(*parts), limits)
