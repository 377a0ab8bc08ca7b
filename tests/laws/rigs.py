"""Rigs for the proof of laws: plant files, and truths with a concealed law, simulated from the plant language.

The truth holds the law as an expression of its own (`LAWS`, from textbooks, and `drawn`, from a grammar whose functions the
search does not have), other parameters than the plant file, and in the open world small misfits that nobody will name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.plants import TWO_BLOCKS
from thermoctl.plant import expression as ex
from thermoctl.plant import loads
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Flow, Node, Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

STAGE = """\
format: thermoctl-plant/1
title: Stage on a spring with a motor
inputs:
  force: {unit: N, between_samples: linear}
parameters:
  stiffness: {value: 90, unit: N/m, range: [30, 300]}
  damping: {value: 4, unit: N*s/m, range: [1, 16]}
nodes:
  velocity: {unit: m/s, storage: 1.3, initial: 0}
  position: {unit: m, storage: 1, initial: 0, initial_sigma: 0.001}
flows:
  drive: {into: velocity, rate: force, unit: N}
  spring: {from: velocity, rate: stiffness * position, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  encoder: {value: position, unit: m, noise: 2e-4}
"""

TANKS = """\
format: thermoctl-plant/1
title: Two tanks
inputs:
  pump: {unit: V}
parameters:
  k_pump: {value: 0.5, unit: m*m*m/s/V, range: [0.2, 1.2]}
  k_12: {value: 0.35, unit: m*m*m/s/m**0.5, range: [0.1, 1]}
  k_out: {value: 0.35, unit: m*m*m/s/m**0.5, range: [0.1, 1]}
nodes:
  upper: {unit: m, storage: 12, initial: 1, initial_sigma: 0.2}
  lower: {unit: m, storage: 15, initial: 1, initial_sigma: 0.2}
flows:
  pumped: {into: upper, rate: k_pump * pump}
  through: {from: upper, into: lower, rate: "k_12 * sqrt(max(upper, 1e-4))"}
  drain: {from: lower, rate: "k_out * sqrt(max(lower, 1e-4))"}
outputs:
  level_1: {value: upper, unit: m, noise: 0.01}
  level_2: {value: lower, unit: m, noise: 0.01}
"""

REACTOR = """\
format: thermoctl-plant/1
title: Stirred reactor with feed and jacket
inputs:
  feed: {unit: 1/s, between_samples: linear}
  jacket: {unit: degC, between_samples: linear}
  current: {unit: A}
parameters:
  heat_capacity: {value: 40, unit: J/K, range: [15, 100]}
  G_jacket: {value: 0.4, unit: W/K, range: [0.1, 1.6]}
  R_heater: {value: 1.2, unit: ohm, range: [0.3, 4]}
  strength: {value: 8, unit: mol, range: [3, 20]}
nodes:
  broth: {unit: degC, storage: heat_capacity, initial: jacket, initial_sigma: 0.5}
  substrate: {unit: mol, storage: 1, initial: 4, initial_sigma: 1}
flows:
  joule: {into: broth, rate: R_heater * current**2, unit: W}
  cooling: {from: broth, rate: G_jacket * (broth - jacket), unit: W}
  fed: {into: substrate, rate: feed * strength, unit: mol/s}
  washed_out: {from: substrate, rate: feed * substrate, unit: mol/s}
outputs:
  temperature: {value: broth, unit: degC, noise: 0.05}
  concentration: {value: substrate, unit: mol, noise: 0.03}
"""

PLANTS = {"heater": TWO_BLOCKS, "stage": STAGE, "tanks": TANKS, "reactor": REACTOR}
RATIOS = {
    "small": 3.0,
    "middle": 10.0,
    "large": 30.0,
}  # rms after a refit over the noise, of the worst output
STEPS = 4  # of the search for the law's size


@dataclass(frozen=True)
class Truth:
    """A concealed law: `rate` is the flow from `source` into `target` for a size of one.

    `switches`: rate of a hidden state `on` that the law may read. `part`: "storage" where `rate` is a part of it."""

    name: str
    family: str
    rate: str
    variables: frozenset[str]
    target: str
    source: str | None = None
    drawn: bool = False
    switches: str | None = None
    part: str = "flow"


def _t(name: str, family: str, rate: str, variables: str, target: str, source: str | None = None) -> Truth:
    return Truth(name, family, rate, frozenset(variables.split()), target, source)


LAWS = (
    _t(
        "Stefan-Boltzmann to a ceiling of 5 degC",
        "heater",
        "-((one + 273.15)**4 - 278.15**4) / 1e9",
        "one",
        "one",
    ),
    _t("Stefan-Boltzmann to an oven wall", "heater", "-((two + 273.15)**4 - 340**4) / 1e9", "two", "two"),
    _t("fan with a thermostat", "heater", "-(one - air) * (1 + tanh((one - 42) / 1)) / 2", "one air", "one"),
    _t("heat of reaction (Arrhenius)", "heater", "exp(7000 * (1 / 310 - 1 / (one + 273.15)))", "one", "one"),
    _t("evaporation (Antoine)", "heater", "-exp(17.6 * two / (two + 243))", "two", "two"),
    _t("boiling above a level", "heater", "-max(one - 45, 0)**1.5 / 30", "one", "one"),
    _t("film with the power 1.6", "heater", "-sign(one - air) * abs(one - air)**1.6 / 100", "one air", "one"),
    _t("Peltier heat of the supply", "heater", "sqrt(max(heat, 0))", "heat", "two"),
    _t("windage with the power 1.6", "stage", "-sign(velocity) * abs(velocity)**1.6", "velocity", "velocity"),
    _t("magnet at the end", "stage", "exp(position / 0.03)", "position", "velocity"),
    _t("spring with the power 2.4", "stage", "-sign(position) * abs(position)**2.4", "position", "velocity"),
    _t("end stop of rubber", "stage", "-max(position - 0.06, 0)**1.3", "position", "velocity"),
    _t("eddy brake with a peak", "stage", "-velocity / (1 + (velocity / 0.15)**2)", "velocity", "velocity"),
    _t("squeeze film", "stage", "-velocity / (1.3 + position / 0.1)**3", "velocity position", "velocity"),
    _t("saturating motor", "stage", "-force * abs(force) / (1 + abs(force) / 4)", "force", "velocity"),
    _t("choked flow", "tanks", "-min(upper, 1.1) + 0", "upper", "lower", None),
    _t("weir", "tanks", "-max(upper - 1.2, 0)**1.5", "upper", "upper"),
    _t("leak by pressure", "tanks", "-lower**1.4", "lower", "lower"),
    _t(
        "backflow of a valve",
        "tanks",
        "sign(upper - lower) * abs(upper - lower)**0.7",
        "upper lower",
        "lower",
        "upper",
    ),
    _t("pump's curve", "tanks", "-pump * upper**2", "pump upper", "upper"),
    _t("siphon", "tanks", "-(1 + tanh((lower - 1.2) / 0.03)) / 2", "lower", "lower"),
    _t("Monod", "reactor", "-substrate / (0.8 + substrate)", "substrate", "substrate"),
    _t("Haldane", "reactor", "-substrate / (1 + substrate + substrate**2 / 2)", "substrate", "substrate"),
    _t("second order", "reactor", "-substrate**2", "substrate", "substrate"),
    _t(
        "Arrhenius loss of substrate",
        "reactor",
        "-substrate * exp(6000 * (1 / 310 - 1 / (broth + 273.15)))",
        "substrate broth",
        "substrate",
    ),
    _t("entropic heat", "reactor", "current", "current", "broth"),
    _t("heat of Monod growth", "reactor", "substrate / (0.8 + substrate)", "substrate", "broth"),
    _t("thermostat", "reactor", "-(1 + tanh((broth - 34) / 0.3)) / 2", "broth", "broth"),
    _t("phase change", "reactor", "exp(-((broth - 33) / 2)**2) * (broth - jacket)", "broth jacket", "broth"),
)


def _relay(
    name: str, family: str, rate: str, on: str, off: str, signal: str, target: str, variables: str
) -> Truth:
    """A law with a switch that goes on above `on` and off below `off`, within about a sample."""
    lag = 0.02 if family == "stage" else 1
    switches = f"(step({signal} - {on} + ({on} - {off}) * on) - on) / {lag}"
    return dataclasses.replace(_t(name, family, rate, variables, target), switches=switches)


RELAYS = (
    _relay("fan with hysteresis", "heater", "-on * (one - air)", "46", "38", "one", "one", "one air"),
    _relay("latching magnet", "stage", "on", "0.03", "-0.02", "position", "velocity", "position"),
    _relay("bell siphon", "tanks", "-on", "1.7", "0.8", "lower", "lower", "lower"),
    _relay("thermostat with hysteresis", "reactor", "-on", "31", "26", "broth", "broth", "broth"),
)

STORAGES = (
    dataclasses.replace(
        _t("melting in the block", "heater", "exp(-((one - 41) / 3)**2)", "one", "one"), part="storage"
    ),
    dataclasses.replace(
        _t("melting in the broth", "reactor", "1 / (1 + ((broth - 29) / 1.5)**2)", "broth", "broth"),
        part="storage",
    ),
)

# what the search's library does not hold; x is the variable over its typical size
GRAMMAR = (
    "x / sqrt(1 + x**2)",
    "x * log(1 + abs(x))",
    "x**3 / (1 + x**2)",
    "exp(x / 2) - exp(-x / 2)",
    "x * exp(-abs(x))",
    "log(1 + 3 * x**2)",
    "min(max(x, 0), 1)**2",
    "x + 0.6 * x * abs(x) - 0.1 * x**3",
)
VARIABLES = {
    "heater": (
        ("one - air", "one air", 15.0, "one"),
        ("two - air", "two air", 8.0, "two"),
        ("one - two", "one two", 8.0, "two"),
    ),
    "stage": (("velocity", "velocity", 0.2, "velocity"), ("position", "position", 0.05, "velocity")),
    "tanks": (("upper", "upper", 1.0, "upper"), ("lower", "lower", 1.0, "lower")),
    "reactor": (
        ("substrate", "substrate", 3.0, "substrate"),
        ("broth - jacket", "broth jacket", 8.0, "broth"),
        ("current", "current", 2.0, "broth"),
    ),
}


def drawn(count: int, seed: int) -> list[Truth]:
    """Laws from the grammar: a function of a variable at a place, going round the families."""
    rng, out = np.random.default_rng(seed), []
    for k in range(count):
        family = list(VARIABLES)[k % len(VARIABLES)]
        text, variables, size, target = VARIABLES[family][int(rng.integers(len(VARIABLES[family])))]
        form = GRAMMAR[int(rng.integers(len(GRAMMAR)))]
        s = size * rng.uniform(0.6, 1.6)
        sign = "-" if text != "current" else ""
        rate = (
            sign
            + "("
            + str(
                ex.substitute(
                    ex.parse(form),
                    lambda e, t=text, s=s: ex.parse(f"({t}) / {s:.4g}") if e.value == "x" else None,
                )
            )
            + ")"
        )
        out.append(Truth(f"{form} of {text}", family, rate, frozenset(variables.split()), target, None, True))
    return out


def inputs(family: str, rng: np.random.Generator) -> Table:
    """The inputs of one recording, with enough levels to see a law."""
    n = 800
    if family == "stage":
        t = np.arange(n) * 0.02
        w = rng.uniform(0.4, 3.0, 5)
        force = sum(rng.uniform(0.5, 2.5) * np.sin(2 * np.pi * (f * t + rng.uniform())) for f in w)
        columns = {"force": force * np.repeat(rng.uniform(0.3, 1.4, 8), n // 8)}
    elif family == "tanks":
        t = np.arange(n) * 2.0
        columns = {"pump": np.repeat(rng.uniform(0.2, 1.4, 16), n // 16)}
    elif family == "heater":
        t = np.arange(n) * 2.0
        columns = {
            "heat": np.repeat(rng.permutation([0, 2.5, 0.8, 0, 1.6, 3, 0, 2.0]), n // 8),
            "air_temperature": 21.5 + 0.4 * np.sin(t / 700 + rng.uniform(0, 6)),
        }
    else:
        t = np.arange(n) * 2.0
        feed = np.repeat(rng.permutation(np.geomspace(0.0002, 0.006, 10)), n // 10)
        columns = {
            "feed": feed,
            "jacket": 24 + 4 * np.sin(t / 260 + rng.uniform(0, 6)),
            "current": np.repeat(rng.uniform(-2.5, 2.5, 20), n // 20),
        }
    return Table("made", "made.csv", t, {k: np.asarray(v, float) for k, v in columns.items()})


@dataclass(frozen=True)
class Made:
    """A case: the plant file, recordings (the last is for scoring only), the truth's plant without its small misfits."""

    plant: Plant
    tables: list[Table]
    truth: Plant
    law: Truth | None
    ratio: float


def make(law: Truth | None, family: str, size: str, world: str, seed: int) -> Made:
    """Simulate a case; in the `open` world with small misfits of 3 to 40 % of the law's own size."""
    rng = np.random.default_rng(seed)
    plant = loads(PLANTS[family])
    moved = {
        k: dataclasses.replace(p, value=float(np.clip(p.value * np.exp(rng.uniform(-0.35, 0.35)), *p.range)))
        if p.range
        else p
        for k, p in plant.parameters.items()
    }
    base = dataclasses.replace(plant, parameters=moved)
    runs = [
        dataclasses.replace(inputs(family, rng), name=f"run_{k + 1}", path=f"run_{k + 1}.csv")
        for k in range(4)
    ]
    goal = RATIOS[size]
    misfit = goal * rng.uniform(0.03, 0.4) if world == "open" else 0.0
    truth, ratio = base, 1.0
    if law and law.switches:
        base = _switching(base, law.switches)
    if law:
        size = 0.3 * _reference(base, runs, law)
        truth, ratio = _sized(plant, runs, lambda q: with_law(base, law, q), size, goal)
    real = truth
    if misfit > 0.3:
        node = list(plant.nodes)[0] if family != "reactor" else str(rng.choice(list(plant.nodes)))
        span = float(runs[0].t[-1])
        waves = " + ".join(
            f"{rng.uniform(0.3, 1):.3g} * sin(2 * pi * t / {span * rng.uniform(0.15, 0.9):.4g} + {rng.uniform(0, 6):.3g})"
            for _ in range(3)
        )
        wander = Truth("wander", family, waves, frozenset(), node)
        size = 0.3 * _reference(base, runs, wander)
        small, _ = _sized(plant, runs, lambda q: with_law(base, wander, q), size, misfit)
        flow = dataclasses.replace(small.flows["hidden"], name="wander")
        real = dataclasses.replace(truth, flows={**truth.flows, "wander": flow})
    model = compile_plant(real)
    return Made(plant, [model.measure(t, seed + k) for k, t in enumerate(runs)], truth, law, ratio)


def _switching(plant: Plant, rate: str) -> Plant:
    """The plant with a state `on` that no flow of it reads yet."""
    node = Node("on", ex.ONE, ex.ZERO, "1", None)
    flow = Flow("switching", ex.parse(rate), None, "on")
    return dataclasses.replace(
        plant, nodes={**plant.nodes, "on": node}, flows={**plant.flows, "switching": flow}
    )


def with_law(base: Plant, law: Truth, size: float) -> Plant:
    """The plant with a law of a size."""
    rate = ex.mul(ex.num(float(f"{size:.4g}")), ex.parse(law.rate))
    if law.part == "storage":
        node = base.nodes[law.target]
        larger = dataclasses.replace(node, storage=ex.add(node.storage, rate))
        return dataclasses.replace(base, nodes={**base.nodes, law.target: larger})
    flow = Flow("hidden", rate, law.source, law.target)
    return dataclasses.replace(base, flows={**base.flows, "hidden": flow})


def _reference(base: Plant, runs: list[Table], law: Truth) -> float:
    """The size with which a law is as large as the flows, or the storage, at its place."""
    shape = np.mean([_rms(base, t, ex.parse(law.rate)) for t in runs[:3]])
    if law.part == "storage":
        return float(_rms(base, runs[0], base.nodes[law.target].storage) / max(shape, 1e-12))
    return float(np.mean([_typical(base, t, law.target) for t in runs[:3]]) / max(shape, 1e-12))


def _sized(
    plant: Plant, runs: list[Table], made: Callable[[float], Plant], size: float, goal: float
) -> tuple[Plant, float]:
    """The plant made with such a size that a refit of the plant file leaves `goal` times the noise."""
    ratio = np.nan
    for _ in range(STEPS):
        found = made(size)
        try:
            ratio = _left(plant, found, runs[:3])
        except Exception:  # an unstable truth: smaller
            size *= 0.3
            continue
        if abs(np.log(ratio / goal)) < 0.25:
            break
        size *= float(np.clip(goal / ratio, 0.1, 10))
    return found, ratio


def _signals(plant: Plant, t: Table) -> dict:
    model = compile_plant(plant)
    d = model.excitation(t)
    run = model.run(d)
    return {
        **dict(zip(plant.inputs, d.u.T, strict=False)),
        **{k: p.value for k, p in plant.parameters.items()},
        **dict(zip(model.states, run.x.T, strict=True)),
        "t": d.t,
        "pi": np.pi,
    }


def _rms(plant: Plant, t: Table, e: ex.Expr) -> float:
    return float(np.sqrt(np.mean(np.asarray(ex.evaluate(e, _signals(plant, t)), float) ** 2)))


def _typical(plant: Plant, t: Table, node: str) -> float:
    return max(_rms(plant, t, f.rate) for f in plant.flows.values() if node in (f.source, f.target))


def _left(plant: Plant, truth: Plant, runs: list[Table]) -> float:
    """Worst output's rms over its noise that a refit of the plant file leaves of noiseless readings, plus the noise."""
    made, model = [], compile_plant(truth)
    for t in runs:
        y = model.run(model.excitation(t)).y
        made.append(
            dataclasses.replace(
                t, columns={**t.columns, **{o.column: y[:, j] for j, o in enumerate(truth.outputs.values())}}
            )
        )
    refitted = compile_plant(plant)
    drives = [refitted.excitation(t) for t in made]
    found = fit(refitted, drives, default_noise(plant, drives), iterations=15, tolerance=1e-2, seconds=np.inf)
    rms = found.rms()
    return max(rms[o.name] / o.noise_sd for o in plant.outputs.values())
