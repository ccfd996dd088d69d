"""Ctrl-C as an event: a solve ends at its next iteration and keeps the best iterate."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


class interruptible:  # noqa: N801
    """Context in which Ctrl-C sets an event instead of raising (main thread only).

    The second Ctrl-C raises KeyboardInterrupt, except while `deferred` is set, as during the
    writing of files. CasADi swallows one that is raised in its callbacks; `aborted` records it.

    Args:
        say: Told what a Ctrl-C does; it is called in a signal handler.
    """

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        self.event = threading.Event()
        self.deferred = self.aborted = False
        self._say = say or (lambda line: None)
        self._old: Any = None

    def __enter__(self) -> threading.Event:
        if threading.current_thread() is threading.main_thread():
            self._old = signal.signal(signal.SIGINT, self._set)
        return self.event

    def _set(self, number: int, frame: FrameType | None) -> None:
        if self.deferred:
            self._say("interrupt received: the files are being written, this ends then")
        elif self.event.is_set():
            self.aborted = True
            raise KeyboardInterrupt
        else:
            self._say(
                "interrupt received: the best iterate will be kept and every file written;"
                " without a start this ends after the stage; once more aborts"
            )
        self.event.set()

    def __exit__(self, *exc: object) -> None:
        if self._old is not None:
            signal.signal(signal.SIGINT, self._old)
