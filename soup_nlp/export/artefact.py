"""Export of an NLP as a folder: .nl with names, problem and manifest."""

from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from pydantic import Field, FiniteFloat
from typing_extensions import TypedDict

from soup_nlp.config.problem import dump_problem
from soup_nlp.errors import ExportError
from soup_nlp.export.nl import write_nl
from soup_nlp.export.verify import examine
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Coordinates, Formulation
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.record import Case
from soup_nlp.storage.files import read_json, write_json, write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.versions import versions

STUB = "soup"
MANIFEST = "manifest.json"
EXPORT_FILES = (f"{STUB}.nl", f"{STUB}.col", f"{STUB}.row", "problem.yaml", MANIFEST)
"""Files of an export."""
STATIONARY = 1e-3
"""Largest dual infeasibility of a start whose multipliers are written: others mislead."""


def form_label(form: Formulation) -> str:
    """Its gauge, or "tangent", which has none."""
    return "tangent" if form.coordinates == "tangent" else form.gauge


def export_case(
    case: Case,
    form: Formulation,
    folder: Path,
    presolved: bool = False,
    overwrite: bool = False,
    lift: bool = False,
) -> dict[str, Any]:
    """Write soup.nl with names, problem.yaml and manifest.json; returns the manifest.

    An earlier export in the folder is replaced when this one is complete.

    Args:
        case: Problem with its start.
        form: Coordinates and gauge; the Hessian of a .nl file is exact.
        folder: Of the export; with `overwrite` also files that the program did not make are lost.
        presolved: The case starts at the answer of the presolve (for the manifest).
        lift: See `nl.write_nl`.

    Raises:
        DataError: the folder cannot be written, or holds a file of the user with the same name.
        ExportError: the NLP cannot be written.
    """
    nlp, layout = case.nlp(form.replace(hessian="exact"))
    target = claim(folder, EXPORT_FILES, overwrite, case.problem.subject)
    with staged(target, True, overwrite, case.problem.subject) as new:
        at_start = examine(nlp, nlp.x0, None) if presolved else None
        lam_g = at_start.lam_g if at_start and at_start.dual <= STATIONARY else None
        file = write_nl(new / f"{STUB}.nl", nlp, lam_g, lift)
        write_text(new / "problem.yaml", dump_problem(case.problem))
        sizes = {
            "superpixels": len(case),
            "knn_edges": len(case.segmentation.edges),
            "neighbour_pairs": len(case.segmentation.pairs),
        }
        manifest = {
            "name": case.problem.name,
            "problem_hash": case.problem.digest(),
            "versions": versions(),
            "coordinates": form.coordinates,
            "smoothing": form.eps,
            "sizes": {**sizes, **nlp.sizes(), **file.counts},
            "nl": {"file": f"{STUB}.nl", "bytes": file.size, "sha256": file.sha256},
            "start": "presolve" if presolved else "proposal",
            "initial_duals": lam_g is not None,
            "lifted": file.lifted,
            "objective_at_start": nlp.value(nlp.x0),
            "exact_energy_at_start": oracle.energy(case.soup, case.data, case.weights),
            "fingerprint": fingerprint(case, nlp, layout),
        }
        write_json(new / MANIFEST, manifest)
    return manifest


def fingerprint(case: Case, nlp: NLP, layout: Layout) -> list[float]:
    """f and |g| at the proposal."""
    x = layout.pack(case.start.soup)
    return [nlp.value(x), float(np.linalg.norm(nlp.constraints(x)))]


# --- the manifest --------------------------------------------------------------------------------


class Energy(TypedDict):
    """Energy by term."""

    total: FiniteFloat


class Manifest(TypedDict):
    """Entries that an import needs."""

    coordinates: Coordinates
    fingerprint: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
    exact_energy_at_start: Energy
    lifted: NotRequired[int]


def read_manifest(folder: Path) -> Manifest:
    """The manifest of an exported folder.

    Raises:
        ExportError: the file is missing, or a needed entry is missing or wrong.
    """
    return read_json(folder / MANIFEST, MANIFEST, Manifest, error=ExportError)
