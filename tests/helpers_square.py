"""Work for processes of their own, which import this module alone."""

from __future__ import annotations

import os


def square(number: int, breaks: bool = False) -> dict:
    """A row that another process makes."""
    if breaks:
        raise ValueError("out of numbers")
    return {"square": number**2, "process": os.getpid()}
