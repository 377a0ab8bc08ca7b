"""A first plant file: from a recording of temperatures, or from a template.

From a recording every thermometer becomes a body. Heat balances the sum of all bodies,

    integral of heat dt = C sum (T - T_start) + G sum integral of (T - T_air) dt,

whose least squares give the size of a body's heat capacity C and of its conductance G to the air. Everything
else is a guess with a comment in the file: which body is heated, and which bodies touch.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from thermoctl.plant.files import loads
from thermoctl.plant.units import conversion, dimension
from thermoctl.recording.logger import parsed_columns, read_recording
from thermoctl.recording.table import Table
from thermoctl.safe_file import write_text
from thermoctl.shipped import shipped
from thermoctl.yamlfile import InputError, suggest

TEMPLATES = ("block", "motor", "hot-end", "room", "tank", "stage", "flexure", "actuator")
AMBIENT = re.compile(r"air|amb|room|umgebung|luft|raum|outside|env", re.IGNORECASE)
MARGIN = 5.0  # the ranges of a first guess reach from value / MARGIN to value * MARGIN
FEW_BODIES = 3  # up to so many bodies every pair gets a link, beyond that neighbours only
LEAST_ROWS = 8


def new(args: argparse.Namespace) -> int:
    """Write a first plant file from a recording or a template. Raises InputError where FILE exists."""
    path = Path(args.file)
    if path.exists():
        raise InputError(f"{path}: exists already; name another file")
    if (args.from_csv is None) == (args.template is None):
        raise InputError(
            f"plant new: either --from-csv RECORDING or --template NAME was expected; templates: {', '.join(TEMPLATES)}"
        )
    if args.template:
        text = template(args.template)
    else:
        table = read_recording(args.from_csv, args.time, parsed_columns(args.columns))
        for note in table.notes:
            print(f"note: {table.path}: {note}", file=sys.stderr)
        text = draft(table, _names(args.inputs), _names(args.outputs))
    plant = loads(text, str(path))
    write_text(path, text)
    todo = [
        f"  {path}:{n}: {line.split('# ')[1]}"
        for n, line in enumerate(text.splitlines(), 1)
        if "# confirm" in line
    ]
    print(
        f"{path}: {len(plant.inputs)} inputs, {len(plant.nodes)} nodes, {len(plant.flows)} flows, "
        f"{len(plant.outputs)} outputs" + ("; please confirm:" if todo else "")
    )
    print(*todo, sep="\n", end="\n" if todo else "")
    return 0


def template(name: str) -> str:
    """Return a template's text. Raises InputError for an unknown name."""
    if name not in TEMPLATES:
        raise InputError(f"no template '{name}'{suggest(name, TEMPLATES)}; there are {', '.join(TEMPLATES)}")
    return (shipped("config/plants/templates") / f"{name}.yaml").read_text(encoding="utf-8")


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [n.strip() for n in text.split(",") if n.strip()]


@dataclass(frozen=True)
class _Columns:
    """The columns of a recording by what they are to the plant."""

    heats: list[str]
    air: str | None
    sensors: list[str]
    unused: list[str]


