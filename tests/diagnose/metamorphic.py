"""Changes of a case that must not change its diagnosis: spelling, order, units, clock, losses, thinning, stated noise.

    python -m tests.diagnose.metamorphic [--cases N] [--changes names,order] [--work DIR]

prints a Markdown table, case by change: `same`, or what differs. The same are verdict, effects and places, with each
probability within CLOSE. The cases are the generator's (tests/concealed), thinned to a few hundred rows.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.concealed.generate import NotVisible, make_case
from tests.diagnose.changes import CHANGES, PLAIN, SEED, Change, Given, thinned
from thermoctl.diagnosis.run import diagnose_files

CLOSE = 0.02  # probabilities that differ by less are the same (issue 23)
EITHER_WAY = ("missing_link", "bending")  # their two places may be named in either order
TIMES = {  # that every second row of a family's recordings is left out at first
    "tanks": 1,
    "heater": 3,
    "drive": 3,
    "flexure": 2,
}
CASES = (  # family, number, kind, world; the quick ones first
    ("tanks", 0, "one", "closed"),
    ("heater", 1, "one", "open"),
    ("tanks", 1, "one", "open"),
    ("heater", 2, "none", "closed"),
    ("tanks", 2, "none", "open"),
    ("heater", 3, "pair", "closed"),
    ("tanks", 3, "unknown", "open"),
    ("heater", 4, "unknown", "open"),
    ("drive", 1, "one", "open"),
    ("drive", 2, "unknown", "closed"),
    ("drive", 0, "none", "open"),
    ("flexure", 2, "none", "closed"),
    ("flexure", 0, "one", "closed"),
    ("flexure", 1, "one", "open"),
)


def drawn(family: str, number: int, kind: str, world: str) -> tuple[Given, dict[str, Any]]:
    """A case of the generator, thinned TIMES, and its answer."""
    plant, runs, answer = make_case(SEED, number, [family], True, kind, world)
    plain = yaml.safe_load(yaml.safe_dump(json.loads(json.dumps(plant, default=float))))
    rig = Given(plain, {f"run_{k + 1}": dict(run) for k, run in enumerate(runs)})
    for _ in range(TIMES[family]):
        rig = thinned(rig, PLAIN)
    return rig, answer


def diagnosed(rig: Given, folder: Path) -> dict[str, Any]:
    """The diagnosis of a case by its files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plant.yaml").write_text(yaml.safe_dump(rig.plant, sort_keys=False))
    files = []
    for name, c in rig.recordings.items():
        rows = np.stack(list(c.values()), axis=1)
        text = "\n".join(",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows)
        files.append(folder / f"{name}.csv")
        files[-1].write_text(",".join(c) + "\n" + text + "\n")
    return diagnose_files(folder / "plant.yaml", files, folder / "out")


def findings(found: Mapping[str, Any], back: Mapping[str, str]) -> dict[str, float]:
    """Effect at place, with the names as they were: probability."""
    out = {}
    for f in found["findings"]:
        ends = [back.get(w, w) for w in f["where"].split("-")]
        kinds = " or ".join(sorted(f["effect"].split(" or ")))  # of a family, in any order
        out[f"{kinds} at {'-'.join(sorted(ends) if f['effect'] in EITHER_WAY else ends)}"] = f["probability"]
    return out


def difference(one: Mapping[str, Any], other: Mapping[str, Any], back: Mapping[str, str]) -> str:
    """What of a diagnosis is another after a change; empty where it is the same."""
    a, b = findings(one, {}), findings(other, back)
    said = [] if one["verdict"] == other["verdict"] else [f"{one['verdict']} -> {other['verdict']}"]
    said += [f"without {k} ({a[k]:.2f})" for k in a if k not in b]
    said += [f"with {k} ({b[k]:.2f})" for k in b if k not in a]
    said += [f"{k}: {a[k]:.3f} -> {b[k]:.3f}" for k in a if k in b and abs(a[k] - b[k]) > CLOSE]
    return "; ".join(said)


def compared(rig: Given, changes: Sequence[str], work: Path) -> dict[str, str]:
    """The verdict without a change, and what differs after each change."""
    before: dict[Change | None, dict[str, Any]] = {None: diagnosed(rig, work / "base_0")}
    out = {"": before[None]["verdict"]}
    for label in changes:
        common, change = CHANGES[label]
        base = rig if common is None else common(rig)
        assert base is not None
        changed = change(base)
        if changed is None:
            out[label] = "-"
            continue
        if common not in before:
            before[common] = diagnosed(base, work / f"base_{len(before)}")
        found = diagnosed(changed, work / label)
        out[label] = difference(before[common], found, changed.back) or "same"
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 1 where something differs."""
    p = argparse.ArgumentParser(prog="python -m tests.diagnose.metamorphic", description=__doc__)
    p.add_argument("--cases", type=int, default=len(CASES), metavar="N", help="the first N cases only")
    p.add_argument("--changes", default=",".join(CHANGES), help="only these changes")
    p.add_argument("--work", type=Path, help="keep the files of all diagnoses here")
    a = p.parse_args(argv)
    changes = a.changes.split(",")
    print(f"| case | verdict | {' | '.join(changes)} |\n|---|---|{'---|' * len(changes)}", flush=True)
    total = same = 0
    with tempfile.TemporaryDirectory() as folder:
        for family, number, kind, world in CASES[: a.cases]:
            begun = time.process_time()
            name = f"{family} {number}, {kind}, {world}"
            try:
                rig, answer = drawn(family, number, kind, world)
            except NotVisible as e:
                print(f"{name}: {e}", file=sys.stderr, flush=True)
                continue
            found = compared(rig, changes, (a.work or Path(folder)) / re.sub(r"\W+", "_", name))
            total += sum(found[c] != "-" for c in changes)
            same += sum(found[c] == "same" for c in changes)
            print(f"| {name}: {answer['effects']} | {' | '.join(found.values())} |", flush=True)
            print(f"{name}: {time.process_time() - begun:.0f} s", file=sys.stderr, flush=True)
    print(f"\n{same} of {total} the same")
    return int(same < total)


if __name__ == "__main__":
    sys.exit(main())
