"""What the commands experiment, identify, model, tune, evaluate and reproduce do; returns are exit statuses."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hal.backend import HardwareError
from thermoctl.calibration import chain, drive, iso230
from thermoctl.identify import experiments, modelfile, tuning
from thermoctl.plant.simulate import compile_plant
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table
from thermoctl.reproduction import rigs
from thermoctl.settings import load_settings
from thermoctl.signals import INDEX, POINTS
from thermoctl.yamlfile import InputError, suggest

CUTOFF_HZ = 4.3e-4  # 1 / (2 pi 370 s), the paper's


def _schedule(name: str, config: str) -> experiments.Schedule:
    path = Path(config).parent / "experiments.yaml"
    tests = experiments.load_experiments(path)
    if name not in tests:
        raise InputError(
            f"{path}: no experiment '{name}'{suggest(name, tests)}; there are {', '.join(tests)}"
        )
    return tests[name]


def spectrum_lines(t: np.ndarray, power: np.ndarray, cutoff_hz: float) -> list[str]:
    """The alternating power's share in octaves round `cutoff_hz`, as lines for a terminal."""
    edges = [0.0, *(cutoff_hz * 2.0**k for k in range(-3, 4)), 0.5 / (t[1] - t[0])]
    f, s = experiments.spectrum(t, power)
    out = []
    for low, high in pairwise(edges):
        share = 100 * s[(f > low) & (f <= high)].sum() / s.sum()
        mark = "  <- f_c" if high == cutoff_hz else ""
        out.append(
            f"  {1e3 * low:8.3f} to {1e3 * high:8.3f} mHz {share:5.1f} % {'#' * round(share / 2)}{mark}"
        )
    return out


def experiment(
    name: str,
    config: str,
    out: str | None,
    dry_run: bool,
    resume: bool,
    plant: str | None = None,
    yes: bool = False,
) -> int:
    """Run a test of experiments.yaml, or the one experiment of the file `name`, and record it.

    On the daemon that answers (its own back end, in real time, under its protections), else on the simulated back end, faster than
    real time; an experiment of inputs also on a plant file in the rig's place. 1 when the person said no, 3 when it ended early:
    what was recorded is kept, and gone on with."""
    if Path(name).suffix in (".yaml", ".yml"):
        inputs = _of_inputs(name)
        if dry_run or plant:
            return _on_plant(inputs, None if dry_run else plant, Path(out or f"{inputs.name}.csv"))
        schedule, name = inputs.schedule(), inputs.name
        _check_predicted(inputs, load_settings(config))
    elif plant:
        raise InputError(
            f"'{name}' is a test of the actuator's setpoint; --plant takes the file of an experiment that lists inputs"
        )
    else:
        schedule = _schedule(name, config)
    settings = load_settings(config)
    drive.within_limits(settings, [schedule])
    print(
        f"{schedule.title}: {drive.span(schedule.duration_s)}, {len(schedule.commands())} moves, "
        f"{schedule.setpoint_um.min():g} to {schedule.setpoint_um.max():g} um"
    )
    _say_power(settings, schedule)
    if dry_run:
        return 0
    rig = drive.rig_of(settings)
    if not drive.agreed(rig, [schedule], yes):
        return 1
    return _record(rig, schedule, Path(out or f"{name}.parquet"), resume)


def _check_predicted(inputs: experiments.Inputs, settings: Any) -> None:
    """Refuse an experiment that a diagnosis expects to leave the rig's protection. Raises InputError with the reading."""
    p = settings.protection
    for column, (low, high) in inputs.predicted.items():
        channel = "position_um" if column == "position_raw_um" else column
        top = min(p.high.get(channel, np.inf), p.coil_limit_c if channel == "coil_c" else np.inf)
        bottom = p.low.get(channel, -np.inf)
        if low < bottom or high > top:
            raise InputError(
                f"experiment '{inputs.name}': {column} would reach {low:.4g} to {high:.4g}, the protection of {settings.path} "
                f"allows {bottom:g} to {top:g}"
            )


def _say_power(settings: Any, schedule: experiments.Schedule) -> None:
    """The coil's power over the schedule, as far as the configuration tells it, and its spectrum."""
    power, peak = drive.forecast(settings, schedule, 20.0)
    if power is None:
        print("power is not predicted: protection.resistance_ohm and flexure_um_per_a are not set")
        return
    print(f"about {power.mean():.2f} W on the mean, {power.max():.2f} W at most", end="")
    print("" if peak is None else f"; the coil warms by {peak - 20.0:.1f} K")
    if np.ptp(power) > 0:
        t = np.arange(len(power), dtype=float)
        print(
            f"{100 * experiments.share_below(t, power, CUTOFF_HZ):.0f} % of the alternating power below f_c = {CUTOFF_HZ:g} Hz:"
        )
        print("\n".join(spectrum_lines(t, power, CUTOFF_HZ)))


