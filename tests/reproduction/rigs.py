"""Simulated rigs for the reproduction, each with physics that no identified model has.

A rig uses the plant file's truth, with its fast electromechanics replaced by the quasi-static equivalent
(plants.py). The position loop settles in milliseconds, heat takes minutes. The current holds the flexures and
overcomes the eddy damping, i = (k x + b v) / k_T, with x the reference after the rate limiter.

Each seed has other heat capacities, conductances and expansions (SPREAD). Each day has another natural
convection (CONVECTION), bench temperature and chamber drift. Unmeasured heat in three bodies is a first-order
random process with time constant HEAT_TAU_S.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg
from scipy.signal import lfilter

from tests.reproduction.plants import HEATED, hidden_masses, quasi_static
from thermoctl.calibration.chain import NOISE_K, STEP_K
from thermoctl.calibration.recorded import Recorded
from thermoctl.identify import filter, kernels
from thermoctl.identify.experiments import Schedule
from thermoctl.plant import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl.rig.signals import POINTS

PAPER_SCALE = {
    "a_bobbin": 1.5,
    "a_bobbin_connector": 1.5,
    "a_shaft_1": 1.5,
    "a_shaft_2": 1.5,
    "a_bracket_1": 7.5,
}
"""Factor on the plant file's expansion: a longer shaft, and a long arm under the encoder's head.

It gives errors of the paper's size: 5.7 +- 7.3 um without compensation, +-2.3 um with the coil alone.
"""
HEAT_W, HEAT_TAU_S = (0.012, 1800.0)  # unmeasured heat in each of HEATED: rms, and correlation time
# The chamber, K: spread of the day's level, amplitude over SWING_S, random drift over WANDER_S.
AIR_K = (0.25, 0.35, 0.12)
SWING_S, WANDER_S = (12000.0, 28000.0), 2500.0
# Factor on the chamber's and the bench's drift in the report's rigs (study.py).
CHAMBER = 0.6
# Largest relative deviation of a seed's parameters from the plant file, by prefix of their names.
SPREAD = {"C_": 0.08, "G_": 0.15, "H_": 0.15, "a_": 0.10, "N_": 0.15}
CONVECTION = 0.06  # spread of a day's convection, share
NEUTRAL_C, BENCH_K = 22.0, 0.3  # mean of chamber and bench; spread of the bench's day
ENCODER_STEP_UM, ENCODER_NOISE_UM = 0.005, 0.015  # of the difference between the two encoders
AIR_STEP_C, AIR_NOISE_C = 0.01, 0.02
METER_SPREAD, METER_NOISE_W = 0.005, 0.002  # of the power meter: gain from rig to rig, and noise
PROOF_DAY = 4  # test 4: disturbances come after its calibration part
CALIBRATED_S = 7200.0  # end of test 4A in test 4
FINE = 10  # steps of the motion in a second


@dataclass(frozen=True)
class Simulated(Recorded):
    """A test of a simulated rig, with the truth: temperatures true_c (N, points), position error true_um (N,)."""

    true_c: np.ndarray
    true_um: np.ndarray


def _outside_heat(t: np.ndarray, late: np.ndarray, columns: dict[str, np.ndarray]) -> None:
    """Heat the stator with 0.4 W for 75 minutes."""
    columns["heat_outer_stator"] = columns["heat_outer_stator"] + 0.4 * (late & (t > 9000) & (t < 13500))


def _changed_air(t: np.ndarray, late: np.ndarray, columns: dict[str, np.ndarray]) -> None:
    """Let the chamber become 1.5 K warmer, with 20 minutes' time constant."""
    rise = 1.5 * (1 - np.exp(-(t - CALIBRATED_S).clip(0) / 1200))
    columns["air"] = columns["air"] + np.where(late, rise, 0)


