"""The command `fleet`, and `diagnose` on the recordings of many rigs and of a running one."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from thermoctl.configuration.settings import load_settings
from thermoctl.files.safe_file import make_folder
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.fleet import live
from thermoctl.fleet.batch import Reporter, cluster, run_all
from thermoctl.fleet.health import Summary, summarise
from thermoctl.fleet.jobs import Job, outcome
from thermoctl.fleet.laws import comparisons, side_by_side
from thermoctl.fleet.recordings import find_recordings, rig_of
from thermoctl.fleet.trend import RigHealth, judge
from thermoctl.plant import load


def fleet(
    folder: str,
    plant: str | None = None,
    parameters: str = "",
    workers: int = 0,
    scheduler: str | None = None,
    as_json: bool = False,
) -> int:
    """Run `thermoctl fleet`: print the rigs of a folder; 1 when one needs attention.

    `workers` 0: in this process. `scheduler`: the address of a Dask scheduler."""
    names = tuple(n.strip() for n in parameters.split(",") if n.strip())
    if names and plant is None:
        raise InputError("--parameters: a plant was expected with --plant FILE")
    ranged = [n for n, p in load(plant).parameters.items() if p.range is not None] if plant else []
    for name in names:
        if name not in ranged:
            raise InputError(
                f"{plant}: no parameter '{name}' with a range{suggest(name, ranged)}; expected some of "
                f"{', '.join(ranged)}"
            )
    paths = find_recordings(folder)
    if workers or scheduler:
        with cluster(scheduler, workers) as client:
            futures = [client.submit(summarise, p, plant, names, pure=False) for p in paths]
            summaries = [future.result() for future in futures]
    else:
        summaries = [summarise(p, plant, names) for p in paths]
    rigs = judge(summaries)
    if as_json:
        print(json.dumps([_plain(asdict(r)) for r in rigs]))
    else:
        _show(rigs, names)
    return int(any(r.advice for r in rigs))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _show(rigs: Sequence[RigHealth], names: Sequence[str]) -> None:
    console = Console()
    grid = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    grid.add_column("rig", no_wrap=True)
    for title in ("files", "hours", "armed", "slips", "innov. K", "proof um", "misfit", *names):
        grid.add_column(title, justify="right", min_width=5, overflow="fold")
    for r in rigs:
        good = [s for s in r.summaries if not s.error]
        newest = good[-1] if good else Summary("", r.name, math.nan, math.nan)
        grid.add_row(
            r.name,
            str(len(r.summaries)),
            f"{sum(s.hours for s in good):.1f}",
            _number(100 * newest.armed, "{:.0f} %"),
            _number(newest.slips, "{:.0f}"),
            _number(newest.innovation_c, "{:+.3f}"),
            _number(newest.proof_um, "{:.3f}"),
            _number(newest.misfit, "{:.1f}"),
            *(_number(newest.estimates.get(p, (math.nan,))[0], "{:.3g}") for p in names),
        )
    console.print(grid)
    for r in rigs:
        for line in r.advice:
            console.print(f"{r.name}: {line}", highlight=False, markup=False)


def _number(value: float, text: str) -> str:
    return text.format(value) if math.isfinite(value) else "-"


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
    not stop the others; completed rigs are not run again."""
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

    None if the model fits. Raises InputError if recordings were given, too."""
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
