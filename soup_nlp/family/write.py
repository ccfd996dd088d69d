"""Writing of the family: .nl files with names, best known points, index, README, licence."""

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.data.pair import Pair
from soup_nlp.export.nl import NLFile, write_nl
from soup_nlp.export.sol import write_sol
from soup_nlp.export.verify import examine
from soup_nlp.family.describe import CLASSES, classes, classification, qualification
from soup_nlp.family.frozen import Frozen, load_frozen
from soup_nlp.family.instances import VERSION, Instance, build_instance, case_of, problems
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.record import Case
from soup_nlp.storage.files import write_json, write_text
from soup_nlp.storage.versions import __version__

Entry = dict[str, Any]

REACHED = 1e-4
"""Relative distance up to which an objective has reached the best known one."""
DIGITS = 9
"""Significant digits in the index; further digits depend on the processor."""


def published() -> dict[str, Any]:
    """Published data of this version: checksums, and solvers that reached the best known points."""
    return dict(json.loads(_file("published.json")))


def _file(name: str) -> str:
    """A text that the package holds beside the records."""
    return (files("soup_nlp.family") / "records" / name).read_text(encoding="utf-8")


def write_family(
    folder: Path, chosen: Sequence[Instance], say: Callable[[str], None] = print
) -> list[Entry]:
    """Write instances with their index into an existing folder.

    Returns:
        Entries of the index. "published" says whether the bytes are those of the published
        version; None if that version has no such instance.

    Raises:
        DataError: the package has no record of a size, or the folder cannot be written.
    """
    known, entries = published(), []

    @cache
    def rendered(scene: str) -> Pair:
        return load_frozen(scene, chosen[0].size).problem.load_pair()

    for scene, size, members in problems(chosen):
        record = load_frozen(scene, size)
        case = case_of(record, rendered(scene))
        for form in dict.fromkeys(i.formulation for i in members):
            starts = [i for i in members if i.formulation == form]
            shared: Entry = {}
            for instance in starts:
                nlp, _, _ = build_instance(case, record, form, instance.start)
                file = write_nl(folder / f"{instance.name}.nl", nlp)
                shared = shared or _solved(folder, case, record, instance, file, known)
                entries.append(_entry(instance, nlp, file, shared, known))
                changed = "  NOT the published bytes" * (entries[-1]["published"] is False)
                say(
                    f"{file.path.name:<52} n {nlp.nx:>6}  m {nlp.ng:>6}"
                    f"  {file.size / 1e6:5.1f} MB{changed}"
                )
    index = {"set": "SOUP", "version": VERSION, "generator": f"soup_nlp {__version__}"}
    write_json(folder / "index.json", {**index, "instances": entries})
    rows = [instance_data(e) for e in entries]
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n", delimiter=";")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "instancedata.csv", table.getvalue())
    write_text(folder / "README.md", readme(entries))
    write_text(folder / "LICENSE.txt", _file("LICENSE.txt"))
    return entries


def _solved(
    folder: Path,
    case: Case,
    record: Frozen,
    instance: Instance,
    file: NLFile,
    known: Mapping[str, Any],
) -> Entry:
    """Write the best known point of a problem as .sol; returns entries that all starts share.

    "runs" has what solvers reached, by start and solver, see `bench.solvers.page.summary`.
    """
    nlp = build_instance(case, record, instance.formulation, "best")[0]
    x = nlp.x0
    message = f"SOUP {VERSION}: best known point of {instance.problem}"
    order = file.variables, file.rows
    write_sol(folder / f"{instance.problem}.sol", x, None, *order, message)
    kinds = classes(nlp)
    solved = dict(known["solved"].get(instance.problem, {}))
    runs = solved.pop("runs", {})
    r = examine(nlp, x, None)
    return {
        "superpixels": len(case),
        **nlp.sizes(),
        "bounded_variables": int((np.isfinite(nlp.lbx) | np.isfinite(nlp.ubx)).sum()),
        **file.counts,
        **kinds,
        "classification": classification(nlp, kinds),
        **qualification(nlp, x),
        "best_known": {
            "objective": _short(nlp.value(x)),
            "sol": f"{instance.problem}.sol",
            **{k: _short(getattr(r, k), 2) for k in ("primal", "dual", "complementarity")},
            "found_by": None,
            "reached_by": [],
            "tried_by": [],
            "date": None,
            **solved,
        },
        "runs": runs,
    }


def _entry(
    instance: Instance, nlp: NLP, file: NLFile, shared: Entry, known: Mapping[str, Any]
) -> Entry:
    """Entry of an instance in the index."""
    sha = known["sha256"].get(instance.name)
    return {
        "name": instance.name,
        "file": file.path.name,
        "scene": instance.scene,
        "formulation": instance.formulation,
        "size": instance.size,
        "start": instance.start,
        **shared,
        "runs": shared["runs"].get(instance.start, {}),
        "objective_at_start": _short(nlp.value(nlp.x0)),
        "bytes": file.size,
        "sha256": file.sha256,
        "published": None if sha is None else sha == file.sha256,
    }