def draft(table: Table, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None) -> str:
    """Return the text of a first plant file of a thermal rig. Raises InputError without a temperature.

    `inputs`, `outputs`: columns; by default a temperature is an output, unless it is the air's by its name,
    and a power is an input."""
    found = _sorted(table, inputs, outputs)
    heats = {c: _in(table, c, "W") for c in found.heats}
    sensors = {c: _in(table, c, "degC") for c in found.sensors}
    air = (
        _in(table, found.air, "degC")
        if found.air
        else np.full(len(table), min(v[0] for v in sensors.values()))
    )
    capacity, conductance = _sizes(table.t, heats, sensors, air)
    ids = _identifiers([*found.heats, *([found.air] if found.air else []), *found.sensors])
    bodies = {c: _body(ids[c], set(ids.values())) for c in found.sensors}
    heated = {ids[c]: bodies[_heated(table.t, power, sensors)] for c, power in heats.items()}
    columns = {c: f", column: {_quoted(c)}" if c != ids[c] else "" for c in ids}
    ambient = ids[found.air] if found.air else "T_ambient"
    names, links = list(bodies.values()), _links(list(bodies.values()))
    lines = ["format: thermoctl-plant/1", f"title: {_quoted(f'First plant of {table.name}')}", "inputs:"]
    lines += [f"  {ids[c]}: {{unit: W{columns[c]}}}" for c in found.heats]
    if found.air:
        lines.append(
            f"  {ambient}: {{unit: degC{columns[found.air]}, between_samples: linear, role: ambient}}"
        )
    lines.append("parameters:")
    if not found.air:
        lines.append(f"  T_ambient: {{value: {air[0]:.4g}, unit: degC}}  # confirm: temperature of the air")
    for body in names:
        lines += [_parameter(f"C_{body}", capacity, "J/K"), _parameter(f"G_{body}", conductance, "W/K")]
    lines += [_parameter(f"G_{a}_{b}", conductance, "W/K", MARGIN**2) for a, b in links]
    lines.append("nodes:")
    for c, body in bodies.items():
        lines.append(
            f"  {body}: {{unit: degC, storage: C_{body}, initial: first({ids[c]}), initial_sigma: 0.5}}"
        )
    lines.append("flows:")
    for power, body in heated.items():
        lines.append(
            f"  heat_{power}: {{into: {body}, rate: {power}, unit: W}}  # confirm: it heats '{body}'"
        )
    for a, b in links:
        lines.append(
            f"  {a}_to_{b}: {{from: {a}, into: {b}, rate: G_{a}_{b} * ({a} - {b}), unit: W}}"
            f"  # confirm: '{a}' and '{b}' touch; if not, delete this line and G_{a}_{b}"
        )
    for body in names:
        lines.append(f"  {body}_to_air: {{from: {body}, rate: G_{body} * ({body} - {ambient}), unit: W}}")
    lines.append("outputs:")
    for c, body in bodies.items():
        lines.append(f"  {ids[c]}: {{value: {body}, unit: degC{columns[c]}{_noise(sensors[c])}}}")
    if found.unused:
        lines.append(
            f"# columns of {Path(table.path).name} that this plant does not read: {', '.join(found.unused)}"
        )
    return "\n".join(lines) + "\n"


def _parameter(name: str, value: float, unit: str, margin: float = MARGIN) -> str:
    return (
        f"  {name}: {{value: {value:.3g}, unit: {unit}, range: [{value / margin:.3g}, {value * margin:.3g}]}}"
    )


def _sorted(table: Table, inputs: Sequence[str] | None, outputs: Sequence[str] | None) -> _Columns:
    for name in (*(inputs or ()), *(outputs or ())):
        if name not in table.columns:
            raise InputError(
                f"{table.path}: no column '{name}'{suggest(name, table.columns)}; the columns are "
                f"{', '.join(table.columns)}"
            )
    warm = [
        c for c in table.columns if _is(table, c, "degC") or (c in (outputs or ()) and c not in table.units)
    ]
    airs = [c for c in warm if (c in inputs if inputs is not None else AMBIENT.search(c))]
    sensors = list(outputs) if outputs is not None else [c for c in warm if c not in airs]
    heats = [
        c for c in (inputs if inputs is not None else table.columns) if c not in airs and c not in sensors
    ]
    heats = [c for c in heats if _is(table, c, "W") or (inputs is not None and c not in table.units)]
    if inputs is not None and len(heats) + len(airs) < len(inputs):
        odd = ", ".join(f"{c} [{table.units[c]}]" for c in inputs if c not in (*heats, *airs))
        raise InputError(
            f"{table.path}: {odd}: powers and temperatures were expected; use a template instead"
        )
    wrong = [c for c in sensors if c in table.units and not _is(table, c, "degC")]
    if wrong or not sensors or not heats:
        lacking = (
            f"column '{wrong[0]}' is no temperature"
            if wrong
            else f"no {'power' if sensors else 'temperature'}"
        )
        raise InputError(
            f"{table.path}: {lacking} (columns {', '.join(table.columns)}); name them with --inputs and --outputs, or "
            f"use a template: {', '.join(TEMPLATES)}"
        )
    used = {*heats, *airs[:1], *sensors}
    return _Columns(heats, airs[0] if airs else None, sensors, [c for c in table.columns if c not in used])


