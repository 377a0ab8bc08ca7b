"""What the commands experiment, identify, model, tune, evaluate and reproduce do; returns are exit statuses."""
from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.evaluate import chain, iso230, rigs
from thermoctl.identify import experiments, modelfile, tuning
from thermoctl.recording.table import Table, read_table, write_table
from thermoctl.settings import load_settings
from thermoctl.signals import INDEX, NAMES, POINTS
from thermoctl.yamlfile import InputError, suggest


def _schedule(name: str, config: str) -> experiments.Schedule:
    path = Path(config).parent / "experiments.yaml"
    tests = experiments.load_experiments(path)
    if name not in tests:
        raise InputError(f"{path}: no experiment '{name}'{suggest(name, tests)}; there are {', '.join(tests)}")
    return tests[name]


def experiment(name: str, config: str, out: str | None, dry_run: bool, resume: bool) -> int:
    """Run a test on the simulated back end, faster than real time; what was recorded is kept when it is aborted."""
    from thermoctl.daemon.simulate import Simulation
    schedule = _schedule(name, config)
    settings = load_settings(config)
    t = np.arange(0, schedule.duration_s)
    power = (schedule.at(t) / 250.0)**2 * 3.3
    print(f"{schedule.title}: {schedule.duration_s / 60:.0f} min, {len(schedule.commands())} moves, "
          f"{schedule.setpoint_um.min():g} to {schedule.setpoint_um.max():g} um")
    print(f"about {power.mean():.2f} W on the mean, {power.max():.2f} W at most; "
          f"{100 * experiments.share_below(t, power, 4.3e-4):.0f} % of the alternating power below 4.3e-4 Hz")
    if dry_run:
        return 0
    if settings.hal.backend != "simulated":
        raise InputError(f"{config}: hal.backend is '{settings.hal.backend}'; experiments run on the simulated back end here")
    path = Path(out or f"{name}.parquet")
    blocks, start = [], 0.0
    if resume and path.exists():
        old = read_table(path)
        blocks.append(np.column_stack([old.t if n == "t_s" else old.columns.get(n, np.full(len(old), np.nan)) for n in NAMES]))
        start = float(old.t[-1] - old.t[0])
    if not settings.compensation.model:
        settings = dataclasses.replace(settings, compensation=dataclasses.replace(settings.compensation, enable=False),
                                       protection=dataclasses.replace(settings.protection, innovation_limit_c=1e3))
    simulation = Simulation(settings)

    def show(p: experiments.Progress) -> None:
        print(f"\r{p.percent:5.1f} %  {p.eta_s:6.0f} s left", end="", file=sys.stderr, flush=True)

    status = 0
    try:
        for block in experiments.run(simulation, schedule, 100, start, show):
            blocks.append(block)
    except (experiments.Aborted, KeyboardInterrupt) as e:
        print(f"\nended early: {e or 'interrupted'}; resume with --resume --out {path}", file=sys.stderr)
        status = 130 if isinstance(e, KeyboardInterrupt) else 1
    finally:
        simulation.close()
    print(file=sys.stderr)
    if blocks:
        rows = np.vstack(blocks)
        if start:                                             # a resumed simulation counts from its own start again
            k = len(blocks[0])
            rows[k:, INDEX["t_s"]] += rows[k - 1, INDEX["t_s"]] + 0.1 - rows[k, INDEX["t_s"]]
        write_table(path, Table(path.stem, str(path), rows[:, INDEX["t_s"]], {n: rows[:, i] for n, i in INDEX.items() if n != "t_s"}))
        print(path)
    return status


def _recorded(path: str) -> rigs.Recorded:
    """A recording at 1 s as the chain takes it. Raises InputError when a signal is missing."""
    table = read_table(path)
    need = ["power_w", "air_c", "output_reference_um", "position_raw_um", "setpoint_um", *(f"{p}_c" for p in POINTS)]
    for n in need:
        if n not in table.columns:
            raise InputError(f"{path}: column '{n}' is missing{suggest(n, table.columns)}; a calibration needs it")
    t = np.arange(np.floor(table.t[-1] - table.t[0]) + 1)
    k = np.clip(np.searchsorted(table.t - table.t[0], t + 1e-9, side="right") - 1, 0, None)
    c = {n: table.columns[n][k] for n in need}
    temperatures = np.column_stack([c[f"{p}_c"] for p in POINTS])
    for n in ("power_w", "air_c"):
        c[n] = chain.filled(c[n][:, None])[:, 0]
    error = c["output_reference_um"] - c["position_raw_um"]
    error = error - np.nanmean(error[:5])
    return rigs.Recorded(t, c["power_w"], c["air_c"], temperatures, error, np.full(temperatures.shape, np.nan), error, c["setpoint_um"])


