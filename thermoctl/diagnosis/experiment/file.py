"""The proposed experiment as files: one for `thermoctl experiment`, and a table of its inputs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.experiment.design import Excitation, together
from thermoctl.files.safe_file import write_text
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

FORMAT = "thermoctl-experiments/1"
FILES = ("next_experiment.yaml", "next_experiment.csv")
SETPOINT = "setpoint_um"  # the daemon commands it; the current of a flexure's actuator follows it
ROWS = 20_000  # largest number of rows in the table for a person


def write(folder: Path, case: Case, entry: Mapping[str, Any], chosen: Excitation) -> None:
    """Write FILES into a folder.

    On a rig that this program controls, the experiment commands the setpoint."""
    plant = case.plant
    driven = {plant.inputs[n].column: (plant.inputs[n].unit, c) for n, c in chosen.corners.items()}
    if (corners := _as_setpoint(case, chosen)) is not None:
        driven = {SETPOINT: ("um", corners)}
    constant = {plant.inputs[n].column: v for n, v in chosen.starts.items() if n in plant.inputs}
    lines = [
        f"# {chosen.title}",
        f"# {entry['why']}",
        *(f"# {line}" for line in peaks(entry)),
        f"format: {FORMAT}",
        "experiments:",
        "  next_experiment:",
        f"    title: {json.dumps(chosen.title)}",
        f"    sample_s: {entry['sample_s']:.9g}",
        "    inputs:",
    ]
    for column, (unit, c) in driven.items():
        lines.append(
            f"      {json.dumps(column)}: {{"
            + (f"unit: {json.dumps(unit)}, " if unit else "")
            + f"corners: [{', '.join(f'[{t:.9g}, {v:.9g}]' for t, v in c)}]}}"
        )
    if constant:
        lines.append("    assumed:            # the surroundings, as the prediction takes them; not driven")
        lines += [f"      {json.dumps(column)}: {v:.9g}" for column, v in constant.items()]
    if entry["predicted"]:
        lines.append(
            "    predicted:          # lowest and highest of each reading; checked against the rig's protection"
        )
        for p in entry["predicted"].values():
            lines.append(f"      {json.dumps(p['column'])}: [{p['low']:.6g}, {p['high']:.6g}]")
    write_text(folder / FILES[0], "\n".join(lines) + "\n")
    t = np.arange(0.0, chosen.duration_s + 1e-9, max(entry["sample_s"], chosen.duration_s / ROWS))
    columns = {n: np.interp(t, c[:, 0], c[:, 1]) for n, (_, c) in driven.items()}
    write_table(folder / FILES[1], Table("next_experiment", FILES[1], t, columns))


def _as_setpoint(case: Case, chosen: Excitation) -> np.ndarray | None:
    """Find the setpoint's corners where the recordings show that a driven input follows it."""
    if any(SETPOINT not in t.columns for t in case.tables):
        return None
    setpoint = np.concatenate([t.columns[SETPOINT] for t in case.tables])
    for n, c in chosen.corners.items():
        values = np.concatenate([t.columns[case.plant.inputs[n].column] for t in case.tables])
        if line := together(values, setpoint):
            inside = np.clip(c[:, 1] * line[0] + line[1], np.nanmin(setpoint), np.nanmax(setpoint))
            return np.column_stack([c[:, 0], inside])
    return None


def peaks(entry: Mapping[str, Any]) -> list[str]:
    """Write each reading's predicted range as a line, beside the recorded range and its limit."""
    lines = []
    for name, p in entry["predicted"].items():
        unit = f" {p['unit']}" if p["unit"] else ""
        recorded = (
            f"recorded {p['recorded'][0]:.4g} to {p['recorded'][1]:.4g}"
            if p["recorded"]
            else "never recorded"
        )
        limit = entry["limits"].get(name)
        kept = f", --limit {limit[0]:g} to {limit[1]:g}" if limit else ""
        lines.append(f"{name}: {p['low']:.4g} to {p['high']:.4g}{unit} predicted ({recorded}{kept})")
    return lines
