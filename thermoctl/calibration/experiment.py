"""Run one experiment and record it.

A test of setpoints on a rig, or an experiment of inputs on a plant file."""

from __future__ import annotations

import functools
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

from thermoctl.calibration import drive, schedules
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import as_table, kept, recover, stream_of
from thermoctl.configuration.settings import Settings
from thermoctl.files.safe_file import WriteError, check_writable, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import experiments
from thermoctl.interrupt import STATUS
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.files import table_kind, write_table
from thermoctl.recording.table import Table

ENDED = 3  # exit status of a test that ended early


def of_inputs(path: str) -> experiments.Inputs:
    """Read the one experiment of a file that lists inputs."""
    listed = list(experiments.load_inputs(path).values())
    if len(listed) != 1:
        raise InputError(f"{path}: {len(listed)} experiments that list inputs; one was expected")
    return listed[0]


def on_plant(inputs: experiments.Inputs, plant_file: str | None, path: Path) -> int:
    """Describe an experiment of inputs.

    Run it on a plant file and record it at `path` where one is given."""
    driven = ", ".join(f"{n} {c[:, 1].min():.4g} to {c[:, 1].max():.4g}" for n, c in inputs.corners.items())
    print(f"{inputs.title}: {inputs.duration_s / 60:.4g} min, every {inputs.sample_s:g} s; drives {driven}")
    if plant_file is None:
        return 0
    plant = load(plant_file)
    t, columns = inputs.columns()
    missing = {i.column for i in plant.inputs.values()} - set(columns)
    if missing:
        raise InputError(
            f"experiment '{inputs.name}' says nothing of {', '.join(sorted(missing))}, which {plant_file} reads"
        )
    table = Table(path.stem, str(path), t, columns)
    try:
        write_table(path, compile_plant(plant, ()).measure(table, seed=len(t)))
    except SimulationError as e:
        raise InputError(f"{plant_file}: {e}") from None
    print(f"{path}: {len(t)} rows")
    return 0


def on_rig(
    settings: Settings, schedule: experiments.Schedule, path: Path, dry_run: bool, resume: bool, yes: bool
) -> int:
    """Describe a test of setpoints, ask, run it on the rig and record it.

    Returns 1 when the user answered no, ENDED when it ended early, STATUS when the user ended it."""
    schedules.within_limits(settings, [schedule])
    there = [p for p in (stream_of(path), path) if p.exists()]
    if there and not dry_run and not (resume and _progress(path).exists()):
        raise InputError(f"{there[0]}: exists, and is never overwritten; name another file by --out")
    print(
        f"{schedule.title}: {schedules.span(schedule.duration_s)}, {len(schedule.commands())} moves, "
        f"{schedule.setpoint_um.min():g} to {schedule.setpoint_um.max():g} um"
    )
    print("\n".join(schedules.power_lines(settings, schedule)))
    if dry_run:
        return 0
    table_kind(path)
    check_writable(path)
    rig = drive.rig_of(settings)
    if not drive.agreed(rig, [schedule], yes):
        return 1
    return _record(rig, schedule, path, resume)


def _write(path: Path, table: Table) -> None:
    """Write the rows of a test, in the folder of temporary files where `path` cannot be written any more."""
    try:
        write_table(path, table)
    except WriteError as e:
        spare = Path(tempfile.mkdtemp(prefix="thermoctl-"), path.name)
        write_table(spare, table)
        raise InputError(
            f"{e.why}; its {len(table)} rows are in {spare}: move them before a restart"
        ) from None


def _progress(path: Path) -> Path:
    """Return the file that holds the time that an unfinished recording reached."""
    return path.with_name(path.name + ".progress")


def _note(path: Path, done_s: list[float]) -> None:
    """Write the time reached, for --resume."""
    write_text(_progress(path), f"{done_s[0]:.3f}\n")


def _reached(path: Path) -> float:
    """Return the time, s, that an unfinished recording reached. Raises InputError for a damaged file."""
    text = _progress(path).read_text(errors="replace")
    try:
        if 0.0 <= (reached_s := float(text)) < math.inf:
            return reached_s
    except ValueError:
        pass
    raise InputError(
        f"{_progress(path)}: {text[:40]!r}: the seconds that {path} reached were expected; name another file by --out and start "
        "again without --resume"
    )


def _record(rig: drive.DrivenRig, schedule: experiments.Schedule, path: Path, resume: bool) -> int:
    """Run a schedule and write the rows; no signal ends it before they are written."""
    earlier, at_s = None, 0.0
    if resume and _progress(path).exists():
        recover(path)
        earlier, at_s = drive.earlier_part(rig, path, _reached(path), print)
    keyboard = Keyboard(sys.stdin.isatty() and sys.stderr.isatty())
    blocks: list[np.ndarray] = []
    done_s = [at_s]

    def show(p: experiments.Progress) -> None:
        """Keep the time reached, s, for --resume; on a terminal also print the progress."""
        done_s[0] = p.done_s
        if sys.stderr.isatty():
            print(f"\r{p.percent:5.1f} %  {p.eta_s:6.0f} s left", end="", file=sys.stderr, flush=True)

    note = functools.partial(_note, path, done_s)
    ended = ""
    with keyboard.listening():
        try:
            run = rig.run(schedule, show, keyboard, earlier, at_s)
            for block in kept(run, path, rig.settings.row, note):
                blocks.append(block)
        except experiments.Aborted as e:
            ended = e.reason
        if blocks:
            rows = np.vstack(blocks)
            _write(path, as_table(rows, path, rig.settings.row))
        if ended:
            note()
        stream_of(path).unlink(missing_ok=True)
    if blocks:
        print(f"{path}: {len(rows)} rows")
    if not ended:
        _progress(path).unlink(missing_ok=True)
        return 0
    print(
        f"ended after {done_s[0]:.0f} of {schedule.duration_s:.0f} s, the amplifier is disabled: {ended}; "
        f"go on with --resume --out {path}",
        file=sys.stderr,
    )
    return STATUS if keyboard.ended else ENDED
