"""Refit of the naive plants on the real recordings beside every figure that is quoted for the same structure.

    make refit-recordings         (THERMOCTL_RECORDINGS: where the recordings lie, default ../shared/recordings)

A figure is quoted with as many digits as it was published with, and is met where ours, rounded to them, is no larger. Where
the quoted fit saw the data it is judged on, so does ours (`joint`); `held out` is data that took no part. On every recording
only the start may move, inside the `initial_sigma` that its plant file gives; in brackets: with the start as the file has it.
EMPS is one record, quoted as a whole (0.29 V); fitted on its first 60 % it gives 0.298 V on the rest, which nobody quotes.
"""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from thermoctl.plant import load
from thermoctl.plant.fitting.estimate import updated
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table

FOLDER = Path(os.environ.get("THERMOCTL_RECORDINGS", Path(__file__).parents[3] / "shared/recordings"))

# recording, runs of the fit, run that is judged, what of it (share of the fit), {output: quoted}, who quotes it
QUOTED = [
    (
        "cascaded_tanks",
        (1,),
        2,
        "held out",
        {"level": "0.67"},
        "README: a square-root model without overflow",
    ),
    ("building_prbs", (1,), 1, "joint", {"indoor": "0.87"}, "README: one state, whole record"),
    ("building_prbs", (1,), 1, 0.6, {"indoor": "1.28"}, "quick refit, last 40 %"),
    ("tclab", (1,), 2, "held out", {"T1": "1.88", "T2": "2.86"}, "quick refit, run 1 to run 2"),
    ("tclab", (4,), 4, 0.6, {"T1": "1.22", "T2": "11.6"}, "quick refit, run 4's last 40 %"),
    *(
        ("tmotor_ak109", (1, 2, 3), k, "joint", {"temperature": q}, "quick refit of the three runs")
        for k, q in ((1, "0.95"), (2, "0.39"), (3, "0.64"))
    ),
    ("zprobe_drift", (1,), 1, "joint", {"z": "22"}, "README: 4..22 um without lags"),
    ("zprobe_drift", (3,), 3, "joint", {"z": "4"}, "README: 4..22 um without lags"),
    ("emps", (1,), 1, "joint", {"drive_voltage": "0.29"}, "quick refit, whole record"),
]


def part(table, start, stop):
    return dataclasses.replace(
        table, t=table.t[start:stop], columns={k: v[start:stop] for k, v in table.columns.items()}
    )


def errors(folder, runs, judged, how):
    """({output: rms}, {output: rms with the start as the file has it}) of a refit on `runs`, on what is judged."""
    model = compile_plant(load(folder / "plant.yaml"))
    tables = [read_table(folder / f"run_{k}.csv") for k in runs]
    whole = model.excitation(read_table(folder / f"run_{judged}.csv"))
    skip = round(how * len(whole.t)) if isinstance(how, float) else 0
    drives = [model.excitation(part(t, 0, skip or len(t.t))) for t in tables]
    found = fit(model, drives, tries=10)
    plant = updated(model.plant, found, drives)
    fixed = compile_plant(plant, ())
    started = (
        found.dx0[0 if skip else runs.index(judged)] if skip or judged in runs else None
    )  # its start took part
    dx0 = started if started is not None or not fixed.uncertain else fit(fixed, [whole]).dx0[0]
    both = []
    for shift in (dx0, None):
        e = (
            whole.y
            - fixed.run(
                fixed.prepare(fixed.excitation(read_table(folder / f"run_{judged}.csv"))), None, shift
            ).y
        )[skip:]
        both.append(dict(zip(model.outputs, np.sqrt(np.nanmean(e**2, axis=0)), strict=True)))
    return both


def met(ours, quoted):
    """Is `ours`, to the digits that were published, no larger than the figure?"""
    digits = len(quoted.partition(".")[2])
    return round(float(ours), digits) <= float(quoted)


@pytest.mark.slow
def test_refits_are_no_worse_than_any_quoted_fit_of_the_same_structure():
    if not FOLDER.is_dir():
        pytest.skip(f"{FOLDER}: no such folder; set THERMOCTL_RECORDINGS to the folder of the recordings")
    rows = []
    for name, runs, judged, how, figures, source in QUOTED:
        ours, as_file = errors(FOLDER / name, runs, judged, how)
        for output, quoted in figures.items():
            rows.append(
                (
                    name,
                    f"run {judged}",
                    how if isinstance(how, str) else "held out",
                    output,
                    quoted,
                    f"{ours[output]:.4g} ({as_file[output]:.4g})",
                    "met" if met(ours[output], quoted) else "NOT met",
                    source,
                )
            )
    heads = ("recording", "judged on", "data", "output", "quoted", "ours", "", "whose figure")
    widths = [max(len(str(r[c])) for r in [*rows, heads]) for c in range(len(heads))]
    print()
    for r in (heads, *rows):
        print("  ".join(str(q).ljust(w) for q, w in zip(r, widths, strict=True)).rstrip())
    assert [r for r in rows if r[6] != "met"] == []


CASES = Path(os.environ.get("THERMOCTL_CASES", FOLDER.parent / "cases"))
PLANTS = sorted([*FOLDER.glob("*/plant*.yaml"), *CASES.glob("*/plant.yaml")])


@pytest.mark.slow
@pytest.mark.skipif(
    not PLANTS, reason=f"{FOLDER}, {CASES}: no such folders; set THERMOCTL_RECORDINGS and THERMOCTL_CASES"
)
@pytest.mark.parametrize("path", PLANTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_every_plant_loads_simulates_and_refits(path):
    """On all its recordings at once; a refit never fits worse than the belief, and stays inside the ranges."""
    model = compile_plant(load(path))
    drives = [model.excitation(read_table(p)) for p in sorted(path.parent.glob("run_*.csv"))]
    runs = [model.run(d) for d in drives]
    assert all(
        np.isfinite(run.y).all() and run.y.shape == d.y.shape for run, d in zip(runs, drives, strict=True)
    )
    found = fit(model, drives, iterations=15, seconds=120.0)
    sigma = np.array([n.sigma for n in found.noise])
    before, after = (
        np.sqrt(np.nanmean(np.concatenate([(e / sigma).ravel() for e in q]) ** 2))
        for q in ([d.y - run.y for run, d in zip(runs, drives, strict=True)], found.residuals)
    )
    print(f"{path.parent.name}: {len(drives)} recordings, error {before:.4g} -> {after:.4g} sigmas rms")
    assert after <= before * 1.001
    for q in model.active:
        low, high = model.plant.parameters[q].range
        column = found.values[:, model.parameters.index(q)]
        assert np.all((column >= low) & (column <= high)), q
