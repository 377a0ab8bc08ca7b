"""Proof on a folder of cases: run the diagnosis on each, then open the answers and score.

A case is a folder with plant.yaml and recordings. Answers lie apart (DIR/NAME.yaml, checked against manifest.sha256) or
as answer.yaml inside the case; they are read after the last diagnosis has ended. Diagnoses run through Dask in separate
processes; a case that is done (OUT/cases/NAME/run.json of the same inputs and the same code) is not run again, and the case
of a worker that dies is given to another.
"""

from __future__ import annotations

import hashlib
import html
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermoctl import __version__
from thermoctl.diagnose.effects import CATALOGUE
from thermoctl.proof import score as scoring
from thermoctl.yamlfile import InputError, load

RECORDINGS = (".csv", ".parquet", ".arrow")
RETRIES = 3  # how many workers may die over one case


@dataclass(frozen=True)
class Job:
    """One diagnosis to run: plant file, recordings, and folders of effects beside the catalogue's."""

    name: str
    plant: str
    recordings: tuple[str, ...]
    effects: tuple[str, ...] = ()

    def fingerprint(self) -> str:
        """Of the contents of all inputs and of the program that diagnoses: a result of other code is not this job's."""
        entries = [f for folder in map(Path, self.effects) for f in sorted(folder.glob("*.yaml"))]
        return _digest((*map(Path, (self.plant, *self.recordings)), *entries, *_program()))


def program() -> str:
    """The fingerprint of the program that diagnoses, with its catalogue: a result of another one is out of date."""
    return _digest(_program())


def _program() -> list[Path]:
    package = Path(__file__).parents[1]
    code = [
        f for part in ("diagnose", "plant", "recording") for f in sorted((package / part).glob("*.[ph]*"))
    ]
    return [*sorted(CATALOGUE.glob("*.yaml")), *code]


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def find_jobs(folder: str | Path, number: int | None = None, apart: Sequence[str] = ()) -> list[Job]:
    """The cases in a folder, in order of their names. `apart`: folders whose recordings are of different rigs and are
    diagnosed one at a time. Raises InputError where there is none."""
    root = Path(folder)
    if not root.is_dir():
        raise InputError(
            f"{root}: no such folder; expected a folder of cases, each with plant.yaml and recordings"
        )
    jobs = []
    for plant in sorted(root.glob("*/plant.yaml")):
        runs = tuple(str(p) for p in sorted(plant.parent.iterdir()) if p.suffix in RECORDINGS)
        name = plant.parent.name
        if not runs:
            raise InputError(
                f"{plant.parent}: plant.yaml without a recording; expected run_1.csv or the like beside it"
            )
        if name in apart:
            jobs += [Job(f"{name}-{Path(r).stem}", str(plant), (r,)) for r in runs]
        else:
            jobs.append(Job(name, str(plant), runs))
    if not jobs:
        raise InputError(f"{root}: no case in it; expected folders with plant.yaml and recordings")
    return jobs[:number]


def run_one(job: Job, out: str) -> dict[str, Any]:
    """Diagnose one case in this process and leave OUT/run.json when all else is written. Never raises for bad cases."""
    from thermoctl.diagnose.run import diagnose

    begun, cpu = time.monotonic(), time.process_time()
    told: dict[str, Any] = {
        "name": job.name,
        "fingerprint": job.fingerprint(),
        "version": __version__,
        "error": None,
    }
    try:
        diagnose(job.plant, list(job.recordings), out, [Path(e) for e in job.effects])
    except InputError as e:
        told["error"] = str(e)
    except Exception as e:  # a crash is a result of the proof, not the end of it
        told["error"] = f"{type(e).__name__}: {e}"
    told |= {"seconds": round(time.monotonic() - begun, 2), "cpu_s": round(time.process_time() - cpu, 2)}
    Path(out).mkdir(parents=True, exist_ok=True)
    part = Path(out) / f".run-{os.getpid()}.json"
    part.write_text(json.dumps(told) + "\n")
    os.replace(part, Path(out) / "run.json")
    return told


def done(job: Job, out: Path) -> bool:
    """Whether this job has been run into `out`, by this code."""
    try:
        told = json.loads((out / "run.json").read_text())
    except (OSError, ValueError):
        return False
    return told.get("fingerprint") == job.fingerprint()


@contextmanager
def cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A Dask client: of the scheduler at the address, else of local single-threaded processes."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": RETRIES,
            "distributed.worker.daemon": False,
            "distributed.comm.timeouts.connect": "60s",
        }
    ):
        if scheduler:
            with Client(scheduler) as client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=workers or os.cpu_count(),
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=50,
            ) as local,
            Client(local) as client,
        ):
            yield client


