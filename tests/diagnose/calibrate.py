"""Set the numbers of config/diagnosis.yaml that weigh hypotheses, from generated cases with known answers.

    python -m tests.diagnose.calibrate CASES RESULTS [CASES RESULTS ...] [--real RECORDINGS OUT] [--write]

CASES as of `python -m tests.concealed.generate --answers inside`; RESULTS: the folders that `thermoctl diagnose` wrote
for them, by the same names. A diagnosis.json holds every hypothesis that was fitted, so it is decided again with
other numbers, without a refit. OUT is the folder of `python -m tests.proof --real RECORDINGS --out OUT`.

Of all combinations of values the best has the most right names less false ones, as a share of the effects that are
there: in the cases, and as much again on the real rigs. Of equal ones it has the least loss. The loss of a case is the
mean log loss of its effects' probabilities: those that are there, and those that are not. `--write` puts values and
provenance into config/diagnosis.yaml.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.proof.rigs import RIGS, Rig
from thermoctl.diagnosis.evidence.odds import rare
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue, contained
from thermoctl.diagnosis.limits import Thresholds, limits
from thermoctl.diagnosis.search.mistakes import MISTAKES
from thermoctl.diagnosis.verdict.decide import Key, Probabilities, weigh
from thermoctl.diagnosis.verdict.misfit import Energy, standing
from thermoctl.plant import load

NUMBERS = {
    "missing": (0.02, 0.05, 0.1, 0.2, 0.35, 0.5),
    "rare": (0.01, 0.03, 0.1, 0.3),
    "alike": (0.05, 0.075, 0.1, 0.15),
}
CONTAINS = contained(catalogue((CATALOGUE,)))
LEAST = 1e-3  # of a probability: the largest loss of one effect is 7
FLAT = 0.02  # of the score, about one name: less says nothing
FILE = Path("config/diagnosis.yaml")


@dataclass(frozen=True)
class Judged:
    """A case's hypotheses, and what the answer says is there.

    `likelihood` and `share`: log evidence and log prior share of places; `rare`: number of rare classes; `laws`: log odds that an
    unknown law adds in the place of an effect, without `missing` and `rare`, and its rare classes; `truths`:
    the accepted (effect, where) of each effect that is there; `tolerated`: further names that are not false."""

    name: str
    likelihood: Mapping[frozenset[Key], float]
    share: Mapping[frozenset[Key], float]
    rare: Mapping[frozenset[Key], int]
    energy: Mapping[frozenset[Key], Energy]
    dims: Mapping[Key, int]
    truths: tuple[frozenset[Key], ...]
    tolerated: frozenset[Key] = frozenset()


def judged(plant: Path, result: Path, used: Thresholds) -> Judged:
    """Read one result, still without truths; `used`: the numbers that made it."""
    entries = catalogue((CATALOGUE, MISTAKES))
    inputs = load(plant).inputs
    found = json.loads((result / "diagnosis.json").read_text())["hypotheses"]
    keyed = {frozenset(_key(e) for e in h["effects"]): h for h in found}

    dims = {k: n for h in found for k, n in zip(map(_key, sorted(h["effects"])), h["dims"], strict=True)}
    counts = {
        keys: sum(rare(entries[e], where in inputs) for e, where in keys if e in entries) for keys in keyed
    }
    missing = np.log(used.missing / (1 - used.missing))
    return Judged(
        result.name,
        {keys: h["log_evidence"] for keys, h in keyed.items()},
        {
            keys: h["log_prior_odds"] - counts[keys] * np.log(used.rare) - len(keys) * missing
            for keys, h in keyed.items()
        },
        counts,
        {keys: Energy(*(tuple(h[n]) for n in ("energy", "misfit", "rows"))) for keys, h in keyed.items()},
        dims,
        (),
    )


def concealed(case: Path, result: Path, used: Thresholds) -> Judged:
    """Read a generated case, its answer and its result."""
    answer = yaml.safe_load((case / "answer.yaml").read_text())
    return dataclasses.replace(judged(case / "plant.yaml", result, used), truths=_truths(answer))


def real(rig: Rig, folder: Path, result: Path, used: Thresholds) -> Judged:
    """Read the result of a real rig: an accepted effect is right at any place."""
    found = judged(folder / rig.folder / rig.plant, result, used)
    truths = tuple(frozenset(k for k in found.dims if k[0] in names) for names in rig.accepted)
    return dataclasses.replace(
        found, truths=truths, tolerated=frozenset(k for k in found.dims if k[0] in rig.tolerated)
    )


def _key(text: str) -> Key:
    effect, _, where = text.partition(" at ")
    return effect, where


def _truths(answer: Mapping[str, Any]) -> tuple[frozenset[Key], ...]:
    """The names and places that are accepted for each effect that is there."""
    out = []
    for effect, where in answer["effects"]:
        if effect == "?":
            continue
        names = {effect, *answer["nearly_the_same"]}
        places = {where, *(p if isinstance(p, str) else p[-1] for p in answer["nearly_the_same_places"])}
        out.append(frozenset((n, p) for n in names for p in places))
    return tuple(out)


def posterior(case: Judged, numbers: Thresholds) -> Probabilities:
    """Decide a case again with other numbers."""
    physics = standing(case.energy, case.dims, CONTAINS, numbers)
    own = np.log(numbers.missing / (1 - numbers.missing))
    scores = {
        keys: case.likelihood[keys]
        + case.share[keys]
        + len(keys) * own
        + case.rare[keys] * np.log(numbers.rare)
        for keys in physics
    }
    return weigh(scores, physics)


def names(cases: Sequence[Judged], numbers: Thresholds) -> tuple[int, int]:
    """Return the numbers of effects that are named rightly, and falsely."""
    right = false = 0
    for case in cases:
        found = posterior(case, numbers)
        likeliest = next((k for k in found.hypotheses if k), ()) if found.something >= numbers.name else ()
        named = {k for k in likeliest if found.effects[k] >= numbers.name}
        right += sum(bool(named & accepted) for accepted in case.truths)
        false += len(named.difference(*case.truths, case.tolerated))
    return right, false


def loss(case: Judged, numbers: Thresholds) -> float:
    """Return the mean log loss of one case: of each effect that is there, and of all that are not."""
    effects = posterior(case, numbers).effects
    right = [sum(effects.get(k, 0.0) for k in accepted) for accepted in case.truths]
    known = frozenset().union(*case.truths)
    wrong = [p for k, p in effects.items() if k not in known]
    terms = [-np.log(np.clip(p, LEAST, 1.0)) for p in right]
    terms.append(-float(np.sum(np.log(np.clip(1 - np.array(wrong), LEAST, 1.0)))))
    return float(np.mean(terms))


def calibrated(
    cases: Sequence[Judged], rigs: Sequence[Judged], numbers: Thresholds
) -> tuple[Thresholds, dict[str, tuple[float, float]]]:
    """Return the numbers with the best names, and for each the range in which the names are as good."""
    there = [sum(len(c.truths) for c in of) for of in (cases, rigs)]
    tried = {}
    for values in product(*NUMBERS.values()):
        other = dataclasses.replace(numbers, **dict(zip(NUMBERS, values, strict=True)))
        of = names(cases, other), names(rigs, other)
        score = sum((right - false) / max(n, 1) for (right, false), n in zip(of, there, strict=True))
        tried[values] = (round(score, 6), -sum(loss(c, other) for c in cases), of)
    best = max(tried, key=lambda v: tried[v][:2])
    ranges = {}
    for k, (name, values) in enumerate(NUMBERS.items()):
        row = {v: tried[(*best[:k], v, *best[k + 1 :])] for v in values}
        flat = [v for v in values if row[v][0] >= tried[best][0] - FLAT]
        ranges[name] = (flat[0], flat[-1])
        print(f"{name} {best[k]:g}; by value: loss; names of cases, of rigs (right, false)")
        for v, (_, gain, of) in row.items():
            print(f"  {v:<6g} {-gain:7.2f}  {of[0]}  {of[1]}")
    return dataclasses.replace(numbers, **dict(zip(NUMBERS, best, strict=True))), ranges


def write(
    numbers: Thresholds, ranges: Mapping[str, tuple[float, float]], cases: Sequence[str], n: int, rigs: int
) -> None:
    """Put values and provenance into config/diagnosis.yaml."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    )
    lines, name = [], ""
    for line in FILE.read_text().splitlines():
        if line and not line.startswith((" ", "#")):
            name = line.rstrip(":")
        if name in ranges and line.startswith("  value:"):
            line = f"  value: {getattr(numbers, name):g}"
        if name in ranges and line.startswith("  set_by:"):
            low, high = ranges[name]
            line = (
                f"  set_by: make calibrate-diagnosis, {n} cases ({', '.join(cases)}) and {rigs} diagnoses of rigs, commit "
                f"{commit.stdout.strip()}; as many names right from {low:g} to {high:g}"
            )
        lines.append(line)
    FILE.write_text("\n".join(lines) + "\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate on folders of cases and results."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("folders", nargs="+", type=Path, help="CASES RESULTS [CASES RESULTS ...]")
    p.add_argument("--real", nargs=2, type=Path, metavar=("RECORDINGS", "OUT"))
    p.add_argument("--write", action="store_true")
    args = p.parse_args(argv)
    used = limits()
    cases = [
        concealed(case, result, used)
        for folder, results in zip(args.folders[::2], args.folders[1::2], strict=True)
        for case in sorted(folder.iterdir())
        if ((result := results / case.name) / "diagnosis.json").exists()
    ]
    rigs = [
        real(rig, args.real[0], result, used)
        for rig in (RIGS if args.real else ())
        if ((result := args.real[1] / "cases" / rig.name) / "diagnosis.json").exists()
    ]
    print(f"{len(cases)} cases, {len(rigs)} diagnoses of rigs")
    numbers, ranges = calibrated(cases, rigs, used)
    if args.write:
        write(numbers, ranges, [f.name for f in args.folders[::2]], len(cases), len(rigs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
