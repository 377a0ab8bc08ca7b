"""Diagnose real recordings: effects found, strays, and the error on data that took no part in any choice."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.proof.rigs import RIGS, Rig
from tests.proof.score import CONFIDENT, meant
from tests.truth.run import diagnose
from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.batch import OnCase, run_all
from thermoctl.fleet.jobs import Job, Run, outcome

VARIABLE = "THERMOCTL_RECORDINGS"  # of the environment: the folder of the recordings
SUFFIX = ".csv"


@dataclass(frozen=True)
class Entry:
    """One diagnosed rig.

    - `hits`: the probability of each accepted effect, 0 where it was not found
    - `strays`: findings that are neither accepted nor tolerated
    - `ratio`: mean over the outputs of held-out error with the findings over that of a refit alone"""

    name: str
    verdict: str
    findings: list[tuple[str, str, float]]  # effect, place, probability
    hits: list[float]
    strays: list[str]
    ratio: float | None
    share_closed: float | None
    cpu_s: float | None
    error: str | None


def recordings_folder(given: str | None) -> Path:
    """Return the given folder, else that of the environment. Raises InputError."""
    name = given or os.environ.get(VARIABLE)
    if not name:
        raise InputError(f"--real: a folder of recordings was expected, as argument or in {VARIABLE}")
    if not Path(name).is_dir():
        raise InputError(f"{name}: no such folder; the folder of real recordings was expected")
    return Path(name)


def real(
    folder: Path,
    out_dir: str | Path,
    scheduler: str | None = None,
    workers: int | None = None,
    number: int | None = None,
    progress: OnCase | None = None,
) -> list[Entry]:
    """Diagnose the known rigs in a folder and write OUT/real.json. Raises InputError where there is none."""
    out = Path(out_dir)
    rigs = [r for r in RIGS if (folder / r.folder / r.plant).is_file()][:number]
    if not rigs:
        raise InputError(
            f"{folder}: none of the known rigs is here ({', '.join(sorted({r.folder for r in RIGS}))})"
        )
    jobs = [rig_job(folder, r) for r in rigs]
    run_all(jobs, out / "cases", scheduler, workers, diagnose, progress)
    entries = [_entry(r, *outcome(j, out / "cases")) for r, j in zip(rigs, jobs, strict=True)]
    write_text(out / "real.json", json.dumps([asdict(e) for e in entries], indent=1) + "\n")
    return entries


def rig_job(folder: Path, rig: Rig) -> Job:
    """Return the diagnosis of a rig whose recordings are below `folder`."""

    def files(names: str) -> tuple[str, ...]:
        """Return the paths of the rig's recordings; `names`: separated by spaces."""
        return tuple(str(folder / rig.folder / f"{n}{SUFFIX}") for n in names.split())

    return Job(rig.name, str(folder / rig.folder / rig.plant), files(rig.runs), held_out=files(rig.held_out))


def _entry(rig: Rig, result: Mapping[str, Any] | None, run: Run) -> Entry:
    result = result or {"verdict": "failed", "findings": [], "fit": {}}
    named = {e: float(f["probability"]) for f in result["findings"] for e, _ in meant(f)}
    known = frozenset().union(*rig.accepted, rig.tolerated)
    return Entry(
        rig.name,
        result["verdict"],
        [(f["effect"], f["where"], f["probability"]) for f in result["findings"]],
        [max((named[e] for e in options if e in named), default=0.0) for options in rig.accepted],
        [f["effect"] for f in result["findings"] if not known & {e for e, _ in meant(f)}],
        _ratio(result["fit"]),
        (result.get("remainder") or {}).get("share_closed"),
        run.get("cpu_s"),
        run["error"],
    )


def _ratio(fit: Mapping[str, Any]) -> float | None:
    before, after = fit.get("held_out_refit_only") or {}, fit.get("held_out_after") or {}
    ratios = [after[o] / before[o] for o in after if before.get(o) and after[o] is not None]
    return sum(ratios) / len(ratios) if ratios else None


def totals(entries: Sequence[Entry]) -> str:
    """Return the effects found, the strays and the diagnoses with every effect and none beside, in words."""
    hits = [p for e in entries for p in e.hits]
    strays = sum(len(e.strays) for e in entries)
    found = sum(p >= CONFIDENT for p in hits)
    clean = sum(min(e.hits, default=1) >= CONFIDENT and not e.strays and not e.error for e in entries)
    return (
        f"{found} of {len(hits)} accepted effects found; {strays} strays in {len(entries)} diagnoses; "
        f"{clean} with every effect and no stray"
    )
