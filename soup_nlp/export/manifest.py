"""manifest.json of an exported folder: description of the export and best known answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError, create_model

from soup_nlp.errors import ExportError
from soup_nlp.model.formulation import Coordinates
from soup_nlp.model.layout import GAUGES
from soup_nlp.model.norms import NormForm
from soup_nlp.storage.files import read_json

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


def _record(name: str, **kinds: Any) -> type[BaseModel]:
    """A model with required fields; further entries are ignored."""
    fields: dict[str, Any] = {key: (kind, ...) for key, kind in kinds.items()}
    return create_model(name, __config__=ConfigDict(strict=True), **fields)


_Best = _record("Best", exact_energy=FiniteFloat, found_by=str)
_Manifest = _record(
    "Manifest",
    formulation=_record(
        "Formulation",
        gauge=Literal[GAUGES],
        norm=Literal[NORMS],
        coordinates=Coordinates,
    ),
    smoothing=_record("Smoothing", eps=FiniteFloat, eps_pixel=FiniteFloat),
    fingerprint=_record("Fingerprint", objective=FiniteFloat, constraints=FiniteFloat),
    exact_energy_at_start=_record("Energy", total=FiniteFloat),
    nl=_record("File", sha256=str),
    best_known=_Best | None,
)
"""Entries that an import needs."""


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of an exported folder.

    Raises:
        ExportError: the file is missing, or a needed entry is missing or wrong.
    """
    manifest = read_json(folder / MANIFEST, MANIFEST, error=ExportError)
    try:
        known = _Manifest.model_validate(manifest).model_dump()
    except ValidationError as error:
        first = error.errors()[0]
        raise ExportError(
            "manifest.json has an entry that cannot be used",
            where=f"{folder / MANIFEST}, {'.'.join(map(str, first['loc']))}",
            found=first["msg"],
            hint="export again",
        ) from None
    return manifest | {key: known[key] for key in ("formulation", "smoothing")}


def kept_best(folder: Path, sha256: str) -> dict[str, Any] | None:
    """best_known of an existing manifest of the same .nl file; None otherwise."""
    try:
        old = read_manifest(folder)
    except ExportError:
        return None
    best: dict[str, Any] | None = old["best_known"]
    return best if old["nl"]["sha256"] == sha256 else None
