"""Pairs of columns that are swapped in generated cases, and which of them `relabelled` would refit and find.

    python -m tests.truth.swaps build/truth/cases [--seed 1]

In each case two pairs of columns, drawn at random, are swapped. The costs are those of the swap back, over the
cost as recorded: before a refit, after a linear step, and refitted. It is found where the last is below 1."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from thermoctl.checks.labels import swaps
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.data.columns import Columns
from thermoctl.diagnosis.relabelled import likely
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
    found: list[tuple[bool, bool]] = []
    for folder in sorted(x.parent for x in args.cases.rglob("answer.yaml")):
        plant = load(folder / "plant.yaml")
        tables = read_recordings(plant, sorted(folder.glob("run_*.csv")))
        inputs = {i.column for i in plant.inputs.values()}
        pairs = [h for h in swaps(plant, tables) if len(inputs & {*h.columns}) != 1]
        for h in (pairs[k] for k in random.permutation(len(pairs))[:PAIRS]):
            try:
                known = case(plant, [h.change(t) for t in tables], {}, Budget(1))
                columns, cost = Columns(known), known.null.cost
                at, after = columns.promised(h.change)
                again = columns.changed(h.change, cost, Budget(1))
            except (InputError, SimulationError) as e:
                print(f"{folder.name}: {' and '.join(h.columns)}: {e}")
                continue
            found.append((again is not None, likely(at, after, cost, cost)))
            refitted = f"{again.null.cost / cost:.3g}" if again else "above 1"
            print(
                f"{folder.parent.name} {folder.name}: {' and '.join(h.columns)}: {at / cost:.3g} {after / cost:.3g} {refitted}"
                f"{'' if found[-1][1] else ', not refitted'}"
            )
    print(
        f"{len(found)} pairs: {sum(a for a, _ in found)} fit better; {sum(a and b for a, b in found)} of these are refitted"
    )


if __name__ == "__main__":
    main()