def _short(value: Any, digits: int = DIGITS) -> float:
    """A number rounded to some significant digits."""
    return float(f"{float(value):.{digits}g}")


def instance_data(entry: Mapping[str, Any]) -> Entry:
    """An entry in the columns of MINLPLib's instancedata.csv, as far as they have a meaning here.

    The dual bound is 0: every term of the objective is at least 0.
    """
    best, rows = entry["best_known"], entry["constraint_classes"].values()
    by_class = {word: sum(c["rows"] for c in rows if c["class"] == word) for word in CLASSES}
    return {
        "name": entry["name"],
        "file": entry["file"],
        "probtype": "NLP",
        "objsense": "min",
        "objtype": "nonlinear",
        "nvars": entry["variables"],
        "nnlvars": entry["nonlinear_variables"]["objective"],
        "ncons": entry["constraints"],
        "nlincons": by_class["constant"] + by_class["linear"],
        "nquadcons": by_class["quadratic"],
        "ngennlcons": by_class["general"],
        "njacobiannz": entry["jacobian_nonzeros"],
        "nlaghessiannz": entry["hessian_nonzeros"],
        "startvalue": entry["objective_at_start"],
        "primalbound": best["objective"],
        "primaltolerance": REACHED,
        "dualbound": 0.0,
        "foundby": best["found_by"] or "soup_nlp",
        "reachedby": " ".join(best["reached_by"]),
    }


# --- README of the folder -------------------------------------------------------------------------

COLUMNS: Mapping[str, Callable[[Entry], str]] = {
    "problem": lambda e: e["name"].rpartition("-")[0],
    "n": lambda e: str(e["variables"]),
    "m": lambda e: str(e["constraints"]),
    "Jacobian": lambda e: str(e["jacobian_nonzeros"]),
    "Hessian": lambda e: str(e["hessian_nonzeros"]),
    "class": lambda e: e["classification"],
    "LICQ": lambda e: f"{'holds' if e['licq'] else 'FAILS'} ({e['active_rank']})",
    "best known": lambda e: f"{e['best_known']['objective']:.8g}",
    "dual inf.": lambda e: f"{e['best_known']['dual']:.0e}",
    "found by": lambda e: str(e["best_known"]["found_by"] or "soup_nlp"),
    "reached by": lambda e: (
        f"{len(e['best_known']['reached_by'])} of {len(tried)} solvers"
        if (tried := e["best_known"]["tried_by"])
        else "not measured"
    ),
}


def _reached(entries: Sequence[Entry]) -> list[str]:
    """What each solver reached from each start: objective above the best known one, CPU seconds."""
    measured = [e for e in entries if e["runs"]]
    solvers = list(dict.fromkeys(s for e in measured for s in e["runs"]))
    if not solvers:
        return []

    def cell(entry: Entry, solver: str) -> str:
        objective, seconds, limit, verified = entry["runs"].get(solver, (None, None, None, False))
        if seconds is None:
            return "-"
        if objective is None:
            return f"no point, {seconds:g} of {limit:g} s"
        best = entry["best_known"]["objective"]
        gap = f"{100 * (objective - best) / abs(best):+.2g} %"
        return f"{f'**{gap}**' if verified else gap}, {seconds:g} of {limit:g} s"

    rows = [[e["name"], *(cell(e, s) for s in solvers)] for e in measured]
    return [
        "",
        "## What solvers reached",
        "",
        "Objective above the best known one; bold: the point is verified as an optimum. CPU seconds"
        " of their limit. Options and machine: results/family of the soup_nlp repository.",
        "",
        "| instance | " + " | ".join(solvers) + " |",
        "|" + "---|" * (len(solvers) + 1),
        *("| " + " | ".join(row) + " |" for row in rows),
    ]


def readme(entries: Sequence[Entry]) -> str:
    """README of the folder, for the entries of its index."""
    scenes = ", ".join(dict.fromkeys(e["scene"] for e in entries))
    sizes = ", ".join(str(n) for n in sorted({e["size"] for e in entries}))
    head = _file("README.md").format(
        scenes=scenes, sizes=sizes, package=__version__, version=VERSION
    )
    unique = list({COLUMNS["problem"](e): e for e in entries}.values())
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(f(e) for f in COLUMNS.values()) + " |" for e in unique]
    starts = ["", "## Instances", "", "| file | objective at start | MB | SHA-256 |"]
    starts.append("|---|---|---|---|")
    starts += [
        f"| {e['file']} | {e['objective_at_start']:.6g} | {e['bytes'] / 1e6:.1f}"
        f" | {e['sha256'][:16]}... |"
        for e in entries
    ]
    note = [
        "",
        "Nonzeros of the Hessian are of its upper triangle. LICQ: at the best known point, with the"
        " rank of the active rows in brackets.",
    ]
    return head + "\n" + "\n".join([*lines, *note, *_reached(entries), *starts]) + "\n"
