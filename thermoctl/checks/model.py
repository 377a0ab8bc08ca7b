"""Checks of the plant itself, at the start of its recordings: storages, stability, time constants.

The linearised plant is dx/dt = J x. An eigenvalue l of J is a time constant 1/|l|; it grows where Re l > 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.checks.finding import Finding
from thermoctl.plant import Plant
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Node
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError

GROWTH = 1.0  # e-folds over the recording from which an unstable plant cannot follow it
NYQUIST = np.pi  # sampling interval over time constant from which a mode lies beyond the Nyquist frequency
ALONG = 9  # number of rows of a run, evenly spaced, at which the slowest time constant is looked for
SIGMAS = 6.0  # standard deviations of a contradiction: probability 2e-9 for a normal error


def plant_findings(model: Model, excitations: Sequence[Excitation]) -> list[Finding]:
    """Check units, storages, stability and time constants."""
    findings = unit_findings(model.plant)
    for excitation in excitations:
        findings += _storages(model, excitation)
        if findings and findings[-1].kind == "storage":
            return findings
        findings += _stability(model, excitation)
        if findings and findings[-1].kind == "unstable":
            return findings
        findings += _time_constants(model, excitation)
    return list({(f.kind, f.what): f for f in reversed(findings)}.values())[::-1]  # each once, the first one


def unit_findings(plant: Plant) -> list[Finding]:
    """Return a warning where nothing in the plant has a unit."""
    items = [*plant.readings(), *plant.parameters.values(), *plant.nodes.values()]
    if any(i.unit for i in items):
        return []
    what = "no quantity has a unit, so no expression could be checked"
    todo = "Give inputs, parameters, nodes and outputs their units."
    return [Finding("no units", plant.file, what, todo, severe=False)]


def start_values(model: Model, excitation: Excitation) -> dict[str, float]:
    """Return every name's value at the start of a recording."""
    p = model.vector(None, excitation.name)
    x0, _ = model.start(excitation, p)
    return {
        **dict(zip(model.inputs, excitation.u[0], strict=False)),
        **dict(zip(model.parameters, map(float, p), strict=True)),
        **dict(zip(model.states, map(float, x0), strict=True)),
        "t": 0.0,
    }


def value_of(e: ex.Expr, values: Mapping[str, float]) -> float:
    """Return an expression's value at these values of its names; a delay counts as none."""
    return float(ex.evaluate(ex.undelayed(e), values))


def _storages(model: Model, excitation: Excitation) -> list[Finding]:
    values = start_values(model, excitation)
    findings = []
    for node in model.plant.nodes.values():
        findings += storage_findings(model.plant, node, value_of(node.storage, values))
    return findings


def storage_findings(plant: Plant, node: Node, storage: float) -> list[Finding]:
    """Return a finding where a node's storage is not positive."""
    if storage > 0:
        return []
    what = f"the storage of node '{node.name}' is {storage:g}; a positive one was expected"
    todo = "A negative heat capacity or mass turns every flow around: correct the sign."
    todo = todo if storage < 0 else "A node without storage cannot be simulated: write its size."
    return [Finding("storage", f"{plant.file}:{node.at}", what, todo)]


def jacobian(plant: Plant, values: dict[str, float], flip: str | None = None) -> np.ndarray:
    """Return d(dx/dt)/dx (nx, nx) in 1/s. `flip`: name of a flow whose sign is reversed."""
    index = {n: i for i, n in enumerate(plant.nodes)}
    out = np.zeros((len(index), len(index)))
    for flow in plant.flows.values():
        sign = -1.0 if flow.name == flip else 1.0
        for name in ex.names(flow.rate) & set(index):
            slope = sign * value_of(ex.derivative(flow.rate, name), values)
            for end, way in ((flow.target, 1.0), (flow.source, -1.0)):
                if end is not None:
                    out[index[end], index[name]] += way * slope
    storages = np.array([value_of(n.storage, values) for n in plant.nodes.values()])
    return out / storages[:, None]


def _eigenvalues(matrix: np.ndarray) -> np.ndarray:
    return np.linalg.eigvals(matrix) if len(matrix) and np.isfinite(matrix).all() else np.zeros(0)


def _growth(matrix: np.ndarray) -> float:
    values = _eigenvalues(matrix)
    return float(values.real.max()) if len(values) else 0.0


