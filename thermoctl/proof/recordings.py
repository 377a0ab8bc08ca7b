"""Diagnose real recordings without a known answer.

The result shows verdict, places and held-out error beside the published figures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from thermoctl.proof.jobs import Job, Run, find_jobs, outcome
from thermoctl.proof.run import OnCase, run_all

_PUBLISHED = re.compile(r"publish|publication|benchmark's|upstream reports", re.IGNORECASE)


@dataclass(frozen=True)
class Entry:
    """One folder of real recordings.

    held_out: output -> rms on held-out data: plant as it was, refitted, extended.
    """

    name: str
    verdict: str
    findings: list[tuple[str, str, float]]  # effect, place, probability
    held_out: dict[str, tuple[float | None, float | None, float | None]]
    gain: Mapping[str, Any] | None
    published: list[str]  # the README's lines on published figures
    seconds: float | None
    error: str | None


def real(
    folder: str | Path,
    out_dir: str | Path,
    apart: Sequence[str] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    progress: OnCase | None = None,
) -> list[Entry]:
    """Diagnose every folder of real recordings; write OUT/real.json."""
    out = Path(out_dir)
    jobs = find_jobs(folder, apart=apart)
    run_all(jobs, out / "cases", scheduler, workers, progress=progress)
    entries = [_entry(job, *outcome(job, out / "cases")) for job in jobs]
    (out / "real.json").write_text(json.dumps([asdict(e) for e in entries], indent=1) + "\n")
    return entries


def _entry(job: Job, result: Mapping[str, Any] | None, run: Run) -> Entry:
    result = result or {"verdict": "failed", "findings": [], "fit": {}}
    fit = result["fit"]
    before, refitted = fit.get("held_out_before", {}), fit.get("held_out_refit_only", {})
    return Entry(
        job.name,
        result["verdict"],
        [(f["effect"], f["where"], f["probability"]) for f in result["findings"]],
        {o: (before.get(o), refitted.get(o), v) for o, v in (fit.get("held_out_after") or {}).items()},
        result.get("held_out_gain"),
        _published(Path(job.plant).parent / "README.md"),
        run.get("seconds"),
        run["error"],
    )


def _published(readme: Path) -> list[str]:
    if not readme.exists():
        return []
    return [line.strip("- ").strip() for line in readme.read_text().splitlines() if _PUBLISHED.search(line)]