def _record(
    rig: drive.SimulatedRig | drive.DaemonRig, schedule: experiments.Schedule, path: Path, resume: bool
) -> int:
    """Run a schedule and write what was recorded; beside it, while it is not at its end, how far it came. 3 when it ended early."""
    progress_path = path.with_name(path.name + ".progress")
    earlier, at_s = None, 0.0
    if resume and path.exists() and progress_path.exists() and isinstance(rig, drive.DaemonRig):
        earlier = rig.meanwhile(read_table(path))
        at_s = float(progress_path.read_text()) if earlier is not None else 0.0
        print(
            f"goes on at {at_s:.0f} s"
            if earlier is not None
            else "begins anew: the daemon did not record without a gap since it was ended, and heat does not wait"
        )
    control = drive.Control(sys.stdin.isatty() and sys.stderr.isatty())
    blocks: list[np.ndarray] = []
    done_s = [at_s]

    def show(p: experiments.Progress) -> None:
        done_s[0] = p.done_s
        if sys.stderr.isatty():
            print(f"\r{p.percent:5.1f} %  {p.eta_s:6.0f} s left", end="", file=sys.stderr, flush=True)

    ended = ""
    try:
        with control.listening():
            for block in rig.run(schedule, show, control, earlier, at_s):
                blocks.append(block)
    except experiments.Aborted as e:
        ended = e.reason
    if blocks:
        rows = np.vstack(blocks)
        write_table(path, drive.as_table(rows, path))
        print(f"{path}: {len(rows)} rows")
    if not ended:
        progress_path.unlink(missing_ok=True)
        return 0
    progress_path.write_text(f"{done_s[0]:.3f}\n")
    print(
        f"ended after {done_s[0]:.0f} of {schedule.duration_s:.0f} s, the amplifier is disabled: {ended}; "
        f"go on with --resume --out {path}",
        file=sys.stderr,
    )
    return 3


def _of_inputs(path: str) -> experiments.Inputs:
    """The one experiment of a file that lists inputs."""
    found = list(experiments.load_inputs(path).values())
    if len(found) != 1:
        raise InputError(f"{path}: {len(found)} experiments that list inputs; one was expected")
    return found[0]


def _on_plant(inputs: experiments.Inputs, plant_file: str | None, path: Path) -> int:
    """An experiment told, and run on a plant file in the rig's place where one is given."""
    from thermoctl.plant import load
    from thermoctl.plant.simulate import SimulationError

    print(
        f"{inputs.title}: {inputs.duration_s / 60:.4g} min, every {inputs.sample_s:g} s; drives "
        + ", ".join(f"{n} {c[:, 1].min():.4g} to {c[:, 1].max():.4g}" for n, c in inputs.corners.items())
    )
    if plant_file is None:
        return 0
    plant = load(plant_file)
    t, columns = inputs.columns()
    unsaid = {i.column for i in plant.inputs.values()} - set(columns)
    if unsaid:
        raise InputError(
            f"experiment '{inputs.name}' says nothing of {', '.join(sorted(unsaid))}, which {plant_file} reads"
        )
    try:
        write_table(
            path, compile_plant(plant, ()).measure(Table(path.stem, str(path), t, columns), seed=len(t))
        )
    except SimulationError as e:
        raise InputError(f"{plant_file}: {e}") from None
    print(f"{path}: {len(t)} rows")
    return 0


def record(experiment_file: Path, recording: Path, config: str, plant: str | None, yes: bool = False) -> None:
    """Run an experiment file for `thermoctl diagnose --resolve`. Raises HardwareError where it does not come to its end."""
    if experiment(str(experiment_file), config, str(recording), False, False, plant, yes):
        raise HardwareError(
            f"{experiment_file}: the experiment did not come to its end; what was recorded is in {recording}"
        )


def _recorded(path: str) -> rigs.Recorded:
    """A recording at 1 s as the chain takes it. Raises InputError when a signal is missing."""
    table = read_table(path)
    need = [
        "power_w",
        "air_c",
        "output_reference_um",
        "position_raw_um",
        "setpoint_um",
        *(f"{p}_c" for p in POINTS),
    ]
    for n in need:
        if n not in table.columns:
            raise InputError(
                f"{path}: column '{n}' is missing{suggest(n, table.columns)}; a calibration needs it"
            )
    t = np.arange(np.floor(table.t[-1] - table.t[0]) + 1)
    k = np.clip(np.searchsorted(table.t - table.t[0], t + 1e-9, side="right") - 1, 0, None)
    c = {n: table.columns[n][k] for n in need}
    temperatures = np.column_stack([c[f"{p}_c"] for p in POINTS])
    for n in ("power_w", "air_c"):
        c[n] = chain.filled(c[n][:, None])[:, 0]
    error = c["output_reference_um"] - c["position_raw_um"]
    error = error - np.nanmean(error[:5])
    return rigs.Recorded(
        t,
        c["power_w"],
        c["air_c"],
        temperatures,
        error,
        np.full(temperatures.shape, np.nan),
        error,
        c["setpoint_um"],
    )


