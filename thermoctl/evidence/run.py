"""The whole diagnosis: five sentences, and the files that they are written to."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from thermoctl.diagnose.effects import CATALOGUE, Effect, catalogue
from thermoctl.evidence.case import Budget, case
from thermoctl.evidence.decide import Facts, decide, weigh
from thermoctl.evidence.fit import as_refitted
from thermoctl.evidence.held_out import split, worth
from thermoctl.evidence.limits import Limits, limits
from thermoctl.evidence.result import Diagnosis, contract
from thermoctl.evidence.search import search
from thermoctl.evidence.threads import one_thread
from thermoctl.evidence.unknown import Left, left, reached
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
    """Find the physics that a plant lacks, from recordings. Raises InputError."""
    chosen_on, reserve = split(tables, held_out)
    known = case(plant, chosen_on, entries, Budget(numbers.fits))
    searched = search(known, numbers)
    posterior = weigh({w.fitted.hypothesis.keys: w.score for w in searched.tried}, numbers)
    best = searched.tried[0].fitted
    null = as_refitted(known, next(w.fitted for w in searched.tried if not w.fitted.hypothesis.effects))
    if not best.hypothesis.effects or posterior.something < numbers.name:
        best = null  # an effect that is not supported explains nothing of what is left
    reach = reached(known)
    after, before = left(known, best, reach), left(known, null, reach)
    value = worth(known, null, best, reserve)
    named = tuple(e.key for e in best.hypothesis.effects if posterior.effects[e.key] >= numbers.name)
    # data that took part in the choice cannot speak against it
    ratio = _ratio(value.after, value.refit_only) if best.hypothesis.effects and value.reserved else 1.0
    facts = Facts(posterior.something, named, max(after.over_noise.values()), closed(before, after), ratio)
    return Diagnosis(
        known, searched, posterior, best, null, after, before, value, decide(posterior, facts, numbers)
    )


def closed(before: Left, after: Left) -> float:
    """Return the share of the misfit's energy that the findings remove.

    The misfit is the residual beyond the sensors' noise; its energy is in units of each output's noise."""
    was = sum((before.rms[o] / before.noise[o]) ** 2 for o in before.rms)
    now = sum((after.rms[o] / before.noise[o]) ** 2 for o in after.rms)
    return 1 - now / was if was > 0 else 1.0


def _ratio(after: Mapping[str, float], before: Mapping[str, float]) -> float:
    """Return the root of the outputs' mean ratio of mean squares; infinite if a simulation failed."""
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
