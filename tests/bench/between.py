"""How many false names a heater gets that switches between the rows of a logger, with straight lines and held.

    python -m tests.bench.between

Nothing is missing in the plant of a bar. Eight pairs of recordings, heaters of three sizes; about five CPU minutes."""

import contextlib
import sys
from unittest import mock

import numpy as np

from thermoctl.diagnosis import diagnose as engine
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.recording.table import Table

AIR = 20.0  # degC
CASES = [(most, seed) for most in (25.0, 40.0) for seed in (11, 13, 15)] + [(60.0, 1), (60.0, 3)]  # W, seed

BAR = """format: thermoctl-plant/1
title: A bar in four pieces, heated at one end and cooled at the other
inputs: {heat: {unit: W}, air: {unit: degC, between_samples: linear}}
parameters:
  C: {value: 50, unit: J/K, range: [20, 200]}
  G: {value: 1.0, unit: W/K, range: [0.2, 4]}
  G_side: {value: 0.07, unit: W/K, range: [0.01, 0.4]}
  G_end: {value: 0.5, unit: W/K, range: [0.1, 3]}
nodes:
""" + "".join(f"  s{k}: {{unit: degC, storage: C, initial: air, initial_sigma: 0.2}}\n" for k in range(4))
BAR += (
    "flows:\n  power: {into: s0, rate: heat, unit: W}\n  end: {from: s3, rate: G_end * (s3 - air), unit: W}\n"
)
BAR += "".join(
    f"  f{k}: {{from: s{k}, into: s{k + 1}, rate: G * (s{k} - s{k + 1}), unit: W}}\n" for k in range(3)
)
BAR += "".join(f"  l{k}: {{from: s{k}, rate: G_side * (s{k} - air), unit: W}}\n" for k in range(4))
BAR += "outputs:\n" + "".join(f"  TC{k}: {{value: s{k}, unit: degC, noise: 0.15}}\n" for k in range(4))


def of_bar(seed: int, rows: int, most: float) -> Table:
    """Rows every two seconds; the exact solution from switch to switch of a heater of 0 to 60 W."""
    rng, t = np.random.default_rng(seed), 2.0 * np.arange(rows)
    times = np.cumsum(rng.uniform(100, 500, rows))
    power = np.append(rng.uniform(0, most, rows), 0.0)
    a = (
        np.diag([-0.85] * 4) + 0.85 * (np.eye(4, k=1) + np.eye(4, k=-1)) + np.diag([0, -0.85, -0.85, -0.6])
    ) / 62
    rates, modes = np.linalg.eig(a - 0.05 / 62 * np.eye(4))
    x, reads = np.zeros(4), []
    for begin in t:
        reads.append(x)
        inside = times[(times > begin) & (times < begin + 2)]
        for at, end in zip((begin, *inside), (*inside, begin + 2), strict=True):
            push = np.linalg.solve(modes, [power[np.searchsorted(times, at, "right")] / 62, 0, 0, 0]) / rates
            x = (modes @ (np.exp(rates * (end - at)) * (np.linalg.solve(modes, x) + push) - push)).real
    noisy = AIR + np.array(reads) + rng.normal(0, 0.15, (rows, 4))
    heat = power[np.searchsorted(times, t, "right")]
    return Table(
        f"run_{seed}",
        "",
        t,
        {"heat": heat, "air": np.full(rows, AIR)} | {f"TC{k}": noisy[:, k] for k in range(4)},
    )


def named(most: float, seed: int, straight: bool) -> list[str]:
    """Names above 0.9 of a diagnosis in which nothing is missing."""
    runs = [of_bar(seed, 1200, most), of_bar(seed + 1, 1000, most)]
    held = mock.patch.object(engine, "between", lambda plant, made: made(plant))
    with contextlib.nullcontext() if straight else held:
        found = engine.diagnose(loads(BAR), runs, catalogue(), limits())
    sure = [f.members[0] for f in found.families]
    return [f"{effect} at {where}" for effect, where in (*found.decision.named, *sure)]


def main() -> int:
    print("| heater | seed | straight lines | held |\n|---|---|---|---|")
    for most, seed in CASES:
        shown = (", ".join(named(most, seed, way)) or "none" for way in (True, False))
        print(f"| {most:g} W | {seed} | {' | '.join(shown)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
