"""The calibration wizard: doctor, step, PID, tests 1 to 4A, model, proof; and, only when told so, acceptance.

Each step leaves its result in a folder of the calibration's own (`--out`), so the command can be ended at any time and called
again: it goes on with the first step that is not done. Nothing outside that folder is written before `--accept`.

Where a daemon answers on the socket, the tests run on it: setpoints by the socket, rows from its shared memory, in real time.
A test that was ended goes on where it stood; what happened meanwhile is taken from the daemon's own recording (the heat does
not wait), and where that has a gap the test begins anew. Without a daemon a simulated rig is run faster than real time;
the same seed gives the same rows, so a test that was ended is simply run again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.calibration import chain, drive
from thermoctl.calibration.drive import Control, DaemonRig, SimulatedRig, as_table, span
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.identify import experiments, modelfile, tuning
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.recording.files import read_table, write_table
from thermoctl.report.page import figure, page, table
from thermoctl.settings import load_settings
from thermoctl.signals import INDEX, POINTS
from thermoctl.yamlfile import InputError

TESTS = ("test_1", "test_2", "test_3", "test_4a")
STEPS = ("doctor", "step", "pid", *TESTS, "model", "test_4b", "proof")
SHOWN_S = 3.0  # of the step's recording, in the report
NEEDED = (
    "position_raw_um",
    "output_reference_um",
    "voltage_v",
    "current_a",
    "air_c",
    *(f"{p}_c" for p in POINTS),
)


# ---------------------------------------------------------------------------------------------------------- the wizard


class Wizard:
    """One calibration in its folder: `done` {step: figures}, `run(control)` does what is left."""

    def __init__(
        self,
        settings: Any,
        rig: SimulatedRig | DaemonRig,
        folder: Path,
        tests: dict[str, Schedule],
        order: int,
        say: Callable[[str], None],
    ):
        self.settings, self.rig, self.folder, self.tests, self.order, self.say = (
            settings,
            rig,
            folder,
            tests,
            order,
            say,
        )
        self.state_path = folder / "state.json"
        self.fingerprint = self._fingerprint()
        self.done: dict[str, dict[str, Any]] = {}
        self.at_s: dict[str, float] = {}  # how far an ended test came
        self._used_s, self._tested_s = 0.0, 0.0  # wall and rig seconds of tests in this run, for the ETA
        for name in (*TESTS, "test_4b"):
            if name not in tests:
                raise InputError(
                    f"{Path(settings.path).parent / 'experiments.yaml'}: no experiment '{name}'; a calibration needs it"
                )
        if self.state_path.exists():
            try:
                state = json.loads(self.state_path.read_text())
                self.done, self.at_s, known = state["done"], state["at_s"], state["configuration"]
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{self.state_path}: not a calibration's state; give another --out"
                ) from None
            if known != self.fingerprint:
                raise InputError(
                    f"{folder}: was begun with another configuration or other experiments than {settings.path} has now; "
                    "put them back, or begin anew with --again"
                )

    def _fingerprint(self) -> str:
        path = Path(self.settings.path)
        return hashlib.sha256(path.read_bytes() + (path.parent / "experiments.yaml").read_bytes()).hexdigest()

    def _save(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        temporary = self.state_path.with_suffix(".writing")
        temporary.write_text(
            json.dumps({"configuration": self.fingerprint, "done": self.done, "at_s": self.at_s}, indent=1)
        )
        temporary.replace(self.state_path)

    def run(self, control: Control) -> bool:
        """Do every step that is left; False when it was ended early. Raises InputError when a step says no."""
        self.say(
            f"calibration of rig '{self.settings.rig.name}' on {self.rig.where}; results in {self.folder}/"
        )
        self._save()
        for number, step in enumerate(STEPS, 1):
            if step in self.done:
                self.say(f"{number:2d}/{len(STEPS)} {step}: done before")
                continue
            if control.ended:
                return False
            if step in self.tests:
                with control.listening():
                    if not self._test(number, step, control):
                        return False
            else:
                figures = getattr(self, f"_{step}")()
                self.done[step] = figures
                self.say(f"{number:2d}/{len(STEPS)} {step}: {figures['said']}")
            self._save()
        self.report()
        return True

    # ------------------------------------------------------------------------------------------------ single steps
    def _doctor(self) -> dict[str, Any]:
        states = self.rig.now()["channels"]
        bad = {
            n: states.get(_channel(n), "ABSENT") for n in NEEDED if states.get(_channel(n), "ABSENT") != "OK"
        }
        if bad:
            raise InputError(
                "a calibration needs the second encoder and all twelve thermocouples; "
                + ", ".join(f"{n} is {s}" for n, s in bad.items())
                + ": see `thermoctl doctor`"
            )
        return {"said": f"{len(NEEDED)} channels read well", "channels": states}

    def _step(self) -> dict[str, Any]:
        s = self.settings
        rows = drive.excite(self.rig, drive.triangles(s, self.rig.now()["compensated_um"]), Control(False))
        t, u, y = (rows[:, INDEX[n]] for n in ("t_s", "drive", "position_raw_um"))
        fitted = tuning.fit_response(t, u, y, s.loop.period_s)
        k0, tau_d, tau_c = tuning.tangent(fitted)
        model = fitted.response(u - u[0], s.loop.period_s)
        shown = slice(0, round(SHOWN_S / s.loop.period_s))
        return {
            "said": f"K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms, time constant {1e3 * tau_c:.3g} ms",
            "t": (t[shown] - t[0]).tolist(),
            "measured_um": (y - y.mean())[shown].tolist(),
            "fitted_um": (model - model.mean())[shown].tolist(),
            "k0": k0,
            "tau_d_s": tau_d,
            "tau_c_s": tau_c,
            "gain": fitted.gain,
            "t1": [fitted.t1.real, fitted.t1.imag],
            "t2": [fitted.t2.real, fitted.t2.imag],
            "theta_s": fitted.theta_s,
        }

    def _pid(self) -> dict[str, Any]:
        s, c = self.done["step"], self.settings.control
        fitted = tuning.SecondOrder(s["gain"], complex(*s["t1"]), complex(*s["t2"]), s["theta_s"])
        period, average = self.settings.loop.period_s, int(c.moving_average)
        gains = {
            "present": tuning.Gains(c.kp, c.ti_s, c.td_s, "present"),
            "proposed": tuning.robust(fitted, period, average),
        }
        found = {
            k: {
                "kp": g.kp,
                "ti_s": g.ti_s,
                "td_s": g.td_s,
                "how": g.how,
                **dataclasses.asdict(tuning.margins(fitted, g, period, average)),
            }
            for k, g in gains.items()
        }
        return {
            "said": "; ".join(
                f"{k}: gain margin {m['gain']:.2f}, phase margin {m['phase_deg']:.0f} deg"
                for k, m in found.items()
            ),
            **found,
        }

    def _test(self, number: int, name: str, control: Control) -> bool:
        schedule, part = self.tests[name], self.folder / f"{name}.part.parquet"
        earlier, at_s = None, 0.0
        if name in self.at_s and part.exists() and isinstance(self.rig, DaemonRig):
            earlier = self.rig.meanwhile(read_table(part))
            at_s = self.at_s[name] if earlier is not None else 0.0
            self.say(
                f"   {name} goes on at {at_s:.0f} s"
                if earlier is not None
                else f"   {name} begins anew: the daemon did not record without a gap since it was ended"
            )
        self.say(f"{number:2d}/{len(STEPS)} {name}: {schedule.title}, {span(schedule.duration_s)}")
        left_s = sum(
            self.tests[n].duration_s for n in STEPS[number:] if n in self.tests and n not in self.done
        )
        show = _progress_line(lambda p: self._eta_s(p, left_s))
        model = (
            modelfile.load_model(self.folder / "model.yaml")
            if name == "test_4b" and isinstance(self.rig, SimulatedRig)
            else None
        )
        blocks, ended, began = [], None, time.monotonic()
        try:
            for block in self.rig.run(schedule, show, control, earlier, at_s, model):
                blocks.append(block)
        except Aborted as e:
            ended = e
        self._used_s += time.monotonic() - began
        self._tested_s += ended.done_s if ended else schedule.duration_s - at_s
        print(file=sys.stderr)
        if blocks:
            write_table(part, as_table(np.vstack(blocks), part))
        if ended is not None:
            self.at_s[name] = ended.done_s
            self._save()
            self.say(
                f"{name} ended at {ended.done_s:.0f} s: {ended.reason}. What was recorded is in {part}; "
                "the same command goes on from here"
            )
            return False
        part.replace(self._recording(name))
        self.at_s.pop(name, None)
        power = np.vstack(blocks)[:, INDEX["power_w"]]
        self.done[name] = {
            "said": f"{span(schedule.duration_s)} recorded",
            "seconds": schedule.duration_s,
            "mean_w": float(np.nanmean(power)),
            "largest_w": float(np.nanmax(power)),
        }
        return True

    def _eta_s(self, p: Progress, left_s: float) -> tuple[float, float]:
        """Seconds left of this test and of all: by the pace of the tests so far."""
        pace = (self._used_s + p.used_s) / max(self._tested_s + p.done_s, 1e-9)
        return pace * (p.duration_s - p.done_s), pace * (p.duration_s - p.done_s + left_s)

    def _recording(self, name: str) -> Path:
        return self.folder / f"{name}.parquet"

    def _model(self) -> dict[str, Any]:
        from thermoctl.calibration.commands import _recorded

        tests = [_recorded(str(self._recording(n))) for n in ("test_2", "test_3", "test_4a")]
        model, kalman, _, um = chain.calibrate_better(tests, self.order or None)
        compensator = chain.better_compensator(kalman, um, self.settings.loop.period_s)
        last = tests[-1]
        left = last.error_um - _estimate(kalman, um, last)
        thin = max(1, len(left) // 2000)
        path = self.folder / "model.yaml"
        path.unlink(missing_ok=True)
        figures = {
            "method": "better",
            "time_constants_s": np.asarray(model.info["time_constants_s"]).tolist(),
            "residual_rms_k": float(np.mean(model.info["residual_rms"])),
            "expansion_rms_um": _rms(left),
        }
        modelfile.save_model(
            path,
            compensator,
            self.settings.rig.name,
            [self._recording(n) for n in ("test_2", "test_3", "test_4a")],
            figures,
        )
        return {
            "said": f"order {len(compensator.A_minus_I)} ({model.order} poles of the identified model, the rest for disturbing heat), "
            f"temperatures to {figures['residual_rms_k']:.3f} K rms, expansion to "
            f"{figures['expansion_rms_um']:.3f} um rms of {_rms(last.error_um):.2f}",
            **figures,
            "grown_rms_um": _rms(last.error_um),
            "t": last.t[::thin].tolist(),
            "measured_um": _plain(last.error_um[::thin]),
            "left_um": _plain(left[::thin]),
        }

    def _proof(self) -> dict[str, Any]:
        t = read_table(self._recording("test_4b"))
        c = t.columns
        growth = c["output_reference_um"] - c["position_raw_um"]
        growth = growth - np.nanmean(growth[:5])
        if isinstance(self.rig, SimulatedRig):
            left = c["output_reference_um"] - c["reference_um"]
            left = left - np.nanmean(left[:5])
            how = "the loop with the new model acting, judged by the second encoder, which it does not use"
        else:
            from thermoctl.calibration.commands import _recorded

            tests = [_recorded(str(self._recording(n))) for n in ("test_2", "test_3", "test_4a", "test_4b")]
            _, kalman, _, um = chain.calibrate_better(tests[:3], self.order or None)
            r = tests[3]
            estimate = np.interp(t.t - t.t[0], r.t, _estimate(kalman, um, r))
            left = growth - estimate
            how = "the second encoder less what the new model estimates from the recording; the model is not acting before it is accepted"
        rest = np.abs(c["reference_um"] - c["setpoint_um"]) < 1e-6
        before, after = (
            mean_and_two_s(growth[rest & np.isfinite(growth)]),
            mean_and_two_s(left[rest & np.isfinite(left)]),
        )
        step = max(1, len(t) // 2000)
        return {
            "said": f"without compensation {before[0]:+.2f} +- {before[1]:.2f} um, with the new model {after[0]:+.3f} +- {after[1]:.3f} um",
            "before": before,
            "after": after,
            "how": how,
            "t": (t.t - t.t[0])[::step].tolist(),
            "without_um": _plain(growth[::step]),
            "with_um": _plain(left[::step]),
            "better": bool(_worst(after) < _worst(before)),
        }

    # --------------------------------------------------------------------------------------------- report, acceptance
    def report(self) -> None:
        """Write report.html into the folder."""
        (self.folder / "report.html").write_text(
            _report(self.settings, self.rig.where, self.done), encoding="utf-8"
        )
        self.say(f"before and after: {self.folder / 'report.html'}")

    def changes(self, models: Path, gains: bool) -> list[str]:
        """What an acceptance would do, as lines."""
        lines = [f"install {self.folder / 'model.yaml'} as the current calibration of {models}/"]
        if gains:
            present, proposed = (
                tuning.Gains(g["kp"], g["ti_s"], g["td_s"], k)
                for k, g in ((k, self.done["pid"][k]) for k in ("present", "proposed"))
            )
            lines.append(f"write into {self.settings.path}:\n{tuning.difference(present, proposed)}")
        if not self._in_use(models):
            now = self.settings.compensation.model or "not set"
            lines.append(
                f"set compensation.model in {self.settings.path} to {self._model_option(models)} (now {now})"
            )
        return lines

    def _in_use(self, models: Path) -> bool:
        return Path(self.settings.compensation.model or ".").resolve() == models.resolve()

    def _model_option(self, models: Path) -> str:
        """The folder of calibrations as the configuration names it: relative to the configuration."""
        return os.path.relpath(models.resolve(), Path(self.settings.path).resolve().parent)

    def accept(self, models: Path, gains: bool) -> None:
        """Install the model, name it in the configuration, and write the gains when asked.

        Raises InputError when the proof is no better than nothing."""
        if not self.done["proof"]["better"]:
            raise InputError(
                f"{self.folder}: the proof shows no smaller error with the new model than without; nothing was installed"
            )
        c = modelfile.load_calibration(self.folder / "model.yaml")
        path = modelfile.install(
            models,
            c.model,
            c.rig,
            [self._recording(n) for n in ("test_2", "test_3", "test_4a")],
            {
                **c.figures,
                "proof_before_um": self.done["proof"]["before"],
                "proof_after_um": self.done["proof"]["after"],
            },
        )
        if gains:
            g = self.done["pid"]["proposed"]
            tuning.write(Path(self.settings.path), tuning.Gains(g["kp"], g["ti_s"], g["td_s"], g["how"]))
        if not self._in_use(models):
            try:
                values = {"model": self._model_option(models)}
                tuning.write_values(Path(self.settings.path), "compensation", values)
            except InputError as e:  # the model is installed; the person names it
                self.say(str(e))
        self.fingerprint = self._fingerprint()
        self._save()
        self.say(
            f"{path} is current; older ones stay (`thermoctl model rollback`). `thermoctl restart` uses it."
        )


def _channel(signal_name: str) -> str:
    return "position_um" if signal_name == "position_raw_um" else signal_name


def _estimate(kalman: Any, um: Any, r: Any) -> np.ndarray:
    return um.predict(chain.run_kalman(kalman, r), chain.smooth_air(r.air_c), um.info.get("start_um", 0.0))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(x))))


def _worst(mean_two_s: tuple[float, float]) -> float:
    return abs(mean_two_s[0]) + mean_two_s[1]


def _plain(x: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in x.tolist()]


def _for_people(said: str) -> str:
    return said.replace("+-", "±").replace(" um", " µm").replace(" deg", "°")


def _progress_line(eta: Callable[[Progress], tuple[float, float]]) -> Callable[[Progress], None]:
    """A line that is written over on a terminal, one a tenth elsewhere."""
    told = [-1.0]

    def show(p: Progress) -> None:
        here, everything = eta(p)
        line = f"   {p.percent:5.1f} %   {span(here)} left of this test, {span(everything)} of all"
        if sys.stderr.isatty():
            print(f"\r{line:78}", end="", file=sys.stderr, flush=True)
        elif p.percent - told[0] >= 10.0:
            told[0] = p.percent
            print(line, file=sys.stderr, flush=True)

    return show


# ---------------------------------------------------------------------------------------------------------- the report


def _report(settings: Any, where: str, done: dict[str, dict[str, Any]]) -> str:
    from matplotlib.figure import Figure

    proof, model, step, pid = done["proof"], done["model"], done["step"], done["pid"]

    def axes(n: int = 1, high: float = 2.6) -> tuple[Any, Any]:
        fig = Figure(figsize=(9, high * n), layout="constrained")
        return fig, fig.subplots(n, 1, sharex=True, squeeze=False)[:, 0]

    def curve(x: list, key: list) -> tuple[np.ndarray, np.ndarray]:
        return np.array(x), np.array([np.nan if v is None else v for v in key])

    sections = [
        (
            "",
            f'<p class="lead"><b>{"Better" if proof["better"] else "No better"}:</b> position error '
            f"{proof['before'][0]:+.2f} ± {proof['before'][1]:.2f} µm without compensation, {proof['after'][0]:+.3f} ± "
            f"{proof['after'][1]:.3f} µm with the new model (ISO 230-2: mean ± 2 s, at rest).</p>",
        )
    ]
    fig, (a, b) = axes(2)
    a.plot(
        np.array(proof["t"]) / 60,
        curve(proof["t"], proof["without_um"])[1],
        color="#c7621b",
        lw=1,
        label="without compensation",
    )
    a.plot(
        np.array(proof["t"]) / 60,
        curve(proof["t"], proof["with_um"])[1],
        color="#0b6bcb",
        lw=1,
        label="with the new model",
    )
    b.plot(np.array(proof["t"]) / 60, curve(proof["t"], proof["with_um"])[1], color="#0b6bcb", lw=0.8)
    a.set(ylabel="error (µm)")
    b.set(ylabel="with, enlarged (µm)", xlabel="time (min)")
    fig.legend(*a.get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False, fontsize=8)
    sections.append(("Proof: before and after", figure(fig, f"Test 4B. How it was made: {proof['how']}.")))
    fig, (a, b) = axes(2)
    t = np.array(model["t"]) / 60
    a.plot(
        t,
        curve(t.tolist(), model["measured_um"])[1],
        color="#1b1f24",
        lw=1,
        label="measured by both encoders",
    )
    a.plot(
        t,
        curve(t.tolist(), model["measured_um"])[1] - curve(t.tolist(), model["left_um"])[1],
        color="#0b6bcb",
        lw=1,
        label="estimated",
    )
    b.plot(t, curve(t.tolist(), model["left_um"])[1], color="#0b6bcb", lw=0.8)
    a.set(ylabel="expansion (µm)")
    b.set(ylabel="left (µm)", xlabel="time (min)")
    fig.legend(*a.get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False, fontsize=8)
    sections.append(
        (
            "Model",
            table(
                ("figure", "value"),
                [
                    ("time constants, s", ", ".join(f"{v:.4g}" for v in model["time_constants_s"])),
                    ("temperatures, K rms", model["residual_rms_k"]),
                    ("expansion left over test 4A, µm rms", model["expansion_rms_um"]),
                    ("expansion itself, µm rms", model["grown_rms_um"]),
                ],
            )
            + figure(
                fig,
                "Test 4A, which took part in the fit: growth of the output against the encoder, and what the estimate leaves of it.",
            ),
        )
    )
    fig, (a,) = axes()
    a.plot(step["t"], step["measured_um"], ".", ms=2, color="#1b1f24", label="measured")
    a.plot(step["t"], step["fitted_um"], color="#0b6bcb", lw=1, label="second order with dead time")
    a.set(xlabel="time (s)", ylabel="position (µm)")
    fig.legend(*a.get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False, fontsize=8)
    rows = [
        (k, g["kp"], g["ti_s"], g["td_s"], g["gain"], g["phase_deg"], g["how"])
        for k, g in pid.items()
        if isinstance(g, dict)
    ]
    sections.append(
        (
            "Step and PID",
            figure(
                fig,
                f"Short ramps of the setpoint, and the response fitted to drive and position. {_for_people(step['said'])}.",
            )
            + table(("gains", "kp", "ti, s", "td, s", "gain margin", "phase margin, °", "how"), rows),
        )
    )
    sections.append(
        (
            "Steps",
            table(
                ("step", "result"), [(k.replace("_", " "), _for_people(v["said"])) for k, v in done.items()]
            ),
        )
    )
    return page("Calibration", sections, f"rig '{settings.rig.name}' · {where}")


def calibrate(
    config: str, out: str | None, models: str, order: int, gains: bool, accept: bool, again: bool, yes: bool
) -> int:
    """The command: 0 when every step is done (and accepted, when asked), 1 when the person said no, 3 when a test ended early.

    Raises InputError for a rig that cannot be calibrated, HardwareError for one that refuses."""
    settings = load_settings(config)
    rig = drive.rig_of(settings)
    folder = Path(out or Path("calibration") / settings.rig.name)
    if again and (folder / "state.json").exists():
        for path in [folder / "state.json", *folder.glob("test_*.part.parquet")]:
            path.unlink()
    tests = experiments.load_experiments(Path(config).parent / "experiments.yaml")
    control = Control(sys.stdin.isatty() and sys.stderr.isatty())
    wizard = Wizard(
        settings,
        rig,
        folder,
        {n: tests[n] for n in (*TESTS, "test_4b") if n in tests},
        order,
        lambda line: print(line, flush=True),
    )
    left = [t for n, t in wizard.tests.items() if n not in wizard.done]
    if left and not drive.agreed(rig, left, yes):
        return 1
    if not wizard.run(control):
        return 3
    print("to accept it means to:\n" + "\n".join(f"- {line}" for line in wizard.changes(Path(models), gains)))
    if not accept and control.interactive:
        accept = (
            input("type 'accept' to do so; anything else leaves everything as it is: ").strip() == "accept"
        )
    if not accept:
        print("nothing was changed; `thermoctl calibrate --accept` takes it")
        return 0
    wizard.accept(Path(models), gains)
    return 0
