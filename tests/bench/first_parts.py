"""Which first parts of a recording lead the refit of an oscillator to its optimum?

    python -m tests.bench.first_parts [--draws 20]

Three systems in which nothing is missing (a Roessler system, a repressilator, a predator with its prey), by
scipy. Each starts from parameters that are wrong by up to a quarter, drawn anew. Prints, for each set of first
parts, how often the refit follows the recording within 1.2 times its noise, and its processor time."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from thermoctl.plant import loads
from thermoctl.plant.fitting import refit
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

FOLLOWS, WRONG, NOISE = 1.2, 0.25, 0.1
SETS = {"none": (), "1/2": (0.5,), "1/4, 1/2": (0.25, 0.5), "1/8, 1/4, 1/2": (0.125, 0.25, 0.5)}
SYSTEMS: dict[str, tuple[dict[str, float], dict[str, str], Callable[..., list[float]], float]] = {
    "Roessler": (
        {"a": 0.2, "b": 0.2, "c": 5.7},
        {"x": "-y - z", "y": "x + a * y", "z": "b + z * (x - c)"},
        lambda _, s: [-s[1] - s[2], s[0] + 0.2 * s[1], 0.2 + s[2] * (s[0] - 5.7)],
        60.0,
    ),
    "repressilator": (
        {"alpha": 30.0, "n": 2.5, "beta": 0.8},
        {f"m{k}": f"alpha / (1 + p{(k + 1) % 3 + 1}**n) - m{k}" for k in (1, 2, 3)}
        | {f"p{k}": f"beta * (m{k} - p{k})" for k in (1, 2, 3)},
        lambda _, s: [
            *(30 / (1 + s[3 + (k + 2) % 3] ** 2.5) - s[k] for k in range(3)),
            *(0.8 * (s[k] - s[3 + k]) for k in range(3)),
        ],
        60.0,
    ),
    "predator": (
        {"r": 0.9, "b": 0.5, "m": 0.6},
        {"prey": "r * prey - b * prey * hunter", "hunter": "0.3 * prey * hunter - m * hunter"},
        lambda _, s: [0.9 * s[0] - 0.5 * s[0] * s[1], 0.3 * s[0] * s[1] - 0.6 * s[1]],
        80.0,
    ),
}


def main() -> None:
    """Print the table."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--draws", type=int, default=20)
    draws = p.parse_args().draws
    print(f"| first parts | {' | '.join(SYSTEMS)} | CPU s |\n|---|{'---|' * (len(SYSTEMS) + 1)}")
    for label, parts in SETS.items():
        refit.FIRST_PARTS, spent = parts, time.process_time()
        found = [sum(follows(name, k) for k in range(draws)) for name in SYSTEMS]
        print(
            f"| {label} | {' | '.join(f'{n}/{draws}' for n in found)} | {time.process_time() - spent:.1f} |"
        )


def follows(name: str, seed: int) -> bool:
    """Return whether the refit of a system, from wrong parameters, follows its recording."""
    parameters, rates, truth, end = SYSTEMS[name]
    rng, t, start = np.random.default_rng(seed), np.arange(0.0, end, 0.1), np.linspace(1.0, 2.0, len(rates))
    x = solve_ivp(truth, (0, end), start, t_eval=t, rtol=1e-9, atol=1e-9).y
    values = {q: v * (1 + rng.uniform(-WRONG, WRONG)) for q, v in parameters.items()}
    text = "format: thermoctl-plant/1\nparameters:\n"
    text += "".join(f"  {q}: {{value: {v}, range: [{v / 2}, {2 * v}]}}\n" for q, v in values.items())
    states = [
        f"  {n}: {{storage: 1, initial: {v}, initial_sigma: 0.1}}\n"
        for n, v in zip(rates, start, strict=True)
    ]
    text += "nodes:\n" + "".join(states)
    text += "flows:\n" + "".join(f"  f_{n}: {{into: {n}, rate: {rate}}}\n" for n, rate in rates.items())
    text += "outputs:\n" + "".join(f"  {n}_read: {{value: {n}, noise: {NOISE}}}\n" for n in rates)
    columns = {f"{n}_read": v + rng.normal(0, NOISE, len(t)) for n, v in zip(rates, x, strict=True)}
    model = compile_plant(loads(text))
    found = refit.fit_by_first_parts(model, [model.excitation(Table("run", "", t, columns))])
    return max(found.rms().values()) < FOLLOWS * NOISE


if __name__ == "__main__":
    main()
