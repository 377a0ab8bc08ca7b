"""Systems of published papers: the equations, the settings, and the part that the paper calls known.

`System.draw(seed)` returns readings with the noise of the paper, simulated by scipy from the equations, not by the
plant language; the last recording is held out. Sources: Ebers, Steele, Kutz (2024), SIAM J. Appl. Dyn. Syst. 23:440
and its code, noise of 0.1; Rackauckas et al. (2020), arXiv 2001.04385, settings of the documentation of SciML;
Strouwen, Micluta-Campeanu (2026), arXiv 2604.01231; ModelingToolkitNeuralNets.jl, tutorial on friction; MATLAB's
demonstration of IDNLGREY with two tanks, with holes and voltages of ours; Wang (2026), arXiv 2606.23215,
whose building is not published: ours is after it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from thermoctl.recording.table import Table

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Run:
    """A recording to simulate: times, held inputs (N,), the start of each state."""

    t: np.ndarray
    u: dict[str, np.ndarray]
    x0: tuple[float, ...]


@dataclass(frozen=True)
class Drawn:
    """Readings of all runs, and the true states at the same times."""

    tables: list[Table]
    truth: list[dict[str, np.ndarray]]
    runs: list[Run]


@dataclass(frozen=True)
class System:
    """`rates`: dx/dt of each state from states and inputs. `missing`: by node the true law's rate dx/dt, a function
    of the signals and of its `coefficients`. `spoils`: sd of the noise by column and true states.
    `names`: effects of the catalogue that are the law, or parts of it.
    `window`: seconds of a forecast (a chaotic system forgets its start).
    `filtered`: the paper filters and differentiates the readings."""

    name: str
    plant: str
    states: tuple[str, ...]
    rates: Callable[[Values], list]
    missing: dict[str, Callable[..., np.ndarray]]
    coefficients: dict[str, tuple[float, ...]]
    reads: dict[str, str]  # column: state
    noise: Callable[[dict[str, np.ndarray]], dict[str, float]]
    runs: Callable[[np.random.Generator], list[Run]]
    names: frozenset[str] = frozenset()
    window: float | None = None
    filtered: bool = False

    def draw(self, seed: int) -> Drawn:
        """Simulate the runs of a seed. Noise is drawn after the inputs."""
        rng = np.random.default_rng(seed)
        tables, truth, runs = [], [], self.runs(rng)
        for k, run in enumerate(runs):
            x = solved(self.rates, self.states, run)
            sd = self.noise(x)
            read = {c: x[s] + sd[c] * rng.standard_normal(len(run.t)) for c, s in self.reads.items()}
            tables.append(Table(f"run_{k + 1}", f"run_{k + 1}.csv", run.t, {**run.u, **read}))
            truth.append(x)
        return Drawn(tables, truth, runs)


def solved(
    rates: Callable[[Values], list], states: tuple[str, ...], run: Run, rtol: float = 1e-8
) -> dict[str, np.ndarray]:
    """Integrate rates along a run, from change to change of its inputs, which are held. Raises ArithmeticError."""
    x = np.full((len(run.t), len(states)), np.nan)
    x[0] = run.x0
    u = np.stack(list(run.u.values()), axis=1) if run.u else np.zeros((len(run.t), 0))
    ends = [0, *(np.flatnonzero(np.any(np.diff(u, axis=0) != 0, axis=1)) + 1), len(run.t) - 1]
    if len(ends) > len(run.t) / 4:
        return _stepped(rates, states, run, x, u)
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        if b <= a:
            continue
        held = dict(zip(run.u, u[a], strict=True))
        found = solve_ivp(
            lambda t, y, held=held: [float(v) for v in rates({**dict(zip(states, y, strict=True)), **held})],
            (run.t[a], run.t[b]),
            x[a],
            t_eval=run.t[a + 1 : b + 1],
            method="LSODA",
            rtol=rtol,
            atol=rtol / 10,
        )
        if not found.success or len(found.t) < b - a:
            raise ArithmeticError(found.message)
        x[a + 1 : b + 1] = found.y.T
    return dict(zip(states, x.T, strict=True))


def _stepped(
    rates: Callable[[Values], list], states: tuple[str, ...], run: Run, x: np.ndarray, u: np.ndarray
) -> dict[str, np.ndarray]:
    """Runge-Kutta steps from sample to sample, for inputs that change all the time."""
    for k, h in enumerate(np.diff(run.t)):
        held = dict(zip(run.u, u[k], strict=True))

        def slope(y: np.ndarray, held: dict = held) -> np.ndarray:
            return np.array([float(v) for v in rates({**dict(zip(states, y, strict=True)), **held})])

        a = slope(x[k])
        b = slope(x[k] + h / 2 * a)
        c = slope(x[k] + h / 2 * b)
        x[k + 1] = x[k] + h / 6 * (a + 2 * b + 2 * c + slope(x[k] + h * c))
    return dict(zip(states, x.T, strict=True))


def _times(seconds: float, step: float) -> np.ndarray:
    return np.arange(round(seconds / step) + 1) * step


def _cut(
    t: np.ndarray, x0: tuple[float, ...], share: float, rates: Callable, states: tuple[str, ...]
) -> list[Run]:
    """The first share of a run, and the rest as a run of its own, as the paper parts its training and test."""
    k = round(share * len(t))
    x = solved(rates, states, Run(t[: k + 1], {}, x0))
    return [Run(t[:k], {}, x0), Run(t[k:] - t[k], {}, tuple(float(x[s][-1]) for s in states))]


def _flat(**sd: float) -> Callable[[dict[str, np.ndarray]], dict[str, float]]:
    return lambda x: sd


# --------------------------------------------------------------------------------------------- oscillator, chaos

VAN_DER_POL = """\
format: thermoctl-plant/1
title: Van der Pol oscillator
parameters:
  mu: {value: 0.5}
