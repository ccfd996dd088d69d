"""Rows that need no solve, in a module that worker processes import quickly."""

import os
from typing import Any


def fake_row(scene: str, dies: bool = False) -> dict[str, Any]:
    """A row without a solve; the row of the sheet fails, and the process of the room may die."""
    if scene == "room" and dies:
        os._exit(3)
    ok = scene != "sheet"
    return {"ok": ok, "error": None if ok else "no", "seconds": 0.0}


def square(number: int, breaks: bool = False) -> dict[str, Any]:
    """A row that another process measures."""
    if breaks:
        raise ValueError("out of numbers")
    return {"square": number**2, "process": os.getpid(), "threads": threads()}


def threads() -> list[str | None]:
    """The number of threads that libraries read from the environment."""
    return [os.environ.get(f"{name}_NUM_THREADS") for name in ("OMP", "OPENBLAS", "MKL", "BLIS")]
