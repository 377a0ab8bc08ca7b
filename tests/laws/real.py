"""Laws of real rigs, with the published form beside them: `python -m tests.laws.real RECORDINGS`.

The catalogue is left out: the law is looked for in what a refit of the naive plant leaves."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from thermoctl.diagnose.case import Budget, case
from thermoctl.diagnose.fit import fitted
from thermoctl.diagnose.held_out import split
from thermoctl.diagnose.law import find_law
from thermoctl.diagnose.law_result import law_entry
from thermoctl.diagnose.limits import limits
from thermoctl.diagnose.words import law_sentence
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings

PUBLISHED = {
    "battery_18650": "entropic heat I T dU/dT, in proportion to the current",
    "cascaded_tanks": "Torricelli, k * sqrt(h): exponent 0.5; overflow above 10 V",
    "emps": "Coulomb and viscous friction, Fc * sign(v) + Fv * v, and an offset",
    "pendulum_free_rotary": "Coulomb and square drag: crests fall by 0.0041 + 0.0013 A + 0.0084 A^2",
}


def main(folder: Path) -> None:
    """Print the law of each rig."""
    numbers = limits()
    for name, form in PUBLISHED.items():
        started = time.process_time()
        plant = load(folder / name / "plant.yaml")
        tables, reserve = split(read_recordings(plant, sorted((folder / name).glob("run_*.csv"))), ())
        known = case(plant, tables, {}, Budget(numbers.fits))
        first = fitted(known, plant, (), known.null)
        law = find_law(known, first, numbers, reserve)
        print(f"## {name}\npublished: {form}")
        if law:
            entry = law_entry(law)
            assert entry is not None
            print(
                f"found: {law_sentence(entry)}\nrms: {first.fit.rms()} -> {entry['rms']}; held-out energy closed: {law.closed:.2f}"
            )
            print("\n".join(entry["family"]))
        else:
            print("found: no law")
        print(f"{time.process_time() - started:.0f} s\n", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
