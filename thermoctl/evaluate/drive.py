"""Driving a rig for a test: only through the daemon's law, armed, with all protections, and only after a yes.

Two rigs run a schedule of setpoints alike. `DaemonRig`: the one that a running daemon holds, in real time; it is armed for this
command's connection, so the daemon disarms it however the command ends. `SimulatedRig`: the configuration's simulated back end with
the same law in this process, faster than real time; no hardware is concerned.

Raises hal.backend.HardwareError (exit status 3, one line) where the rig refuses or is not there.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hal.backend import HardwareError
from thermoctl.control import arming, faults
from thermoctl.control.law import COPPER_1_K
from thermoctl.control.model import CompensatorModel
from thermoctl.identify import experiments
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.signals import INDEX, NAMES, POINTS
from thermoctl.yamlfile import InputError

EVERY_S = 0.1  # between the rows that are kept
LOOK_S = 0.01  # between two looks at the rig and at the person's signals
STILL_S = (
    1.0  # a loop that makes no tick for so long has ended (the supervisor's STALL_S, or protection.late_s)
)
LAST_WORD_S = 5.0  # the command process is back within this, where it alone ended
REST_K, REST_S = (
    0.5,
    600.0,
)  # at rest: no two points further apart, or none moved by more than that in so long
RAMPS_S = 8 * (0.1, 0.2, 0.1, 0.3)  # 11 s: phase margins repeat within 1 degree on the simulated rig
TRAVEL_UM = 10.0  # of a ramp for tuning, at most
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

    real = False

    def __init__(self, settings: Any):
        self.settings = settings
        self.where = "the simulated rig, faster than real time"

    def now(self) -> dict[str, Any]:
        """Channel states, temperatures and position once the law is READY. Raises HardwareError when it does not get there."""
        from thermoctl.daemon.simulate import Simulation
        from thermoctl.daemon.snapshot import channel_states

        simulation = Simulation(self.settings)
        try:
            ready = simulation.until(lambda row: row[INDEX["state"]] == arming.READY, 20.0)
            row = simulation.row
            if not ready:
                raise HardwareError(f"{self.settings.path}: not READY within 20 s: {_causes(row)}")
            return {
                "channels": channel_states(int(row[INDEX["status_bits"]])),
                "temperatures_c": {p: float(row[INDEX[f"{p}_c"]]) for p in POINTS},
                "compensated_um": float(row[INDEX["compensated_um"]]),
            }
        finally:
            simulation.close()

    def run(
        self,
        schedule: Schedule,
        progress: Callable[[Progress], None],
        control: Control,
        earlier: Table | None = None,
        at_s: float = 0.0,
        model: CompensatorModel | None = None,
        every_s: float = EVERY_S,
        rest: bool = True,
    ) -> Iterator[np.ndarray]:
        """Rows of a test, one every `every_s`, with `model` acting when given. `earlier`, `at_s`, `rest` are not needed: the same
        rows come again, and the rig starts at rest. Raises Aborted when the law leaves ARMED or the person ends it."""
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
                simulation, schedule, max(1, round(every_s / simulation.period_s)), 0.0, progress, stop
            )
        except RuntimeError:
            raise Aborted(f"not READY within 20 s: {_causes(simulation.row)}", 0.0) from None
        finally:
            simulation.close()


class DaemonRig:
    """The rig that a running daemon holds."""

    real = True

    def __init__(self, settings: Any):
        self.settings = settings
        self.where = f"the daemon at {settings.socket.path}, in real time"

    def now(self) -> dict[str, Any]:
        """The daemon's status. Raises HardwareError unless it is READY."""
        from thermoctl.daemon.control_socket import ask

        until = time.monotonic() + STILL_S  # a loop that was just started or disarmed needs a few ticks
        with _rig_answers():
            while (status := ask(self.settings.socket.path, {"command": "status"}))["state"] in (
                "OFF",
                "SAFE",
            ):
                if time.monotonic() > until:
                    break
                time.sleep(LOOK_S)
        if status["state"] != "READY":
            causes = "; ".join(f"{f['name']}: {f['meaning']}; {f['remedy']}" for f in status["faults"])
            if status["state"] == "ARMED":
                causes = "somebody uses it; `thermoctl disarm` ends that"
            raise HardwareError(
                f"the rig of {self.settings.path} is {status['state']}, READY was expected{': ' if causes else ''}{causes}"
            )
        return status

    def run(
        self,
        schedule: Schedule,
        progress: Callable[[Progress], None],
        control: Control,
        earlier: Table | None = None,
        at_s: float = 0.0,
        model: CompensatorModel | None = None,
        every_s: float = EVERY_S,
        rest: bool = True,
    ) -> Iterator[np.ndarray]:
        """Rows of a test from `at_s` of its schedule on, those before it from `earlier` and the daemon's recording.

        Arms, and disarms on every way out. While paused the setpoint is held and the rows go on: heat does not wait, and the model
        is fitted to what was measured, not to the schedule. `rest`: wait first until the rig is at rest. Raises Aborted when the
        law leaves ARMED, the daemon ends or the person ends it; HardwareError where it does not arm."""
        from thermoctl.daemon.assemble import shared_name
        from thermoctl.daemon.control_socket import Connection
        from thermoctl.daemon.shared import Shared

        if earlier is not None:
            yield _rows(earlier)
        elif rest:
            self._rest(control)
        with _rig_answers(), Connection(self.settings.socket.path) as daemon:
            shared = Shared.attach(shared_name(self.settings))
            answer = daemon.ask({"command": "arm", "held": True})
            if not answer["ok"]:
                raise HardwareError(answer["error"])
            try:
                yield from self._play(daemon, shared, schedule, at_s, progress, control, every_s)
            finally:
                self._disarm(daemon, shared)

    def _play(
        self,
        daemon: Any,
        shared: Any,
        schedule: Schedule,
        at_s: float,
        progress: Callable[[Progress], None],
        control: Control,
        every_s: float,
    ) -> Iterator[np.ndarray]:
        stride = max(1, round(every_s / self.settings.loop.period_s))
        still_s = max(STILL_S, self.settings.protection.late_s)
        position, done, commands = shared.ring.head, at_s, schedule.commands()
        before = [c for c in commands if c[0] < at_s]
        waiting = [*before[-1:], *(c for c in commands if c[0] >= at_s)]
        began = last = ticked = time.monotonic()
        while done < schedule.duration_s:
            paused = control.pausing()
            while not paused and waiting and waiting[0][0] <= done:
                try:
                    daemon.ask({"command": "setpoint", "value": waiting.pop(0)[2]})
                except InputError as e:
                    raise Aborted(str(e), done) from None
            if daemon.lost(LOOK_S):
                raise Aborted("the daemon closed the connection; see its log", done)
            now = time.monotonic()
            done, last = done + (0.0 if paused else now - last), now
            rows, position, _ = shared.ring.read(position)
            kept = rows[rows[:, INDEX["tick"]] % stride == 0]
            if len(kept):
                yield kept
            ticked = now if len(rows) else ticked
            progress(Progress(min(done, schedule.duration_s), schedule.duration_s, now - began))
            if len(rows) and rows[-1, INDEX["state"]] != arming.ARMED:
                raise Aborted(f"the law left ARMED: {_causes(rows[-1])}", done)
            if now - ticked > still_s:
                raise Aborted("the daemon's loop makes no more ticks; see its log", done)
            if control.ended:
                raise Aborted("ended on request", done)

    def _disarm(self, daemon: Any, shared: Any) -> None:
        """Disarm where it is still armed; a fault stays latched for the person to read."""
        from thermoctl.daemon.control_socket import ask

        newest = shared.ring.newest()
        if newest is None or newest[INDEX["state"]] != arming.ARMED:
            return
        with contextlib.suppress(InputError):
            daemon.ask({"command": "disarm"})
            return
        until = (
            time.monotonic() + LAST_WORD_S
        )  # the command process alone may have ended; the supervisor starts it again
        while time.monotonic() < until:
            with contextlib.suppress(InputError):
                ask(self.settings.socket.path, {"command": "disarm"})
                return
            time.sleep(0.1)

    def _rest(self, control: Control) -> None:
        """Wait until the rig is at rest: the models are fitted from there. Raises Aborted when the person ends it."""
        seen: list[tuple[float, np.ndarray]] = []
        told = -math.inf
        while True:
            now, status = time.monotonic(), self.now()
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
        return as_table(rows, earlier.path)


