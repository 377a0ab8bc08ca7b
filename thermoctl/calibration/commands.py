"""The commands experiment, identify, model, tune, evaluate and calibrate.

Each returns its exit status."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.calibration import chain, drive, experiment, iso230, recorded, schedules
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.tune import TESTS
from thermoctl.calibration.tune import tune as tune_loop
from thermoctl.calibration.wizard import Wizard
from thermoctl.configuration.settings import Settings, load_settings
from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import experiments, modelfile, tuning
from thermoctl.interrupt import STATUS, Interrupted
from thermoctl.recording.files import read_table
from thermoctl_hal.base.backend import HardwareError

MODELS = Path("models")
"""Folder of calibrations where none is given; those of an axis are in a folder of its name below it."""


def run_experiment(
    name: str,
    config: str,
    out: str | None,
    dry_run: bool,
    resume: bool,
    plant: str | None = None,
    yes: bool = False,
) -> int:
    """Run `thermoctl experiment`: record a test of experiments.yaml, or the experiment of a file.

    With a running daemon it runs in real time under the daemon's protections. Without one it runs on the
    simulated back end, faster than real time. An experiment of inputs can also run on a plant file. Returns 1
    when the user answered no, 3 when it ended early, STATUS when the user ended it. Then the rows are kept,
    and --resume continues from there."""
    if Path(name).suffix in (".yaml", ".yml"):  # the file of an experiment, not a test of the rig
        inputs = experiment.of_inputs(name)
        if dry_run or plant:
            return experiment.on_plant(inputs, None if dry_run else plant, Path(out or f"{inputs.name}.csv"))
        settings = load_settings(config)
        schedule, name = inputs.schedule(), inputs.name
        schedules.check_predicted(inputs, settings)
    elif plant:
        raise InputError(
            f"'{name}' is a test of the actuator's setpoint; --plant takes the file of an experiment that lists inputs"
        )
    else:
        schedule = schedules.find(name, config)
        settings = load_settings(config)
    return experiment.on_rig(settings, schedule, Path(out or f"{name}.parquet"), dry_run, resume, yes)


def record(experiment_file: Path, recording: Path, config: str, plant: str | None, yes: bool = False) -> None:
    """Run an experiment file for `thermoctl diagnose --resolve`.

    Raises HardwareError where it ends early, Interrupted where the person ends it, and InputError where the
    person does not say `go`."""
    status = run_experiment(str(experiment_file), config, str(recording), False, False, plant, yes)
    if status == 1:
        raise InputError(
            f"{experiment_file}: not run, the answer was not `go`; diagnosis.json beside it stands"
        )
    if status:
        raise (Interrupted if status == STATUS else HardwareError)(
            f"{experiment_file}: the experiment did not come to its end; what was recorded is in {recording}"
        )


def identify(test_2: str, test_3: str, test_4a: str, config: str, models: str | None, order: int) -> int:
    """Run `thermoctl identify`.

    Calibrate from recordings and install the compensator in the folder `models`."""
    settings = load_settings(config)
    points = settings.channels.point_names
    r2, r3, r4 = (recorded.read(p, points) for p in (test_2, test_3, test_4a))
    thermal, kalman, variances, um = chain.calibrate([r2, r3, r4], order or None)
    model = chain.compensator(kalman, um, settings.loop.period_s, points=points)
    left = r4.error_um - um.predict(
        chain.run_kalman(kalman, r4), chain.smooth_air(r4.air_c), um.info["start_um"]
    )
    figures: dict[str, Any] = {
        "time_constants_s": thermal.info["time_constants_s"],
        "residual_rms_k": thermal.info["residual_rms"],
        "variances": variances,
    }
    figures["expansion_rms_um"] = float(np.sqrt(np.nanmean(left**2)))
    folder = _models(models, settings)
    path = modelfile.install(folder, model, settings.rig.name, [test_2, test_3, test_4a], figures)
    print(
        f"{path}: expansion left {figures['expansion_rms_um']:.3g} um rms over test 4A; set compensation.model to it, or to {folder}"
    )
    return 0


def _models(given: str | None, settings: Settings) -> Path:
    """Return the folder of calibrations: a folder for each axis, because one of them is current."""
    return Path(given) if given else MODELS / settings.axis


def model(action: str, models: str | None, name: str | None) -> int:
    """Run `thermoctl model`: list, show or roll back calibrations."""
    models = models or str(MODELS)
    if action == "rollback":
        print(f"current is now {modelfile.roll_back(models, name)}")
        return 0
    now = modelfile.current(models)
    if action == "list":
        for p in modelfile.history(models):
            c = modelfile.load_calibration(p)
            print(
                f"{'*' if p == now else ' '} {p.name}  {c.created}  rig {c.rig}  {c.model.kind}  order {len(c.model.A_minus_I)}"
            )
        return 0
    c = modelfile.load_calibration(Path(models) / name if name else now)
    print(
        f"{name or now.name}: rig {c.rig}, {c.created}, {c.model.kind}, order {len(c.model.A_minus_I)}, f1 {c.model.f1:.5g}"
    )
    for key, value in {**c.figures, **{f"sha256 {k}": v for k, v in c.fingerprints.items()}}.items():
        print(f"  {key}: {value}")
    return 0


def tune(config: str, write: bool, yes: bool) -> int:
    """Run `thermoctl tune`: propose gains from the response to short setpoint ramps.

    On request the proposal is proven on the rig, step by step, and written. Returns 1 when the user answered
    no."""
    settings = load_settings(config)
    rig = drive.rig_of(settings)
    one = schedules.triangles(settings, rig.now()["compensated_um"])
    if not drive.agreed(rig, [one] * (TESTS if write else 1), yes):
        return 1
    tuned = tune_loop(rig, write, Keyboard(False), lambda line: print(line, flush=True))
    if write and tuned.proposed != tuned.present:
        tuning.write(Path(settings.path), tuned.proposed, settings.axis)
        print(f"written to {settings.path}; 'thermoctl reload' applies it")
    return 0


def evaluate(recordings: list[str]) -> int:
    """Run `thermoctl evaluate`.

    ISO 230-2 figures of the error at rest, over each recording and by target and direction."""
    for path in recordings:
        print("\n".join(iso230.figures(read_table(path), path)))
    return 0


def calibrate(
    config: str,
    out: str | None,
    models: str | None,
    order: int,
    gains: bool,
    accept: bool,
    again: bool,
    yes: bool,
) -> int:
    """Run `thermoctl calibrate`: 0 when every step is done (and accepted, when asked).

    Returns 1 when the user answered no, 3 when a test ended early, STATUS when the user ended it. Raises
    InputError for a rig that cannot be calibrated, HardwareError for one that refuses."""
    load("matplotlib", "calibrate")  # the report needs it: if it is missing, end before any test
    settings = load_settings(config)
    rig = drive.rig_of(settings)
    folder = Path(out or Path("calibration") / settings.rig.name)
    if again and (folder / "state.json").exists():
        for path in [folder / "state.json", *folder.glob("test_*.part.parquet*")]:
            path.unlink()
    tests = experiments.load_experiments(schedules.of_config(config))
    keyboard = Keyboard(sys.stdin.isatty() and sys.stderr.isatty())
    wizard = Wizard(settings, rig, folder, tests, order, lambda line: print(line, flush=True))
    left = [t for n, t in wizard.tests.items() if n not in wizard.done]
    if left and not drive.agreed(rig, left, yes):
        return 1
    if not wizard.run(keyboard):
        return STATUS if keyboard.ended else experiment.ENDED
    installed = _models(models, settings)
    print("to accept it means to:\n" + "\n".join(f"- {line}" for line in wizard.changes(installed, gains)))
    if not accept and keyboard.interactive:
        accept = (
            input("type 'accept' to do so; anything else leaves everything as it is: ").strip() == "accept"
        )
    if not accept:
        print("nothing was changed; `thermoctl calibrate --accept` takes it")
        return 0
    wizard.accept(installed, gains)
    return 0
