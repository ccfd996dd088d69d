"""Available memory, checked before large arrays are made."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import psutil

from soup_nlp.errors import DataError

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Files with the memory limit of a container."""


def usable_memory() -> int:
    """Bytes that this process can still allocate without swapping."""
    free = [int(psutil.virtual_memory().available)]
    for name in _LIMITS:
        with suppress(OSError, ValueError):
            free.append(int(Path(name).read_text()) - int(psutil.Process().memory_info().rss))
    return max(0, min(free))


def require_memory(size: float, what: str, where: object = None, hint: str | None = None) -> None:
    """Raise DataError if fewer than `size` bytes of memory are usable.

    Args:
        size: Bytes that will be allocated.
        what: What needs them, for the message.
        where: File or option concerned.
        hint: What to try.
    """
    usable = usable_memory()
    if size > usable:
        raise DataError(
            f"{what} would take more memory than this machine has",
            where=where,
            found=f"about {size / 1e9:.3g} GB",
            expected=f"at most {usable / 1e9:.3g} GB, which are free",
            hint=hint,
        )
