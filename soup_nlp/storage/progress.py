"""Progress of long work: a record of every iteration, its listeners, and interruption."""

import signal
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from types import FrameType

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
    during the writing of files. CasADi discards a KeyboardInterrupt from its callbacks; `aborted`
    records it.

    Args:
        say: Called in a signal handler, with the effect of this Ctrl-C.
        numbers: The signals.
    """

    def __init__(
        self, say: Callable[[str], None] | None = None, numbers: Iterable[int] = SIGNALS
    ) -> None:
        self._handling = handling(self._set, numbers)
        self.event = threading.Event()
        self.at_once = self.deferred = self.aborted = False
        self._say = say or (lambda line: None)

    def __enter__(self) -> threading.Event:
        self._handling.__enter__()
        return self.event

    def _set(self, number: int, frame: FrameType | None) -> None:
        if self.deferred:
            self._say("interrupt received: the files are being written, this ends then")
        elif self.at_once or self.event.is_set():
            if not self.event.is_set():
                self._say("interrupt received before there was a start: this ends at once")
            self.event.set()
            self.aborted = True
            raise KeyboardInterrupt
        else:
            self._say(
                "interrupt received: the best iterate so far will be written with every file; a"
                " second interrupt aborts at once"
            )
        self.event.set()

    def __exit__(self, *exc: object) -> None:
        self._handling.__exit__(None, None, None)


def raising() -> list[int]:
    """Signals that would raise KeyboardInterrupt, which CasADi discards in its callbacks."""
    return [n for n in SIGNALS if signal.getsignal(n) is signal.default_int_handler]
