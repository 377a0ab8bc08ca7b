"""Learn each sensor's own noise from recordings in which nothing else is expected: `thermoctl noise`.

The plant is refitted to the recordings, and the residual of each output is taken for its noise. Three spectra
are compared: white, white with a first-order part, and white with a 1/f part. In a band of a DCT
(coordinates.py) with n rows and power P the likelihood is the Gaussian one:

    log p = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

Each parameter more costs log(rows) / 2 (Schwarz 1978). Physics that the plant lacks would be learnt as noise,
too: so the inputs should be constant, or the plant complete.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table as Printed
from scipy.optimize import minimize

from thermoctl.diagnosis.data.coordinates import Channel, Coordinates, transform
from thermoctl.diagnosis.data.spectra import spectrum
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, save
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Plant, SensorNoise
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

LEAST = 100  # least number of measured values of an output to learn its noise
DIGITS = 3


Power = tuple[Channel, np.ndarray]  # a channel, and the power of its residual in each band (bands,)


def learnt(plant: Plant, tables: Sequence[Table]) -> Plant:
    """Return the plant with the noise of every output that was measured often enough. Raises InputError."""
    model = compile_plant(plant)
    drives = [model.excitation(t) for t in tables]
    coordinates = Coordinates(drives)
    channels, by_output = coordinates.channels, coordinates.by_output()
    counts = {j: sum(len(channels[k].index) for k in ks) for j, ks in by_output.items()}
    most = max(counts.values(), default=0)
    if most < LEAST:
        raise InputError(
            f"{', '.join(t.path for t in tables)}: too little data: at most {most} measured values of one output; "
            f"{LEAST} or more are needed to learn its noise"
        )
    refitted = fit(model, drives, default_noise(plant, drives), tolerance=1e-3, seconds=np.inf)
    rows = [transform(c, refitted.residuals[c.recording][:, c.output]) for c in channels]
    powers = list(zip(channels, coordinates.powers(rows), strict=True))
    outputs = dict(plant.outputs)
    for j, ks in by_output.items():
        if counts[j] < LEAST:
            continue
        o = outputs[model.outputs[j]]
        # Variance of the rounding: the plant file states it as `resolution`, so it is no part of the noise.
        step = (o.resolution or 0.0) ** 2 / 12
        outputs[o.name] = dataclasses.replace(o, noise=_best([powers[k] for k in ks], step))
    return dataclasses.replace(plant, outputs=outputs)


def _best(powers: Sequence[Power], step: float) -> SensorNoise:
    """Return the spectrum with the best Schwarz criterion. `step`: the variance of the rounding."""
    rows = sum(float(c.count.sum()) for c, _ in powers)
    total = float(np.sqrt(sum(p.sum() for _, p in powers) / rows))
    longest = max(c.interval * c.rows for c, _ in powers)
    shortest = min(c.interval for c, _ in powers)
    starts = {
        "white": [[0.0]],
        "drift": [[-0.3, -1.0, np.log(tau)] for tau in np.geomspace(3 * shortest, longest / 3, 4)],
        "flicker": [[-0.3, -1.5]],
    }
    tried = []
    for kind, points in starts.items():
        for start in points:
            done = minimize(_cost, start, (kind, powers, total, step), method="Nelder-Mead")
            noise = _made(kind, done.x, total)
            inside = noise.time is None or shortest < noise.time < longest
            tried.append((done.fun + 0.5 * len(start) * np.log(rows) + (0 if inside else np.inf), noise))
    best = min(tried, key=lambda x: x[0])[1]
    # by channel, the rms of the residual over that of the noise
    ratios = (np.sum(p / _expected(c, best, step)) / c.count.sum() for c, p in powers)
    scale = np.sqrt([*ratios])
    spread = float(np.var(np.log(scale)) if len(scale) > 1 else 0.0)
    # Of the logarithm: the variance of one estimate, and that from recording to recording.
    sd = np.sqrt(0.5 / rows + spread)
    return dataclasses.replace(best, sd=float(f"{sd:.{DIGITS}g}"))


def _made(kind: str, x: np.ndarray, total: float) -> SensorNoise:
    size = [float(f"{total * np.exp(v):.{DIGITS}g}") for v in x[:2]]
    if kind == "drift":
        return SensorNoise(size[0], drift=size[1], time=float(f"{np.exp(x[2]):.{DIGITS}g}"))
    return SensorNoise(size[0], flicker=size[1]) if kind == "flicker" else SensorNoise(size[0])


def _expected(c: Channel, noise: SensorNoise, step: float) -> np.ndarray:
    """Return the variance of a row in each band. `step`: the variance of the rounding."""
    return step + spectrum(noise, c.frequency, c.interval)


def _cost(x: np.ndarray, kind: str, powers: Sequence[Power], total: float, step: float) -> float:
    """Minus the log likelihood, up to a constant."""
    noise, cost = _made(kind, np.clip(x, -20.0, 20.0), total), 0.0
    for c, p in powers:
        v = _expected(c, noise, step) + 1e-12 * total**2
        cost += 0.5 * float(np.sum(c.count * np.log(v) + p / v))
    return cost


def command(args: argparse.Namespace) -> int:
    """`thermoctl noise`: learn, write the plant file, print stated and learnt noise. Raises InputError."""
    plant = load(args.plant)
    if Path(args.out).resolve() == Path(args.plant).resolve():
        raise InputError(f"--out {args.out}: is the plant file itself; name another file")
    new_plant = learnt(plant, read_recordings(plant, args.recordings))
    save(new_plant, args.out, note=f"{Path(args.plant).name}, with its sensors' noise learnt")
    load(args.out)
    table = Printed("output", "unit", "stated", "learnt", "known to", box=None, header_style="bold")
    for name, o in new_plant.outputs.items():
        before = plant.outputs[name].noise
        sd = o.noise.sd if isinstance(o.noise, SensorNoise) and o.noise.sd else None
        table.add_row(
            name,
            o.unit or "",
            "-" if before is None else str(before),
            str(o.noise) if o is not plant.outputs[name] else "too few values",
            f"{100 * sd:.2g} %" if sd else "-",
        )
    console = Console(width=160)
    console.print(table)
    console.print(
        f"written: {args.out}. What the plant lacks in these recordings is counted as noise.", markup=False
    )
    return 0
