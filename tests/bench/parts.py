"""Where the time of a diagnosis goes, by family and stage, here and in another checkout: cases with plant.yaml and run_*.csv.

python -m tests.bench.parts [--before CHECKOUT] CASE [CASE ...]

Each case is diagnosed in a process of its own, on one core, with no compiled plant but with Python's bytecode at hand, in
both checkouts one after the other. Its stack is sampled every 5 ms of processor time. Each sample counts for the
innermost stage that it is in; the compiler's processes are added. A row for each family (`family` of its answer.yaml,
else the folder's name) and checkout: mean seconds of processor time of a case by stage, names that the verdict gives,
and whether they are the same.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType

EVERY = 0.005  # s of processor time between two samples
HERE = Path(__file__).parents[2]
# of the innermost frame that is in one of them: a part of the file's path in the package, name of the function ("" is any)
STAGES = (
    ("/compile.py", "", "compiler"),
    ("/build.py", "", "compiler"),
    ("/noise.py", "", "likelihood"),
    ("/spectra.py", "", "likelihood"),
    ("/screen", "", "screening"),
    ("/gains.py", "", "screening"),
    ("/overlay.py", "", "screening"),
    ("/shortlist.py", "", "screening"),
    ("/unknown", "", "unknown"),
    ("/law/smooth.py", "missing_flow", "missing flow"),
    ("/law/", "", "law"),
    ("/held_out.py", "", "held out"),
    ("/experiment/", "", "experiment"),
    ("/report/", "", "report"),
    ("thermoctl/checks/", "", "checks"),
    ("plant/units.py", "", "checks"),
    ("/case.py", "", "first refit"),
    ("/fit.py", "", "refits"),
    ("/posterior.py", "", "refits"),
    ("/refit.py", "", "refits"),
    ("/climb.py", "", "refits"),
)
NAMES = ("imports", "simulate", "with slopes", *dict.fromkeys(stage for _, _, stage in STAGES), "else")


def stage(frame: FrameType | None) -> str:
    """Return the stage of a diagnosis that a stack is in."""
    while frame is not None:
        file, name = frame.f_code.co_filename, frame.f_code.co_name
        if name == "<module>" and frame.f_back is not None or file.startswith("<frozen importlib"):
            return "imports"
        if file.endswith("/simulate.py") and name in ("_run", "respond"):
            slopes = name == "respond" or frame.f_locals.get("sensitivities")
            return "with slopes" if slopes else "simulate"
        own = "".join(file.rpartition("/thermoctl/")[1:]) if "/thermoctl/" in file else ""
        for part, function, label in STAGES:
            if part in own and function in ("", name):
                return label
        frame = frame.f_back
    return "else"


def sampled(case: Path) -> dict[str, object]:
    """Diagnose a case in this process; return the seconds of each stage, the verdict and its names."""
    found: collections.Counter[str] = collections.Counter()
    signal.signal(signal.SIGPROF, lambda _, frame: found.update([stage(frame)]))
    signal.setitimer(signal.ITIMER_PROF, EVERY, EVERY)
    try:
        from thermoctl.diagnosis.run import diagnose
    except ImportError:  # a checkout of before 2026-11-26
        from thermoctl.diagnose.run import diagnose
    from thermoctl.plant import load
    from thermoctl.plant.recordings import read_recordings

    plant = load(case / "plant.yaml")
    tables = read_recordings(plant, sorted(map(str, case.glob("run_*.csv"))))
    try:
        with tempfile.TemporaryDirectory() as folder:
            result = diagnose(plant, tables, Path(folder) / "out")
    finally:  # at the end of the process its signal would kill it, and hide the error
        signal.setitimer(signal.ITIMER_PROF, 0)
    own, children = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    scale = (own.ru_utime + own.ru_stime) / max(sum(found.values()), 1)  # a call into C takes several ticks
    seconds = {k: n * scale for k, n in found.items()}
    seconds["compiler"] = seconds.get("compiler", 0.0) + children.ru_utime + children.ru_stime
    names = [f"{f['effect']} at {f['where']} {f['probability']:.3f}" for f in result["findings"]]
    return {"seconds": seconds, "told": " ".join([result["verdict"], *names]), "MiB": own.ru_maxrss / 1024}


def measured(case: Path, checkout: Path, bytecode: str) -> dict[str, object]:
    """Diagnose a case in a process of its own with a checkout's code, whose bytecode is in a folder."""
    python = checkout / ".venv/bin/python"
    call = [
        str(python if python.exists() else sys.executable),
        str(Path(__file__).resolve()),
        "--one",
        str(case),
    ]
    with tempfile.TemporaryDirectory() as cache:  # a stranger's machine has compiled nothing yet
        own = {
            **os.environ,
            "THERMOCTL_CACHE": cache,
            "PYTHONPATH": str(checkout),
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "",
            "PYTHONPYCACHEPREFIX": bytecode,
        }
        out = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=True, env=own, cwd=cache).stdout
    return dict(json.loads(out.splitlines()[-1]))


def family(case: Path) -> str:
    """Return the family that a case's answer names, else the case's folder."""
    try:
        lines = (case / "answer.yaml").read_text().splitlines()
    except OSError:
        lines = []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("family:")), case.name)


def table(rows: dict[tuple[str, str], list[dict[str, float]]]) -> None:
    """Print the mean seconds of each family and checkout by stage."""
    used = [k for k in NAMES if any(s.get(k, 0) >= 0.05 for cases in rows.values() for s in cases)]
    print("| family | checkout | cases | " + " | ".join([*used, "all", "longest"]) + " |")
    print("|---" * (len(used) + 5) + "|")
    for (name, which), cases in sorted(rows.items()):
        whole = [sum(s.values()) for s in cases]
        means = [sum(s.get(k, 0.0) for s in cases) / len(cases) for k in used]
        cells = [f"{m:.2f}" for m in [*means, sum(whole) / len(whole), max(whole)]]
        print(f"| {name} | {which} | {len(cases)} | {' | '.join(cells)} |")


def main(argv: list[str]) -> int:
    """Print the table of all cases; with --one the figures of a single case as JSON."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--before", type=Path, help="another checkout, with its own .venv")
    p.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    p.add_argument("cases", nargs="+", type=Path)
    a = p.parse_args(argv)
    if a.one:
        print(json.dumps(sampled(a.cases[0])))
        return 0
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    checkouts = {**({"before": a.before.resolve()} if a.before else {}), "here": HERE}
    rows: dict[tuple[str, str], list[dict[str, float]]] = collections.defaultdict(list)
    with tempfile.TemporaryDirectory() as bytecode:
        for checkout in checkouts.values():  # not counted: this run writes the bytecode
            measured(a.cases[0].resolve(), checkout, bytecode)
        for case in a.cases:
            told = {}
            for which, checkout in checkouts.items():
                found = measured(case.resolve(), checkout, bytecode)
                seconds: dict[str, float] = found["seconds"]  # type: ignore[assignment]
                rows[family(case), which].append(seconds)
                told[which] = found["told"]
                print(
                    f"{case} {which}: {sum(seconds.values()):.1f} s, {found['MiB']:.0f} MiB, {found['told']}",
                    file=sys.stderr,
                    flush=True,
                )
            if len(set(told.values())) > 1:
                print(f"{case}: another answer: {told['before']} -> {told['here']}", flush=True)
    table(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
