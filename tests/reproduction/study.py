"""Run all seeds of simulated rigs, measure the goals, write the report and its figures."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.reproduction import closed_loop
from tests.reproduction.goals import Goal, Limit, goals, limits
from tests.reproduction.report import report
from tests.reproduction.rigs import CHAMBER, DISTURBANCES
from tests.reproduction.seeds import Kept, SeedResult, one_seed
from thermoctl.calibration.schedules import of_config
from thermoctl.files.safe_file import write_text

SEEN, FRESH = (*range(12), *range(1000, 1012)), tuple(range(2000, 2012))
"""Seeds. The methods and the rigs (rigs.PAPER_SCALE, rigs.HEAT_W, rigs.CHAMBER, paper.CHOICES,
chain.DRIFT_S) were chosen on the first. Every goal is checked on the others, on which nothing was chosen.
"""
DISTURBED_SEEDS = 4

Waiting = Future[tuple[SeedResult, Kept | None]]


@dataclass(frozen=True)
class _Runs:
    """The results on all rigs; `families` names them by the drift of chamber and bench."""

    fresh: list[SeedResult]
    seen: list[SeedResult]
    disturbed: list[SeedResult]
    families: dict[str, list[SeedResult]]
    kept: Kept


def reproduce(
    plant_file: str,
    config: str,
    out: Path,
    seeds: int = 12,
    full: bool = True,
    say: Callable[[str], object] = print,
) -> bool:
    """Run everything; write report.html, figures.json and figures.txt into `out`.

    Return whether every goal is met."""
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    runs = _run(plant_file, str(of_config(config)), seeds)
    say(f"{sum(map(len, (runs.fresh, runs.seen, runs.disturbed)))} rigs: {time.monotonic() - started:.0f} s")
    whole = closed_loop.run(config, plant_file, out, say) if full else None
    measured, before = goals(runs.fresh, runs.disturbed), goals(runs.seen, [])
    reasons = limits(runs.families)
    seconds = time.monotonic() - started
    content = {
        "goals": measured,
        "goals_on_seeds_looked_at": before,
        "why": reasons,
        "seeds": [asdict(r) for r in runs.fresh],
        "seeds_looked_at": [asdict(r) for r in runs.seen],
        "disturbed": [asdict(r) for r in runs.disturbed],
        "full": whole,
        "seconds": seconds,
    }
    write_text(out / "figures.json", json.dumps(content, indent=1, default=float))
    page = report(runs.fresh, runs.disturbed, runs.kept, measured, before, reasons, whole, seconds)
    write_text(out / "report.html", page)
    lines = [*_lines(measured, reasons, whole), f"     {seconds:.0f} s"]
    write_text(out / "figures.txt", "\n".join(lines) + "\n")
    for line in [*lines, str(out / "report.html")]:
        say(line)
    return all(g.met == "yes" for g in measured)


def _run(plant_file: str, tests_file: str, seeds: int) -> _Runs:
    with ProcessPoolExecutor(2) as pool:

        def submit(seed: int, disturbance: str | None = None, keep: bool = False, **ease: float) -> Waiting:
            """Start a seed in the pool with the arguments of `one_seed`."""
            return pool.submit(one_seed, plant_file, tests_file, seed, disturbance, keep, **ease)

        fresh = [submit(k, keep=k == FRESH[0]) for k in FRESH[:seeds]]
        seen = [submit(k) for k in SEEN[: 2 * seeds]]
        disturbed = [submit(k, d) for d in DISTURBANCES for k in FRESH[: min(DISTURBED_SEEDS, seeds)]]
        families = {
            "as judged": fresh,
            f"chamber and bench drift {1 / CHAMBER:.1f} times as much": [
                submit(k, air=1.0, bench=1.0) for k in FRESH[:seeds]
            ],
            "no drift of chamber or bench, no unmeasured heat": [
                submit(k, air=0.0, bench=0.0, heat=0.0) for k in FRESH[:seeds]
            ],
        }

        def done(waiting: Sequence[Waiting]) -> list[SeedResult]:
            """Wait for seeds; return their results without the data for the figures."""
            return [f.result()[0] for f in waiting]

        kept = fresh[0].result()[1]
        assert kept is not None
        return _Runs(
            done(fresh), done(seen), done(disturbed), {k: done(v) for k, v in families.items()}, kept
        )


def _lines(measured: Sequence[Goal], reasons: Sequence[Limit], whole: Mapping[str, Any] | None) -> list[str]:
    lines = [f"{g.met:3s}  {g.measured:9.3g}  {g.wanted:10s} {g.what}" for g in measured]
    lines += [
        f"     {r.rigs}: paper's / SISO {r.paper_over_siso:.2f}, paper's 2 s {r.paper_um:.2f} um, largest filtered temperature "
        f"error {r.largest_k:.2f} K, better / paper's {r.better_over_paper:.2f}, worst {r.worst:.2f}"
        for r in reasons
    ]
    if whole:
        lines += [
            f"     full run at 1 ms, {k}: {v[0]:+.2f} +- {v[1]:.2f} um"
            for k, v in whole.items()
            if isinstance(v, tuple)
        ]
        lines += [
            f"     quasi-static against full, {k}: " + ", ".join(f"{a} {b:.3g}" for a, b in v.items())
            for k, v in whole["agreement"].items()
        ]
    return lines
