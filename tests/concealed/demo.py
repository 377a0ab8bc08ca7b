"""From concealed physics to a smaller error: the whole chain on rigs whose truth the program does not share.

    python -m tests.concealed.demo [--out DIR] [--only NAMES] [--seed S]          (make demo-concealed)

For each effect below, none of which is told to the program:
1 conceal      a rig of tests/concealed (finite volumes or split steps, own noise) gets the effect at SIGMAS sigmas after an honest
               refit, or as near as it goes; two recordings; the second one takes no part in anything but the judging
2 diagnose     `diagnose` on the first recording alone
3 extend       the plant file that it wrote, against the same plant merely refitted to the same recording
4 linearise    actuator: both plants to compensators (Kalman filter, coil sensor and electrical power only)
5 judge        actuator: position error of the second recording's true growth, each compensator correcting it, zeroed at the start, as ISO 230-2
               puts it (mean and 2 s); other rigs: free-run error of the second recording over its noise
Done effects in --out are not run again; the page is DIR/demo.html.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.concealed import generate, sensors
from tests.concealed.judge import size_for, snr
from tests.concealed.rig import Scene
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.diagnosis import run as diagnosis
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.jobs import program
from thermoctl.identify.linearise import linearise
from thermoctl.plant import load, save
from thermoctl.plant.fitting.estimate import updated
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table
from thermoctl.report import page

SIGMAS = 120.0
LATE = 1e9  # seconds: the joint is as it is after the recordings


@dataclass(frozen=True)
class Story:
    """One concealed effect and what it is in the workshop."""

    effect: str
    where: str
    family: str
    meaning: str


STORIES = (
    Story("external_heat_source", "outer_stator", "actuator", "a lamp shines on the stator for a while"),
    Story("conductance_step", "outer_stator_to_air", "actuator", "the stator's contact to the frame loosens"),
    Story("missing_member", "bracket_2", "actuator", "a bracket grows and the model does not know it"),
    Story("eddy_heating", "housing", "drive", "eddy currents heat the housing at speed"),
    Story("force_constant_temperature", "motor", "flexure", "the magnets weaken when warm"),
    Story("sensor_lag", "temperature_1", "heater", "the thermometer sits in a slow sleeve"),
    Story("coulomb_friction", "velocity", "stage", "the guide rubs"),
)


def conceal(
    story: Story, seed: int, folder: Path
) -> tuple[Scene, tuple[str, str, dict], list[np.ndarray], float]:
    """Write plant.yaml, run_1.csv and run_2.csv; returns the scene, the effect with its parameters, the true readings of each
    run (N, outputs) and how many sigmas the effect leaves after a refit. An actuator's columns get the program's names."""
    for attempt in range(400):
        rng = np.random.default_rng([seed, attempt])
        scene = generate.FAMILIES[story.family].scene(rng, "designed", True)
        # the judge's `top` is the largest sensible size for a case; the demonstration may go beyond it
        held = [
            dataclasses.replace(s, top=40.0)
            for s in scene.suspects
            if (s.effect, s.where) == (story.effect, story.where)
        ]
        if held and (story.family != "actuator" or len(scene.outputs) == 13):
            break
    else:
        raise RuntimeError(f"no rig of 400 has a place for {story.effect} at {story.where}")
    bench = generate.Bench(scene, rng)
    bench.measure(held)
    size = size_for(bench.curve[0], min(SIGMAS, 0.95 * float(np.max(snr(bench.curve[0][2])))))
    effect = (story.effect, story.where, held[0].make(size))
    true = bench.readings([effect])
    left = bench.refit(true)
    tables = []
    for k, recording in enumerate(scene.runs):
        columns = [("t", recording["t"]), *((c, recording[key]) for c, key in scene.columns.items())]
        columns += [
            (c, sensors.record(true[k][:, j], bench.noise[j], scene.sd[j], scene.resolution[j], {}, rng))
            for j, c in enumerate(scene.outputs)
        ]
        tables.append(columns)
    plant = scene.plant
    if story.family == "actuator":
        tables = [in_signals(plant, columns)[1] for columns in tables]
        plant, _ = in_signals(plant, tables[0])
    generate.write_case(folder, plant, tables)
    return scene, effect, true, float(np.linalg.norm(left))


def in_signals(plant: dict, columns: list) -> tuple[dict, list]:
    """An actuator's plant file and columns by the program's names of signals, which its compensator knows."""
    names = {
        "voltage": "voltage_v",
        "current": "current_a",
        "air_temperature": "air_c",
        "position_error": "position_error_um",
    }
    names |= {o: o.replace("_temperature", "_c") for o in plant["outputs"] if o.endswith("_temperature")}

    def named(part: str) -> dict:
        return {
            n: {**x, "column": names.get(x.get("column", n), x.get("column", n))}
            for n, x in plant[part].items()
        }

    return {**plant, "inputs": named("inputs"), "outputs": named("outputs")}, [
        (names.get(n, n), x) for n, x in columns
    ]


def compensated(plant_file: Path, recording: Path, true_um: np.ndarray, t_now_s: float) -> np.ndarray:
    """Position error (N,) um that is left of the true growth (N,) when the plant's linearised compensator corrects it:
    x+ = x + (A - I) x + B [P, d(air)], x += K (coil - C x), e = b2 . C x + a_air (air - air at start)."""
    table = read_table(recording)
    c = table.columns
    period = float(np.median(np.diff(table.t)))
    model = linearise(at_time(load(plant_file), t_now_s), period_s=period, sensor_period_s=period)
    power, air = c["voltage_v"] * c["current_a"], c["air_c"]
    rise, d_air = c["coil_c"] - air, np.append(np.diff(air), 0.0) / period
    x = np.zeros(len(model.A_minus_I))
    gain, first = model.gain[:, 0], model.C[0]
    said = np.empty(len(air))
    for k in range(len(air)):
        x = x + gain * (rise[k] - first @ x)
        said[k] = model.b2 @ (model.C @ x) + model.b_air * (air[k] - air[0])
        x = x + model.A_minus_I @ x + model.B @ np.array([power[k], d_air[k]])
    error = true_um - said
    return error - np.mean(error[:30])


def at_time(plant: Any, t_s: float) -> Any:
    """The plant with the time `t` in its equations put to t_s: what it is now, steps that have happened included."""
    from thermoctl.plant import expression as ex

    def now(e: Any) -> Any:
        return ex.substitute(e, lambda part: ex.num(t_s) if part.op == "name" and part.value == "t" else None)

    return dataclasses.replace(
        plant, flows={k: dataclasses.replace(f, rate=now(f.rate)) for k, f in plant.flows.items()}
    )


def unseen(plant_file: Path, recording: Path) -> dict[str, float]:
    """Free-run rms error of each output over its noise on a recording; its own start is estimated, nothing else."""
    plant = load(plant_file)
    model = compile_plant(plant, ())
    drive = model.excitation(read_table(recording))
    found = fit(model, [drive])
    noise = {
        o.name: float(np.hypot(o.noise_sd, (o.resolution or 0.0) / np.sqrt(12)))
        for o in plant.outputs.values()
    }
    return {o: r / noise[o] for o, r in found.rms().items() if np.isfinite(r) and noise[o]}


def tell(story: Story, seed: int, out: Path) -> dict[str, Any]:
    """The chain for one effect; kept in OUT/EFFECT/result.json for the same seed and program."""
    folder = out / story.effect
    made_by = {"seed": seed, "program": program()}
    if (folder / "result.json").exists() and made_by.items() <= (
        kept := json.loads((folder / "result.json").read_text())
    ).items():
        return kept
    say(f"{story.effect}: concealed in a {story.family}")
    scene, effect, true, sigmas = conceal(story, seed, folder)
    begun = time.monotonic()
    say(f"{story.effect}: diagnosing (the truth is sealed in the judge)")
    result = diagnosis.diagnose_files(folder / "plant.yaml", [folder / "run_1.csv"], folder / "diagnosis")
    seconds = time.monotonic() - begun
    plant = load(folder / "plant.yaml")
    model = compile_plant(plant)
    drives = [model.excitation(read_table(folder / "run_1.csv"))]
    save(updated(plant, fit(model, drives), drives), folder / "refitted.yaml")
    files = {
        "as it came": folder / "plant.yaml",
        "refitted": folder / "refitted.yaml",
        "extended": folder / "diagnosis" / "plant.yaml",
    }
    told: dict[str, Any] = {
        **made_by,
        **dataclasses.asdict(story),
        "sigmas": sigmas,
        "true": effect[2],
        "verdict": result["verdict"],
        "seconds": seconds,
        "findings": [[f["effect"], f["where"], f["probability"]] for f in result["findings"]],
        "fit": {},
        "position_um": {},
        "curves": {},
    }
    for name, file in files.items():
        told["fit"][name] = unseen(file, folder / "run_2.csv")
        if story.family == "actuator":
            try:
                error = compensated(file, folder / "run_2.csv", true[1][:, -1], LATE)
            except InputError as e:
                told["position_um"][name] = str(e)
                continue
            told["position_um"][name] = mean_and_two_s(error)
            told["curves"][name] = error[::10].tolist()
    if story.family == "actuator":
        free = true[1][:, -1] - true[1][:30, -1].mean()
        told["position_um"]["no compensation"] = mean_and_two_s(free)
        told["curves"]["no compensation"] = free[::10].tolist()
        told["t"] = scene.runs[1]["t"][::10].tolist()
    (folder / "result.json").write_text(json.dumps(told, default=float) + "\n")
    return told


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def right(told: dict[str, Any]) -> bool:
    """The concealed effect at its place is among what was found."""
    return any((e, w) == (told["effect"], told["where"]) for e, w, _ in told["findings"])


def worst(ratios: dict[str, float]) -> float:
    """The worst output's error in units of its noise."""
    return max(ratios.values(), default=float("nan"))