@dataclass(frozen=True)
class Disturbance:
    """A change of a rig that the methods do not know.

    Sensors and motion differ always, the rest after calibration.
    """

    inputs: Callable[[np.ndarray, np.ndarray, dict[str, np.ndarray]], None] | None = None
    # factors on parameters, by prefix of their names
    factors: Mapping[str, float] = field(default_factory=dict)
    speed: float = 1.0  # factor of the velocity
    friction_w: float = 0.0  # heat while it moves faster than 1 um/s
    lag_s: float = 0.0  # additional lag of the thermocouples
    coarse_k: float = 0.0  # additional rounding step of the thermocouples' readings
    missing: float = 0.0  # share of missing readings


DISTURBANCES = {
    "outside_heat": Disturbance(inputs=_outside_heat),
    "fan": Disturbance(factors={"H_": 1.4, "N_": 1.4}),
    "changed_air": Disturbance(inputs=_changed_air),
    "stuck_quantisation": Disturbance(coarse_k=0.5),
    "sensor_lag": Disturbance(lag_s=25.0),
    "missing_samples": Disturbance(missing=0.3),
    "faster_motion": Disturbance(speed=40.0, friction_w=0.15),
    "aged_joint": Disturbance(
        factors={"G_stator_connector_bracket_1": 0.6, "G_bobbin_bobbin_connector": 0.6}
    ),
}
NONE = Disturbance()


@dataclass(frozen=True)
class _Day:
    """One day of a rig: parameters, the inputs of its thermal plant at 1 s, random numbers."""

    t: np.ndarray
    parameters: dict[str, float]
    columns: dict[str, np.ndarray]
    rng: np.random.Generator
    calibrated_s: float | None  # time after which the rig changes; None: it does not

    @property
    def changed_from(self) -> int:
        """Return the first row, at 1 s a row, of the changed plant; unused where `calibrated_s` is None."""
        return int(self.calibrated_s or 0)


