"""The machine and the code that a measurement belongs to."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from soup_nlp.storage.versions import code_version, versions


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