def fits(all_told: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """One row an effect: what was concealed, what was found, the unseen recording's worst output before and after."""
    rows = []
    for x in all_told:
        found = ", ".join(f"{e} at {w} ({p:.2f})" for e, w, p in x["findings"]) or "nothing"
        rows.append(
            [
                f"{x['effect']} at {x['where']}",
                x["family"],
                f"{x['verdict']}: {found}",
                "yes" if right(x) else "no",
                *(worst(x["fit"][n]) for n in FILES),
            ]
        )
    return rows


def positions(all_told: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One row an actuator: position error, mean and 2 s in um, without and with the compensator made from each plant."""

    def figure(v: Any) -> str:
        return v if isinstance(v, str) else f"{v[0]:+.3f} ± {v[1]:.3f}"

    return [
        [x["effect"], *(figure(x["position_um"][n]) for n in (FREE, *FILES))]
        for x in all_told
        if x["position_um"]
    ]


FREE, FILES = "no compensation", ("as it came", "refitted", "extended")
HEAD = ("concealed", "rig", "diagnosis", "right", *FILES)
FIT_NOTE = (
    "Worst output's free-run error on a recording that took no part, in units of its noise, by plant file."
)
POSITION_NOTE = "Position error of that recording in um (mean ± 2 s, ISO 230-2), corrected by the compensator made from each plant file."


def write(all_told: Sequence[dict[str, Any]], out: Path) -> None:
    """The page and the terminal's tables."""
    from rich.console import Console
    from rich.table import Table

    parts = [
        (HEAD, fits(all_told), FIT_NOTE),
        (("concealed", FREE, *FILES), positions(all_told), POSITION_NOTE),
    ]
    for head, rows, note in parts:
        t = Table(*head, caption=note)
        for row in rows:
            t.add_row(*(f"{c:.2f}" if isinstance(c, float) else str(c) for c in row))
        Console(width=150).print(t)
    sections = [
        (
            "Before and after",
            "".join(f"<p>{note}</p>{page.table(head, rows)}" for head, rows, note in parts if rows),
        )
    ]
    for x in all_told:
        body = (
            f"<p>Concealed: {x['meaning']} ({x['effect']} at {x['where']}, {x['sigmas']:.0f} sigmas after a refit). "
            f"Diagnosis took {x['seconds']:.0f} s: {x['verdict']}.</p>"
        )
        if x["curves"]:
            from matplotlib.figure import Figure

            figure = Figure(figsize=(9, 2.8), layout="constrained")
            axes = figure.subplots()
            for name, curve in x["curves"].items():
                axes.plot(np.array(x["t"]) / 3600, curve, label=name, lw=1)
            axes.set(xlabel="hours", ylabel="position error, um")
            axes.legend(ncol=4, fontsize=8)
            body += page.figure(figure, "Position error on the second recording, zeroed at its start")
        sections.append((x["effect"], body))
    out.mkdir(parents=True, exist_ok=True)
    (out / "demo.html").write_text(
        page.page("Concealed physics, from the error to the cure", sections, "make demo-concealed")
    )
    say(f"written: {out / 'demo.html'}")


def main(argv: Sequence[str] | None = None) -> int:
    """The command: 0 when every concealed effect was found at its place and every compensator could be made."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", type=Path, default=Path("build/demo-concealed"))
    p.add_argument("--only", default="", help="names of effects, separated by commas")
    p.add_argument("--seed", type=int, default=5)
    a = p.parse_args(argv)
    names = [n for n in a.only.split(",") if n]
    if unknown := set(names) - {s.effect for s in STORIES}:
        p.error(
            f"--only: {', '.join(sorted(unknown))}: expected some of {', '.join(s.effect for s in STORIES)}"
        )
    told = [tell(s, a.seed, a.out) for s in STORIES if not names or s.effect in names]
    write(told, a.out)
    refused = any(isinstance(v, str) for x in told for v in x["position_um"].values())
    return 0 if all(map(right, told)) and not refused else 1


if __name__ == "__main__":
    sys.exit(main())
