"""manifest.json of an exported folder: what was exported, and the best answer known."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from soup_nlp.errors import ExportError
from soup_nlp.export.bundles import FUNCTIONS
from soup_nlp.model.layout import GAUGES

STUB = "soup"
MANIFEST = "manifest.json"
NORMS = ("smooth", "epigraph")
TRUNCATIONS = ("smooth", "lifted")
OWN = frozenset(f"{STUB}{s}" for s in (".nl", ".col", ".row", ".h5")) | frozenset(
    f"{name}.casadi" for name in FUNCTIONS
)
"""Every file beside problem.yaml and the manifest that an export may write."""


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


Check = Callable[[object], bool]
NEEDED: Mapping[str, Mapping[str, Check]] = {
    "formulation": {
        "gauge": lambda v: v in GAUGES,
        "norm": lambda v: v in NORMS,
        "truncation": lambda v: v in TRUNCATIONS,
    },
    "smoothing": {"eps": _number, "eps_pixel": _number},
    "fingerprint": {"objective": _number, "constraints": _number},
    "exact_energy_at_start": {"total": _number},
    "nl": {"sha256": lambda v: isinstance(v, str)},
    "best_known": {"exact_energy": _number, "found_by": lambda v: isinstance(v, str)},
}
"""Entries that an import uses, and what they must be; best_known may be null."""


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
    if not isinstance(manifest, dict):
        raise ExportError("manifest.json is not a mapping", where=folder)
    missing = [key for key in NEEDED if key not in manifest]
    if missing:
        raise ExportError("manifest.json lacks entries", where=folder, found=missing)
    for key, checks in NEEDED.items():
        part = manifest[key]
        if key == "best_known" and part is None:
            continue
        if not isinstance(part, dict):
            raise _wrong(folder, key, part)
        for name, good in checks.items():
            if name not in part or not good(part[name]):
                raise _wrong(folder, f"{key}.{name}", part.get(name, "nothing"))
    # what is beyond these is for people
    for key in ("formulation", "smoothing"):
        manifest[key] = {name: manifest[key][name] for name in NEEDED[key]}
    return manifest


def _wrong(folder: Path, key: str, found: object) -> ExportError:
    return ExportError(
        "manifest.json has an entry that cannot be used",
        where=f"{folder / MANIFEST}, {key}",
        found=str(found)[:60],
        hint="export again",
    )


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
