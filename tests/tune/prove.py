"""`make prove-tune`: tunes on loops of known truth, in simulated time; docs/proof/tuning.md.

    python -m tests.tune.prove [--number 100] [--seed 1] [--page FILE]

Each tune is the product's own, from its first test to the proven gains. The loop is run by the daemon's tick over a plant with dead
time, a command period, skipped and late ticks (rig.py). What the loop is before and after is computed apart (truth.py).
"""

import argparse
import dataclasses
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from tests.tune import truth as true
from tests.tune.rig import LoopRig, Truth, settings_of
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.tune import tune
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import HardwareError

GOOD_GAIN, GOOD_DEG = 2.0, 45.0
# The true margins that a written loop must have where the present one had them: what is wanted less what a test can tell.
LEAST_GAIN, LEAST_DEG = 1.75, 38.0
SLOWER = 1.1  # largest increase of the error under a load, for a loop whose margins were good
WORDS = (
    (r"were skipped", "ticks skipped or late"),
    (r"known to .* deg only", "noise hides the response"),
    (r"not known well enough", "noise hides a step's margins"),
    (r"predicted; the gains", "a step's loop was not as predicted"),
    (r"no gains within|no lambda", "no gains with margins within the factor"),
    (r"ended after", "a fault or a growing error ended a test"),
)


@dataclasses.dataclass(frozen=True)
class Case:
    """A loop and its present gains."""

    truth: Truth
    kp: float
    ti_s: float
    td_s: float
    rate_um_s: float


@dataclasses.dataclass
class Result:
    """What became of it: written, kept or refused; the true margins and load errors before and after."""

    case: Case
    outcome: str
    why: str
    before: tuple[float, float, float]
    after: tuple[float, float, float]
    gains: tuple[float, float, float]

    @property
    def unstable(self):
        return self.outcome == "written" and self.after[0] == 0.0

    @property
    def worse(self):
        """Less margin than wanted and than before; or slower though the margins were good."""
        if self.outcome != "written":
            return False
        (gain0, deg0, load0), (gain, deg, load) = self.before, self.after
        if gain < min(LEAST_GAIN, 0.97 * gain0) or deg < min(LEAST_DEG, deg0 - 2.0):
            return True
        return gain0 >= GOOD_GAIN and deg0 >= GOOD_DEG and load > SLOWER * load0


def cases(number, seed):
    """Loops over skips of 0 to 20 %, jitter, command rates of 50 to 1000 Hz, dead times of 1 to 8 ms, with and without derivative.

    The present gains are those of lambda tuning for the true loop, times 0.1 to 1.4."""
    random = np.random.default_rng(seed)
    while number:
        period_s = float(random.choice([0.001, 0.002, 0.004]))
        truth = Truth(
            gain=float(np.exp(random.uniform(np.log(30), np.log(1000)))),
            t1_s=float(random.uniform(0.006, 0.03)),
            t2_s=float(random.uniform(0.0002, 0.003)),
            dead_s=float(random.uniform(0.001, 0.008)),
            command_hz=float(random.choice([50, 100, 200, 500, 1000])),
            noise_um=float(np.exp(random.uniform(np.log(0.01), np.log(0.1)))),
            skips=float(
                random.choice(
                    [
                        0.0,
                        np.exp(random.uniform(np.log(0.001), np.log(0.01))),
                        np.exp(random.uniform(np.log(0.01), np.log(0.2))),
                    ],
                    p=[0.3, 0.4, 0.3],
                )
            ),
            stall_ticks=float(random.choice([1.2, 2.0, 5.0])),
            jitter_s=float(random.choice([0.0, 0.02, 0.1, 0.25]) * period_s),
            period_s=period_s,
        )
        theta = truth.dead_s + 0.5 * max(period_s, 1.0 / truth.command_hz)
        factor = float(np.exp(random.uniform(np.log(0.1), np.log(1.4))))
        with_derivative = bool(random.integers(2))
        ti_s = truth.t1_s + truth.t2_s
        kp = factor * ti_s / (truth.gain * 2.0 * theta)
        td_s = truth.t1_s * truth.t2_s / ti_s if with_derivative else 0.0
        case = Case(
            truth, kp, ti_s * float(random.uniform(0.5, 1.5)), td_s, float(random.choice([16.7, 50.0, 100.0]))
        )
        if true.stable(truth, [case.kp], case.ti_s, case.td_s)[0]:  # nobody tunes a loop that does not run
            number -= 1
            yield case


def judged(case, kp, ti_s, td_s):
    gain, delay = true.margins(case.truth, kp, ti_s, td_s)
    load = true.load_error(case.truth, kp, ti_s, td_s) if gain else math.inf
    return gain, true.phase_deg(case.truth, kp, ti_s, td_s, delay), load


