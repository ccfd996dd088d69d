"""Progress of long work: a record of every iteration, its listeners, and interruption."""

import signal
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from soup_nlp.errors import StoppedError
from soup_nlp.storage.system import SIGNALS, handling


@dataclass(frozen=True)
class Progress:
    """One iteration as it happens.

    Attributes:
        stage: Name of the stage.
        iteration: Counted from 0 in the stage.
        objective: f of the solver's form.
        infeasibility: Largest violation of a constraint.
        seconds: Since the stage began.
    """

    stage: str
    iteration: int
    objective: float
    infeasibility: float
    seconds: float

    def __str__(self) -> str:
        return (
            f"{self.stage:<16} it {self.iteration:>3}  f {self.objective:12.6g}"
            f"  infeasibility {self.infeasibility:8.1e}  {self.seconds:6.1f} s"
        )

    __repr__ = __str__


Listener = Callable[[Progress], None]


@dataclass(frozen=True)
class Watch:
    """Listeners of a solve, and the event that stops it.

    Attributes:
        listener: Called at every iteration.
        stop: Set it to end at the next iteration.
        say: Called with a line after every stage.
        log_file: A line of every iteration is appended here.
    """

    listener: Listener | None = None
    stop: threading.Event = field(default_factory=threading.Event)
    say: Callable[[str], None] = lambda line: None
    log_file: str | None = None


class interruptible:  # noqa: N801
    """Context in which Ctrl-C sets an event instead of raising (main thread only).

    SIGTERM does the same. The second signal raises KeyboardInterrupt, and the first one while
    `at_once` is set, as long as there is nothing to keep; neither does while `deferred` is set, as
    during the writing of files. Native code may discard a KeyboardInterrupt, or turn it into
    another exception: `aborted` records it, and the block ends with a KeyboardInterrupt for any.

    Args:
        say: Called in a signal handler, with the effect of this Ctrl-C.
        numbers: The signals.
        at_once: See above.
    """

    def __init__(
        self,
        say: Callable[[str], None] = lambda line: None,
        numbers: Iterable[int] = SIGNALS,
        at_once: bool = False,
    ) -> None:
        self._handling = handling(self.handle, numbers)
        self.event = threading.Event()
        self.at_once = at_once
        self.deferred = self.aborted = self._heard = False
        self._say = say

    def __enter__(self) -> threading.Event:
        self._handling.__enter__()
        return self.event

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal, also while an earlier one is being handled."""
        again, self._heard = self._heard, True
        if self.deferred:
            self._say("interrupt received: the files are being written, this ends then")
        elif self.at_once or again:
            self.aborted = True
            if not again:
                self._say("interrupt received before there was a start: this ends at once")
        else:
            self._say(
                "interrupt received: the best iterate so far will be written with every file; a"
                " second interrupt aborts at once"
            )
        if not again:
            # within the `set` that a second signal interrupts, it would wait for ever
            self.event.set()
        if self.aborted and not self.deferred:
            raise KeyboardInterrupt

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._handling.__exit__(None, None, None)
        # a StoppedError already says what is kept
        if self.aborted and isinstance(error, Exception) and not isinstance(error, StoppedError):
            raise KeyboardInterrupt from error


def raising() -> list[int]:
    """Signals that would raise KeyboardInterrupt, which CasADi discards in its callbacks."""

    def raises(handler: Any) -> bool:
        own = getattr(handler, "__self__", None)
        at_once = isinstance(own, interruptible) and own.at_once
        return at_once or handler is signal.default_int_handler

    return [number for number in SIGNALS if raises(signal.getsignal(number))]
