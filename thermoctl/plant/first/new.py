"""The command `plant new`: a first plant file from a recording of any rig, or from a template."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant.files import loads
from thermoctl.plant.first import motion, tanks, template, thermal
from thermoctl.plant.first.columns import COLDEST, HOTTEST, Column, quoted, recognise
from thermoctl.plant.first.template import TEMPLATES
from thermoctl.recording.foreign.logger import options, print_notes, read_recording
from thermoctl.recording.foreign.units import column_of, split_unit
from thermoctl.recording.table import Table
from thermoctl.units import dimension

HEATING = ("power", "current", "voltage", "duty")
DRIVING = ("force", "torque", "current", "voltage", "duty", "power")
PUMPING = ("flow", "duty", "power", "voltage")


def new(args: argparse.Namespace) -> int:
    """Write a first plant file from a recording or a template. Raises InputError where FILE exists."""
    path = Path(args.file)
    if path.exists():
        raise InputError(f"{path}: exists already; name another file")
    if args.from_csv is None and args.template is None:
        raise InputError(
            "plant new: --from-csv RECORDING or --template NAME was expected, or both; "
            f"templates: {', '.join(TEMPLATES)}"
        )
    text = template.text(args.template) if args.template else ""
    if args.from_csv:
        text = _from_recording(args)
    plant = loads(text.replace('value: "?"', "value: 1"), str(path))
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


def _from_recording(args: argparse.Namespace) -> str:
    how = options(args)
    chosen = how["columns"]
    table = read_recording(args.from_csv, **how | ({"columns": {}} if args.template else {}))
    print_notes([table])
    inputs, outputs = _named(table, args.inputs), _named(table, args.outputs)
    columns = recognise(table, {**(inputs or {}), **(outputs or {})})
    if not args.template:
        return draft(table, columns, inputs, outputs)
    for own, name in chosen.items():
        if (column := column_of(name, columns, table.units)) is None:
            raise _no_column(table, name)
        chosen[own] = column
    text, unused = template.mapped(args.template, table, columns, chosen)
    return text + _unread(table, unused)


def draft(
    table: Table,
    columns: Mapping[str, Column],
    inputs: Mapping[str, str] | None = None,
    outputs: Mapping[str, str] | None = None,
) -> str:
    """Return the text of a first plant file: of an axis, of tanks or of a thermal rig, by the columns' kinds.

    `inputs`, `outputs`: columns that the user named, with their units where he stated them; by default the
    kinds decide. Raises InputError where nothing tells what a named column is, or none can be an output."""
    sensors = _outputs(table, columns, outputs, inputs)
    kinds = {c.kind for c in sensors}
    air = None
    if kinds & {"temperature"}:
        sensors = [c for c in sensors if c.kind == "temperature"]
        air, sensors = _air(columns, sensors, inputs, outputs)
        drives = _inputs(table, columns, inputs, (*HEATING, "temperature"), sensors, "heats")
        lines = thermal.draft(table, [c for c in drives if c.kind != "temperature"], air, sensors)
    elif kinds & {"position", "angle", "velocity", "turning"}:
        sensors = [c for c in sensors if c.kind in ("position", "angle", "velocity", "turning")]
        drives = _one_drive(table, _inputs(table, columns, inputs, DRIVING, sensors, "moves"), inputs)
        lines = motion.draft(table, drives, sensors)
    else:
        sensors = [c for c in sensors if c.kind == "level"]
        drives = _inputs(table, columns, inputs, PUMPING, sensors, "fills")
        lines = tanks.draft(table, drives, sensors)
    text = "\n".join(lines)
    head = f"format: thermoctl-plant/1\ntitle: {quoted(f'First plant of {table.name}')}\n"
    used = {
        c.name
        for c in (*drives, *sensors, *([air] if air else []))
        if quoted(c.name) in text or c.name in text
    }
    return f"{head}{text}\n{_unread(table, [c for c in table.columns if c not in used])}"


def _one_drive(table: Table, drives: list[Column], inputs: Mapping[str, str] | None) -> list[Column]:
    """Return the one input of a motion plant, with a note on others. Raises InputError for two named ones."""
    if len(drives) > 1:
        others = ", ".join(f"'{c.name}'" for c in drives[1:])
        advice = "a first motion plant has one input: name one with --inputs, and add the force of the other by hand"
        if inputs is not None:
            raise InputError(f"{table.path}: --inputs: {others} beside '{drives[0].name}'; {advice}")
        print(f"note: {table.path}: '{drives[0].name}' is the input, not {others}; {advice}", file=sys.stderr)
    return drives[:1]


def _unread(table: Table, names: Sequence[str]) -> str:
    return (
        f"# columns of {Path(table.path).name} that this plant does not read: {', '.join(names)}\n"
        if names
        else ""
    )


def _no_column(table: Table, name: str) -> InputError:
    return InputError(
        f"{table.path}: no column '{name}'{suggest(name, table.columns)}; the columns are {', '.join(table.columns)}"
    )


def _named(table: Table, text: str | None) -> dict[str, str] | None:
    """Return the stated unit, or "", of each column of --inputs or --outputs. Raises InputError."""
    if text is None:
        return None
    units = {}
    for part in (p.strip() for p in text.split(",") if p.strip()):
        name, unit = (part, None) if part in table.columns else split_unit(part)
        if name not in table.columns:
            raise _no_column(table, name)
        try:
            dimension(unit or "1")
        except ValueError as e:
            raise InputError(f"{table.path}: column '{name}': {e}") from None
        units[name] = unit or ""
    return units


def _outputs(
    table: Table,
    columns: Mapping[str, Column],
    named: Mapping[str, str] | None,
    inputs: Mapping[str, str] | None,
) -> list[Column]:
    """Return the columns that may be outputs, by `named`, else by kind. Raises InputError for none."""
    kinds = ("temperature", "position", "angle", "velocity", "turning", "level")
    if named is None:
        outputs = [c for c in columns.values() if c.kind in kinds and c.name not in (inputs or ())]
        if outputs:
            return outputs
        raise _no_output(table, list(columns.values()))
    outputs = []
    for name in named:
        c = columns[name]
        if c.kind == "" and not c.unit and name not in (inputs or ()):
            values = table.columns[name]
            low, high = float(values.min()), float(values.max())
            if not COLDEST <= low <= high <= HOTTEST:
                raise _unclear(table, c, "--outputs", "as [m] or [m/s]")
            c = Column(name, "temperature", "degC", f"'{name}' has no unit; degC by its values")
        if c.kind not in kinds:
            raise _no_output(table, [c])
        outputs.append(c)
    return outputs


def _no_output(table: Table, columns: Sequence[Column]) -> InputError:
    """Return the error that no first plant starts from these columns: asks for a unit where one lacks."""
    empty = {c.name for c in columns if not np.isfinite(table.columns[c.name]).any()}
    shown = ", ".join(f"'{c.name}'{' (no values)' if c.name in empty else _taken(c)}" for c in columns)
    bare = next((c.name for c in columns if c.name not in empty and (not c.unit or c.doubt)), None)
    unit = f"write its unit, as [degC] or [m]: --outputs '{bare} [UNIT]'; or " if bare else ""
    return InputError(
        f"{table.path}: a first plant is drawn from a temperature, position, velocity or level, and none is known in "
        f"{shown}; {unit}take a template that is near, and edit it: thermoctl plant new FILE --template NAME "
        f"({', '.join(TEMPLATES)})"
    )


def _taken(c: Column) -> str:
    """Return the unit and the kind of a column as text, such as ' [V] (voltage)'."""
    return f" [{c.unit}]" * bool(c.unit) + f" ({c.kind})" * bool(c.kind)


def _unclear(table: Table, c: Column, option: str, units: str) -> InputError:
    values = table.columns[c.name]
    return InputError(
        f"{table.path}: neither name nor unit tells what '{c.name}' is (from {values.min():.4g} to {values.max():.4g}); "
        f"write its unit, {units}: {option} '{c.name} [UNIT]'"
    )


def _air(
    columns: Mapping[str, Column],
    sensors: list[Column],
    inputs: Mapping[str, str] | None,
    outputs: Mapping[str, str] | None,
) -> tuple[Column | None, list[Column]]:
    """Return the temperature of the surroundings, if one is recorded, and the other thermometers."""
    warm = [c for c in columns.values() if c.kind == "temperature" and c.name not in (outputs or ())]
    if inputs is not None:
        air = max((c for c in warm if c.name in inputs), key=lambda c: c.outside, default=None)
    else:
        air = max((c for c in warm if c.outside), key=lambda c: c.outside, default=None)
    rest = [c for c in sensors if c is not air]
    return (air, rest) if rest else (None, sensors)


def _inputs(
    table: Table,
    columns: Mapping[str, Column],
    named: Mapping[str, str] | None,
    kinds: Sequence[str],
    sensors: Sequence[Column],
    does: str,
) -> list[Column]:
    """Return the inputs, by `named`, else by kind; none where only sensors are recorded or `named` is empty.

    Raises InputError for a wrong kind, and where an unknown column may be the input."""
    if named is None:
        drives = [
            c for c in columns.values() if c.kind in kinds and c.kind != "temperature" and c not in sensors
        ]
    else:
        # a named input in % or 1 is a share of full
        drives = [columns[n] for n in named]
        drives = [replace(c, kind="duty") if not c.kind and c.unit in ("%", "1") else c for c in drives]
        for c in drives:
            if c.kind == "" and not c.unit:
                raise _unclear(table, c, "--inputs", "as [W], [N] or, of a duty, [%] or [1]")
            if c.kind not in kinds:
                raise InputError(
                    f"{table.path}: input '{c.name}'{_taken(c)}: one of {', '.join(kinds)} was expected"
                )
    rest = [c.name for c in columns.values() if c not in sensors and c.kind != "temperature"]
    if named is None and rest and not drives:
        raise InputError(
            f"{table.path}: no column is recognised as what {does} it: {', '.join(k for k in kinds if k != 'temperature')}"
            f"; name one with its unit, such as --inputs '{rest[0]} [{'W' if does == 'heats' else 'N'}]', or none: "
            f"--inputs '' (columns {', '.join(table.columns)}), or use a template: {', '.join(TEMPLATES)}"
        )
    return drives
