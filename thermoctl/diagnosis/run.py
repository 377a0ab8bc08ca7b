"""Diagnose recordings and write diagnosis.json, plant.yaml, report.html and the next experiment."""

from __future__ import annotations

import dataclasses
import html
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from thermoctl.diagnosis import diagnose as engine
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.data import memory
from thermoctl.diagnosis.evidence.fit import remembered
from thermoctl.diagnosis.experiment import file as experiment_file
from thermoctl.diagnosis.experiment.design import NONE, Ranges
from thermoctl.diagnosis.experiment.propose import propose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits as numbers
from thermoctl.diagnosis.relabelled import relabelled
from thermoctl.diagnosis.report.page import write_report
from thermoctl.diagnosis.report.trend import earlier_trends, trend_notes, trends
from thermoctl.diagnosis.report.unseen import not_seen
from thermoctl.diagnosis.report.words import words
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.diagnosis.threads import one_thread
from thermoctl.extras import lacking
from thermoctl.files.safe_file import whole_files, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, save
from thermoctl.plant.language import Plant
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import SimulationError
from thermoctl.recording.table import Table
from thermoctl.report.page import page

STOPPED = (
    "stopped by hand after {} refits: probabilities compare the hypotheses that were tried; what was not tried may be "
    "likelier; diagnose again for the whole search"
)


@one_thread()
def diagnose(
    plant: Plant,
    tables: Sequence[Table],
    out: str | Path,
    effects: Sequence[Path] = (),
    held_out: Sequence[Table] = (),
    progress: Callable[[str], None] | None = None,
    drivable: Sequence[str] = (),
    limits: Ranges = NONE,
    stopped: Callable[[], bool] = lambda: False,
    earlier: Path | None = None,
    anyway: bool = False,
) -> dict[str, Any]:
    """Diagnose recordings, write the result into the folder `out` (all files or none), return it.

    - `effects`: folders of effects beside the catalogue
    - `held_out`: recordings that take no part in any choice
    - `drivable`: inputs that the next experiment may drive (default: those that changed)
    - `limits`: ranges of inputs and outputs in the next experiment
    - `stopped`: once true, the result is that of the hypotheses tried so far, with a note
    - `earlier`: the folder of an earlier diagnosis, which goes on with these recordings
    - `anyway`: write the result even where wrong columns explain the recordings better than physics

    Raises InputError for unusable inputs."""
    if not tables:
        raise InputError("no recording was given; one or more were expected")
    started, folder = time.monotonic(), writable(Path(out))
    named = _distinct([*tables, *held_out])
    chosen_on, reserve = named[: len(tables)], named[len(tables) :]
    before, sizes = memory.read(earlier, plant) if earlier else memory.Memory(), earlier_trends(earlier)
    if again := {t.name for t in named} & set(before.recordings):
        raise InputError(
            f"{earlier}: holds {', '.join(sorted(again))} already; recordings that it has not seen were expected"
        )
    try:
        diagnosis = engine.diagnose(
            plant, chosen_on, catalogue((CATALOGUE, *effects)), numbers(), reserve, progress, stopped, before
        )
    except SimulationError as e:
        raise InputError(f"{plant.file}: the plant cannot follow these recordings at all: {e}") from None
    if not (anyway or stopped()) and (wrong := relabelled(diagnosis)):
        raise InputError(f"{wrong[0]} (--anyway diagnoses in spite of it)")
    proposed = None if stopped() else propose(diagnosis, drivable, limits, progress)
    result = contract(diagnosis)
    result["next_experiment"] = proposed[0] if proposed else None
    result["trends"] = trends(diagnosis, sizes)
    result["notes"] += trend_notes(result["trends"])
    if before.recordings:
        result["notes"].insert(0, f"goes on from {len(before.recordings)} earlier recordings ({earlier})")
    if stopped():
        result["notes"].insert(0, STOPPED.format(diagnosis.case.budget.fits_done))
    result["not_seen"] = (
        not_seen(diagnosis) if diagnosis.decision.verdict == "consistent" and not stopped() else []
    )
    result["seconds"] = round(time.monotonic() - started, 1)
    _write(folder, plant, diagnosis, result, proposed)
    return result


def _write(folder: Path, plant: Plant, diagnosis: Diagnosis, result: dict[str, Any], proposed: Any) -> None:
    """Write all files of a result, or none."""
    with whole_files(folder, remove=experiment_file.FILES) as part:
        added = "".join(f"; with {e.key[0]} at {e.key[1]}" for e in diagnosis.shown)
        save(diagnosis.plant, part / "plant.yaml", note=f"{Path(plant.file).name}, refitted{added}")
        load(part / "plant.yaml")
        _report(diagnosis, result, part / "report.html")
        write_text(part / "diagnosis.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
        memory.write(part, plant, _remembered(diagnosis))
        if proposed:
            experiment_file.write(part, diagnosis.case, *proposed)


def _report(diagnosis: Diagnosis, result: dict[str, Any], path: Path) -> None:
    """Write report.html; without matplotlib only the summary, with a note in the result."""
    try:
        write_report(diagnosis, result, path)
    except ModuleNotFoundError as e:
        if (line := lacking(e)) is None:
            raise
        result["notes"].append(f"report.html without figures and tables: {line}")
        summary = html.escape(f"{words(result)} {result['notes'][-1]}")
        write_text(path, page("Diagnosis", [("", f"<p>{summary}</p>")]))


def _remembered(diagnosis: Diagnosis) -> memory.Memory:
    """Return the memory for a later diagnosis: the likeliest hypotheses, and the plant without effects."""
    kept = [
        w.fitted
        for k, w in enumerate(diagnosis.searched.tried)
        if k < memory.KEPT or not w.fitted.hypothesis.effects
    ]
    names = (*diagnosis.case.memory.recordings, *(t.name for t in diagnosis.case.tables))
    straight = tuple(i.name for i in diagnosis.case.plant.inputs.values() if i.linear and not i.stated)
    return memory.Memory(tuple(remembered(diagnosis.case, f) for f in kept), names, straight)


def diagnose_files(
    plant_file: str | Path,
    recordings: Sequence[str | Path],
    out: str | Path,
    effects: Sequence[Path] = (),
    held_out: Sequence[str | Path] = (),
) -> dict[str, Any]:
    """Diagnose recordings that are named by their files. Raises InputError."""
    plant = load(plant_file)
    tables, reserve = read_recordings(plant, recordings), read_recordings(plant, held_out)
    return diagnose(plant, tables, out, effects, reserve)


def writable(folder: Path) -> Path:
    """Return the folder of a result, if files can be written there; else InputError before the work."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file; a folder for the result was expected (--out)")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder if folder.exists() else folder.parent):
            pass
    except OSError as e:
        raise InputError(
            f"{folder}: the result cannot be written there: {e.strerror}; give another --out"
        ) from None
    return folder


def _distinct(tables: Sequence[Table]) -> list[Table]:
    """Return the tables with distinct names: a name that occurs twice gets its folder's name in front."""
    names = [t.name for t in tables]
    return [
        t if names.count(t.name) == 1 else dataclasses.replace(t, name=f"{Path(t.path).parent.name}_{t.name}")
        for t in tables
    ]