class ProvingRig:
    """One seed's rig.

    `run(schedule, day)` simulates a test on a day; the same arguments give the same recording. `air`, `bench`
    and `heat` are factors on the chamber's drift, the bench's drift and the unmeasured heat.
    """

    def __init__(
        self,
        plant: Plant,
        seed: int,
        disturbance: str | None = None,
        scale: Mapping[str, float] | None = None,
        air: float = 1.0,
        bench: float = 1.0,
        heat: float = 1.0,
    ):
        self.seed, self.disturbance = seed, DISTURBANCES[disturbance] if disturbance else NONE
        self.air_k, self.bench, self.heat_w = tuple(air * v for v in AIR_K), bench, heat * HEAT_W
        p = {k: v.value for k, v in plant.parameters.items()}
        self.electrical = {k: p[k] for k in ("k_flexure", "k_T", "b_eddy")}
        self.model = compile_plant(hidden_masses(quasi_static(plant)))
        names = list(self.model.outputs)
        self.order = [names.index(f"{q}_c") for q in POINTS] + [names.index("error_um")]
        self.power = names.index("power_w")
        rng = np.random.default_rng([seed, 1])
        self.base = {
            k: v.value * (1 + SPREAD.get(k[:2], 0.0) * rng.uniform(-1, 1))
            for k, v in self.model.plant.parameters.items()
        }
        for k, factor in (scale or {}).items():
            self.base[k] *= factor
        self.meter_gain = 1 + METER_SPREAD * rng.standard_normal()

    def run(self, schedule: Schedule, day: int, noise: bool = True) -> Simulated:
        """Simulate a test at 1 s.

        `noise` False: the same day with perfect instruments and without the unmeasured heat."""
        return self._read(self._day(schedule, day, noise), schedule, noise)

    def _day(self, schedule: Schedule, day: int, noise: bool) -> _Day:
        rng = np.random.default_rng([self.seed, 2, day])
        t = np.arange(int(schedule.duration_s) + 1, dtype=float)
        p = dict(self.base)
        convection = 1 + CONVECTION * rng.standard_normal()
        for k in p:
            if k[:2] in ("N_", "H_"):
                p[k] *= convection
        p["T_bench"] = NEUTRAL_C + self.bench * BENCH_K * rng.standard_normal()
        p["bench_swing"] *= self.bench
        level, swing, wander = self.air_k
        air = (
            NEUTRAL_C
            + level * rng.standard_normal()
            + swing * np.sin(2 * np.pi * (t / rng.uniform(*SWING_S) + rng.uniform()))
            + wander * _walk(rng, len(t), WANDER_S)
        )
        heat = {f"heat_{b}": self.heat_w * noise * _walk(rng, len(t), HEAT_TAU_S) for b in HEATED}
        columns = {**self._motion(schedule, len(t)), "air": air, **heat}
        late = t > CALIBRATED_S if day == PROOF_DAY else np.ones(len(t), bool)
        if self.disturbance.inputs and day >= PROOF_DAY:
            self.disturbance.inputs(t, late, columns)
        change = (CALIBRATED_S if day == PROOF_DAY else 0.0) if day >= PROOF_DAY else None
        return _Day(t, p, columns, rng, change if self.disturbance.factors else None)

    def _motion(self, schedule: Schedule, n: int) -> dict[str, np.ndarray]:
        """Compute coil current, rms, and eddy heat of each second."""
        e, d = self.electrical, self.disturbance
        x = schedule.at(np.arange(0, n * FINE) / FINE)
        v = d.speed * np.gradient(x, 1 / FINE)
        i = (e["k_flexure"] * x * 1e-6 + e["b_eddy"] * v * 1e-6) / e["k_T"]
        eddy = (e["b_eddy"] * (v * 1e-6) ** 2).reshape(n, FINE).mean(1)
        eddy += d.friction_w * (np.abs(v).reshape(n, FINE).mean(1) > 1)
        return {"current": np.sqrt((i**2).reshape(n, FINE).mean(1)), "eddy_w": eddy}

    def _simulated(self, day: _Day) -> np.ndarray:
        """Simulate the plant's outputs (N, ny) over a day."""
        if day.calibrated_s is None:
            return self.model.simulate(Table("rig", "rig", day.t, day.columns), day.parameters).y
        factors = self.disturbance.factors
        changed = {
            k: v * next((f for start, f in factors.items() if k.startswith(start)), 1.0)
            for k, v in day.parameters.items()
        }
        u = np.column_stack([day.columns[k] for k in self.model.inputs])
        rows = np.empty((len(day.t), len(self.model.outputs)))
        before = self.model.stepper(1.0, u[0], day.parameters)
        after = self.model.stepper(1.0, u[0], changed)
        for k in range(len(day.t)):
            if k == day.changed_from:  # the changed plant continues from the first one's state
                after.x[:] = before.x
            rows[k] = (before if k < day.changed_from else after).step(u[k])
        return rows

    def _read(self, day: _Day, schedule: Schedule, noise: bool) -> Simulated:
        """Return the readings of the rig's instruments from the plant's outputs."""
        y, rng, d = self._simulated(day), day.rng, self.disturbance
        true_c, true_um = y[:, self.order[:-1]], y[:, self.order[-1]] - y[0, self.order[-1]]
        measured = true_c.copy()
        if d.lag_s:
            for k in range(1, len(day.t)):
                measured[k] = measured[k - 1] + (true_c[k] - measured[k - 1]) / d.lag_s
        if noise:
            measured = _stepped(measured + NOISE_K * rng.standard_normal(measured.shape), STEP_K)
        if noise and d.coarse_k:
            measured = _stepped(measured, d.coarse_k)
        if d.missing:
            measured[rng.random(measured.shape) < d.missing] = np.nan
            for start in rng.integers(0, len(day.t), 6):  # and six gaps of four minutes
                measured[start : start + 240] = np.nan
        error, air = true_um, day.columns["air"]
        if noise:
            error = _stepped(error + ENCODER_NOISE_UM * rng.standard_normal(len(error)), ENCODER_STEP_UM)
            air = _stepped(air + AIR_NOISE_C * rng.standard_normal(len(air)), AIR_STEP_C)
        power = y[:, self.power] * self.meter_gain + METER_NOISE_W * rng.standard_normal(len(air))
        return Simulated(day.t, power, air, measured, error, schedule.at(day.t), true_c, true_um)

    def bayes(self, schedule: Schedule, day: int, recorded: Recorded) -> np.ndarray:
        """Estimate the position error (N,) with the best possible filter: a bound for all methods.

        A Kalman filter about the true plant's own run. It has the day's true parameters and air, the true
        statistics of the unmeasured heat, and the same single coil sensor.
        """
        today = self._day(schedule, day, noise=False)
        nominal = self._read(today, schedule, noise=False)
        a, b, c = self._linearised(today)
        n, m = len(a), b.shape[1]
        f = np.exp(-1 / HEAT_TAU_S)
        big = np.block([[a, b], [np.zeros((m, n)), f * np.eye(m)]])
        q = np.zeros((n + m, n + m))
        q[n:, n:] = max(self.heat_w, 1e-6) ** 2 * (1 - f * f) * np.eye(m)
        q[:n, :n] = 1e-12 * np.eye(n)
        coil, error = (np.append(c[self.order[j]], np.zeros(m)) for j in (0, -1))
        r = filter.sensor_variance(STEP_K, NOISE_K)
        p = linalg.solve_discrete_are(big.T, coil[:, None], q, np.array([[r]]))
        gain = p @ coil / (coil @ p @ coil + r)
        innovation = recorded.temperatures[:, :1] - nominal.true_c[:, :1]
        x = kernels.steady_filter(
            np.ascontiguousarray(big),
            np.zeros((n + m, 1)),
            np.ascontiguousarray(coil[None]),
            np.ascontiguousarray(gain[:, None]),
            np.zeros(n + m),
            np.zeros((len(innovation), 1)),
            np.ascontiguousarray(innovation),
        )
        return nominal.true_um + x @ error

    def _linearised(self, day: _Day) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute A, B (of the unmeasured heat) and C of a step of one second, by differences."""
        inputs = list(self.model.inputs)
        u0 = np.array([float(np.mean(day.columns[k])) for k in inputs])
        stepper = self.model.stepper(1.0, u0, day.parameters)
        for _ in range(3000):  # run to rest
            stepper.step(u0)
        x0 = stepper.x.copy()

        def step(dx: np.ndarray, du: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return states and outputs 1 s after the rest state plus `dx`, with the inputs plus `du`."""
            s = self.model.stepper(1.0, u0, day.parameters)
            s.x[:] = x0 + dx
            y = s.step(u0 + du).copy()
            return s.x.copy(), y

        n, h = len(x0), 0.01
        still_x, still_u = np.zeros(n), np.zeros(len(u0))
        base_x, base_y = step(still_x, still_u)
        a, ca = np.empty((n, n)), np.empty((len(self.model.outputs), n))
        for k in range(n):
            x1, y1 = step(h * np.eye(n)[k], still_u)
            a[:, k], ca[:, k] = (x1 - base_x) / h, (y1 - base_y) / h
        heat = [inputs.index(f"heat_{b}") for b in HEATED]
        b = np.column_stack([(step(still_x, h * np.eye(len(u0))[k])[0] - base_x) / h for k in heat])
        return a, b, ca @ np.linalg.inv(a)


def _stepped(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step


def _walk(rng: np.random.Generator, n: int, tau_s: float) -> np.ndarray:
    """Return an Ornstein-Uhlenbeck process of unit variance at 1 s."""
    f = np.exp(-1 / tau_s)
    w = rng.standard_normal(n) * np.sqrt(1 - f * f)
    w[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -f], w))


def joined(a: Schedule, b: Schedule, name: str) -> Schedule:
    """Join two schedules, one after the other."""
    return replace(
        a,
        name=name,
        t_s=np.concatenate([a.t_s, a.t_s[-1] + b.t_s[1:]]),
        setpoint_um=np.concatenate([a.setpoint_um, b.setpoint_um[1:]]),
        duration_s=a.duration_s + b.duration_s,
    )
