"""Laws of real rigs, with the published form beside them: `python -m tests.laws.real RECORDINGS [RIG ...]`.

The catalogue is left out: the law is looked for in what a refit of the naive plant leaves."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.proof.rigs import RIGS, Rig
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.law.result import law_entry
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report.words import law_sentence
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings

PUBLISHED = {
    "battery": "reversible heat, I T dU/dT, that changes with the charge drawn; a resistance that rises when nearly empty",
    "tanks": "Torricelli, k * sqrt(h): exponent 0.5; overflow above 10 V",
    "emps": "Coulomb friction 20.4 N, viscous friction 203.5 N s/m, an offset of -3.2 N; a little more in one direction",
    "pendulum": "Coulomb and square drag: crests fall by 0.0041 + 0.0013 A + 0.0084 A^2",
    "silverbox": "a cubic spring",
}


def law_of(folder: Path, rig: Rig, without: Sequence[str] = ()) -> Diagnosis:
    """Return the diagnosis without the catalogue, and without some columns of the recordings."""
    numbers, plant = limits(), load(folder / rig.folder / rig.plant)

    def read(names: str):
        tables = read_recordings(plant, [folder / rig.folder / f"{n}.csv" for n in names.split()])
        for t in tables:
            for column in without:
                del t.columns[column]
        return tables

    return diagnose(plant, read(rig.runs), {}, numbers, read(rig.held_out))


def main(folder: Path, names: Sequence[str]) -> None:
    """Print the law of each rig."""
    for rig in RIGS:
        if not (folder / rig.folder / rig.plant).is_file() or (names and rig.name not in names):
            continue
        started = time.process_time()
        d = law_of(folder, rig)
        law = d.law
        print(f"## {rig.name}")
        if rig.name in PUBLISHED:
            print(f"published: {PUBLISHED[rig.name]}")
        if law:
            entry = law_entry([law], d.worth)
            assert entry is not None
            print(f"found: {law_sentence(entry)}")
            print(f"rms: {d.null.fit.rms()} -> {entry['rms']}; energy closed: {d.worth.share_closed:.2f}")
            print("\n".join(entry["equivalent"]))
        else:
            print("found: no law")
        print(f"{time.process_time() - started:.0f} s\n", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
