"""Rows that need no solve, in a module that worker processes import quickly."""

import os
from typing import Any


def fake_row(scene: str, dies: bool = False) -> dict[str, Any]:
    """A row without a solve; the row of the sheet fails, and the process of the room may die."""
    if scene == "room" and dies:
        os._exit(3)
    ok = scene != "sheet"
    return {"ok": ok, "error": None if ok else "no", "seconds": 0.0}
