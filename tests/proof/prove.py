"""Proof on a folder of cases: run the diagnosis on each, then open the answers and score.

Answers are read after the last diagnosis has ended.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.proof.cases import find_jobs, read_answers
from tests.proof.score import Row, plain, score
from tests.proof.summary import summary
from tests.truth.run import diagnose
from thermoctl import __version__
from thermoctl.files.safe_file import whole_files, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.batch import OnCase, run_all
from thermoctl.fleet.jobs import Job, outcome
from thermoctl.recording.files import read_table


def prove(
    cases: str | Path,
    out_dir: str | Path,
    answers: str | Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    number: int | None = None,
    progress: OnCase | None = None,
) -> dict[str, Any]:
    """Run and score a set of cases; return the content of OUT/proof.json.

    OUT/summary.json is the same without the cases, to be kept with a commit."""
    out = Path(out_dir)
    jobs = find_jobs(cases, number)
    run_all(jobs, out / "cases", scheduler, workers, diagnose, progress)
    sealed = read_answers(jobs, Path(answers) if answers is not None else None)
    rows = [_scored(job, out / "cases", sealed[job.name]) for job in jobs]
    figures = {
        "format": "thermoctl-proof/1",
        "version": __version__,
        "commit": commit(),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "set": {"answers_sha256": hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()},
        **summary(rows),
    }
    content = {**figures, "rows": plain(rows)}
    with whole_files(out) as part:
        write_text(part / "proof.json", json.dumps(content, indent=1) + "\n")
        write_text(part / "summary.json", json.dumps(figures, indent=1) + "\n")
    return content


def _scored(job: Job, cases: Path, answer: Mapping[str, Any]) -> Row:
    result, run = outcome(job, cases)
    duration_s = _duration(job.recordings) if answer.get("onset") is not None else None
    return score(job.name, answer, result, run.get("cpu_s"), run["error"], duration_s)


def _duration(recordings: Sequence[str]) -> float | None:
    """Return the length of the first recording, s; None if it cannot be read."""
    try:
        t = read_table(recordings[0], columns=["t"]).t
    except InputError:
        return None
    return float(t[-1] - t[0])


def commit() -> str | None:
    """Return the source's commit, `-dirty` when changed since; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    run = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    return run.stdout.strip() or None