def excite(rig: SimulatedRig | DaemonRig, schedule: Schedule, control: Control) -> np.ndarray:
    """Every tick's record row of a short schedule. Raises HardwareError when it ends early."""
    try:
        with control.listening():
            rows = np.vstack(list(rig.run(schedule, lambda p: None, control, every_s=0.0, rest=False)))
    except Aborted as e:
        raise HardwareError(f"ended after {e.done_s:.1f} s, the amplifier is disabled: {e.reason}") from None
    return rows[rows[:, INDEX["state"]] == arming.ARMED]


def triangles(settings: Any, start_um: float) -> Schedule:
    """Setpoints about `start_um` for a fit of the position's response: ramps at the law's own rate, RAMPS_S long, up and down.

    Each turn is a step of velocity, which excites the fast dynamics. At 1 mm/min the output moves by 5 um at most."""
    c = settings.control
    sign = -1.0 if start_um + TRAVEL_UM > c.setpoint_high_um else 1.0
    corners = [(0.0, start_um), (0.5, start_um)]
    for ramp_s in RAMPS_S:
        for to in (start_um + sign * min(c.setpoint_rate_um_s * ramp_s, TRAVEL_UM), start_um):
            corners.append((corners[-1][0] + ramp_s, to))
    t, um = np.array(corners).T
    return Schedule("tune", "triangles", t, um, float(t[-1]))


