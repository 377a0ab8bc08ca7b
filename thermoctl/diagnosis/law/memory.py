"""Memories of a signal z, for laws that depend on its history: nodes of the plant, and values for regression.

- lag: follows z with the time constant tau.
- total: the integral of z since the start, divided by the duration of the longest recording.
- relay: 1 beyond the threshold `on`, 0 beyond the threshold `off`, unchanged between them, such as a
  thermostat or a siphon. `on` is the upper threshold or the lower one.

The relay is the non-ideal relay of Visintin, Differential Models of Hysteresis (1994), section I.2. As a node
it is a trigger with positive feedback (Schmitt, J. Sci. Instrum. 15 (1938) 24):

    dm/dt = ((1 + tanh(6 s + 10 (m - 1/2))) / 2 - m) / sample
    s = (z - (on + off) / 2) / (on - off)

Its two stable states end where ds/dm = 0, at s = 0.505 and -0.505. It switches within a few samples; faster
switching would not show. It starts at 0.5 and goes to the stable state that s selects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnosis.search.overlay import filtered

Shapes = Mapping[str, np.ndarray]
Along = Callable[[np.ndarray, np.ndarray, Shapes, float], np.ndarray]


@dataclass(frozen=True)
class SignalMemory:
    """A memory m of a signal z.

    - `rate`: dm/dt, of z, m, the form's shapes, `duration` (of the longest run) and `sample`, s
    - `start`, `start_sigma`: m at the first sample, and its standard deviation
    - `words`: a description of m for a report
    - `along`: m (N, k) along t (N,) and z (N,), for k values of each shape and a duration"""

    rate: str
    start: str
    start_sigma: float | None
    words: str
    along: Along


def _lag(t: np.ndarray, z: np.ndarray, shapes: Shapes, duration: float) -> np.ndarray:
    decay = np.exp(-np.diff(t)[:, None] / shapes["tau"])
    start = np.full((1, decay.shape[1]), z[0])
    return np.concatenate([start, filtered(decay, (1 - decay) * z[:-1, None], start)])


def _total(t: np.ndarray, z: np.ndarray, shapes: Shapes, duration: float) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(z[:-1] * np.diff(t))])[:, None] / duration


def _relay(t: np.ndarray, z: np.ndarray, shapes: Shapes, duration: float) -> np.ndarray:
    on, off = shapes["on"], shapes["off"]
    s = (z[:, None] - 0.5 * (on + off)) / (on - off)
    outside = np.abs(s) >= 0.5
    outside[0] = True
    last = np.maximum.accumulate(np.where(outside, np.arange(len(s))[:, None], 0))
    return np.take_along_axis(s >= 0, last, axis=0).astype(float)


MEMORIES = {
    "lag": SignalMemory("(z - m) / tau", "0", 0.1, "{z}, delayed by a first-order lag of {tau}", _lag),
    "total": SignalMemory(
        "z / duration", "0", 0.1, "the integral of {z} since the start, over {duration} s", _total
    ),
    "relay": SignalMemory(
        "((1 + tanh(6 * (z - 0.5 * (on + off)) / (on - off) + 10 * (m - 0.5))) / 2 - m) / sample",
        "0.5",
        None,
        "1 after {z} passed {on}, 0 after it passed {off}",
        _relay,
    ),
}
