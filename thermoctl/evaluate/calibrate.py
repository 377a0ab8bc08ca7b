"""The calibration wizard: doctor, step, PID, tests 1 to 4A, model, proof; and, only when told so, acceptance.

Each step leaves its result in a folder of the calibration's own (`--out`), so the command can be ended at any time and called
again: it goes on with the first step that is not done. Nothing outside that folder is written before `--accept`.

Where a daemon answers on the socket, the tests run on it: setpoints by the socket, rows from its shared memory, in real time.
A test that was ended goes on where it stood; what happened meanwhile is taken from the daemon's own recording (the heat does
not wait), and where that has a gap the test begins anew. Without a daemon a simulated rig is run faster than real time;
the same seed gives the same rows, so a test that was ended is simply run again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.control import arming, faults
from thermoctl.control.model import CompensatorModel
from thermoctl.evaluate import chain
from thermoctl.evaluate.iso230 import mean_and_two_s
from thermoctl.identify import experiments, modelfile, tuning
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table
from thermoctl.report.page import figure, page, table
from thermoctl.settings import load_settings
from thermoctl.signals import INDEX, NAMES, POINTS
from thermoctl.yamlfile import InputError

TESTS = ("test_1", "test_2", "test_3", "test_4a")
STEPS = ("doctor", "step", "pid", *TESTS, "model", "test_4b", "proof")
NEEDED = (
    "position_raw_um",
    "output_reference_um",
    "voltage_v",
    "current_a",
    "air_c",
    *(f"{p}_c" for p in POINTS),
)
EVERY_S = 0.1  # between the rows that are kept
STEP_DRIVE = 0.3  # of the open-loop step, in units of the drive
REST_K, REST_S = (
    0.5,
    600.0,
)  # at rest: no two points further apart, or none moved by more than that in so long
GAP_S = 2.0  # a hole in the daemon's own recording that a test does not survive


class Control:
    """What the person at the keyboard wants: the first Ctrl-C pauses, Enter goes on, a second Ctrl-C (or SIGTERM) ends."""

    def __init__(self, interactive: bool):
        self.interactive, self.paused, self.ended = interactive, False, False

    def interrupt(self, number: int, _: Any = None) -> None:
        """A signal came."""
        if number == signal.SIGINT and self.interactive and not self.paused:
            self.paused = True
            print(
                "\npaused; the setpoint is held. Enter goes on, Ctrl-C ends (what is recorded is kept)",
                file=sys.stderr,
            )
        else:
            self.ended = True

    def pausing(self) -> bool:
        """Whether it is paused now; waits up to 0.2 s for Enter."""
        if self.paused and not self.ended and select.select([sys.stdin], [], [], 0.2)[0]:
            sys.stdin.readline()
            self.paused = False
        return self.paused and not self.ended

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Signals come here while it lasts."""
        before = {n: signal.signal(n, self.interrupt) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


# ------------------------------------------------------------------------------------------------------------ the rigs


class SimulatedRig:
    """The configuration's simulated back end, in this process, each test from rest."""

    where = "the simulated rig, faster than real time"

    def __init__(self, settings: Any):
        self.settings = settings

    def look(self) -> dict[str, str]:
        """Status of each channel once the law is READY."""
        from thermoctl.daemon.simulate import Simulation
        from thermoctl.daemon.socket import channel_states

        simulation = Simulation(self.settings)
        try:
            ready = simulation.until(lambda row: row[INDEX["state"]] == arming.READY, 20.0)
            row = simulation.row
            if not ready:
                names = ", ".join(f.name for f in faults.decode(row[INDEX["fault_bits"]])) or "none"
                raise InputError(f"{self.settings.path}: not READY within 20 s; faults: {names}")
            return channel_states(int(row[INDEX["status_bits"]]))
        finally:
            simulation.close()

    def step(self) -> tuple[np.ndarray, np.ndarray] | None:
        """An open-loop step of STEP_DRIVE: (t s, position um)."""
        from thermoctl.evaluate.commands import open_loop_step

        return open_loop_step(self.settings.path, STEP_DRIVE)

    def run(
        self,
        schedule: Schedule,
        earlier: Table | None,
        at_s: float,
        progress: Callable[[Progress], None],
        control: Control,
        model: CompensatorModel | None = None,
    ) -> Iterator[np.ndarray]:
        """Rows of a test, with `model` acting when given. `earlier` is not needed: the same rows come again."""
        from thermoctl.daemon.simulate import Simulation

        s = self.settings
        s = dataclasses.replace(
            s, compensation=dataclasses.replace(s.compensation, enable=model is not None, model="")
        )
        if model is None:  # nothing is estimated yet that the coil could be compared with
            s = dataclasses.replace(s, protection=dataclasses.replace(s.protection, innovation_limit_c=1e3))
        simulation = Simulation(s, model)

        def stop() -> bool:
            while control.pausing():
                pass
            return control.ended

        try:
            yield from experiments.run(
                simulation, schedule, round(EVERY_S / simulation.period_s), 0.0, progress, stop
            )
        except RuntimeError as e:
            raise Aborted(str(e), 0.0) from None
        finally:
            simulation.close()


class DaemonRig:
    """The rig that a running daemon holds."""

    def __init__(self, settings: Any):
        self.settings = settings
        self.where = f"the daemon at {settings.socket.path}, in real time"

    def _ask(self, command: str, value: float | None = None) -> dict[str, Any]:
        from thermoctl.daemon.socket import ask

        answer = ask(self.settings.socket.path, {"command": command, "value": value})
        if not answer["ok"]:
            raise InputError(answer["error"])
        return answer

    def look(self) -> dict[str, str]:
        """Status of each channel; raises InputError while a fault stands."""
        answer = self._ask("status")
        for f in answer["faults"]:
            if f["severity"] != "warning":
                raise InputError(f"fault {f['name']}: {f['meaning']}; {f['remedy']}")
        return answer["channels"]

    def step(self) -> tuple[np.ndarray, np.ndarray] | None:
        """None: the amplifier is the daemon's; an open-loop step needs it stopped (thermoctl tune)."""
        return None

    def run(
        self,
        schedule: Schedule,
        earlier: Table | None,
        at_s: float,
        progress: Callable[[Progress], None],
        control: Control,
        model: CompensatorModel | None = None,
    ) -> Iterator[np.ndarray]:
        """Rows of a test from `at_s` of its schedule on, those before it from `earlier` and the daemon's recording.

        Disarms at the end. While paused the setpoint is held and the rows go on: heat does not wait, and the model is fitted to
        what was measured, not to the schedule. Raises Aborted when the law leaves ARMED or the person ends it."""
        from thermoctl.daemon.assemble import shared_name
        from thermoctl.daemon.shared import Shared

        shared = Shared.attach(shared_name(self.settings))
        stride = round(EVERY_S / self.settings.loop.period_s)
        if earlier is not None:
            yield _rows(earlier)
        else:
            self._rest(control)
        if self._ask("status")["state"] != "ARMED":
            self._ask("arm")
        position, done = shared.ring.head, at_s
        commands = schedule.commands()
        before = [c for c in commands if c[0] < at_s]
        waiting = [*before[-1:], *(c for c in commands if c[0] >= at_s)]
        began = last = time.monotonic()
        try:
            while done < schedule.duration_s:
                if not control.pausing():
                    while waiting and waiting[0][0] <= done:
                        self._ask("setpoint", waiting.pop(0)[2])
                    time.sleep(0.05)
                    done += time.monotonic() - last
                last = time.monotonic()
                rows, position, _ = shared.ring.read(position)
                kept = rows[rows[:, INDEX["tick"]] % stride == 0]
                if len(kept):
                    yield kept
                progress(Progress(min(done, schedule.duration_s), schedule.duration_s, last - began))
                newest = rows[-1] if len(rows) else shared.ring.newest()
                if newest is not None and newest[INDEX["state"]] != arming.ARMED:
                    names = (
                        ", ".join(f.name for f in faults.decode(newest[INDEX["fault_bits"]]))
                        or "somebody disarmed it"
                    )
                    raise Aborted(f"the law left ARMED: {names}", done)
                if control.ended:
                    raise Aborted("ended on request", done)
        finally:
            with contextlib.suppress(InputError):
                self._ask("setpoint", 0.0)
                self._ask("disarm")

    def _rest(self, control: Control) -> None:
        """Wait until the rig is at rest: the models are fitted from there. Raises Aborted when the person ends it."""
        seen: list[tuple[float, np.ndarray]] = []
        told = -math.inf
        while True:
            now, status = time.monotonic(), self._ask("status")
            seen.append(
                (now, np.array([math.nan if v is None else v for v in status["temperatures_c"].values()]))
            )
            if at_rest(seen):
                return
            if control.ended:
                raise Aborted("ended on request", 0.0)
            if now - told >= 60.0:
                told, warm = now, seen[-1][1]
                print(
                    f"   the rig is still warm ({np.nanmin(warm):.1f} to {np.nanmax(warm):.1f} degC): waiting until it is at rest",
                    file=sys.stderr,
                    flush=True,
                )
            time.sleep(1.0)

    def meanwhile(self, earlier: Table) -> Table | None:
        """`earlier` with what the daemon recorded since, or None when that has a hole longer than GAP_S."""
        from thermoctl.recording.writer import TIER, recording_files

        parts = [_rows(earlier)]
        wall, folder = INDEX["wall_s"], Path(self.settings.recording.directory)
        for path in recording_files(folder, TIER) if folder.is_dir() else ():
            with contextlib.suppress(InputError):
                rows = _rows(read_table(path))
                parts.append(
                    rows[
                        (rows[:, wall] > parts[-1][-1, wall])
                        & (rows[:, INDEX["t_s"]] > parts[-1][-1, INDEX["t_s"]])
                    ]
                )
                parts = [p for p in parts if len(p)]
        rows = np.vstack(parts)
        if np.diff(rows[:, wall]).max(initial=0.0) > GAP_S or time.time() - rows[-1, wall] > GAP_S:
            return None
        return _table(rows, earlier.path)


def rig_of(settings: Any) -> SimulatedRig | DaemonRig:
    """The rig that tests run on: the daemon's where one answers, else the simulated one. Raises InputError where there is neither."""
    from thermoctl.daemon.socket import ask

    try:
        ask(settings.socket.path, {"command": "status"})
        return DaemonRig(settings)
    except InputError:
        if settings.hal.backend != "simulated":
            raise InputError(
                f"{settings.path}: hal.backend is '{settings.hal.backend}' and no daemon answers on {settings.socket.path}; "
                "start it first (thermoctl start)"
            ) from None
    return SimulatedRig(settings)


def at_rest(seen: list[tuple[float, np.ndarray]]) -> bool:
    """Whether a rig of these temperatures, (s, degC (12,)) oldest first, is at rest: all alike within REST_K, or, because thermocouples
    differ by a degree, none moved by more than REST_K in the last REST_S."""
    now, newest = seen[-1]
    if np.nanmax(newest) - np.nanmin(newest) <= REST_K:
        return True
    window = [t for at, t in seen if at >= now - REST_S]
    return now - seen[0][0] >= REST_S and bool(
        np.nanmax(np.nanmax(window, axis=0) - np.nanmin(window, axis=0)) <= REST_K
    )


def _rows(t: Table) -> np.ndarray:
    return np.column_stack([t.t if n == "t_s" else t.columns.get(n, np.full(len(t), np.nan)) for n in NAMES])


def _table(rows: np.ndarray, path: str | Path) -> Table:
    return Table(
        Path(path).stem,
        str(path),
        rows[:, INDEX["t_s"]],
        {n: rows[:, i] for n, i in INDEX.items() if n != "t_s"},
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
        states = self.rig.look()
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
        measured = self.rig.step()
        if measured is None:
            return {
                "said": "left out: the daemon holds the amplifier; stop it and use `thermoctl tune` for new gains"
            }
        t, y = measured
        fitted = tuning.fit_step(t, y, STEP_DRIVE)
        k0, tau_d, tau_c = tuning.tangent(fitted)
        return {
            "said": f"K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms, time constant {1e3 * tau_c:.3g} ms",
            "t": t.tolist(),
            "y": y.tolist(),
            "k0": k0,
            "tau_d_s": tau_d,
            "tau_c_s": tau_c,
            "gain": fitted.gain,
            "t1": [fitted.t1.real, fitted.t1.imag],
            "t2": [fitted.t2.real, fitted.t2.imag],
            "theta_s": fitted.theta_s,
        }

    def _fitted(self) -> tuning.SecondOrder | None:
        s = self.done["step"]
        return (
            tuning.SecondOrder(s["gain"], complex(*s["t1"]), complex(*s["t2"]), s["theta_s"])
            if "gain" in s
            else None
        )

    def _pid(self) -> dict[str, Any]:
        fitted, c = self._fitted(), self.settings.control
        if fitted is None:
            return {
                "said": f"left out; the present gains stay: kp {c.kp:g}, ti {c.ti_s:g} s, td {c.td_s:g} s"
            }
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
        self.say(f"{number:2d}/{len(STEPS)} {name}: {schedule.title}, {_span(schedule.duration_s)}")
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
            with control.listening():
                for block in self.rig.run(schedule, earlier, at_s, show, control, model):
                    blocks.append(block)
        except Aborted as e:
            ended = e
        self._used_s += time.monotonic() - began
        self._tested_s += ended.done_s if ended else schedule.duration_s - at_s
        print(file=sys.stderr)
        if blocks:
            write_table(part, _table(np.vstack(blocks), part))
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
            "said": f"{_span(schedule.duration_s)} recorded",
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
        from thermoctl.evaluate.commands import _recorded

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
            "said": f"order {model.order}, temperatures to {figures['residual_rms_k']:.3f} K rms, expansion to "
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
            from thermoctl.evaluate.commands import _recorded

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
        if gains and "proposed" in self.done["pid"]:
            present, proposed = (
                tuning.Gains(g["kp"], g["ti_s"], g["td_s"], k)
                for k, g in ((k, self.done["pid"][k]) for k in ("present", "proposed"))
            )
            lines.append(f"write into {self.settings.path}:\n{tuning.difference(present, proposed)}")
        return lines

    def accept(self, models: Path, gains: bool) -> None:
        """Install the model, and the gains when asked. Raises InputError when the proof is no better than nothing."""
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
        if gains and "proposed" in self.done["pid"]:
            g = self.done["pid"]["proposed"]
            tuning.write(Path(self.settings.path), tuning.Gains(g["kp"], g["ti_s"], g["td_s"], g["how"]))
            self.fingerprint = self._fingerprint()
            self._save()
        self.say(f"{path} is current; older ones stay (`thermoctl model rollback`).")
        if Path(self.settings.compensation.model or ".").resolve() not in (models.resolve(), path.resolve()):
            self.say(
                f"compensation.model is {self.settings.compensation.model or 'not set'}: set it to {models.resolve()} to use it, then "
                "`thermoctl restart`"
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


def _span(s: float) -> str:
    return (
        f"{s:.0f} s"
        if s < 120
        else f"{s / 60:.0f} min"
        if s < 7200
        else f"{int(s // 3600)} h {s % 3600 / 60:.0f} min"
    )


def _progress_line(eta: Callable[[Progress], tuple[float, float]]) -> Callable[[Progress], None]:
    """A line that is written over on a terminal, one a tenth elsewhere."""
    told = [-1.0]

    def show(p: Progress) -> None:
        here, everything = eta(p)
        line = f"   {p.percent:5.1f} %   {_span(here)} left of this test, {_span(everything)} of all"
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
    if "gain" in step:
        fitted = tuning.SecondOrder(step["gain"], complex(*step["t1"]), complex(*step["t2"]), step["theta_s"])
        fig, (a,) = axes()
        ts = np.array(step["t"])
        y = np.array(step["y"])
        a.plot(1e3 * ts, y - y[ts < 0].mean(), ".", ms=2, color="#1b1f24", label="measured")
        a.plot(
            1e3 * ts,
            np.where(ts > 0, fitted.step(ts) * STEP_DRIVE, 0.0),
            color="#0b6bcb",
            lw=1,
            label="second order with dead time",
        )
        a.set(xlabel="time (ms)", ylabel="position (µm)")
        fig.legend(
            *a.get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False, fontsize=8
        )
        rows = [
            (k, g["kp"], g["ti_s"], g["td_s"], g["gain"], g["phase_deg"], g["how"])
            for k, g in pid.items()
            if isinstance(g, dict)
        ]
        sections.append(
            (
                "Step and PID",
                figure(fig, f"Open-loop step of {STEP_DRIVE:g} of the drive. {_for_people(step['said'])}.")
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
    config: str, out: str | None, models: str, order: int, gains: bool, accept: bool, again: bool
) -> int:
    """The command: 0 when every step is done (and accepted, when asked), 1 when it was ended early or not accepted.

    Raises InputError for a rig that cannot be calibrated."""
    settings = load_settings(config)
    rig = rig_of(settings)
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
    if not wizard.run(control):
        return 1
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
