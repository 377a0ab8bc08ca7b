"""Checks of a plant file by itself: units, storages, signs, and scales that no recording can give."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from thermoctl.checks.finding import Finding
from thermoctl.checks.model import jacobian, storage_findings, unit_findings, value_of
from thermoctl.plant import Plant
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import Flow, Input, Node, Output
from thermoctl.units import conversion, dimension, size_of

_TEMPERATURES = ("degC", "K", "degF")
POINTS = 3  # random values at which an expression is tried
SAME = 1e-6  # relative error of equal sizes of units
HOMOGENEOUS = 1e-9  # relative error of Euler's theorem


def file_findings(plant: Plant) -> list[Finding]:
    """Return warnings of a plant file; no recording is needed."""
    return [
        *other_degrees(plant),
        *unit_findings(plant),
        *(f for f, _ in unconverted(plant)),
        *_storages(plant),
        *_signs(plant),
        *_scales(plant),
    ]


def other_degrees(plant: Plant) -> list[Finding]:
    """Return a severe finding for each temperature in neither degC nor K.

    Effects add 273.15 to degrees, and take each difference for kelvins: radiation would be wrong in degF."""
    items: list[Input | Node | Output] = [*plant.inputs.values(), *plant.nodes.values()]
    items += plant.outputs.values()
    return [
        Finding(
            "unit",
            f"{plant.file}:{q.at}",
            f"'{q.name}' is in {q.unit}, and effects know temperatures in degC or K only",
            f"State it in one of these; its column may be in any unit: column: {{name: ..., unit: {q.unit}}}.",
        )
        for q in items
        if q.unit and dimension(q.unit) == dimension("K") and conversion(q.unit, "K")[0] != 1
    ]


def unconverted(plant: Plant) -> Iterator[tuple[Finding, Plant]]:
    """Yield a warning for each expression in another unit than its place states, and the plant corrected.

    Units are checked by dimension: a position in m that is read in mm fits, but nothing makes it 1000 times
    larger. An expression with a number, but an exponent, may convert."""
    named = [*plant.readings(), *plant.parameters.values(), *plant.nodes.values()]
    sizes = {i.name: size_of(i.unit) if i.unit else None for i in named} | {"t": 1.0}
    for o in plant.outputs.values():
        if factor := _unconverted(o.value, o.unit, sizes):
            right = replace(o, value=ex.mul(ex.num(factor), o.value))
            finding = _finding(plant, f"the value of '{o.name}'", o.value, o.unit, o.at, factor)
            yield finding, replace(plant, outputs={**plant.outputs, o.name: right})
    for f in plant.flows.values():
        if factor := _unconverted(f.rate, f.unit, sizes):
            turned = replace(f, rate=ex.mul(ex.num(factor), f.rate))
            finding = _finding(plant, f"the rate of '{f.name}'", f.rate, f.unit, f.at, factor)
            yield finding, replace(plant, flows={**plant.flows, f.name: turned})
        elif factor := _size_at_node(plant, f, sizes):
            turned = replace(f, rate=ex.mul(ex.num(factor), f.rate))
            unit = f"is stated in {f.unit}" if f.unit else f"has the unit of '{f.rate}'"
            told = f"the rate of '{f.name}' {unit}, but its node asks for storage times node per second: nothing converts it"
            todo = f"Multiply the rate by {factor:.6g}, and state the unit that it has then."
            finding = Finding("unit", f"{plant.file}:{f.at}", told, todo, severe=False)
            yield finding, replace(plant, flows={**plant.flows, f.name: turned})


def _size_at_node(plant: Plant, f: Flow, sizes: Mapping[str, float | None]) -> float | None:
    """Return the size of a flow's unit in that of its node; None if equal or unknown."""
    given = size_of(f.unit) if f.unit else _size(f.rate, sizes)
    for n in (plant.nodes[e] for e in (f.source, f.target) if e):
        storage = 1.0 if n.storage is ex.ONE else _size(n.storage, sizes)
        node = size_of(n.unit) if n.unit else None
        if given and storage and node and not np.isclose(given / (storage * node), 1.0, SAME, 0):
            return given / (storage * node)
    return None


def _finding(plant: Plant, what: str, e: Expr, unit: str | None, at: str, factor: float) -> Finding:
    told = f"{what} is stated in {unit}, but '{e}' has a unit of {factor:.6g} {unit}, and nothing converts it"
    todo = f"Multiply it by {factor:.6g}, or state the unit that it has."
    return Finding("unit", f"{plant.file}:{at}", told, todo, severe=False)


def _unconverted(e: Expr, unit: str | None, sizes: Mapping[str, float | None]) -> float | None:
    """Return the size of an expression's unit in the stated one; None if equal, unknown or converted."""
    stated, size = size_of(unit) if unit else None, _size(e, sizes)
    return size / stated if stated and size and not np.isclose(size / stated, 1.0, SAME, 0) else None