def _stability(model: Model, excitation: Excitation) -> list[Finding]:
    """Find a mode that grows by more than e over the recording, and the flows whose sign would stop it."""
    plant, span = model.plant, float(excitation.t[-1] - excitation.t[0])
    values = start_values(model, excitation)
    growth = _growth(jacobian(plant, values))
    if growth * span <= GROWTH:
        return []
    suspects = [f for f in plant.flows if _growth(jacobian(plant, values, f)) * span <= GROWTH]
    turn = f"Is the sign of the rate of {' or '.join(repr(s) for s in suspects)} right, or its 'from' and 'into'?"
    what = (
        f"the plant is unstable at the start of '{excitation.name}': a deviation doubles every "
        f"{np.log(2) / growth:.3g} s, and the recording lasts {span:.4g} s"
    )
    advice = (
        turn if suspects else "An oscillator or a population grows so; else check the signs of its flows."
    )
    return [Finding("unstable", plant.file, what, advice, severe=False)]


def rates_of(model: Model, excitation: Excitation) -> np.ndarray:
    """Return the plant's eigenvalues at the start, absolute, 1/s; an integrator has none."""
    return _rates(model.plant, start_values(model, excitation))


def _rates(plant: Plant, values: dict[str, float]) -> np.ndarray:
    rates = np.abs(_eigenvalues(jacobian(plant, values)))
    return rates[rates > 1e-9 * rates.max(initial=0.0)]


def _slowest(model: Model, excitation: Excitation) -> float:
    """Return the largest time constant, s, along the plant's own run: at rest, friction makes it short."""
    try:
        x = model.run(excitation).x
    except SimulationError:
        x = np.zeros((0, len(model.states)))
    values, slow = start_values(model, excitation), 1 / rates_of(model, excitation).min()
    for k in np.linspace(0, len(x) - 1, ALONG).astype(int) if len(x) else ():
        values |= dict(zip(model.inputs, excitation.u[k], strict=False))
        values |= dict(zip(model.states, map(float, x[k]), strict=True)) | {"t": float(excitation.t[k])}
        slow = max(slow, 1 / _rates(model.plant, values).min(initial=np.inf))
    return float(slow)


def _time_constants(model: Model, excitation: Excitation) -> list[Finding]:
    """Compare the sampling with the plant's time constants."""
    if len(excitation.t) < 2:
        return []
    step = float(np.median(np.diff(excitation.t)))
    rates = rates_of(model, excitation)
    if not len(rates):
        return []
    fast = 1 / rates.max()
    integrates = len(rates) < len(model.states)
    if step <= NYQUIST * fast:
        return []
    slow = _slowest(model, excitation)
    none = step > NYQUIST * slow and not integrates
    seen = f"slowest time constant of {slow:.3g} s" if none else f"time constant of {fast:.3g} s"
    ask = (
        "Is the time in another unit? Then state it in the header: t [ms]. Otherwise sample faster, or "
        if none
        else ("Effects of that mode cannot be seen: sample faster, or ")
    )
    what = f"the samples are {step:.4g} s apart and miss the plant's {seen}"
    advice = ask + "make that part of the plant static."
    return [Finding("sampling", excitation.name, what, advice, severe=False)]


def start_errors(model: Model, excitation: Excitation) -> dict[str, tuple[float, float]]:
    """Return by output the first sample minus the plant's initial value: in its unit, in standard deviations.

    Noise, initial_sigma and the parameters' ranges count. An output without a state is left out."""
    plant = model.plant
    if not model.states:
        return {}
    try:
        run = model.run(excitation.part(0, 2), sensitivities=True)
    except SimulationError:
        return {}
    spread = [np.ptp(p.range) / 12**0.5 if (p := plant.parameters[q]).range else 0.0 for q in model.active]
    spread += [plant.nodes[n].initial_sigma or 0.0 for n in model.uncertain]
    errors = {}
    noises = default_noise(plant, [excitation])
    for j, (o, noise) in enumerate(zip(plant.outputs.values(), noises, strict=True)):
        if ex.names(o.value) & set(model.states) and np.isfinite(excitation.y[0, j]):
            error = float(excitation.y[0, j] - run.y[0, j])
            sd = float(np.hypot(noise.sigma, np.linalg.norm(run.sensitivities[0, j] * spread)))
            errors[o.name] = error, abs(error) / sd
    return errors


def start_findings(model: Model, excitation: Excitation) -> list[Finding]:
    """Report first samples that are far from the plant's start."""
    return [
        Finding(
            "start",
            excitation.name,
            f"'{name}' starts {abs(error):.4g} {'above' if error > 0 else 'below'} the plant's start: "
            f"{sigmas:.0f} standard deviations apart",
            f"Start the node from the data (initial: first({name})), or give it an initial_sigma.",
            severe=False,
        )
        for name, (error, sigmas) in start_errors(model, excitation).items()
        if sigmas > SIGMAS
    ]