@contextlib.contextmanager
def _rig_answers() -> Iterator[None]:
    """A daemon that does not answer is a rig that is not there: HardwareError."""
    try:
        yield
    except InputError as e:
        raise HardwareError(str(e)) from None


def _causes(row: np.ndarray) -> str:
    """The faults of a record row that trip, with their remedies; none: somebody disarmed it."""
    found = [f for f in faults.decode(row[INDEX["fault_bits"]]) if f.severity != "warning"]
    return "; ".join(f"{f.name}: {f.meaning} -> {f.remedy}" for f in found) or "somebody disarmed it"


def rig_of(settings: Any) -> SimulatedRig | DaemonRig:
    """The rig that tests run on: the daemon's where one answers, else the simulated one. Raises HardwareError where there is neither."""
    from thermoctl.daemon.control_socket import ask

    try:
        ask(settings.socket.path, {"command": "status"})
        return DaemonRig(settings)
    except InputError as e:
        if settings.hal.backend != "simulated":
            raise HardwareError(
                f"{settings.path}: no daemon holds this rig ({e}); it is driven only through the daemon: "
                "thermoctl start, then this command again"
            ) from None
    return SimulatedRig(settings)


# ---------------------------------------------------------------------------------------------- what will move; a yes


def forecast(settings: Any, schedule: Schedule, coil_c: float) -> tuple[np.ndarray | None, float | None]:
    """(coil's power in W for each second of the schedule, its highest temperature in degC) from a coil at `coil_c`.

    Power: R20 (1 + alpha (T - 20 degC)) i^2 with the current that holds the flexures, i = x / flexure_um_per_a, largest in each
    second. Temperature: coil_c and the rise that the compensator's model gives this power. None where the configuration does not
    say: protection.resistance_ohm and flexure_um_per_a, compensation.model."""
    from thermoctl.daemon.assemble import compensator

    p = settings.protection
    if not (p.resistance_ohm and p.flexure_um_per_a):
        return None, None
    seconds = max(1, math.ceil(schedule.duration_s))
    um = np.abs(schedule.at(np.arange(10 * seconds) / 10)).reshape(seconds, 10).max(axis=1)
    model = compensator(settings)
    n = len(model.A_minus_I)
    one = np.zeros((n + 1, n + 1))  # the model's step with its power as a state that stays
    one[:n, :n], one[:n, n], one[n, n] = np.eye(n) + model.A_minus_I, model.B[:, 0], 1.0
    second = np.linalg.matrix_power(one, round(1.0 / model.period_s))
    power, rise, x = np.zeros(seconds), np.zeros(seconds), np.zeros(n + 1)
    for k, i in enumerate(um / p.flexure_um_per_a):
        x[n] = power[k] = (
            p.resistance_ohm * (1 + COPPER_1_K * (coil_c + float(model.C[0] @ x[:n]) - 20.0)) * i * i
        )
        x = second @ x
        rise[k] = model.C[0] @ x[:n]
    return power, coil_c + float(rise.max()) if model.C[0].any() else None


