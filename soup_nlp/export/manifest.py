"""manifest.json of an exported folder: what was exported, and the best answer known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError

from soup_nlp.errors import ExportError
from soup_nlp.model.layout import GAUGES

STUB = "soup"
MANIFEST = "manifest.json"
NORMS = ("smooth", "epigraph")
TRUNCATIONS = ("smooth", "lifted")
FUNCTIONS = ("oracle", "grad_f", "jac_g", "hess_lag")
"""Functions of the NLP that the format casadi has."""
OWN = {f"{STUB}{s}" for s in (".nl", ".col", ".row", ".h5")} | {f"{f}.casadi" for f in FUNCTIONS}
"""Every file beside problem.yaml and the manifest that an export may write."""


class _Part(BaseModel):
    """A part of the manifest; entries beyond these are for people."""

    model_config = ConfigDict(strict=True)


class _Formulation(_Part):
    gauge: Literal[GAUGES]  # type: ignore[valid-type]
    norm: Literal[NORMS]  # type: ignore[valid-type]
    truncation: Literal[TRUNCATIONS]  # type: ignore[valid-type]


class _Smoothing(_Part):
    eps: FiniteFloat
    eps_pixel: FiniteFloat


class _Fingerprint(_Part):
    objective: FiniteFloat
    constraints: FiniteFloat


class _Energy(_Part):
    total: FiniteFloat


class _File(_Part):
    sha256: str


class _Best(_Part):
    exact_energy: FiniteFloat
    found_by: str


class _Manifest(_Part):
    """Entries that an import needs."""

    formulation: _Formulation
    smoothing: _Smoothing
    fingerprint: _Fingerprint
    exact_energy_at_start: _Energy
    nl: _File
    best_known: _Best | None


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of an exported folder.

    Raises:
        ExportError: it is missing, or an entry that is needed is missing or wrong.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ExportError(
            "manifest.json cannot be read",
            where=folder,
            found=error,
            hint="soup-nlp export PROBLEM.yaml -o DIR makes one",
        ) from error
    try:
        known = _Manifest.model_validate(manifest)
    except ValidationError as error:
        first = error.errors()[0]
        raise ExportError(
            "manifest.json has an entry that cannot be used",
            where=f"{folder / MANIFEST}, {'.'.join(map(str, first['loc']))}",
            found=first["msg"],
            hint="export again",
        ) from None
    return {
        **manifest,
        "formulation": known.formulation.model_dump(),
        "smoothing": known.smoothing.model_dump(),
    }


def kept_best(folder: Path, sha256: str) -> dict[str, Any] | None:
    """best_known of a manifest that is there already, if it is of the same file."""
    try:
        old = read_manifest(folder)
    except ExportError:
        return None
    best: dict[str, Any] | None = old["best_known"]
    return best if old["nl"]["sha256"] == sha256 else None


def remove_stale(folder: Path, written: Sequence[str]) -> None:
    """Remove what the manifest of an earlier export lists and this one does not write.

    Files that no export writes are never touched, whatever the manifest says.
    """
    try:
        listed = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["files"]
        names = {str(name) for name in listed}
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in (names & OWN).difference(written):
        (folder / name).unlink(missing_ok=True)