nodes:
  x: {storage: 1, initial: first(x_meas), initial_sigma: 0.1, role: position}
  v: {storage: 1, initial: first(v_meas), initial_sigma: 0.1, role: velocity}
flows:
  motion: {into: x, rate: v}
  damping: {into: v, rate: mu * (1 - x**2) * v}
  spring: {from: v, rate: x}
outputs:
  x_meas: {value: x, noise: 0.1}
  v_meas: {value: v, noise: 0.1}
"""


def _van_der_pol(q: Values) -> list:
    return [q["v"], 0.5 * (1 - q["x"] ** 2) * q["v"] - q["x"] + 0.01 * q["x"] ** 3]


LORENZ = """\
format: thermoctl-plant/1
title: Lorenz system
nodes:
  x: {storage: 1, initial: first(x_meas), initial_sigma: 0.1}
  y: {storage: 1, initial: first(y_meas), initial_sigma: 0.1}
  z: {storage: 1, initial: first(z_meas), initial_sigma: 0.1}
flows:
  stirred: {into: x, rate: 10 * (y - x)}
  heated: {into: y, rate: x * (28 - z) - y}
  mixed: {into: z, rate: x * y - 8 / 3 * z}
outputs:
  x_meas: {value: x, noise: 0.1}
  y_meas: {value: y, noise: 0.1}
  z_meas: {value: z, noise: 0.1}
"""


def _lorenz(q: Values) -> list:
    x, y, z = q["x"], q["y"], q["z"]
    return [10 * (y - x) + 0.01 * x**3, x * (28 - z) - y, x * y - 8 / 3 * z]


# ------------------------------------------------------------------------------------------------------- building

BUILDING = """\
format: thermoctl-plant/1
title: Single-zone building
inputs:
  outdoor: {unit: degC, column: T_out, role: ambient}
  solar: {unit: W/m^2}
  heater: {unit: W}
parameters:
  C: {value: 4.5e6, unit: J/K, range: [2e6, 1.5e7]}
  UA: {value: 180, unit: W/K, range: [50, 500]}
  gA: {value: 1.5, unit: m^2, range: [0.2, 8]}