def run_all(
    jobs: Sequence[Job],
    out: Path,
    scheduler: str | None = None,
    workers: int | None = None,
    task: Callable[[Job, str], dict[str, Any]] = run_one,
    progress: Callable[[int, int, dict], None] | None = None,
) -> int:
    """Run every job that is not done yet into OUT/NAME; returns how many were run. `task` is called in a worker."""
    waiting = [j for j in jobs if not done(j, out / j.name)]
    if not waiting:
        return 0
    from distributed import as_completed

    with cluster(scheduler, workers) as client:
        futures = {
            client.submit(task, j, str(out / j.name), pure=False, key=f"case-{j.name}"): j for j in waiting
        }
        for count, future in enumerate(as_completed(list(futures)), 1):
            job = futures[future]
            if future.status == "error":  # its workers died again and again
                told = {
                    "name": job.name,
                    "fingerprint": job.fingerprint(),
                    "version": __version__,
                    "seconds": None,
                    "error": f"{type(future.exception()).__name__}: {future.exception()}",
                }
                folder = out / job.name
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "run.json").write_text(json.dumps(told) + "\n")
            else:
                told = future.result()
            if progress:
                progress(count, len(waiting), told)
    return len(waiting)


def read_answers(jobs: Sequence[Job], answers: Path | None) -> dict[str, dict[str, Any]]:
    """The answers by case. Apart, they must match manifest.sha256 where there is one. Raises InputError."""
    sealed: dict[str, str] = {}
    if answers is not None and (answers / "manifest.sha256").exists():
        for line in (answers / "manifest.sha256").read_text().splitlines():
            digest, name = line.split(maxsplit=1)
            sealed[name] = digest
    found = {}
    for job in jobs:
        path = answers / f"{job.name}.yaml" if answers is not None else Path(job.plant).parent / "answer.yaml"
        if not path.exists():
            raise InputError(
                f"{path}: no answer for case {job.name}; give the folder of answers with --answers"
            )
        content = path.read_bytes()
        if sealed and sealed.get(path.name) != hashlib.sha256(content).hexdigest():
            raise InputError(
                f"{path}: the answer is not the one that was sealed (manifest.sha256); make the set again"
            )
        answer = load(path).plain()
        if not isinstance(answer, dict):
            raise InputError(f"{path}: expected a mapping with verdict, effects and nearly_the_same")
        found[job.name] = answer
    return found


def _outcome(job: Job, out: Path) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    folder = out / "cases" / job.name
    told = json.loads((folder / "run.json").read_text())
    path = folder / "diagnosis.json"
    return (json.loads(path.read_text()) if not told["error"] and path.exists() else None), told


def _duration(job: Job) -> float | None:
    from thermoctl.recording.files import read_table

    try:
        t = read_table(job.recordings[0], columns=["t"]).t
    except InputError:
        return None
    return float(t[-1] - t[0])


def prove(
    cases: str | Path,
    out_dir: str | Path,
    answers: str | Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    number: int | None = None,
    progress: Callable[[int, int, dict], None] | None = None,
) -> dict[str, Any]:
    """Run and score a set; writes OUT/proof.json, OUT/summary.json (the same without the cases: to be kept with a commit)
    and OUT/proof.html; returns the JSON's content."""
    out = Path(out_dir)
    jobs = find_jobs(cases, number)
    run_all(jobs, out / "cases", scheduler, workers, progress=progress)
    told = read_answers(jobs, Path(answers) if answers is not None else None)
    rows = []
    for job in jobs:
        result, run = _outcome(job, out)
        answer = told[job.name]
        rows.append(
            scoring.score(
                job.name,
                answer,
                result,
                run["seconds"],
                run["error"],
                _duration(job) if answer.get("onset") is not None else None,
            )
        )
    content = {
        "format": "thermoctl-proof/1",
        "version": __version__,
        "commit": _commit(),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "set": {"answers_sha256": hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()},
        **scoring.summary(rows),
        "rows": scoring.plain(rows),
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "proof.json").write_text(json.dumps(content, indent=1) + "\n")
    small = {k: v for k, v in content.items() if k != "rows"}
    (out / "summary.json").write_text(json.dumps(small, indent=1) + "\n")
    (out / "proof.html").write_text(page(content, rows))
    return content


