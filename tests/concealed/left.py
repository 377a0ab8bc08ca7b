"""How much of each single effect is really left after the product's own refit, beside what the generator says.

    python -m tests.concealed.left CASES ANSWERS RESULT       # RESULT: what `python -m tests.proof --out` wrote

In white noise  sigmas^2 = sum over outputs of n (rms^2 after the refit / rms^2 of the true noise - 1) + free parameters.
Below it: how many of the small effects an ideal test finds at 4.15 sigmas (a chance of 0.5 % over 150 looks), if it knows
the noise, and if it has to learn the noise from the same record (`judge.py`). Then how many small effects, and how many
plants with nothing missing, would be called incomplete from other probabilities than the present one.
"""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import yaml
from scipy.stats import norm

THRESHOLD = 4.15
PROBABILITIES = (0.05, 0.2, 0.5, 0.9)  # that something is missing


def left(case: Path, answer: dict, fit: dict[str, float]) -> float:
    """Sigmas that a refit with these residuals (rms by output) left; negative where it fits better than the true physics."""
    plant = yaml.safe_load((case / "plant.yaml").read_text())
    count: Counter[str] = Counter()
    for f in case.glob("run_*.csv"):
        with f.open() as file:
            for row in csv.DictReader(file):
                count.update(o for o, v in plant["outputs"].items() if row[v.get("column", o)])
    free = sum("range" in p for p in plant["parameters"].values())
    square = sum(count[o] * ((rms / answer["oracle_rms"][o]) ** 2 - 1) for o, rms in fit.items()) + free
    return float(np.sign(square) * abs(square) ** 0.5)


def main(argv: list[str]) -> int:
    """The command."""
    if len(argv) != 3:
        sys.exit(__doc__)
    cases, answers, result = map(Path, argv)
    rows = json.loads((result / "proof.json").read_text())["rows"]
    rows = {r["case"]: r for r in rows if r["verdict"] != "failed"}
    small = []
    print("white noise, no outliers: case, size, verdict, sigmas by the generator, sigmas after the refit")
    for name, row in rows.items():
        answer = yaml.safe_load((answers / f"{name}.yaml").read_text())
        if row["kind"] != "one":
            continue
        if row["band"] == "small":
            small.append((answer["snr"][0], answer["snr_learnt"]))
        if answer["colour"] == "white" and answer["dirt"] != "outliers":
            fit = json.loads((result / "cases" / name / "diagnosis.json").read_text())["fit"]["refit_only"]
            told = "detected" if row["detected"] else "missed"
            print(
                f"{name} {row['band']:6s} {told:8s} {answer['snr'][0]:6.1f} {left(cases / name, answer, fit):6.1f}"
            )
    if small:
        known, learnt = norm.sf(THRESHOLD - np.array(small)).mean(axis=0)
        found = sum(
            row["detected"] for row in rows.values() if row["kind"] == "one" and row["band"] == "small"
        )
        print(
            f"of the {len(small)} small effects an ideal test finds {known:.0%}, one that has to learn the noise {learnt:.0%}; "
            f"found: {found}"
        )
    missing = {
        name: json.loads((result / "cases" / name / "diagnosis.json").read_text())["decision"]["something"]
        for name in rows
    }
    groups = {
        f"{title}, {world} world": [
            missing[n] for n, r in rows.items() if r["world"] == world and what in (r["kind"], r["band"])
        ]
        for world in ("closed", "open")
        for title, what in (("nothing missing", "none"), ("small", "small"))
    }
    print("something is missing with", *PROBABILITIES)
    for title, group in groups.items():
        if group:
            print(f"{title}, of {len(group)}:", *(sum(p >= q for p in group) for q in PROBABILITIES))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