nodes:
  room: {unit: degC, storage: C, initial: first(T_in), initial_sigma: 0.05}
flows:
  envelope: {from: room, rate: UA * (room - outdoor), unit: W}
  sun: {into: room, rate: gA * solar, unit: W}
  heating: {into: room, rate: heater, unit: W}
outputs:
  T_in: {value: room, unit: degC, noise: 0.05}
"""


def _building(q: Values) -> list:
    room = q["room"]
    loss = 150 * (room - q["T_out"]) + 300 * np.maximum(room - 23, 0)
    return [(2 * q["solar"] + q["heater"] - loss) / 6e6]


def _weeks(rng: np.random.Generator) -> list[Run]:
    """Three weeks of 15 min: a day's course outdoors, sun by day, a heater that changes every six hours."""
    out = []
    for _ in range(3):
        t = _times(7 * 86400 - 900, 900)
        day = 2 * np.pi * t / 86400
        weather = np.repeat(rng.normal(0, 2, 7), 96)
        outdoor = 8 + weather - 4 * np.cos(day - 0.5) + rng.normal(0, 0.2, len(t))
        cloud = np.repeat(rng.uniform(0.3, 1, 7), 96)
        solar = cloud * 600 * np.maximum(-np.cos(day), 0)
        heater = np.repeat(rng.choice([0, 1000, 2500, 4000], 28), 24).astype(float)
        out.append(Run(t, {"T_out": outdoor, "solar": solar, "heater": heater}, (20.0,)))
    return out


# ------------------------------------------------------------------------------------------- populations, reactor

POPULATIONS = """\
format: thermoctl-plant/1
title: Lotka-Volterra, only the two linear terms are known
parameters:
  alpha: {value: 1.3}
  delta: {value: 1.8}
nodes:
  rabbits: {storage: 1, initial: first(x), initial_sigma: SDX}
  wolves: {storage: 1, initial: first(y), initial_sigma: SDY}
flows:
  growth: {into: rabbits, rate: alpha * rabbits}
  death: {from: wolves, rate: delta * wolves}
outputs:
  x: {value: rabbits, noise: SDX}
  y: {value: wolves, noise: SDY}
"""


def _populations(q: Values) -> list:
    x, y = q["rabbits"], q["wolves"]
    return [1.3 * x - 0.9 * x * y, 0.8 * x * y - 1.8 * y]


BIOREACTOR = """\
format: thermoctl-plant/1
title: Fed-batch bioreactor; the growth rate mu(Cs) is unknown
inputs:
  Q: {column: Q_in}
parameters:
  yield_xs: {value: 0.777}
  Cs_in: {value: 50}
  mu0: {value: 0.2, range: [0.001, 1.0]}
nodes:
  Cs: {storage: yield_xs, initial: "1", initial_sigma: 0.01}
  Cx: {storage: 1, initial: "1"}
  V: {storage: 1, initial: "7"}
flows:
  feed: {into: Cs, rate: yield_xs * Q / V * (Cs_in - Cs)}
  dilution: {from: Cx, rate: Q / V * Cx}
  fill: {into: V, rate: Q}
  growth: {from: Cs, into: Cx, rate: mu0 * Cx}
outputs:
  Cs_meas: {value: Cs, noise: 0.1}
"""


def _bioreactor(q: Values) -> list:
    cs, cx, feed = q["Cs"], q["Cx"], q["Q_in"] / q["V"]
    mu = 0.421 * cs / (4.39 + cs)
    return [-mu / 0.777 * cx + feed * (50 - cs), mu * cx - feed * cx, q["Q_in"]]


