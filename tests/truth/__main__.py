"""Judge the diagnosis on frozen cases: make (once), diagnose, compare with an older result.

    python -m tests.truth [--number 60] [--seed S] [--form coarse] [--old FILE] [--keep FILE] [--only home,foreign,closed,open,crowded]

OUT/result.json holds the result. A diagnosis is kept for the same case and the same program: run it again to
continue. docs/proof/truth.md shows what this prints.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.proof.prove import commit
from tests.truth.cases import Case, foreign, generated, home
from tests.truth.forms import FORMS
from tests.truth.judge import Row, changes, figures, row
from tests.truth.run import diagnose
from thermoctl.fleet.batch import Reporter, run_all
from thermoctl.fleet.jobs import outcome

BASE_LINE = Path(__file__).with_name("base_line.json")
GROUPS = {
    "home": "real rigs",
    "foreign": "other people's systems",
    "closed": "generated, closed world",
    "open": "generated, open world",
    "crowded": "generated, crowded",
}
USUAL = "home,foreign,closed,open"


def say(line: str) -> None:
    """Print progress."""
    print(line, file=sys.stderr, flush=True)


def cases(a: argparse.Namespace) -> list[Case]:
    """Return the asked cases; the longest rigs first, so that no process is left with one at the end."""
    wanted = a.only.split(",")
    found = [*(home(say) if "home" in wanted else ()), *(foreign(say) if "foreign" in wanted else ())]
    numbers = {"closed": (a.number + 1) // 2, "open": (a.number + 1) // 2, "crowded": a.number * 2 // 3}
    numbers = {world: number for world, number in numbers.items() if world in wanted}
    return found + generated(a.out / "cases", numbers, a.workers, say, a.seed, a.form)


def judged(found: Sequence[Case], out: Path, workers: int) -> dict[str, Row]:
    """Diagnose what is not done yet, and judge all."""
    run_all([c.job for c in found], out, workers=workers, task=diagnose, progress=Reporter())
    rows = {}
    for c in found:
        result, run = outcome(c.job, out)
        rows[c.job.name] = row(c, result, float(run.get("cpu_s") or 0.0), run["error"])
    return rows


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures by group as a table of Markdown, for each run of `results` (title: result)."""
    lines: list[str] = []
    for group, title in GROUPS.items():
        for run, result in results.items():
            rows = [r for r in result["cases"].values() if r["group"] == group]
            if rows:
                cells = figures(rows)
                if not lines:
                    lines += [f"| cases | run | {' | '.join(cells)} |", "|---" * (len(cells) + 2) + "|"]
                lines.append(f"| {title} | {run} | {' | '.join(cells.values())} |")
    return "\n".join(lines)


def compared(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return the changes by case as a list of Markdown; both runs are cut to the cases that they share."""
    lines = [f"- {case}: *{kind}* {what}" for case, kind, what in changes(old["cases"], new["cases"])]
    return "\n".join(lines or ["- no name of 0.9 or more and no verdict changed"])


def shared(result: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with only the cases that the other has, too."""
    return {**result, "cases": {k: r for k, r in result["cases"].items() if k in other["cases"]}}


def write(rows: Mapping[str, Row], *files: Path) -> dict[str, Any]:
    """Write and return the result of this commit and day, one line a case."""
    new = {"commit": commit(), "date": datetime.now(UTC).date().isoformat(), "cases": rows}
    text = json.dumps(new, indent=None, separators=(",", ":")).replace('},"', '},\n"') + "\n"
    for path in files:
        path.write_text(text)
    return new


def options(p: argparse.ArgumentParser) -> None:
    """Add the options that choose the cases."""
    p.add_argument(
        "--number",
        type=int,
        default=60,
        help="generated cases, half of each world; crowded ones: two thirds of it",
    )
    p.add_argument("--seed", type=int, help="other generated cases: those of this seed, in both worlds")
    p.add_argument("--form", choices=FORMS, help="generated cases in another form (tests/truth/forms.py)")
    p.add_argument("--only", default=USUAL, help=f"groups of cases (default: {USUAL}; crowded)")
    p.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    p.add_argument(
        "--out", type=Path, default=Path("build/truth"), help="folder of the cases and their diagnoses"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """The command: 1 when a diagnosis failed."""
    p = argparse.ArgumentParser(prog="python -m tests.truth", description=__doc__.splitlines()[0])
    options(p)
    p.add_argument(
        "--old", type=Path, default=BASE_LINE, help="the older result (default: the committed base line)"
    )
    p.add_argument("--keep", type=Path, metavar="FILE", help="write the result into FILE, too")
    a = p.parse_args(argv)
    found = cases(a)
    if not found:
        say("no case: give --only closed,open, or the folders of the environment")
        return 2
    new = write(
        judged(found, a.out / "diagnoses", a.workers), a.out / "result.json", *([a.keep] if a.keep else [])
    )
    old = json.loads(a.old.read_text()) if a.old.exists() else {"cases": {}}
    if old["cases"].keys() & new["cases"].keys():
        old, now = shared(old, new), shared(new, old)
        print(table({f"{old['date']}, {old['commit']}": old, f"{now['date']}, {now['commit']}": now}))
        print(f"\n{compared(old, now)}")
    else:
        print(table({f"{new['date']}, {new['commit']}": new}))
    return int(any(r["error"] for r in new["cases"].values()))


if __name__ == "__main__":
    sys.exit(main())