def identify(test_2: str, test_3: str, test_4a: str, config: str, models: str, method: str, order: int) -> int:
    """Calibrate from recordings and install the compensator in the folder `models`."""
    settings = load_settings(config)
    r2, r3, r4 = (_recorded(p) for p in (test_2, test_3, test_4a))
    c = chain.calibrate(r2, r3, r4, order or None)
    model = chain.compensator(c, method, settings.loop.period_s)
    left = r4.error_um - chain.estimates(c, r4)[method]
    figures: dict[str, Any] = {"method": method, "time_constants_s": c.model.info["time_constants_s"], "residual_rms_k": c.model.info["residual_rms"],
                               "expansion_rms_um": float(np.sqrt(np.nanmean(left**2))), "zeta": c.mkf.zeta}
    path = modelfile.install(models, model, settings.rig.name, [test_2, test_3, test_4a], figures)
    print(f"{path}: expansion left {figures['expansion_rms_um']:.3g} um rms over test 4A; set compensation.model to it, or to {models}")
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
            print(f"{'*' if p == now else ' '} {p.name}  {c.created}  rig {c.rig}  {c.model.kind}  order {len(c.model.A_minus_I)}")
        return 0
    c = modelfile.load_calibration(Path(models) / name if name else now)
    print(f"{name or now.name}: rig {c.rig}, {c.created}, {c.model.kind}, order {len(c.model.A_minus_I)}, f1 {c.model.f1:.5g}")
    for key, value in {**c.figures, **{f"sha256 {k}": v for k, v in c.fingerprints.items()}}.items():
        print(f"  {key}: {value}")
    return 0


def open_loop_step(config: str, drive: float = 0.3, before_s: float = 0.05, after_s: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Step of the drive on the opened back end, without the position loop: (t from the step s, position um). The drive is bounded by
    control.output_limit and the test ends when the position leaves protection's range."""
    from hal.backend import ROLE, make_backend
    settings = load_settings(config)
    backend = make_backend(settings)
    backend.open()
    period = settings.loop.period_s
    drive = float(np.clip(drive, -settings.control.output_limit, settings.control.output_limit))
    high = float(settings.protection.high.get("position_um", np.inf))
    t, y = [], []
    try:
        ready = round(1.0 / period)                            # the amplifier powers up
        for k in range(ready + round((before_s + after_s) / period)):
            now = (k + 1) * period
            sample = backend.read(now)
            since = now - (ready * period + before_s)
            position = float(sample.value[ROLE["position_um"]])
            if k >= ready:
                t.append(since)
                y.append(position)
            if abs(position) > high:
                raise InputError(f"the step of {drive:g} drove the position to {position:.0f} um, beyond {high:g} um; give a smaller step")
            backend.write(drive if since >= 0 else 0.0, True)
    finally:
        backend.write(0.0, False)
        backend.close()
    return np.array(t), np.array(y)


def tune(config: str, method: str, write: bool) -> int:
    """Propose gains; write them only when asked."""
    settings = load_settings(config)
    c = settings.control
    present = tuning.Gains(c.kp, c.ti_s, c.td_s, "present")
    t, y = open_loop_step(config)
    plant = tuning.fit_step(t, y, 0.3)
    period, average = settings.loop.period_s, int(c.moving_average)
    if method == "zn":
        proposed = tuning.ziegler_nichols(plant)
    elif method == "imc":
        proposed = tuning.robust(plant, period, average)
    else:
        raise InputError("the relay test needs the amplifier in a loop of its own; use 'zn' or 'imc' on this rig")
    k0, tau_d, tau_c = tuning.tangent(plant)
    print(f"open-loop step: K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms, time constant {1e3 * tau_c:.3g} ms, "
          f"residual {plant.residual:.2g} um")
    for g in (present, proposed):
        m = tuning.margins(plant, g, period, average)
        print(f"{g.how}: gain margin {m.gain:.2f}, phase margin {m.phase_deg:.0f} deg{'' if m.stable else ', UNSTABLE'}")
    print(tuning.difference(present, proposed))
    if write:
        tuning.write(Path(config), proposed)
        print(f"written to {config}; 'thermoctl reload' applies it")
    return 0


def evaluate(recordings: list[str]) -> int:
    """ISO 230-2 figures: of the error at rest over the whole recording, and by target and direction."""
    for path in recordings:
        table = read_table(path)
        for n in ("output_reference_um", "setpoint_um"):
            if n not in table.columns:
                raise InputError(f"{path}: column '{n}' is missing; only a recording with the reference encoder can be judged")
        setpoint, reference = table.columns["setpoint_um"], table.columns["output_reference_um"]
        limited = table.columns.get("reference_um", setpoint)
        error = reference - limited
        error = error - np.nanmean(error[:10])
        rest = np.abs(limited - setpoint) < 1e-6
        mean, two_s = iso230.mean_and_two_s(error[rest])
        print(f"{path}: {mean:+.3f} +- {two_s:.3f} um (mean deviation, 2 s, {int(rest.sum())} samples at rest)")
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
    from thermoctl.evaluate import reproduce as room
    return 0 if room.reproduce(plant, config, Path(out), seeds, not quick, print) else 1
