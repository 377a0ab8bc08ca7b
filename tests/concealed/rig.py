"""What the generator needs to know of a rig family, and helpers to write its plant file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from tests.concealed.thermal import Variant


@dataclass(frozen=True)
class Suspect:
    """An effect at a place. `make(size)` gives its parameters at `size` (1: typical); `top` the largest sensible."""

    effect: str
    where: str
    make: Callable[[float], dict]
    top: float = 8.0
    onset: str | None = None
    aliases: tuple[str, ...] = ()  # other places that name the same thing


@dataclass
class Scene:
    """One rig on one day: the plant file, the truth's parameters, the runs and the sensors."""

    plant: dict
    theta: dict[str, float]
    ranges: dict[str, tuple[float, float]]  # of the parameters a refit may move
    starts: dict[str, float]  # initial_sigma by node
    runs: list[dict]  # t, inputs and everything the truth wants
    columns: dict[str, str]  # recorded input column -> key in run
    outputs: list[str]
    sd: np.ndarray
    resolution: np.ndarray
    outputs_of: Callable[[int, list[Variant]], np.ndarray]  # (run, rows) -> (m, N, ny) readings without noise
    suspects: list[Suspect] = field(default_factory=list)
    unknowns: list[Suspect] = field(default_factory=list)
    rough_of: Callable[[int, list[Variant]], np.ndarray] | None = None  # outputs_of with fewer volumes

    @classmethod
    def of(cls, plant: dict, theta: dict, runs: list[dict], columns: dict[str, str], *truth: Any) -> Scene:
        """A scene whose ranges, starts and sensors are those of its plant file. `truth`: outputs_of and what follows it."""
        outputs = plant["outputs"]
        ranges = {q: tuple(p["range"]) for q, p in plant["parameters"].items() if "range" in p}
        starts = {n: x["initial_sigma"] for n, x in plant["nodes"].items() if "initial_sigma" in x}
        sd = np.array([o["noise"] for o in outputs.values()])
        resolution = np.array([o.get("resolution", 0.0) for o in outputs.values()])
        return cls(plant, theta, ranges, starts, runs, columns, list(outputs), sd, resolution, *truth)

    def changes_of(self, k: int, rows: list[Variant], rough: bool) -> np.ndarray:
        """Changes (m - 1, N, ny) of the readings from those of the first of `rows`; rough: of fewer volumes, where that saves time."""
        y = (rough and self.rough_of or self.outputs_of)(k, rows)
        return y[1:] - y[:1]


class Family(Protocol):
    """A rig family."""

    name: str

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        """Draw a rig, its parameters and its two runs; `vigour` scales an electric drive's current."""
        ...


def off_centre(value: float, low: float, high: float, rng: np.random.Generator) -> float:
    """A true value away from the belief's, well inside its range (log-uniform where the sign is fixed)."""
    if low > 0:
        up, down = np.log(high / value), np.log(value / low)
        step = rng.uniform(0.15, 0.6) * (up if rng.random() < 0.5 else -down)
        return float(value * np.exp(step * 0.7))
    step = rng.uniform(0.1, 0.5) * ((high - value) if rng.random() < 0.5 else -(value - low))
    return float(value + step * 0.7)


def clock(n: int, period: float, rng: np.random.Generator) -> np.ndarray:
    """Sampling times (n,) with jitter, as recorded (they are the true ones)."""
    jitter = rng.choice([0.0, 0.01, 0.03]) * period
    t = np.arange(n) * period + np.clip(rng.standard_normal(n), -3, 3) * jitter
    return np.round(t - t[0], 6)


def room(t: np.ndarray, rng: np.random.Generator, swing: float) -> np.ndarray:
    """Air temperature (N,) degC: daily and air-conditioning waves and a slow ramp."""
    span = t[-1]
    air = rng.uniform(19.5, 23.5) + swing * rng.uniform(-1, 1) * t / span
    for _ in range(3):
        air = air + swing * rng.uniform(0.1, 0.5) * np.sin(
            2 * np.pi * t / (span * rng.uniform(0.2, 1.2)) + rng.uniform(0, 6)
        )
    return np.round(air, 5)


def levels(
    t: np.ndarray, rng: np.random.Generator, schedule: str, top: float, hold: float, quiet: float = 0.1
) -> np.ndarray:
    """A drive level (N,) of steps: warm-up (one long hold, then rest), production-like (cycles round one level),
    designed (many levels and lengths, with rests)."""
    span = t[-1]
    out = np.zeros(len(t))
    if schedule == "warm-up":
        on, off = rng.uniform(0.03, 0.08) * span, rng.uniform(0.6, 0.72) * span
        out[(t >= on) & (t < off)] = top * rng.uniform(0.75, 1.0)
        return out
    now = rng.uniform(0.01, quiet) * span
    base = top * rng.uniform(0.5, 0.8)
    while now < span:
        length = hold * rng.uniform(0.5, 2.0)
        if schedule == "production-like":
            level = base * rng.uniform(0.85, 1.2) if rng.random() < 0.7 else 0.0
            if now > 0.75 * span:
                level = 0.0
        else:
            level = top * rng.choice([0, 0, 0.3, 0.55, 0.8, 1.0])
        out[(t >= now) & (t < now + length)] = level
        now += length
    return out
