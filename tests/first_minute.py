"""`make first-minute`: what a new user sees of compensation in the first two minutes, from the demo's own recordings.

python tests/first_minute.py [RUNS]: runs `thermoctl demo` and prints the output's error with and without compensation, um, each
the mean over a second at rest, AT_S after the demo began to move. Exit status 1 when compensation does not show by then.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.views.demo import demo_folder
from thermoctl.recording.reader import read_rows
from thermoctl.rig.signals import INDEX

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "config/simulated.yaml"
AT_S = (20.0, 60.0, 120.0)
MEAN_S = 1.0
TIMES = 20.0  # by how much compensation is to make the error smaller at the last of AT_S


def errors(path):
    """(len(AT_S), 2): the error with and without compensation, um; then the loop's slips and the faults that stood."""
    rows, _ = read_rows(path)
    column = {name: rows[:, INDEX[name]] for name in INDEX}
    moved = column["t_s"][np.flatnonzero(column["setpoint_um"] > 1.0)[0]]
    found = []
    for at in AT_S:
        now = (column["t_s"] > moved + at - MEAN_S) & (column["t_s"] <= moved + at)
        error = column["output_reference_um"][now] - column["reference_um"][now]
        found.append((error.mean(), (error + column["compensation_um"][now]).mean()))
    return (
        np.array(found),
        int(column["slips"][-1]),
        int((column["fault_bits"][column["t_s"] > moved] != 0).sum()),
    )


def main():
    """Run the demo so often; 0 when compensation shows every time."""
    recordings = demo_folder(load_settings(CONFIG)) / "recordings"
    print(
        "run "
        + "".join(f"{f'{at:g} s: with':>16}{'without':>9}{'ratio':>7}" for at in AT_S)
        + "   slips  faulty ticks"
    )
    ratios = []
    for run in range(int(sys.argv[1]) if len(sys.argv) > 1 else 1):
        before = set(recordings.glob("*.arrows"))
        subprocess.run(
            f"{sys.executable} -P -m thermoctl.cli demo --config {CONFIG} --seconds {AT_S[-1] + 5:g}".split(),
            check=True,
            stdout=subprocess.DEVNULL,
        )
        (path,) = (p for p in set(recordings.glob("*.arrows")) - before if "10hz" not in p.name.lower())
        found, slips, faulty = errors(path)
        ratio = np.abs(found[:, 1] / found[:, 0])
        print(
            f"{run + 1:3d} "
            + "".join(f"{w:+16.3f}{o:+9.3f}{r:7.0f}" for (w, o), r in zip(found, ratio, strict=True))
            + f"{slips:8d}{faulty:8d}",
            flush=True,
        )
        ratios.append(ratio[-1])
    return int(min(ratios) < TIMES)


if __name__ == "__main__":
    sys.exit(main())