def _feeds(rng: np.random.Generator) -> list[Run]:
    """Without feed, two experiments and the held-out one with a feed that changes by the hour, as in the paper.

    The paper designs the feeds; these are drawn: about one hour in three is fed, with up to 10 l/h."""
    t = _times(15, 0.25)
    out = [Run(t, {"Q_in": np.zeros(len(t))}, (1.0, 1.0, 7.0))]
    for _ in range(3):
        hourly = rng.uniform(0, 10, 16) * (rng.random(16) < 0.3)
        hourly[0] = rng.uniform(1, 10)
        feed = hourly[np.minimum((t + 1e-9).astype(int), 15)]
        out.append(Run(t, {"Q_in": feed}, (1.0, 1.0, 7.0)))
    return out


# -------------------------------------------------------------------------------------------------- tanks, friction

TWO_TANKS = """\
format: thermoctl-plant/1
title: Two tanks with laminar outlets
inputs:
  pump: {unit: V}
parameters:
  A1: {value: 0.5, unit: m^2}
  k: {value: 0.0035, unit: m^3/s/V, range: [0.001, 0.02]}
  c1: {value: 0.1, unit: m^2/s, range: [0.005, 2]}
  A2: {value: 0.25, unit: m^2}
  c2: {value: 0.1, unit: m^2/s, range: [0.005, 2]}
nodes:
  upper: {unit: m, storage: A1, initial: "0"}
  lower_level: {unit: m, storage: A2, initial: "0.1"}
flows:
  inflow: {into: upper, rate: k * pump, unit: m^3/s}
  outlet1: {from: upper, into: lower_level, rate: c1 * upper, unit: m^3/s}
  outlet2: {from: lower_level, rate: c2 * lower_level, unit: m^3/s}
outputs:
  lower: {value: lower_level, unit: m, noise: 0.004}
"""
_HOLE_1, _HOLE_2 = 0.019 * np.sqrt(2 * 9.81), 0.016 * np.sqrt(2 * 9.81)


def _root(level: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(level, 0))


def _two_tanks(q: Values) -> list:
    through, out = _HOLE_1 * _root(q["upper"]), _HOLE_2 * _root(q["lower_level"])
    return [(0.005 * q["pump"] - through) / 0.5, (through - out) / 0.25]


def _pumped(rng: np.random.Generator) -> list[Run]:
    """3000 samples of 0.2 s as in the demonstration, the pump's voltage drawn every 40 s."""
    t = _times(599.8, 0.2)
    volts = [np.repeat(rng.uniform(1, 10, 15), 200) for _ in range(2)]
    return [Run(t, {"pump": u}, (0.0, 0.1)) for u in volts]


FRICTION = """\
format: thermoctl-plant/1
title: Block pushed by a force, friction not in the model
inputs:
  Fu: {column: force}
nodes:
  v: {storage: 1, initial: "0", initial_sigma: 0.01, role: velocity}
flows:
  push: {into: v, rate: Fu}
outputs:
  vel: {value: v, noise: 0.01, role: velocity}
"""


def _stribeck(
    v: np.ndarray, breakaway: float = 20.0, coulomb: float = 80.0, scale: float = 1.0
) -> np.ndarray:
    """Simscape's translational friction, of which the tutorial takes breakaway 100, Coulomb 80, 10 m/s."""
    return np.sqrt(2 * np.e) * breakaway * np.exp(-((v / scale) ** 2)) * v / scale + coulomb * np.tanh(
        v / (10 * np.sqrt(2))
    )


def _block(q: Values) -> list:
    return [q["force"] - _stribeck(q["v"])]


def _pushes(rng: np.random.Generator) -> list[Run]:
    """The tutorial's run of 0.1 s with 120 N; a smaller force is held out."""
    t = _times(0.1, 0.001)
    return [Run(t, {"force": np.full(len(t), f)}, (0.0,)) for f in (120.0, 105.0)]