def _commit() -> str | None:
    """The source's commit, `-dirty` when changed since; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    run = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    return run.stdout.strip() or None


# --- for people ------------------------------------------------------------------------------------------
_TITLES = {
    "false_alarms": "false alarms on nothing missing",
    "detected_large": "detected, large",
    "detected_middle": "detected, middle",
    "detected_small": "detected, small",
    "exact_name": "exact name",
    "name_or_its_like": "name, or one the data cannot tell from it",
    "right_when_named": "right when it names (or its like)",
    "right_when_named_exactly": "right when it names, exactly",
    "inside_the_set": "truth (or its like) inside the set",
    "inside_the_set_exactly": "truth itself inside the set",
    "place_right": "place right",
    "onset_within_2_percent": "onset within 2 % of the record",
    "unknown_called_unknown": "unknown called unknown",
    "confidently_misnamed": "unknown named with confidence",
    "pairs_both_right": "pairs: both right",
    "pairs_one_right": "pairs: at least one right",
    "interval_coverage": "95 % intervals that hold the parameter",
    "failed": "diagnosis failed",
}
_NUMBERS = {
    "half_found_at_all": "found half of the time, sigmas of an ideal test",
    "half_found_at_white": "the same in white noise",
    "half_found_at_coloured": "the same in coloured noise",
    "calibration_error": "calibration error of the probabilities",
    "gain_median": "held-out gain, share of the oracle's, median",
    "gain_worst_tenth": "held-out gain, worst tenth",
    "parameter_error_median": "effect parameter error, median",
    "set_size_when_ambiguous": "names in an ambiguous set",
    "seconds_median": "seconds a case, median",
    "seconds_longest": "seconds a case, longest",
}


def table(content: dict[str, Any]) -> Any:
    """The figures as a rich table."""
    from rich.table import Table

    t = Table(
        title=f"{content['figures']['cases']} cases, thermoctl {content['version']} ({content['commit']})"
    )
    for title, side in (
        ("figure", "left"),
        ("is", "right"),
        ("95 % interval", "right"),
        ("of", "right"),
        ("goal", "right"),
    ):
        t.add_column(title, justify=side)  # type: ignore[arg-type]
    for line in _lines(content):
        t.add_row(*line[:5], style={True: None, False: "red", None: None}[line[5]])
    return t


def _lines(content: dict[str, Any]) -> Iterator[tuple[str, str, str, str, str, bool | None]]:
    def goal(key: str, percent: bool) -> tuple[str, bool | None]:
        g = content["goals"].get(key)
        if g is None:
            return "", None
        sign = "≥" if g["at"] == "least" else "≤"
        return (f"{sign} {100 * g['goal']:.0f} %" if percent else f"{sign} {g['goal']:g}"), g["reached"]

    for key, title in _TITLES.items():
        s = content["shares"][key]
        if s["n"]:
            text, reached = goal(key, True)
            yield (
                title,
                f"{100 * s['share']:.1f} %",
                f"{100 * s['low']:.0f}–{100 * s['high']:.0f} %",
                f"{s['k']}/{s['n']}",
                text,
                reached,
            )
    for key, title in _NUMBERS.items():
        value = content["figures"][key]
        if value is not None:
            text, reached = goal(key, False)
            curve = content["found_by_size"].get(key.removeprefix("half_found_at_"))
            wide, of = (f"{curve['low']:.1f}–{curve['high']:.1f}", str(curve["n"])) if curve else ("", "")
            yield title, f"{value:.3g}", wide, of, text, reached
    yield from _open_lines(content["open_world"])


def _open_lines(found: dict[str, Any]) -> Iterator[tuple[str, str, str, str, str, bool | None]]:
    """The lines of the cases with small misfits that nobody will name."""
    for key, s in found.get("shares", {}).items():
        if s["n"]:
            wide = f"{100 * s['low']:.0f}–{100 * s['high']:.0f} %"
            yield (
                f"open world: {key.replace('_', ' ')}",
                f"{100 * s['share']:.1f} %",
                wide,
                f"{s['k']}/{s['n']}",
                "",
                None,
            )
    for key in ("strays_per_diagnosis", "calibration_error", "gain_median"):
        if found.get(key) is not None:
            yield f"open world: {key.replace('_', ' ')}", f"{found[key]:.3g}", "", "", "", None


def page(content: dict[str, Any], rows: Sequence[scoring.Row]) -> str:
    """One self-contained HTML page: figures, plots, confusion, by family and effect, what went wrong case by case."""
    from thermoctl.report import page as sheet

    def brief(part: str) -> str:
        groups = content[part]
        return sheet.table(
            ["", *next(iter(groups.values()), {})], [[k, *b.values()] for k, b in groups.items()]
        )

    wrong = [
        (
            r.case,
            r.family,
            f"{r.kind} {r.band or ''}",
            _names(r.truth),
            r.verdict,
            _names(r.findings),
            r.error or "",
        )
        for r in rows
        if not (
            r.alike
            and r.placed is not False
            or r.kind == "none"
            and not r.detected
            or r.kind == "unknown"
            and r.verdict == "unexplained"
        )
    ]
    kinds = ", ".join(f"{n} {k}" for k, n in sorted(Counter(r.kind for r in rows).items()))
    sections = [
        ("Figures", _figures(content)),
        ("Plots", sheet.figure(_plots(content, rows), "Bars are 95 % intervals (Wilson).")),
        ("Called (columns) against true (rows)", _confusion(content["confusion"])),
        ("By rig family", brief("by_family")),
        ("By effect", brief("by_effect")),
        ("Not right", sheet.table(("case", "rig", "kind", "true", "verdict", "found", "error"), wrong)),
    ]
    note = (
        f"{content['figures']['cases']} cases ({kinds}); thermoctl {content['version']} {content['commit'] or ''}. Answers were opened "
        "after the last diagnosis. Red: a goal that is missed."
    )
    return sheet.page("Proof on concealed cases", sections, note)


def _figures(content: dict[str, Any]) -> str:
    e = html.escape
    body = "".join(
        f"<tr{' class=bad' if reached is False else ''}>"
        + "".join(f"<td>{e(c)}</td>" for c in cells)
        + "</tr>"
        for *cells, reached in _lines(content)
    )
    return f"<table><tr><th>figure<th>is<th>95 % interval<th>of<th>goal</tr>{body}</table>"


def _confusion(confusion: dict[str, dict[str, int]]) -> str:
    e = html.escape
    called = sorted({c for row in confusion.values() for c in row})
    head = "".join(f"<th style='writing-mode:vertical-rl;text-align:left'>{e(c)}</th>" for c in called)
    body = "".join(
        f"<tr><th style='text-align:left'>{e(t)}</th>"
        + "".join(
            f"<td class={'good' if c.removeprefix('ambiguous: ') == t else 'bad'}><b>{row[c]}</b></td>"
            if c in row
            else "<td></td>"
            for c in called
        )
        + "</tr>"
        for t, row in confusion.items()
    )
    return f"<div style='overflow-x:auto'><table><tr><th></th>{head}</tr>{body}</table></div>"


def _names(effects: Sequence[tuple[str, str]]) -> str:
    return ", ".join(f"{a} at {b}" for a, b in effects) or "nothing"


def _plots(content: dict[str, Any], rows: Sequence[scoring.Row]) -> Any:
    """Detection and name by size, reliability, held-out gain, effect parameters, onset and time as one matplotlib figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 6.6), layout="constrained")
    (size, reliable, gain), (wide, onset, clock) = figure.subplots(2, 3)
    for shift, what, label in ((-0.08, "detected", "detected"), (0.08, "exact_name", "exact name")):
        told = [
            (k, s)
            for k, b in enumerate(reversed(scoring.BANDS))
            if (s := content["shares"][f"{what}_{b}"])["n"]
        ]
        y = [s["share"] for _, s in told]
        spread = [
            [max(s["share"] - s["low"], 0) for _, s in told],
            [max(s["high"] - s["share"], 0) for _, s in told],
        ]
        size.errorbar([k + shift for k, _ in told], y, yerr=spread, fmt="o", capsize=3, label=label)
    size.set(
        xticks=range(3),
        xticklabels=["small\n3–6 σ", "middle\n6–15 σ", "large\n> 15 σ"],
        ylim=(0, 1.05),
        title="By size",
        ylabel="share",
    )
    size.legend(loc="lower right")
    reliable.plot([0, 1], [0, 1], color="0.8")
    for b in content["reliability"]:
        s = scoring.Share(round(b["right"] * b["n"]), int(b["n"]))
        low, high = s.interval()
        reliable.plot([b["probability"]] * 2, [low, high], color="C0", lw=1)
        reliable.scatter([b["probability"]], [b["right"]], s=12 + 2 * b["n"], color="C0")
    reliable.set(
        xlabel="probability given", ylabel="share right", title="Reliability", xlim=(0, 1.02), ylim=(0, 1.05)
    )
    gains = [r.gain for r in rows if r.gain is not None and r.detected]
    gain.hist([max(min(g, 1.2), -0.2) for g in gains], bins=28, range=(-0.2, 1.2))
    gain.set(xlabel="share of the oracle's held-out gain", ylabel="cases", title="Held-out gain")
    errors = [p["error"] for r in rows for p in r.parameters]
    wide.hist([min(x, 1.0) for x in errors], bins=20, range=(0, 1))
    wide.set(
        xlabel="relative error (1: that or more)",
        ylabel="parameters",
        title="Effect parameters of right names",
    )
    onset.hist([min(r.onset_error, 0.2) for r in rows if r.onset_error is not None], bins=20, range=(0, 0.2))
    onset.set(xlabel="share of the recording", ylabel="cases", title="Onset error")
    clock.hist([r.seconds for r in rows if r.seconds is not None], bins=30)
    clock.set(xlabel="seconds", ylabel="cases", title="Time per case")
    return figure


