"""The whole diagnosis: five sentences, and the files that they are written to."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from thermoctl.diagnose.effects import CATALOGUE, Effect, catalogue
from thermoctl.evidence.case import Budget, case
from thermoctl.evidence.decide import Facts, decide, weigh
from thermoctl.evidence.held_out import split, worth
from thermoctl.evidence.limits import Limits, limits
from thermoctl.evidence.result import Diagnosis, contract
from thermoctl.evidence.search import search
from thermoctl.evidence.threads import one_thread
from thermoctl.evidence.unknown import Left, left
from thermoctl.plant import load, save
from thermoctl.plant.language import Plant
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table


@one_thread()
def diagnose(
    plant: Plant,
    tables: Sequence[Table],
    entries: Mapping[str, Effect],
    numbers: Limits,
    held_out: Sequence[Table] = (),
) -> Diagnosis:
    """What is missing from a plant, by recordings. Raises InputError."""
    chosen_on, reserve = split(tables, held_out)
    known = case(plant, chosen_on, entries, Budget(numbers.fits, numbers.fits))
    searched = search(known, numbers)
    posterior = weigh({w.fitted.hypothesis.keys: w.score for w in searched.tried}, numbers)
    best, null = (
        searched.tried[0].fitted,
        next(w.fitted for w in searched.tried if not w.fitted.hypothesis.effects),
    )
    after, before = left(known, best), left(known, null)
    value = worth(known, null, best, reserve)
    named = tuple(e.key for e in best.hypothesis.effects if posterior.effects[e.key] >= numbers.name)
    ratio = _ratio(value.after, value.refit_only) if best.hypothesis.effects else 1.0
    facts = Facts(posterior.something, named, max(after.over_noise.values()), closed(before, after), ratio)
    return Diagnosis(
        known, searched, posterior, best, after, before, value, decide(posterior, facts, numbers)
    )


def closed(before: Left, after: Left) -> float:
    """Share of the misfit's energy beyond the sensors' noise that is gone, each output in units of its noise."""
    was = sum((before.rms[o] / before.noise[o]) ** 2 for o in before.rms)
    now = sum((after.rms[o] / before.noise[o]) ** 2 for o in after.rms)
    return 1 - now / was if was > 0 else 1.0


def _ratio(after: Mapping[str, float], before: Mapping[str, float]) -> float:
    """Root of the mean over outputs of the ratio of mean squares; infinite where the plant could not be simulated."""
    pairs = [(after.get(o, float("inf")), before[o]) for o in before if before[o] > 0]
    return (sum((a / b) ** 2 for a, b in pairs) / max(len(pairs), 1)) ** 0.5


def write(
    plant_file: str | Path,
    recordings: Sequence[str | Path],
    out: str | Path,
    folders: Sequence[Path] = (),
    held_out: Sequence[str | Path] = (),
) -> dict[str, Any]:
    """Diagnose files and write diagnosis.json and plant.yaml into a folder. Raises InputError."""
    found = diagnose(
        load(plant_file),
        [read_table(r) for r in recordings],
        catalogue((CATALOGUE, *folders)),
        limits(),
        [read_table(r) for r in held_out],
    )
    result = contract(found)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    save(found.best.plant if found.shown else found.null.plant, folder / "plant.yaml")
    (folder / "diagnosis.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    return result
