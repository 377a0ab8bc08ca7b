"""What the law is given: the compensator's model (from identification) and its parameters (from the configuration).

Both are plain arrays and numbers. Neither knows a file; `Parameters.pack` turns the parameters into one flat vector so
that they cross from the process that validated them to the loop through shared memory, and are stored in recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from thermoctl.control.faults import CHANNELS, TEMPERATURES

MAX_ORDER = 24
M = len(TEMPERATURES)


@dataclass(frozen=True)
class CompensatorModel:
    """Thermal state space model, its estimator's gain, and the expansion model.

    State (33), in delta form so that nothing is lost near 1: x(n+1) = x(n) + A_minus_I x(n) + B q(n), every `period_s`;
    q = [electrical power W, rate of the air temperature K/s]; C x are the twelve rises above the air, K.

    kind      'mkf': the scalar Riccati recursion (34), (35) with first row of A, R_w, R_v and gain = the map zeta (36);
              'kalman': gain K of a steady Kalman filter, one column per sensor.
    gain      (n, s): one column per sensor that corrects, K (or zeta) per K of innovation.
    sensors   (s,) which of the twelve temperatures they are; the first must be the coil (0). 'mkf' has just the coil.
    f1, b1, b2, b_air: yL(n+1) = f1 yL(n) + b1 . T(n-1) + b2 . T(n) + b_air (air - air at start) (39), um, every
              `expansion_period_s`; offset_um is added to its output.
    air_filter_s: time constant of the low-pass from which the rate of the air is taken.
    Raises ValueError when shapes or numbers do not fit together.
    """

    kind: str
    period_s: float
    A_minus_I: np.ndarray
    B: np.ndarray
    C: np.ndarray
    gain: np.ndarray
    R_w: float
    R_v: float
    f1: float
    b1: np.ndarray
    b2: np.ndarray
    expansion_period_s: float
    sensors: tuple[int, ...] = (0,)
    b_air: float = 0.0
    offset_um: float = 0.0
    air_filter_s: float = 60.0
    meta: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("A_minus_I", "B", "C", "gain", "b1", "b2"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64, order="C"))
        n, s = self.A_minus_I.shape[0], len(self.sensors)
        if self.gain.ndim == 1:
            object.__setattr__(self, "gain", self.gain.reshape(-1, 1))
        shapes = {"A_minus_I": (n, n), "B": (n, 2), "C": (M, n), "gain": (n, s), "b1": (M,), "b2": (M,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"compensator model: {name} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"compensator model: {name} holds a number that is not finite")
        if self.kind not in ("mkf", "kalman"):
            raise ValueError(f"compensator model: kind is '{self.kind}', expected 'mkf' or 'kalman'")
        if n > MAX_ORDER:
            raise ValueError(f"compensator model: order {n}, expected at most {MAX_ORDER}")
        if not self.sensors or self.sensors[0] != 0 or not all(0 <= j < M for j in self.sensors):
            raise ValueError(
                f"compensator model: sensors {self.sensors}, expected 0 (the coil) first, all below {M}"
            )
        if self.kind == "mkf" and s != 1:
            raise ValueError("compensator model: the MKF corrects by the coil alone")
        positive = {
            "period_s": self.period_s,
            "expansion_period_s": self.expansion_period_s,
            "R_v": self.R_v,
            "air_filter_s": self.air_filter_s,
        }
        for name, number in positive.items():
            if not (np.isfinite(number) and number > 0.0):
                raise ValueError(f"compensator model: {name} is {number}, expected a number above 0")
        if not (
            np.isfinite(self.R_w)
            and self.R_w >= 0.0
            and np.isfinite([self.f1, self.b_air, self.offset_um]).all()
        ):
            raise ValueError(
                "compensator model: R_w, f1, b_air and offset_um must be finite, R_w not negative"
            )
        if abs(self.f1) >= 1.0:
            raise ValueError(
                f"compensator model: f1 is {self.f1}, expected |f1| < 1 (a stable expansion model)"
            )


def zero_model(period_s: float = 0.001) -> CompensatorModel:
    """A model that estimates no rise and no expansion: the loop without compensation."""
    return CompensatorModel(
        "mkf",
        period_s,
        np.full((1, 1), -period_s / 400.0),
        np.zeros((1, 2)),
        np.zeros((M, 1)),
        np.zeros(1),
        0.0,
        1.0,
        0.0,
        np.zeros(M),
        np.zeros(M),
        1.0,
    )


def _channels(value: float) -> np.ndarray:
    return np.full(len(CHANNELS), float(value))


@dataclass(frozen=True)
class Parameters:
    """Gains, limits and protection of one tick; a reload replaces them whole. Arrays are over CHANNELS.

    Defaults switch a limit off (inf), except the ones without which nothing may be driven.
    """

    kp: float
    ti_s: float
    td_s: float
    output_limit: float
    setpoint_rate_um_s: float = 1000.0 / 60.0
    setpoint_low_um: float = -np.inf
    setpoint_high_um: float = np.inf
    moving_average: float = 1.0  # samples, 1..MAX_AVERAGE
    compensate: float = 1.0  # 1 on, 0 off
    bound_um: float = np.inf
    slew_um_s: float = np.inf
    low: np.ndarray = field(default_factory=lambda: _channels(-np.inf))
    high: np.ndarray = field(default_factory=lambda: _channels(np.inf))
    rate: np.ndarray = field(default_factory=lambda: _channels(np.inf))  # largest change per second
    stale_s: np.ndarray = field(default_factory=lambda: _channels(np.inf))
    frozen_s: np.ndarray = field(default_factory=lambda: _channels(np.inf))
    required: np.ndarray = field(default_factory=lambda: _channels(0.0))  # 1: a fault of this reading trips
    following_um: float = np.inf
    following_s: float = 0.0
    coil_limit_c: float = np.inf
    coil_rate_k_s: float = np.inf
    coil_rate_time_s: float = 30.0
    innovation_limit_c: float = np.inf
    innovation_time_s: float = 30.0
    power_limit_w: float = np.inf
    power_time_s: float = 10.0
    idle_current_a: float = np.inf
    idle_power_w: float = np.inf
    idle_s: float = 0.5
    saturation_s: float = np.inf
    amplifier_s: float = 1.0
    late_s: float = np.inf
    agree_time_s: float = 0.5  # readings are compared in their means over this time
    drift_limit_c: float = np.inf  # coil's reading against the model alone
    monitored_limit_c: float = np.inf  # a watched temperature against its estimate
    resistance_ohm: float = 0.0  # of the coil at 20 degC; 0: not compared
    resistance_tolerance: float = 0.2
    resistance_v: float = 0.3
    current_per_drive: float = 0.0  # A per unit of drive of a current amplifier; 0: not compared
    current_tolerance_a: float = np.inf
    flexure_um_per_a: float = 0.0  # where a current holds the stage; 0: not compared
    position_tolerance_um: float = np.inf
    reference_tolerance_um: float = np.inf
    order_limit_c: float = np.inf  # how far two temperatures may stand the wrong way round

    def pack(self) -> np.ndarray:
        """All numbers as one flat float64 vector (fields in order, arrays in place)."""
        return np.concatenate(
            [np.atleast_1d(np.asarray(getattr(self, f.name), dtype=float)) for f in fields(self)]
        )

    @classmethod
    def unpack(cls, vector: np.ndarray) -> Parameters:
        """The reverse of `pack`. Raises ValueError for a vector of another length."""
        if len(vector) != len(NAMES):
            raise ValueError(f"parameters: {len(vector)} numbers, expected {len(NAMES)}")
        values: dict[str, Any] = {}
        start = 0
        for f in fields(cls):
            if f.name in _ARRAYS:
                values[f.name] = np.array(vector[start : start + len(CHANNELS)], dtype=np.float64)
                start += len(CHANNELS)
            else:
                values[f.name] = float(vector[start])
                start += 1
        return cls(**values)


_ARRAYS = ("low", "high", "rate", "stale_s", "frozen_s", "required")
NAMES = tuple(
    name
    for f in fields(Parameters)
    for name in ([f"{f.name}[{c}]" for c in CHANNELS] if f.name in _ARRAYS else [f.name])
)
"""The names of the numbers of `Parameters.pack`, in order."""
