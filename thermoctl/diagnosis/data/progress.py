"""Time left of a diagnosis, from the time that its steps took so far. No decision depends on it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

FROM_S = 60.0  # after so many seconds of work the time left is reported
FINISH = 0.1  # share of a diagnosis after its search: 5 to 15 % with chains and networks of 12 to 120 bodies


@dataclass
class Pace:
    """Durations in s of the finished steps by kind, and the running step. `clock`: time in s, any origin."""

    clock: Callable[[], float] = time.monotonic
    started: float = field(init=False)
    spent: dict[str, list[float]] = field(default_factory=dict)
    step: tuple[str, float] | None = None

    def __post_init__(self) -> None:
        self.started = self.clock()

    def enter(self, kind: str) -> None:
        """End the running step, and start the next."""
        now = self.clock()
        if self.step:
            self.spent.setdefault(self.step[0], []).append(now - self.step[1])
        self.step = kind, now

    def left(self, planned: Mapping[str, float]) -> float | None:
        """Return the seconds that are left of a diagnosis.

        `planned`: number of steps of each kind, with the running one. None if a kind has no finished step."""
        if any(n > 0 and kind not in self.spent for kind, n in planned.items()):
            return None
        steps = sum(n * sum(self.spent[k]) / len(self.spent[k]) for k, n in planned.items() if n > 0)
        return (steps + FINISH * (self.clock() - self.started)) / (1 - FINISH)

    def left_text(self, planned: Mapping[str, float]) -> str:
        """Return the time left as the end of a sentence; '' before FROM_S or where it is not known."""
        left = self.left(planned)
        if left is None or self.clock() - self.started < FROM_S:
            return ""
        return f", about {left / 60:.0f} min left" if left > 90 else f", about {10 * round(left / 10)} s left"