_VDP, _XYZ, _LEVELS = ("x", "v"), ("x", "y", "z"), ("upper", "lower_level")
_RABBITS = (3.1463924566781167, 1.5423300037202512)
_COUNTED = (  # columns, noise and runs of both systems of predator and prey
    {"x": "rabbits", "y": "wolves"},
    lambda x: {"x": 5e-3 * float(x["rabbits"].mean()), "y": 5e-3 * float(x["wolves"].mean())},
    lambda rng: [Run(_times(5, 0.25), {}, _RABBITS), Run(_times(5, 0.25), {}, (2.0, 3.0))],
)
SYSTEMS = (
    System(
        "Van der Pol",
        VAN_DER_POL,
        _VDP,
        _van_der_pol,
        {"v": lambda q, k: k * q["x"] ** 3},
        {"v": (0.01,)},
        {"x_meas": "x", "v_meas": "v"},
        _flat(x_meas=0.1, v_meas=0.1),
        lambda rng: _cut(_times(50, 0.01), (0.1, 0.1), 0.6, _van_der_pol, _VDP),
        names=frozenset({"cubic_stiffness"}),
        filtered=True,
    ),
    System(
        "Lorenz",
        LORENZ,
        _XYZ,
        _lorenz,
        {"x": lambda q, k: k * q["x"] ** 3},
        {"x": (0.01,)},
        {"x_meas": "x", "y_meas": "y", "z_meas": "z"},
        _flat(x_meas=0.1, y_meas=0.1, z_meas=0.1),
        lambda rng: _cut(_times(50, 0.01), (-8.0, 8.0, 27.0), 0.6, _lorenz, _XYZ),
        window=1.0,
        filtered=True,
    ),
    System(
        "building with a hinge",
        BUILDING,
        ("room",),
        _building,
        {"room": lambda q, k, at: -k * np.maximum(q["room"] - at, 0) / 6e6},
        {"room": (300.0, 23.0)},
        {"T_in": "room"},
        _flat(T_in=0.05),
        _weeks,
    ),
    System(
        "predator and prey, both terms missing",
        POPULATIONS,
        ("rabbits", "wolves"),
        _populations,
        {
            "rabbits": lambda q, k: -k * q["rabbits"] * q["wolves"],
            "wolves": lambda q, k: k * q["rabbits"] * q["wolves"],
        },
        {"rabbits": (0.9,), "wolves": (0.8,)},
        *_COUNTED,
    ),
    System(
        "predator and prey, one term known",
        POPULATIONS.replace("outputs:", "  eaten: {from: rabbits, rate: 0.9 * rabbits * wolves}\noutputs:"),
        ("rabbits", "wolves"),
        _populations,
        {"wolves": lambda q, k: k * q["rabbits"] * q["wolves"]},
        {"wolves": (0.8,)},
        *_COUNTED,
    ),
    System(
        "bioreactor",
        BIOREACTOR,
        ("Cs", "Cx", "V"),
        _bioreactor,
        {
            "Cs": lambda q, k, half: -k / 0.777 * q["Cs"] / (half + q["Cs"]) * q["Cx"],
            "Cx": lambda q, k, half: k * q["Cs"] / (half + q["Cs"]) * q["Cx"],
        },
        {"Cs": (0.421, 4.39), "Cx": (0.421, 4.39)},
        {"Cs_meas": "Cs"},
        _flat(Cs_meas=0.1),
        _feeds,
    ),
    System(
        "two tanks",
        TWO_TANKS,
        _LEVELS,
        _two_tanks,
        {
            "upper": lambda q, k: -k * _root(q["upper"]) / 0.5,
            "lower_level": lambda q, k, h: (k * _root(q["upper"]) - h * _root(q["lower_level"])) / 0.25,
        },
        {"upper": (_HOLE_1,), "lower_level": (_HOLE_1, _HOLE_2)},
        {"lower": "lower_level"},
        _flat(lower=0.004),
        _pumped,
        names=frozenset({"orifice_exponent"}),
    ),
    System(
        "friction",
        FRICTION,
        ("v",),
        _block,
        {"v": lambda q, b, c, s: -_stribeck(q["v"], b, c, s)},
        {"v": (20.0, 80.0, 1.0)},
        {"vel": "v"},
        _flat(vel=0.01),
        _pushes,
        names=frozenset(
            {"stribeck_friction", "coulomb_friction", "viscous_friction", "directional_friction"}
        ),
    ),
)