def run(case, seed, folder):
    """One tune, and what it made of the true loop."""
    settings = settings_of(folder, case.truth, case.kp, case.ti_s, case.td_s, case.rate_um_s)
    before = judged(case, case.kp, case.ti_s, case.td_s)
    present, outcome, why = (case.kp, case.ti_s, case.td_s), "refused", ""
    gains = present
    try:
        found = tune(LoopRig(settings, case.truth, seed), True, Keyboard(False), lambda line: None)
        gains = (found.proposed.kp, found.proposed.ti_s, found.proposed.td_s)
        outcome = "kept" if found.proposed == found.present else "written"
    except (InputError, HardwareError) as e:
        why = str(e)
    after = judged(case, *gains) if outcome == "written" else before
    return Result(case, outcome, why, before, after, gains)


def reason(why):
    return next((words for pattern, words in WORDS if re.search(pattern, why)), why[:80])


def table(results):
    """The lines of the result, in Markdown."""
    written = [r for r in results if r.outcome == "written"]
    count = Counter(r.outcome for r in results)
    lines = [
        f"{len(results)} tunes: {count['written']} written, {count['kept']} kept (good margins, nothing faster), {count['refused']} refused.",
        f"Written unstable: {sum(r.unstable for r in results)}. Left worse: {sum(r.worse for r in results)}.",
        "",
        "| refused because | tunes |",
        "| --- | --- |",
        *(
            f"| {why} | {n} |"
            for why, n in Counter(reason(r.why) for r in results if r.outcome == "refused").most_common()
        ),
        "",
        "| ticks skipped | tunes | written | kept | refused | unstable | worse |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    edges = (
        ("none", 0.0, 0.0),
        ("to 0.5 %", 1e-9, 0.005),
        ("0.5 to 2 %", 0.005, 0.02),
        ("2 to 20 %", 0.02, 1.0),
    )
    lines += _rows(
        results, [(name, lambda r, a=low, b=high: a <= r.case.truth.skips <= b) for name, low, high in edges]
    )
    lines += [
        "",
        "| command rate, Hz | tunes | written | kept | refused | unstable | worse |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += _rows(
        results,
        [(f"{hz:g}", lambda r, a=hz: r.case.truth.command_hz == a) for hz in (50, 100, 200, 500, 1000)],
    )
    lines += [
        "",
        "| derivative | tunes | written | kept | refused | unstable | worse |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += _rows(
        results,
        [
            (name, lambda r, a=flag: (r.case.td_s > 0) == a)
            for name, flag in (("with", True), ("without", False))
        ],
    )
    if written:
        worst = [min(r.after[i] for r in written) for i in (0, 1)]
        middle = [float(np.median([r.after[i] for r in written])) for i in (0, 1)]
        faster = float(np.median([r.before[2] / r.after[2] for r in written]))
        lines += [
            "",
            f"True margins of the loops written: gain {middle[0]:.2f} in the median and {worst[0]:.2f} at least, phase {middle[1]:.0f} and "
            f"{worst[1]:.0f} deg; the error under a load falls by a factor of {faster:.2g} in the median.",
        ]
    return lines


def _rows(results, groups):
    for name, has in groups:
        mine = [r for r in results if has(r)]
        c = Counter(r.outcome for r in mine)
        yield (
            f"| {name} | {len(mine)} | {c['written']} | {c['kept']} | {c['refused']} | {sum(r.unstable for r in mine)} | "
            f"{sum(r.worse for r in mine)} |"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page")
    parser.add_argument("--each", action="store_true", help="a line for each tune")
    a = parser.parse_args()
    begin, results = time.process_time(), []
    with tempfile.TemporaryDirectory() as folder:
        for k, case in enumerate(cases(a.number, a.seed)):
            r = run(case, k, folder)
            results.append(r)
            if a.each or r.unstable or r.worse:
                t = case.truth
                print(
                    f"{k:3d} {r.outcome:8s}{'UNSTABLE ' if r.unstable else 'WORSE ' if r.worse else ''}skips {100 * t.skips:.2g} % jitter "
                    f"{t.jitter_s / t.period_s:.2g} command {t.command_hz:g} Hz dead {1e3 * t.dead_s:.2g} t1 {1e3 * t.t1_s:.2g}, {1e3 * t.t2_s:.2g} "
                    f"period {1e3 * t.period_s:g} ms noise {t.noise_um:.2g} at {case.rate_um_s:g}: "
                    f"gain margin {r.before[0]:.2f} -> {r.after[0]:.2f}, phase {r.before[1]:.0f} -> {r.after[1]:.0f}, load {r.before[2]:.3g} -> "
                    f"{r.after[2]:.3g} kp x{r.gains[0] / case.kp:.2g} {r.why}",
                    flush=True,
                )
            elif k % 10 == 9:
                print(
                    f"{k + 1} of {a.number}, {time.process_time() - begin:.0f} s", file=sys.stderr, flush=True
                )
    lines = table(results)
    print("\n".join(lines))
    if a.page:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
        ).stdout.strip()
        command = f"python -m tests.tune.prove --number {a.number} --seed {a.seed}"
        head = Path(a.page).read_text().split("<!-- result -->")[0]
        Path(a.page).write_text(
            f"{head}<!-- result -->\n{datetime.now(UTC):%Y-%m-%d}, commit {commit}, `{command}`, {time.process_time() - begin:.0f} s of CPU.\n\n"
            + "\n".join(lines)
            + "\n"
        )
    return 1 if any(r.unstable or r.worse for r in results) else 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
