"""Progress of a solve: the record of an iteration, its listeners, and the event that stops it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field


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
