"""One row of the configuration's table: a dataclass field with unit, range, default and meaning."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

# Largest change of a gain at once while ARMED. It is less than the gain margin of 2 that `tune` proposes: a
# stable loop stays stable.
LIVE_STEP = 1.5
# Largest change of a gain in one tuning. The recording was made with the present loop, whose motion hardly
# reaches the frequencies at which a loop several times faster has its margins.
TRIAL_FACTOR = 3.0


@dataclass(frozen=True)
class Option:
    """Properties of one option besides its type and default."""

    unit: str
    low: float
    high: float
    restart: bool
    meaning: str
    choices: tuple[str, ...] = ()


def option(
    meaning: str,
    default: Any = dataclasses.MISSING,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    restart: bool = False,
    choices: tuple[str, ...] = (),
    factory: Any = dataclasses.MISSING,
) -> Any:
    """Return the dataclass field of one option; without default or factory the option must be given."""
    return field(
        default=default,
        default_factory=factory,
        kw_only=True,
        metadata={"option": Option(unit, low, high, restart, meaning, choices)},
    )
