"""`diagnose` on the recordings of many rigs, and of a running one."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from thermoctl.configuration.settings import load_settings
from thermoctl.files.safe_file import make_folder
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet import live
from thermoctl.fleet.batch import Reporter, run_all
from thermoctl.fleet.jobs import Job, outcome
from thermoctl.fleet.laws import comparisons, side_by_side
from thermoctl.fleet.recordings import find_recordings, rig_of
from thermoctl.plant import load


@dataclass(frozen=True)
class RigDiagnosis:
    """The diagnosis of one rig of a folder; `error` if it could not be diagnosed."""

    rig: str
    recordings: list[str]
    error: str | None
    seconds: float | None
    verdict: str | None
    findings: list[dict[str, Any]]
    law: dict[str, Any] | None


def diagnose_folders(args: argparse.Namespace) -> int:
    """Run `thermoctl diagnose` over folders: every rig's newest recordings, with the result in OUT/RIG.

    The rigs are spread over processes or a Dask cluster. A rig that cannot be diagnosed is reported and does
    not stop the others; completed rigs are not run again.
    """
    if not Path(args.plant).is_file():
        raise InputError(f"{args.plant}: no such file; the plant of the fleet's rigs was expected")
    jobs, out = _jobs(args), Path(args.out)
    run_all(jobs, out, args.scheduler, args.workers, progress=None if args.quiet else Reporter())
    diagnoses = [_diagnosis(job, out) for job in jobs]
    if args.json:
        print(json.dumps([asdict(d) for d in diagnoses], indent=1))
    elif not args.quiet:
        Console(soft_wrap=True).print(_diagnoses(diagnoses))
        _print_laws(diagnoses)
        print(f"reports: {out}/RIG/report.html")
    return 0


def _jobs(args: argparse.Namespace) -> list[Job]:
    """Return one job for each rig, with its newest recordings (`--last`: how many)."""
    rigs: dict[str, list[str]] = {}
    for path in (p for r in args.recordings for p in (find_recordings(r) if Path(r).is_dir() else [r])):
        rigs.setdefault(rig_of(path), []).append(path)
    return [
        Job(
            rig,
            args.plant,
            tuple(sorted(paths, key=lambda p: Path(p).name)[-args.last :]),
            tuple(args.effects or ()),
        )
        for rig, paths in sorted(rigs.items())
    ]


def _diagnosis(job: Job, out: Path) -> RigDiagnosis:
    result, run = outcome(job, out)
    findings = [
        {k: f[k] for k in ("effect", "where", "probability")} for f in (result or {}).get("findings", [])
    ]
    verdict = result["verdict"] if result else None
    law = ((result or {}).get("remainder") or {}).get("law")
    return RigDiagnosis(
        job.name, list(job.recordings), run["error"], run.get("seconds"), verdict, findings, law
    )


def _print_laws(found: Sequence[RigDiagnosis]) -> None:
    """Print the laws of all rigs side by side, and the parameters that repeat in them."""
    laws = {d.rig: d.law for d in found if d.law}
    if laws:
        console = Console(soft_wrap=True)
        console.print(side_by_side(laws))
        for line in comparisons(laws):
            console.print(line, highlight=False, markup=False)


def _diagnoses(found: Sequence[RigDiagnosis]) -> Table:
    titles = ("rig", "recordings", "verdict", "effect at place (probability)", "s")
    table = Table(*titles, box=None, header_style="bold")
    for d in found:
        what = d.error or "\n".join(
            f"{f['effect']} at {f['where']} ({f['probability']:.2f})" for f in d.findings
        )
        verdict = d.verdict or "not diagnosed"
        table.add_row(d.rig, str(len(d.recordings)), verdict, what, f"{d.seconds or 0:.0f}")
    return table


def live_recordings(args: argparse.Namespace) -> list[str]:
    """Extract the data of `thermoctl diagnose --live` into OUT/live.csv, from the onset of the misfit on.

    None if the model fits. Raises InputError if recordings were given, too.
    """
    if args.recordings:
        raise InputError(
            "diagnose --live reads the daemon's own recordings; no recording was expected beside it"
        )
    settings = load_settings(args.config)
    table = live.newest(settings.recording.directory, settings.rig.name, args.hours)
    alarms = live.alarms(settings, table)
    span = f"{table.t[0]:.0f} s to {table.t[-1]:.0f} s of the newest session"
    if not alarms:
        print(
            f"The model fits: from {span} its innovations are what the filter expects. Nothing to diagnose."
        )
        return []
    a = alarms[-1]
    print(
        f"The model no longer fits from {a.begin_s:.0f} s on{live.wall_clock(table, a.begin_s)} (mean innovation {a.mean_c:+.3f} K; {span}); "
        "that is diagnosed.",
        file=sys.stderr,
    )
    path = make_folder(args.out) / "live.csv"
    live.extract(load(args.plant), table, a, path)
    return [str(path)]
