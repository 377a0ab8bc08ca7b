"""The command `plant export`."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np

from thermoctl.export.c import c_source
from thermoctl.export.fmu import write_fmu
from thermoctl.export.modelica import modelica_source
from thermoctl.export.python import python_source
from thermoctl.export.values import values
from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant, load
from thermoctl.plant import expression as ex
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.equations import Equations
from thermoctl.recording.foreign.logger import options
from thermoctl.recording.table import Table

SUFFIX = {"fmu": ".fmu", "modelica": ".mo", "python": ".py", "c": ".c"}


def export(args: argparse.Namespace) -> int:
    """Write a plant for another program. Raises InputError where that is impossible."""
    plant = load(args.plant)
    recording = None
    if args.data:
        (recording,) = read_recordings(plant, [args.data], **options(args))
    out = Path(args.out or Path(args.plant).with_suffix(SUFFIX[args.to]).name)
    if out.suffix != SUFFIX[args.to]:
        raise InputError(f"{out}: --to {args.to} writes a file that ends in {SUFFIX[args.to]}")
    write(plant, args.to, out, recording)
    print(out)
    return 0


def write(plant: Plant, to: str, out: Path, recording: Table | None = None) -> None:
    """Write a plant as `to` (a key of SUFFIX); `recording` gives first readings and widths of jumps.

    Raises InputError where the format lacks what the plant needs, or the file cannot be written."""
    equations = Equations(plant)
    if equations.fmus:
        raise InputError(
            f"{plant.file}: a plant that calls an FMU cannot be exported; write the effect into the FMU's own model"
        )
    numbers = values(plant, equations, recording)
    delays = (*equations.input_delays.values(), *equations.output_delays.values())
    ahead = [float(ex.evaluate(seconds, numbers.parameters)) for _, seconds in delays]
    if to != "python" and min(ahead, default=0.0) < 0:
        raise InputError(
            f"{plant.file}: an input is read {-min(ahead):g} s ahead of its time, which only a recording can give: "
            "shift its column and take the delay() out, or use --to python"
        )
    name = re.sub(r"\W", "_", out.stem)
    name = name if name[:1].isalpha() else f"plant_{name}"
    if to == "fmu":
        start = {}
        for i in plant.inputs.values() if recording else ():
            assert recording is not None
            column = recording.columns[i.column]
            start[i.name] = float(column[np.isfinite(column)][0])
        write_fmu(plant, numbers, out, start)
        return
    text = {
        "modelica": lambda: modelica_source(plant, numbers, name),
        "python": lambda: python_source(plant, numbers),
        "c": lambda: c_source(plant, numbers),
    }[to]()
    write_text(out, text)