def _size(e: Expr, sizes: Mapping[str, float | None]) -> float | None:
    """Return the size of an expression's unit in SI units; None if unknown, or if a number may convert."""
    known = {q: sizes.get(q) for q in ex.names(e)}
    exponents = {p for q in ex.walk(e) if q.op == "**" for p in ex.walk(q.args[1])}
    numbers = [q for q in ex.walk(e) if q.op in ("num", "fmu", "table", "first") and q not in exponents]
    if not known or numbers or None in known.values():
        return None
    factors = []
    for seed in range(POINTS):
        drawn = np.random.default_rng(seed).uniform(0.5, 2.0, len(known))
        values = dict(zip(sorted(known), drawn, strict=True))
        in_si = {q: v * float(known[q] or 1.0) for q, v in values.items()}
        with np.errstate(all="ignore"):
            factors.append(float(np.divide(value_of(e, in_si), value_of(e, values))))
    same = np.isfinite(factors).all() and np.allclose(factors, factors[0], SAME, 0)
    return factors[0] if same else None


def _values(plant: Plant, seed: int = 0) -> dict[str, float]:
    """Return parameters as they are, and inputs and nodes at random values of a usual size."""
    rng = np.random.default_rng(seed)
    values = {p.name: p.value for p in plant.parameters.values()} | {"t": 1.0}
    items: list[Input | Node] = [*plant.inputs.values(), *plant.nodes.values()]
    for item in items:
        warm = item.unit in _TEMPERATURES or item.role in ("ambient", "temperature")
        values[item.name] = float(rng.uniform(20, 40) if warm else rng.uniform(0.1, 1))
    return values


def _storages(plant: Plant) -> list[Finding]:
    known = [n for n in plant.nodes.values() if ex.names(n.storage) <= set(plant.parameters)]
    return [f for n in known for f in storage_findings(plant, n, value_of(n.storage, _values(plant)))]


def driving_away(plant: Plant) -> list[Flow]:
    """Return the flows that drive their own nodes away: they grow with the target or fall with the source."""
    values = [_values(plant, seed) for seed in range(POINTS)]
    flows = []
    for flow in plant.flows.values():
        read = ex.names(flow.rate)
        own = [(e, way) for e, way in ((flow.source, -1.0), (flow.target, 1.0)) if e in read]
        slopes = [way * value_of(ex.derivative(flow.rate, str(e)), v) for e, way in own for v in values]
        if slopes and min(slopes) > 0:
            flows.append(flow)
    return flows


def _signs(plant: Plant) -> list[Finding]:
    """Find a flow of a node by itself that drives the node away: it should hold it back."""
    findings = []
    values = _values(plant)
    for flow in driving_away(plant):
        if _grows(plant, values) and not _grows(plant, values, flow.name):
            own = next(e for e in (flow.source, flow.target) if e in ex.names(flow.rate))
            what = (
                f"flow '{flow.name}' grows with '{own}' and drives it further away, so the plant is unstable"
            )
            advice = "Is the sign of its rate right, or its 'from' and 'into'?"
            findings.append(Finding("sign", f"{plant.file}:{flow.at}", what, advice, severe=False))
    return findings


def _grows(plant: Plant, values: dict[str, float], flip: str | None = None) -> bool:
    matrix = jacobian(plant, values, flip)
    if not np.isfinite(matrix).all():
        return False
    rates = np.linalg.eigvals(matrix)
    return bool(rates.real.max(initial=0.0) > 1e-6 * np.abs(rates).max(initial=0.0))


def _scales(plant: Plant) -> list[Finding]:
    """Find parameters that can all be multiplied by one factor without any change of a reading.

    A part of the network has such a scale if its storages and rates are homogeneous of degree 1 in them.
    Euler's theorem shows it: sum p df/dp = f. Parameters that act later, such as a step's, are left out."""
    free = {p.name for p in plant.parameters.values() if p.range}
    read = frozenset().union(
        *(ex.names(o.value) for o in plant.outputs.values()),
        *(ex.names(n.initial) for n in plant.nodes.values()),
    )
    findings = []
    for part in _parts(plant):
        flows = [f for f in plant.flows.values() if {f.source, f.target} & part]
        exprs = [f.rate for f in flows] + [plant.nodes[n].storage for n in part]
        scaled = {q for q in free & frozenset().union(*map(ex.names, exprs)) if _acts(plant, exprs, q)}
        if scaled and not scaled & read and all(_homogeneous(plant, e, scaled) for e in exprs):
            names = ", ".join(sorted(scaled))
            what = f"the readings give only ratios of {names}: all of them times one factor change nothing"
            advice = "Fix one of them: take its range away, once it is measured or computed."
            findings.append(Finding("scale", plant.file, what, advice, severe=False))
    return findings


def _parts(plant: Plant) -> list[set[str]]:
    """Return the nodes by connected part of the network of flows."""
    parts = [{n} for n in plant.nodes]
    for f in plant.flows.values():
        if f.source and f.target:
            a = next(p for p in parts if f.source in p)
            b = next(p for p in parts if f.target in p)
            if a is not b:
                a |= b
                parts.remove(b)
    return parts


def _acts(plant: Plant, exprs: Sequence[Expr], parameter: str) -> bool:
    slopes = [ex.derivative(e, parameter) for e in exprs]
    return any(value_of(s, _values(plant, seed)) for s in slopes for seed in range(POINTS))


def _homogeneous(plant: Plant, e: Expr, parameters: set[str]) -> bool:
    for seed in range(POINTS):
        values = _values(plant, seed)
        value = value_of(e, values)
        total = sum(values[q] * value_of(ex.derivative(e, q), values) for q in parameters & ex.names(e))
        if not abs(total - value) <= HOMOGENEOUS * max(abs(value), 1e-12):
            return False
    return True