def within_limits(settings: Any, schedules: Sequence[Schedule]) -> tuple[float, float]:
    """The lowest and highest setpoint, um. Raises InputError where they leave the configuration's limits."""
    c = settings.control
    low = min(float(s.setpoint_um.min()) for s in schedules)
    high = max(float(s.setpoint_um.max()) for s in schedules)
    if low < c.setpoint_low_um or high > c.setpoint_high_um:
        raise InputError(
            f"{settings.path}: the setpoints leave control.setpoint_low_um..setpoint_high_um ({c.setpoint_low_um:g}.."
            f"{c.setpoint_high_um:g}): {low:.4g} to {high:.4g} um"
        )
    return low, high


def agreed(rig: SimulatedRig | DaemonRig, schedules: Sequence[Schedule], yes: bool) -> bool:
    """Say which rig, what will move, how far, how long and how warm; on a daemon's rig True only when the person types go, or `yes`.

    Raises InputError for setpoints outside the configuration's limits, for a coil that would become too hot, and where nobody can
    be asked."""
    settings = rig.settings
    p = settings.protection
    low, high = within_limits(settings, schedules)
    coil_c = float(rig.now()["temperatures_c"]["coil"] or math.nan)
    peaks = [forecast(settings, s, coil_c)[1] for s in schedules]
    known = [t for t in peaks if t is not None and math.isfinite(t)]
    if known and max(known) > p.coil_limit_c:
        raise InputError(
            f"{settings.path}: the coil would reach {max(known):.1f} degC, above protection.coil_limit_c ({p.coil_limit_c:g})"
        )
    warm = (
        f"at most {max(known):.1f} degC predicted"
        if known
        else "not predicted (no model, or no reading of the coil)"
    )
    print(f"rig '{settings.rig.name}' ({settings.path}), back end {settings.hal.backend}: {rig.where}")
    if settings.hal.backend == "devices":
        from hal.devices import make_devices

        print("devices: " + ", ".join(f"{d.name} at {d.binding.port}" for d in make_devices(settings)))
    print(
        f"moves the output from {low:.4g} to {high:.4g} um, {span(sum(s.duration_s for s in schedules))} in all; "
        f"coil {warm}, the protection trips at {p.coil_limit_c:g} degC",
        flush=True,
    )
    if not rig.real or yes:
        return True
    if not sys.stdin.isatty():
        raise InputError(
            "this moves a rig and there is no terminal to ask at; --yes starts it without a question"
        )
    return input("type go to arm the rig and start; anything else leaves it as it is: ").strip() == "go"


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


def as_table(rows: np.ndarray, path: str | Path) -> Table:
    """Record rows as a table named after the file `path`."""
    return Table(
        Path(path).stem,
        str(path),
        rows[:, INDEX["t_s"]],
        {n: rows[:, i] for n, i in INDEX.items() if n != "t_s"},
    )


def span(s: float) -> str:
    """Seconds in words: 90 s, 12 min, 3 h 5 min."""
    return (
        f"{s:.0f} s"
        if s < 120
        else f"{s / 60:.0f} min"
        if s < 7200
        else f"{int(s // 3600)} h {s % 3600 / 60:.0f} min"
    )
