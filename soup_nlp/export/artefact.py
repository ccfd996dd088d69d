"""Export of an NLP as a folder: .nl with names, CasADi functions, HDF5, problem and manifest."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NotRequired, get_args

import casadi as ca
import numpy as np
from pydantic import FiniteFloat
from scipy import sparse
from typing_extensions import TypedDict

from soup_nlp.config.problem import dump_problem
from soup_nlp.errors import ConfigError, ExportError
from soup_nlp.evaluation.information import Information, information
from soup_nlp.export.nl import NLFile, suffixes_of, write_nl
from soup_nlp.export.verify import examine
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Coordinates, Formulation
from soup_nlp.model.layout import GAUGES, Gauge, Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.norms import NormForm
from soup_nlp.model.symbolic import Graph
from soup_nlp.pipeline.record import Case
from soup_nlp.storage.files import read_json, write_json, write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.store import parse_table, write_h5
from soup_nlp.storage.versions import versions

STUB = "soup"
MANIFEST = "manifest.json"
NORMS: tuple[NormForm, ...] = get_args(NormForm)
FUNCTIONS = ("oracle", "grad_f", "jac_g", "hess_lag")
"""Functions of the NLP in the format casadi."""
EXPORT_FILES = (
    *(f"{STUB}{suffix}" for suffix in (".nl", ".col", ".row", ".h5")),
    *(f"{function}.casadi" for function in FUNCTIONS),
    "problem.yaml",
    MANIFEST,
)
"""Files that an export may write."""
FORMATS = ("nl", "casadi", "h5")
STATIONARY = 1e-3
"""Largest dual infeasibility of a start whose multipliers are written."""
START = """
x0                          1  X  start
lbx                         1  X  lower bounds
ubx                         1  X  upper bounds
lbg                         1  G  lower bounds of g
ubg                         1  G  upper bounds of g
p                           1  P  parameters of the functions
x_names                     1  X  variables
g_names                     1  G  constraints
at_start/f                  1  -  objective
at_start/g                  1  G  constraints
at_start/grad_f             1  X  gradient of the objective
at_start/*/row              1  Z  row of every entry
at_start/*/column           1  Z  column of every entry
at_start/*/shape            1  2  rows, columns
at_start/jac_g/value        1  Z  Jacobian of g
at_start/information/value  1  Z  triu Gauss-Newton information of E at the start in nine \
coordinates a superpixel: relative inverse depth at the anchor, its slopes (2), rotation (3), \
shift of the anchor (3)
at_start/hess_lag/value     1  Z  triu Hessian, lam_f = lam_g = 1"""
"""Arrays of the HDF5 file, see `parse_table`; the last line ends with the kind of the Hessian."""
TANGENT = "tangent"
"""Stands in the place of a gauge for tangent coordinates, which have none."""
CHOICES = {"gauge": (*GAUGES, TANGENT), "norm": NORMS}
"""Values of each part of a formulation, in the order of its label."""


def parse_formulation(text: str, coordinates: Coordinates = "matrix") -> dict[str, str]:
    """Parse `gauge/norm`; missing parts, of "" all, are those of the problem file.

    "tangent" in the place of a gauge becomes `coordinates`.

    Raises:
        ConfigError: a word is not one of the choices, or a gauge is named for tangent coordinates.
    """
    words = [w.strip() for w in text.split("/")] if text else []
    if len(words) > len(CHOICES):
        raise ConfigError(
            "too many words", where="--formulation", found=text, expected="/".join(CHOICES)
        )
    for word, (key, choices) in zip(words, CHOICES.items()):
        if word not in choices:
            raise ConfigError(
                f"unknown {key}", where="--formulation", found=word, expected=", ".join(choices)
            )
    out = dict(zip(CHOICES, words))
    if TANGENT not in (coordinates, out.get("gauge")):
        return out
    gauge = out.pop("gauge", TANGENT)
    if gauge != TANGENT:
        raise ConfigError("tangent coordinates have no gauge", where="--formulation", found=gauge)
    return {"coordinates": TANGENT, **out}


def form_label(form: Formulation) -> str:
    """`gauge/norm`, with "tangent" in the place of a gauge."""
    first = TANGENT if form.coordinates == TANGENT else form.gauge
    return f"{first}/{form.norm}"


def export_case(
    case: Case,
    form: Formulation,
    folder: Path,
    formats: Sequence[str] = ("nl",),
    presolved: bool = False,
    overwrite: bool = False,
    suffixes: bool = False,
    lift: bool = False,
) -> dict[str, Any]:
    """Write soup.nl with names, problem.yaml and manifest.json; returns the manifest.

    An earlier export in the folder is replaced when this one is complete.

    Args:
        case: Problem with its start.
        form: Gauge and norm; the Hessian in the files is exact.
        folder: Output folder.
        formats: Some of FORMATS; nl is always written, and casadi includes h5.
        presolved: The case starts at the answer of the presolve (for the manifest).
        overwrite: Overwrite files that the program did not make.
        suffixes: Write the suffixes of `nl.suffixes_of`, which CasADi's reader does not accept.
        lift: See `nl.write_nl`.

    Raises:
        ConfigError: a format is unknown.
        DataError: the folder cannot be written, or holds a file of the user with the same name.
        ExportError: the NLP cannot be written.
    """
    for word in formats:
        if word not in FORMATS:
            raise ConfigError(
                "unknown format", where="--format", found=word, expected=", ".join(FORMATS)
            )
    form = form.replace(hessian="exact")
    nlp, layout = case.nlp(form)
    target = claim(folder, EXPORT_FILES, overwrite, case.problem.subject)
    with staged(target, True, overwrite, case.problem.subject) as new:
        duals = examine(nlp, nlp.x0, None) if presolved else None
        if duals is not None and not duals.dual <= STATIONARY:
            # multipliers of a point that is not stationary mislead
            duals = None
        kinds, segments = suffixes_of(nlp)
        lam_g = None if duals is None else duals.lam_g
        file = write_nl(new / f"{STUB}.nl", nlp, lam_g, segments if suffixes else (), lift)
        if "casadi" in formats:
            graph = Graph(nlp)
            for function in FUNCTIONS:
                # the file writer of CasADi ignores a full disk
                text = ca.StringSerializer()
                text.pack(getattr(graph, function))
                write_text(new / f"{function}.casadi", text.encode())
        write_text(new / "problem.yaml", dump_problem(case.problem))
        manifest = {
            **_description(case, form, nlp, layout, file),
            "start": "presolve" if presolved else "proposal",
            "initial_duals": duals is not None,
            "lifted": file.lifted,
            "kinds": kinds,
        }
        # the functions also need parameters, start and bounds
        if "h5" in formats or "casadi" in formats:
            attrs = {k: manifest[k] for k in ("name", "problem_hash", "formulation", "smoothing")}
            info = information(case.soup, case.data, case.weights, form)
            _write_start_h5(new / f"{STUB}.h5", nlp, attrs, info)
        files = {path.name for path in new.iterdir()} - {"problem.yaml"}
        manifest["files"] = sorted(files, key=EXPORT_FILES.index)
        write_json(new / MANIFEST, manifest)
    return manifest


def _description(
    case: Case, form: Formulation, nlp: NLP, layout: Layout, file: NLFile
) -> dict[str, Any]:
    """Entries of the manifest that follow from the problem and its .nl file."""
    return {
        "name": case.problem.name,
        "problem_hash": case.problem.digest(),
        "versions": versions(),
        "formulation": {k: getattr(form, k) for k in (*CHOICES, "coordinates")},
        "smoothing": {"eps": form.eps, "eps_pixel": form.eps_pixel},
        "sizes": {
            "superpixels": len(case),
            "knn_edges": len(case.segmentation.edges),
            "neighbour_pairs": len(case.segmentation.pairs),
            **nlp.sizes(),
            **file.counts,
        },
        "nl": {"file": f"{STUB}.nl", "bytes": file.size, "sha256": file.sha256},
        "objective_at_start": nlp.value(nlp.x0),
        "exact_energy_at_start": oracle.energy(case.soup, case.data, case.weights),
        "fingerprint": fingerprint(case, nlp, layout),
    }


def fingerprint(case: Case, nlp: NLP, layout: Layout) -> dict[str, float]:
    """f and |g| at the proposal with all slack variables and switches at 1/2."""
    x = np.full(nlp.nx, 0.5)
    x[: layout.size] = layout.pack(case.start.soup)
    return {
        "objective": nlp.value(x),
        "constraints": float(np.linalg.norm(nlp.constraints(x))),
    }


def _write_start_h5(path: Path, nlp: NLP, attrs: dict[str, object], info: Information) -> None:
    """Write bounds, parameters, names, and values at the start with their sparsity.

    The Hessian is that of the NLP with lam_f = 1 and lam_g = 1; `info` is the Gauss-Newton
    information at the start.
    """
    x = nlp.x0
    upper = sparse.triu(nlp.hessian(x, np.ones(nlp.ng)))

    def matrix(value: sparse.spmatrix) -> dict[str, Any]:
        m = value.tocoo()
        row, column = m.row.astype(np.int64), m.col.astype(np.int64)
        return {"row": row, "column": column, "value": m.data, "shape": np.array(m.shape)}

    vectors = {key: getattr(nlp, key) for key in ("x0", "lbx", "ubx", "lbg", "ubg")}
    tree = {
        **{key: np.asarray(value, float).ravel() for key, value in vectors.items()},
        "p": Graph(nlp).p,
        "x_names": nlp.x_names(),
        "g_names": nlp.g_names(),
        "at_start": {
            "f": nlp.value(x),
            "g": nlp.constraints(x),
            "grad_f": nlp.gradient(x),
            "jac_g": matrix(nlp.jacobian(x)),
            "hess_lag": matrix(upper),
            "information": matrix(sparse.triu(info.matrix)),
        },
    }
    rows = parse_table(START + f" ({nlp.hessian_kind})")
    write_h5(path, tree, attrs, rows)


# --- the manifest --------------------------------------------------------------------------------


class Written(TypedDict):
    """The formulation that was exported."""

    gauge: Gauge
    norm: NormForm
    coordinates: Coordinates


class Smoothing(TypedDict):
    """Its smoothing widths."""

    eps: FiniteFloat
    eps_pixel: FiniteFloat


class Fingerprint(TypedDict):
    """See `fingerprint`."""

    objective: FiniteFloat
    constraints: FiniteFloat


class Energy(TypedDict):
    """Energy by term."""

    total: FiniteFloat


class Manifest(TypedDict):
    """Entries that an import needs."""

    formulation: Written
    smoothing: Smoothing
    fingerprint: Fingerprint
    exact_energy_at_start: Energy
    lifted: NotRequired[int]


def read_manifest(folder: Path) -> Manifest:
    """The manifest of an exported folder.

    Raises:
        ExportError: the file is missing, or a needed entry is missing or wrong.
    """
    return read_json(folder / MANIFEST, MANIFEST, Manifest, error=ExportError)