def real(
    folder: str | Path,
    out_dir: str | Path,
    apart: Sequence[str] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int, dict], None] | None = None,
) -> list[dict[str, Any]]:
    """Diagnose every folder of real recordings; one entry each: what, where, held-out rms before and after, and the
    README's lines on published figures. Writes OUT/real.json."""
    out = Path(out_dir)
    jobs = find_jobs(folder, apart=apart)
    run_all(jobs, out / "cases", scheduler, workers, progress=progress)
    entries = []
    for job in jobs:
        result, run = _outcome(job, out)
        readme = Path(job.plant).parent / "README.md"
        published = (
            [
                line.strip("- ").strip()
                for line in readme.read_text().splitlines()
                if re.search(r"publish|publication|benchmark's|upstream reports", line, re.I)
            ]
            if readme.exists()
            else []
        )
        fit = (result or {}).get("fit", {})
        entries.append(
            {
                "name": job.name,
                "verdict": (result or {}).get("verdict", "failed"),
                "findings": [
                    (f["effect"], f["where"], f["probability"]) for f in (result or {}).get("findings", [])
                ],
                "held_out": {
                    o: (
                        fit.get("held_out_before", {}).get(o),
                        fit.get("held_out_refit_only", {}).get(o),
                        after,
                    )
                    for o, after in (fit.get("held_out_after") or {}).items()
                },
                "gain": (result or {}).get("held_out_gain"),
                "published": published,
                "seconds": run["seconds"],
                "error": run["error"],
            }
        )
    (out / "real.json").write_text(json.dumps(entries, indent=1) + "\n")
    return entries


