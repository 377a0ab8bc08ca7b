"""Which pairs of columns `relabelled` would refit, of those that are swapped in generated cases and of all others.

    python -m tests.truth.swaps build/truth/cases [--seed 1]

In each case two pairs of columns, drawn at random, are swapped and swapped back. All pairs of the case are
counted, as they are."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from thermoctl.checks.labels import swaps
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.relabelled import better_unfitted, changed
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import SimulationError

PAIRS = 2  # of each case


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("cases", type=Path, help="folder under which each folder with an answer.yaml is a case")
    p.add_argument("--seed", type=int, default=1)
    args = p.parse_args()
    random = np.random.default_rng(args.seed)
    better, found, sound, refitted = 0, 0, 0, 0
    for folder in sorted(x.parent for x in args.cases.rglob("answer.yaml")):
        plant = load(folder / "plant.yaml")
        tables = read_recordings(plant, sorted(folder.glob("run_*.csv")))
        inputs = {i.column for i in plant.inputs.values()}
        pairs = [h for h in swaps(plant, tables) if len(inputs & {*h.columns}) != 1]
        asked = [pairs[k] for k in random.permutation(len(pairs))[:PAIRS]]
        for h in (None, *asked):
            read = [h.change(t) if h else t for t in tables]
            try:
                known = case(plant, read, {}, Budget(1))
            except (InputError, SimulationError) as e:
                print(f"{folder.parent.name} {folder.name}: {e}")
                continue
            if h is None:
                sound, refitted = sound + len(pairs), refitted + len(better_unfitted(known, pairs))
                continue
            again = changed(known, [h.change(t) for t in known.tables], known.null.cost, Budget(1))
            kept = bool(better_unfitted(known, [h]))
            better, found = better + bool(again), found + bool(again and kept)
            if not (again and kept):
                print(
                    f"{folder.parent.name} {folder.name}: {' and '.join(h.columns)}: {'not refitted' if again else 'fits no better'}"
                )
    print(
        f"of {better} swapped pairs that fit better swapped back, {found} are refitted; of {sound} others {refitted}"
    )


if __name__ == "__main__":
    main()
