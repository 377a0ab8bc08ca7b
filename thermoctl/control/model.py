"""Inputs of the law besides its readings: the compensator's model and the parameters.

The model comes from identification, the parameters come from the configuration. Both are plain arrays and
numbers; neither knows a file. `Parameters.pack` makes one flat vector of the parameters. As such they cross
to the loop through shared memory, and are stored in recordings.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from operator import index
from typing import Any

import numpy as np

from thermoctl.control.limits import Limits
from thermoctl.rig.channels import DEFAULT, FIXED, MAX_POINTS

MAX_ORDER = 2 * MAX_POINTS


def _array(unit: str, *shape: str | int) -> Any:
    """Return the field of a float64 array; its shape in numbers, `n` states, `m` points, `s` sensors."""
    return field(metadata={"unit": unit, "shape": shape})


def _number(unit: str = "", default: Any = MISSING, positive: bool = False) -> Any:
    """Return the dataclass field of a scalar, with its unit and whether it must be positive."""
    return field(default=default, metadata={"unit": unit, "positive": positive})


def _numbers(name: str, value: Any) -> np.ndarray:
    """Return a copy as float64. Raises ValueError for texts and other things that are no numbers."""
    array = np.array(value, order="C")
    if array.dtype.kind not in "iuf":
        raise ValueError(f"compensator model: {name} holds something that is no number")
    return array.astype(np.float64)


@dataclass(frozen=True)
class CompensatorModel:
    """Thermal state space model, gain of its estimator, and the expansion model.

    State (33), in delta form so that no digits are lost near 1, every `period_s`:

        x(n+1) = x(n) + A_minus_I x(n) + B q(n),   q = [electrical power W, rate of the air temperature K/s]

    C x are the points' rises above the air, K, the coil's first. Expansion (39), um, each expansion period:

        yL(n+1) = f1 yL(n) + b1 . T(n-1) + b2 . T(n) + b_air (air - air at start)

    kind: 'kalman' or 'mkf'. With 'kalman' the gain is K of a steady Kalman filter. With 'mkf' it is the map
    zeta (36) of the scalar Riccati recursion (34), (35), which uses the first row of A, R_w and R_v. gain:
    (n, s), one column per correcting sensor, K (or zeta) per K of innovation. sensors: (s,) indices among the
    points; the first must be the coil (0). 'mkf' has only the coil. offset_um: added to the
    expansion model's output. air_filter_s: time constant of the low-pass filter that gives the rate of the
    air temperature. points: names of the points, m; () in a model that an older version made.

    Raises ValueError when shapes or numbers do not fit together. Files of models, recordings and the warm
    start's fingerprint derive from these fields."""

    kind: str
    period_s: float = _number("s", positive=True)
    A_minus_I: np.ndarray = _array("1 per period", "n", "n")
    B: np.ndarray = _array("K per W, K per (K/s)", "n", 2)
    C: np.ndarray = _array("K", "m", "n")
    gain: np.ndarray = _array("K/K", "n", "s")
    R_w: float = _number("K^2")
    R_v: float = _number("K^2", positive=True)
    f1: float = _number()
    b1: np.ndarray = _array("um/K", "m")
    b2: np.ndarray = _array("um/K", "m")
    expansion_period_s: float = _number("s", positive=True)
    sensors: tuple[int, ...] = (0,)
    b_air: float = _number("um/K", 0.0)
    offset_um: float = _number("um", 0.0)
    air_filter_s: float = _number("s", 60.0, positive=True)
    points: tuple[str, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ARRAYS:
            object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        object.__setattr__(self, "sensors", tuple(map(index, self.sensors)))
        if self.gain.ndim == 1:
            object.__setattr__(self, "gain", self.gain.reshape(-1, 1))
        m = len(np.atleast_1d(self.C))
        sizes = {"n": len(np.atleast_1d(self.A_minus_I)), "s": len(self.sensors), "m": m}
        for f in _MODEL_FIELDS:
            if "shape" in f.metadata:
                self._check_array(f.name, tuple(sizes.get(k, k) for k in f.metadata["shape"]))
            elif "positive" in f.metadata:
                self._check_number(f.name, f.metadata["positive"])
        if self.kind not in ("mkf", "kalman"):
            raise ValueError(f"compensator model: kind is '{self.kind}', expected 'mkf' or 'kalman'")
        if sizes["n"] > MAX_ORDER:
            raise ValueError(f"compensator model: order {sizes['n']}, expected at most {MAX_ORDER}")
        self._check_points(m)
        self._check_stable()

    def _check_stable(self) -> None:
        if self.R_w < 0.0:
            raise ValueError(f"compensator model: R_w is {self.R_w}, expected at least 0")
        if np.abs(1.0 + np.linalg.eigvals(self.A_minus_I)).max(initial=0.0) > 1.0 + 1e-9:
            raise ValueError("compensator model: A_minus_I has a pole outside the unit circle")
        if abs(self.f1) >= 1.0:
            raise ValueError(
                f"compensator model: f1 is {self.f1}, expected |f1| < 1 (a stable expansion model)"
            )

    def _check_points(self, m: int) -> None:
        if not self.sensors or self.sensors[0] != 0 or not all(0 <= j < m for j in self.sensors):
            raise ValueError(
                f"compensator model: sensors {self.sensors}, expected 0 (the coil) first, all below {m}"
            )
        named = len(self.points) in (0, m) and all(isinstance(p, str) for p in self.points)
        if not 1 <= m <= MAX_POINTS or not named:
            raise ValueError(
                f"compensator model: {m} points with {len(self.points)} names, expected 1 to {MAX_POINTS}, each named"
            )
        if self.kind == "mkf" and len(self.sensors) != 1:
            raise ValueError("compensator model: the MKF corrects by the coil alone")

    def _check_array(self, name: str, shape: tuple[Any, ...]) -> None:
        value = getattr(self, name)
        if value.shape != shape:
            raise ValueError(f"compensator model: {name} has shape {value.shape}, expected {shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"compensator model: {name} holds a number that is not finite")

    def _check_number(self, name: str, positive: bool) -> None:
        number = getattr(self, name)
        real = (
            isinstance(number, int | float | np.number)
            and not isinstance(number, bool)
            and -np.inf < number < np.inf
        )
        if not real or (positive and number <= 0.0):
            expected = "a number above 0" if positive else "a finite number"
            raise ValueError(f"compensator model: {name} is {number!r}, expected {expected}")


_MODEL_FIELDS = fields(CompensatorModel)
ARRAYS = tuple(f.name for f in _MODEL_FIELDS if "shape" in f.metadata)
"""The model's arrays."""
PLAIN = tuple(f.name for f in _MODEL_FIELDS if f.name not in (*ARRAYS, "meta"))
"""The model's other fields; `meta` is only a description."""
UNITS = {f.name: f.metadata["unit"] for f in _MODEL_FIELDS if f.metadata.get("unit")}


def zero_model(period_s: float = 0.001, points: tuple[str, ...] = DEFAULT.point_names) -> CompensatorModel:
    """Return a model that estimates no rise and no expansion: the loop without compensation."""
    m = len(points)
    return CompensatorModel(
        "mkf",
        period_s,
        np.full((1, 1), -period_s / 400.0),
        np.zeros((1, 2)),
        np.zeros((m, 1)),
        np.zeros(1),
        0.0,
        1.0,
        0.0,
        np.zeros(m),
        np.zeros(m),
        1.0,
        points=points,
    )


def _by_channel(value: float) -> Any:
    return field(default_factory=lambda: np.full(len(DEFAULT.names), value), metadata={"by_channel": value})


@dataclass(frozen=True)
class Gains:
    """Gains of the controller, and limits of each channel's readings (arrays over the channels).

    By default a reading has no limit and no channel is required."""

    kp: float
    ti_s: float
    td_s: float
    output_limit: float
    setpoint_rate_um_s: float = 1000.0 / 60.0
    setpoint_low_um: float = -np.inf
    setpoint_high_um: float = np.inf
    moving_average: float = 1.0  # samples, 1..MAX_AVERAGE
    compensate: float = 1.0  # 1 on, 0 off
    position_mode: float = 0.0  # 1: the drive takes a target position, um; 0: the controller's output
    bound_um: float = np.inf
    slew_um_s: float = np.inf
    low: np.ndarray = _by_channel(-np.inf)
    high: np.ndarray = _by_channel(np.inf)
    rate: np.ndarray = _by_channel(np.inf)  # largest change per second
    stale_s: np.ndarray = _by_channel(np.inf)
    frozen_s: np.ndarray = _by_channel(np.inf)
    required: np.ndarray = _by_channel(0.0)  # 1: a fault of this reading trips


@dataclass(frozen=True)
class Parameters(Limits, Gains):
    """Gains, limits and protection of one tick; a reload replaces them whole.

    The configuration gives each field by its name (daemon/tick/assemble.py); the law reads each by its name.
    """

    def pack(self) -> np.ndarray:
        """Return all numbers as one flat float64 vector (fields in order, arrays in place)."""
        return np.concatenate(
            [np.atleast_1d(np.asarray(getattr(self, f.name), dtype=float)) for f in fields(self)]
        )

    @classmethod
    def unpack(cls, vector: np.ndarray) -> Parameters:
        """Return the parameters of a packed vector. Raises ValueError for an impossible length."""
        channels, rest = divmod(len(vector) - (len(fields(cls)) - len(BY_CHANNEL)), len(BY_CHANNEL))
        if rest or not 1 <= channels - len(FIXED) <= MAX_POINTS:
            raise ValueError(
                f"parameters: {len(vector)} numbers, expected {packed_length(len(FIXED) + 1)} and "
                f"{len(BY_CHANNEL)} more a point"
            )
        values: dict[str, Any] = {}
        start = 0
        for f in fields(cls):
            if f.name in BY_CHANNEL:
                values[f.name] = np.array(vector[start : start + channels], dtype=np.float64)
                start += channels
            else:
                values[f.name] = float(vector[start])
                start += 1
        return cls(**values)


BY_CHANNEL = {f.name: f.metadata["by_channel"] for f in fields(Parameters) if "by_channel" in f.metadata}
"""Arrays over the channels, each with its default for a channel without an entry."""


def packed_length(channels: int) -> int:
    """Return the number of numbers of `Parameters.pack` for so many channels."""
    return len(fields(Parameters)) + (channels - 1) * len(BY_CHANNEL)


def packed_names(roles: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the numbers of `Parameters.pack`, in order, for these channels."""
    return tuple(
        name
        for f in fields(Parameters)
        for name in ([f"{f.name}[{role}]" for role in roles] if f.name in BY_CHANNEL else [f.name])
    )