def real_table(entries: Sequence[dict[str, Any]]) -> Any:
    """The real recordings as a rich table; under each the lines on published figures."""
    from rich.table import Table

    t = Table(title="Real recordings, each from its naive plant")
    for title in (
        "recording",
        "verdict",
        "effect at place (probability)",
        "held-out rms: as it was → refit → extended",
        "s",
    ):
        t.add_column(title)
    for x in entries:
        found = "\n".join(f"{a} at {b} ({p:.2f})" for a, b, p in x["findings"]) or (x["error"] or "")
        rms = "\n".join(
            f"{o}: " + " → ".join("–" if v is None else f"{v:.4g}" for v in three)
            for o, three in x["held_out"].items()
        )
        t.add_row(x["name"], x["verdict"], found, rms, f"{x['seconds'] or 0:.0f}")
        for line in x["published"]:
            t.add_row("", "", f"[dim]README: {line[:110]}[/dim]", "", "")
    return t


class Reporter:
    """Progress on stderr: one line a case with the time that is left."""

    def __init__(self, stream: Any = None):
        self.begun, self.stream = time.monotonic(), stream or sys.stderr

    def __call__(self, count: int, total: int, told: dict[str, Any]) -> None:
        left = (time.monotonic() - self.begun) / count * (total - count)
        what = f" {told['error']}" if told["error"] else ""
        print(
            f"[{count}/{total}] {told['name']} {told['seconds'] or 0:.0f} s, {left / 60:.1f} min left{what}",
            file=self.stream,
            flush=True,
        )


def command(args: Any) -> int:
    """`thermoctl prove`: 0 when every goal that could be measured is reached, else 1."""
    from rich.console import Console

    console = Console()
    if args.real:
        entries = real(
            args.cases,
            args.out,
            args.apart.split(",") if args.apart else (),
            args.scheduler,
            args.workers,
            Reporter(),
        )
        console.print(real_table(entries))
        return 0
    content = prove(args.cases, args.out, args.answers, args.scheduler, args.workers, args.number, Reporter())
    console.print(table(content))
    console.print(f"written: {Path(args.out) / 'proof.json'}, {Path(args.out) / 'proof.html'}")
    return 0 if all(g["reached"] is not False for g in content["goals"].values()) else 1
