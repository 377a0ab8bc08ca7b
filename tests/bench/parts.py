"""Where the time of a diagnosis goes, on cases with plant.yaml and run_*.csv.

python -m tests.bench.parts CASE [CASE ...]

Each case is diagnosed in a process of its own, on one core, with no compiled plant at hand. Its stack is sampled every
5 ms of processor time. Each sample counts for the innermost part that it is in; the compiler's processes are added.
A table: share of each part, the median and the largest of all cases, and seconds.
"""

from __future__ import annotations

import collections
import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType

import numpy as np

from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings

EVERY = 0.005  # s of processor time between two samples
# of the innermost frame that is in one of them: end of the file's name, name of the function ("" is any)
PARTS = (
    ("plant/compile.py", "", "compile"),
    ("plant/build.py", "", "compile"),
    ("diagnose/noise.py", "", "evidence"),
    ("diagnose/coordinates.py", "", "evidence"),
    ("diagnose/posterior.py", "", "evidence"),
    ("diagnose/fit.py", "", "evidence"),
    ("diagnose/screen.py", "", "screening"),
    ("diagnose/screening.py", "", "screening"),
    ("diagnose/gains.py", "", "screening"),
    ("diagnose/overlay.py", "", "screening"),
    ("diagnose/metric.py", "", "screening"),
    ("diagnose/shortlist.py", "", "screening"),
    ("diagnose/report/page.py", "", "report"),
    ("plant/residuals.py", "", "refit"),
    ("plant/refit.py", "", "refit"),
    ("diagnose/search.py", "", "search"),
)


def part(frame: FrameType | None) -> str:
    """Return the part of a diagnosis that a stack is in."""
    while frame is not None:
        file, name = frame.f_code.co_filename, frame.f_code.co_name
        if file.endswith("plant/simulate.py") and name in ("_run", "respond"):
            slopes = name == "respond" or frame.f_locals.get("sensitivities")
            return "sensitivities" if slopes else "simulate"
        for end, function, label in PARTS:
            if file.endswith(end) and function in ("", name):
                return label
        frame = frame.f_back
    return "else"


def sampled(case: Path) -> dict[str, float]:
    """Diagnose a case in this process, and return the seconds of each part."""
    found: collections.Counter[str] = collections.Counter()
    signal.signal(signal.SIGPROF, lambda _, frame: found.update([part(frame)]))
    signal.setitimer(signal.ITIMER_PROF, EVERY, EVERY)
    from thermoctl.diagnose.run import diagnose

    plant = load(case / "plant.yaml")
    tables = read_recordings(plant, sorted(map(str, case.glob("run_*.csv"))))
    with tempfile.TemporaryDirectory() as folder:
        diagnose(plant, tables, Path(folder) / "out")
    signal.setitimer(signal.ITIMER_PROF, 0)
    own, children = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    scale = (own.ru_utime + own.ru_stime) / max(
        sum(found.values()), 1
    )  # a long call into C takes several ticks
    seconds = {k: n * scale for k, n in found.items()}
    seconds["compile"] = seconds.get("compile", 0.0) + children.ru_utime + children.ru_stime
    return seconds


def main(cases: list[str]) -> int:
    """Print the table of all cases; with --one the seconds of a single case as JSON."""
    if cases[0] == "--one":
        print(json.dumps(sampled(Path(cases[1]))))
        return 0
    rows = []
    for case in cases:
        call = [sys.executable, "-m", "tests.bench.parts", "--one", case]
        with tempfile.TemporaryDirectory() as cache:  # a stranger's machine has compiled nothing yet
            own = {**os.environ, "THERMOCTL_CACHE": cache}
            out = subprocess.run(call, capture_output=True, text=True, check=True, env=own).stdout
        rows.append(json.loads(out.splitlines()[-1]))
        print(f"{case}: {sum(rows[-1].values()):.1f} s", file=sys.stderr, flush=True)
    labels = sorted({k for r in rows for k in r}, key=lambda k: -sum(r.get(k, 0.0) for r in rows))
    print("| part | median share | largest share | median seconds |\n|---|---|---|---|")
    for k in labels:
        share = [r.get(k, 0.0) / sum(r.values()) for r in rows]
        seconds = float(np.median([r.get(k, 0.0) for r in rows]))
        print(f"| {k} | {100 * float(np.median(share)):.0f} % | {100 * max(share):.0f} % | {seconds:.1f} |")
    return 0


if __name__ == "__main__":
    with contextlib.suppress(AttributeError):  # not on every system
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sys.exit(main(sys.argv[1:]))