def _is(table: Table, column: str, unit: str) -> bool:
    try:
        conversion(table.units.get(column, ""), unit)
    except ValueError:
        return False
    return bool(dimension(table.units[column]) or unit == "1") or table.units[column] in ("C", "F")


def _in(table: Table, column: str, unit: str) -> np.ndarray:
    """Return a column without gaps in a unit."""
    scale, offset = conversion(table.units.get(column, unit), unit)
    values = scale * table.columns[column] + offset
    good = np.isfinite(values)
    if good.sum() < LEAST_ROWS:
        raise InputError(
            f"{table.path}: column '{column}' has {good.sum()} values; {LEAST_ROWS} or more were expected"
        )
    return np.interp(table.t, table.t[good], values[good])


def _sizes(
    t: np.ndarray, heats: Mapping[str, np.ndarray], sensors: Mapping[str, np.ndarray], air: np.ndarray
) -> tuple[float, float]:
    """Return a body's heat capacity, J/K, and conductance to the air, W/K, from the heat balance."""
    dt = np.diff(t)

    def integral(values: np.ndarray) -> np.ndarray:
        """Return the integral over time up to each sample (N,); each value holds until the next sample."""
        return np.concatenate([[0.0], np.cumsum(values[:-1] * dt)])

    energy = integral(np.sum(list(heats.values()), axis=0))
    stored = np.sum([v - v[0] for v in sensors.values()], axis=0)
    lost = np.sum([integral(v - air) for v in sensors.values()], axis=0)
    capacity, conductance = np.linalg.lstsq(np.column_stack([stored, lost]), energy, rcond=None)[0]
    span = float(t[-1] - t[0])
    if not capacity > 0:
        capacity = max(abs(energy[-1]) / max(float(np.ptp(stored)), 1e-9), 1e-9)
    if not conductance > 0:
        conductance = capacity / span
    return float(capacity), float(conductance)


def _heated(t: np.ndarray, power: np.ndarray, sensors: Mapping[str, np.ndarray]) -> str:
    """Return the sensor whose rise over the recording follows the supplied energy most."""
    steps = max(len(t) // 200, 1)

    def rise(values: np.ndarray) -> float:
        """Return the covariance of a temperature's rate and the power, K W/s."""
        rate = np.diff(values[::steps]) / np.diff(t[::steps])
        drive = power[::steps][: len(rate)]
        return float(np.mean((rate - rate.mean()) * (drive - drive.mean())))

    return max(sensors, key=lambda c: rise(sensors[c]))


def _links(bodies: list[str]) -> list[tuple[str, str]]:
    pairs = list(combinations(bodies, 2))
    return pairs if len(bodies) <= FEW_BODIES else list(zip(bodies, bodies[1:], strict=False))


def _noise(values: np.ndarray) -> str:
    """Return the keys `noise` and, of a coarse sensor, `resolution`, from the second differences."""
    steps = np.abs(np.diff(values))
    quantum = float(steps[steps > 0].min(initial=np.inf))
    noise = 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / 6**0.5
    if np.isfinite(quantum) and noise < quantum:
        return f", noise: {max(noise, quantum / 12**0.5):.2g}, resolution: {quantum:.4g}"
    return f", noise: {noise:.2g}" if noise > 0 else ""


def _identifiers(columns: Sequence[str]) -> dict[str, str]:
    """Return a name of the plant language for each column."""
    found: dict[str, str] = {}
    for c in columns:
        name = re.sub(r"\W+", "_", c, flags=re.ASCII).strip("_") or "x"
        name = f"q_{name}" if name[0].isdigit() or name in ("t", "pi") else name
        while name in found.values():
            name += "_2"
        found[c] = name
    return found


def _body(sensor: str, taken: set[str]) -> str:
    """Return a body's name from its sensor's: T_block is in 'block'."""
    bare = re.sub(r"^(T|temp|temperature)_+|_+(T|C|degC|temp|temperature)$", "", sensor, flags=re.IGNORECASE)
    return (
        bare if bare and bare != sensor and not bare[0].isdigit() and bare not in taken else f"body_{sensor}"
    )


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
