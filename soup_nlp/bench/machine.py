"""The machine and the code that a measurement belongs to."""

from __future__ import annotations

import hashlib
import os
import platform
from functools import cache
from pathlib import Path

from soup_nlp.storage.store import versions

PACKAGE = Path(__file__).resolve().parents[1]

CODE = (
    *(f"{room}/*.py" for room in ("data", "geometry", "model", "mrf", "start", "solve")),
    *("cases.py", "inputs.py"),
)
"""Sources that a solve without refinement runs through: they make the code of its seconds."""


def machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions, as text."""
    memory = 0.0
    if "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "memory": f"{memory:.0f} GB" if memory else "unknown",
        "system": f"{platform.system()} {platform.machine()}",
        **versions(),
        "code": code_version(),
    }


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or "unknown"
    lines = [line for line in text.splitlines() if line.startswith("model name")]
    return lines[0].partition(":")[2].strip() if lines else platform.machine()


@cache
def code_version() -> str:
    """Hash of what a solve runs through; benchmarks, reports and commands are not part of it."""
    digest = hashlib.sha256()
    for path in sorted({file for pattern in CODE for file in PACKAGE.glob(pattern)}):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