def identify(
    test_2: str, test_3: str, test_4a: str, config: str, models: str, method: str, order: int
) -> int:
    """Calibrate from recordings and install the compensator in the folder `models`."""
    settings = load_settings(config)
    r2, r3, r4 = (_recorded(p) for p in (test_2, test_3, test_4a))
    figures: dict[str, Any] = {"method": method}
    if method == "paper":
        c = chain.calibrate(r2, r3, r4, order or None)
        model = chain.compensator(c, method, settings.loop.period_s)
        left = r4.error_um - chain.estimates(c, r4)[method]
        figures |= {"time_constants_s": c.paper_model.time_constants_s, "zeta": c.mkf.zeta}
    else:
        thermal, kalman, variances, um, refined = chain.calibrate_refined([r2, r3, r4], order or None)
        model = chain.better_compensator(kalman, um, settings.loop.period_s)
        left = r4.error_um - um.predict(
            chain.run_kalman(kalman, r4), chain.smooth_air(r4.air_c), um.info.get("start_um", 0.0)
        )
        figures |= {
            "time_constants_s": thermal.info["time_constants_s"],
            "residual_rms_k": thermal.info["residual_rms"],
            "variances": variances,
            "refinement": refined,
        }
        print(f"prediction-error refinement: {refined}")
    figures["expansion_rms_um"] = float(np.sqrt(np.nanmean(left**2)))
    path = modelfile.install(models, model, settings.rig.name, [test_2, test_3, test_4a], figures)
    print(
        f"{path}: expansion left {figures['expansion_rms_um']:.3g} um rms over test 4A; set compensation.model to it, or to {models}"
    )
    return 0


def model(action: str, models: str, name: str | None) -> int:
    """List, show, or roll back calibrations."""
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


def tune(config: str, method: str, write: bool, yes: bool) -> int:
    """Propose gains from the closed loop's answer to short setpoint ramps; write them only when asked. 1: the person said no."""
    settings = load_settings(config)
    c = settings.control
    rig = drive.rig_of(settings)
    schedule = drive.triangles(settings, rig.now()["compensated_um"])
    if not drive.agreed(rig, [schedule], yes):
        return 1
    rows = drive.excite(rig, schedule, drive.Control(False))
    period, average = settings.loop.period_s, int(c.moving_average)
    t, u, y = (rows[:, INDEX[n]] for n in ("t_s", "drive", "position_raw_um"))
    plant = tuning.fit_response(t, u, y, period)
    present = tuning.Gains(c.kp, c.ti_s, c.td_s, "present")
    proposed = tuning.ziegler_nichols(plant) if method == "zn" else tuning.robust(plant, period, average)
    k0, tau_d, tau_c = tuning.tangent(plant)
    print(
        f"response: K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms, time constant {1e3 * tau_c:.3g} ms, "
        f"residual {plant.residual:.2g} um"
    )
    for g in (present, proposed):
        m = tuning.margins(plant, g, period, average)
        print(
            f"{g.how}: gain margin {m.gain:.2f}, phase margin {m.phase_deg:.0f} deg{'' if m.stable else ', UNSTABLE'}"
        )
    print(tuning.difference(present, proposed))
    if write:
        if not m.stable:
            raise InputError(
                f"{config}: not written, the proposed gains make this loop unstable; take --method imc"
            )
        tuning.write(Path(config), proposed)
        print(f"written to {config}; 'thermoctl reload' applies it")
    return 0


def evaluate(recordings: list[str]) -> int:
    """ISO 230-2 figures: of the error at rest over the whole recording, and by target and direction."""
    for path in recordings:
        table = read_table(path)
        for n in ("output_reference_um", "setpoint_um"):
            if n not in table.columns:
                raise InputError(
                    f"{path}: column '{n}' is missing; only a recording with the reference encoder can be judged"
                )
        setpoint, reference = table.columns["setpoint_um"], table.columns["output_reference_um"]
        limited = table.columns.get("reference_um", setpoint)
        error = reference - limited
        error = error - np.nanmean(error[:10])
        rest = np.abs(limited - setpoint) < 1e-6
        mean, two_s = iso230.mean_and_two_s(error[rest])
        print(
            f"{path}: {mean:+.3f} +- {two_s:.3f} um (mean deviation, 2 s, {int(rest.sum())} samples at rest)"
        )
        stops = iso230.approaches(limited, reference, max(1, round(2.0 / np.median(np.diff(table.t)))))
        for way, word in ((1, "upwards"), (-1, "downwards")):
            mine = [(v, error[k]) for k, v, d in stops if d == way]
            if len(mine) >= 2:
                targets, e = np.round(np.array(mine).T, 3)
                counts = {v: int((targets == v).sum()) for v in np.unique(targets)}
                some = np.isin(targets, [v for v, n in counts.items() if n >= 2])
                if some.any():
                    d = iso230.unidirectional(targets[some], e[some])
                    for v, m, s, n in zip(d.targets, d.mean, d.s, d.n, strict=True):
                        print(f"  {word} to {v:g} um: {m:+.3f} +- {2 * s:.3f} um, {n} approaches")
    return 0


def reproduce(config: str, plant: str, out: str, seeds: int, quick: bool) -> int:
    """The whole report; 1 when a goal is missed."""
    from thermoctl.reproduction import study as room

    return 0 if room.reproduce(plant, config, Path(out), seeds, not quick, print) else 1
