"""Drive the rig of a running daemon in real time through its command socket.

It is armed for this command's connection, so the daemon disarms it however the command ends.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import as_table, causes, rows_of
from thermoctl.calibration.simulated_rig import EVERY_S
from thermoctl.configuration.settings import Settings
from thermoctl.control import arming
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.control_socket import Connection, ask
from thermoctl.daemon.tick.assemble import shared_name
from thermoctl.daemon.tick.shared import Shared
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.identify.tuning import Gains
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.recording.writer import TIER, recording_files
from thermoctl.rig.signals import AT
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.rig.make import driving_devices

POLL_S = 0.01  # time between two polls of the rig and of the keyboard
# after this time without a tick the loop has ended (the supervisor's STALL_S; at least protection.late_s)
STALL_S = 1.0
RESTART_S = 5.0  # time for the supervisor to restart a command process that ended
REST_K, REST_S = 0.5, 600.0  # the rig is at rest if all points are within REST_K, or moved less in REST_S
REPORT_S = 60.0  # time between two reports while the rig cools
GAP_S = 2.0  # a longer gap in the daemon's own recording makes a test start again


class DaemonRig:
    """The rig that a running daemon holds."""

    real = True

    def __init__(self, settings: Settings):
        self.settings, self.command_s = settings, command_period_s(settings)
        self.where = f"the daemon at {settings.socket.path}, in real time"

    def now(self) -> dict[str, Any]:
        """Ask for the daemon's status. Raises HardwareError unless it is READY."""
        until = time.monotonic() + STALL_S  # a loop that was just started or disarmed needs a few ticks
        with _rig_answers():
            while (status := ask(self.settings.socket.path, {"command": "status"}))["state"] in (
                "OFF",
                "SAFE",
            ):
                if time.monotonic() > until:
                    break
                time.sleep(POLL_S)
        if status["state"] != "READY":
            causes = "; ".join(f"{f['name']}: {f['meaning']}; {f['remedy']}" for f in status["faults"])
            if status["state"] == "ARMED":
                causes = "somebody uses it; `thermoctl disarm` ends that"
            raise HardwareError(
                f"the rig of {self.settings.path} is {status['state']}, READY was expected{': ' if causes else ''}{causes}"
            )
        return status

    def gains(self) -> Gains:
        """Return the gains in force. Raises HardwareError when the daemon does not say."""
        with _rig_answers():
            answer = ask(self.settings.socket.path, {"command": "gains"})
        if not answer["ok"]:
            raise HardwareError(answer["error"])
        return Gains(answer["kp"], answer["ti_s"], answer["td_s"], "present")

    def run(
        self,
        schedule: Schedule,
        progress: Callable[[Progress], None],
        keyboard: Keyboard,
        earlier: Table | None = None,
        at_s: float = 0.0,
        model: CompensatorModel | None = None,
        every_s: float = EVERY_S,
        rest: bool = True,
        gains: Gains | None = None,
    ) -> Generator[np.ndarray, None, None]:
        """Yield the rows of a test from `at_s` of its schedule on, after those of `earlier`.

        It arms first, and disarms on every way out. While paused, the setpoint is held and rows continue,
        because the rig cools meanwhile. The model is fitted to the measured rows, not to the schedule.
        `rest`: wait first until the rig is at rest. `gains`: tried until it disarms. Raises Aborted when
        the law leaves ARMED, the daemon ends, or the user ends the test. Raises HardwareError when the rig
        does not arm."""
        if earlier is not None:
            yield rows_of(earlier, self.settings.row)
        elif rest:
            self._rest(keyboard)
        with _rig_answers(), Connection(self.settings.socket.path) as daemon:
            shared = Shared.attach(shared_name(self.settings))
            answer = daemon.ask({"command": "arm", "held": True})
            if not answer["ok"]:
                raise HardwareError(answer["error"])
            try:
                if gains is not None:
                    tried = {"kp": gains.kp, "ti_s": gains.ti_s, "td_s": gains.td_s}
                    answer = daemon.ask({"command": "gains", **tried})
                    if not answer["ok"]:
                        raise HardwareError(answer["error"])
                yield from self._play(daemon, shared, schedule, at_s, progress, keyboard, every_s)
            finally:
                self._disarm(daemon, shared)

    def _play(
        self,
        daemon: Connection,
        shared: Shared,
        schedule: Schedule,
        at_s: float,
        progress: Callable[[Progress], None],
        keyboard: Keyboard,
        every_s: float,
    ) -> Iterator[np.ndarray]:
        stride = max(1, round(every_s / self.settings.loop.period_s))
        stall_s = max(STALL_S, self.settings.protection.late_s)
        position, done, commands = shared.ring.head, at_s, schedule.commands()
        before = [c for c in commands if c[0] < at_s]
        waiting = [*before[-1:], *(c for c in commands if c[0] >= at_s)]
        started = last = ticked = time.monotonic()
        while done < schedule.duration_s:
            paused = keyboard.pausing()
            while not paused and waiting and waiting[0][0] <= done:
                try:
                    daemon.ask({"command": "setpoint", "value": waiting.pop(0)[2]})
                except InputError as e:
                    raise Aborted(str(e), done) from None
            if daemon.lost(POLL_S):
                raise Aborted("the daemon closed the connection; see its log", done)
            now = time.monotonic()
            done, last = done + (0.0 if paused else now - last), now
            rows, position, _ = shared.ring.read(position)
            kept = rows[rows[:, AT["tick"]] % stride == 0]
            if len(kept):
                yield kept
            ticked = now if len(rows) else ticked
            progress(Progress(min(done, schedule.duration_s), schedule.duration_s, now - started))
            if len(rows) and rows[-1, AT["state"]] != arming.ARMED:
                raise Aborted(f"the law left ARMED: {causes(rows[-1])}", done)
            if now - ticked > stall_s:
                raise Aborted("the daemon's loop makes no more ticks; see its log", done)
            if keyboard.ended:
                raise Aborted("ended on request", done)

    def _disarm(self, daemon: Connection, shared: Shared) -> None:
        """Disarm if it is still armed; a fault stays latched for the user to read."""
        newest = shared.ring.newest()
        if newest is None or newest[AT["state"]] != arming.ARMED:
            return
        with contextlib.suppress(InputError):
            daemon.ask({"command": "disarm"})
            return
        # The command process alone may have ended; the supervisor starts it again.
        until = time.monotonic() + RESTART_S
        while time.monotonic() < until:
            with contextlib.suppress(InputError):
                ask(self.settings.socket.path, {"command": "disarm"})
                return
            time.sleep(0.1)

    def _rest(self, keyboard: Keyboard) -> None:
        """Wait until the rig is at rest, the models' initial state. Raises Aborted when the user ends it."""
        seen: list[tuple[float, np.ndarray]] = []
        reported = -math.inf
        while True:
            now, status = time.monotonic(), self.now()
            seen.append(
                (now, np.array([math.nan if v is None else v for v in status["temperatures_c"].values()]))
            )
            if at_rest(seen):
                return
            if keyboard.ended:
                raise Aborted("ended on request", 0.0)
            if now - reported >= REPORT_S:
                reported, warm = now, seen[-1][1]
                print(
                    f"   the rig is still warm ({np.nanmin(warm):.1f} to {np.nanmax(warm):.1f} degC): waiting until it is at rest",
                    file=sys.stderr,
                    flush=True,
                )
            time.sleep(1.0)

    def meanwhile(self, earlier: Table) -> Table | None:
        """Append to `earlier` the daemon's own rows since then; None if they have a gap above GAP_S.

        The last seconds are not in its recording yet: they come from its ring."""
        rows = rows_of(earlier, self.settings.row)
        wall, folder = AT["wall_s"], Path(self.settings.recording.directory)
        for path in recording_files(folder, TIER) if folder.is_dir() else ():
            with contextlib.suppress(InputError):
                rows = _extended(rows, rows_of(read_table(path), self.settings.row))
        newest = Shared.attach(shared_name(self.settings)).ring.read(0)[0]
        stride = max(1, round(EVERY_S / self.settings.loop.period_s))
        rows = _extended(rows, newest[newest[:, AT["tick"]] % stride == 0])
        if np.diff(rows[:, wall]).max(initial=0.0) > GAP_S or time.time() - rows[-1, wall] > GAP_S:
            return None
        return as_table(rows, earlier.path, self.settings.row)


def _extended(rows: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Append those of the rows `later` that are newer than the last of `rows`."""
    is_new = (later[:, AT["wall_s"]] > rows[-1, AT["wall_s"]]) & (later[:, AT["t_s"]] > rows[-1, AT["t_s"]])
    return np.vstack((rows, later[is_new]))


def command_period_s(settings: Settings) -> float:
    """Return the time between two commands that the rig's amplifier takes, s; a tick at least.

    A tick sends the command when 1 / command_hz has passed since the last one; a slow device takes it in the
    rounds of its poller. A CiA-402 drive takes it in every tick."""
    period_s = settings.loop.period_s
    periods_s = [period_s]
    for device in driving_devices(settings) if settings.hal.backend == "devices" else ():
        amplifier = device.binding.profile.amplifier
        if amplifier is None or amplifier.command is None:
            continue
        ticks = 1.0 / (amplifier.command_hz * period_s)
        periods_s.append((ticks + 1.0 if device.slow else math.ceil(ticks - 1e-9)) * period_s)
    return max(periods_s)


@contextlib.contextmanager
def _rig_answers() -> Iterator[None]:
    """Raise HardwareError where the daemon does not answer: its rig cannot be reached."""
    try:
        yield
    except InputError as e:
        raise HardwareError(str(e)) from None


def at_rest(seen: list[tuple[float, np.ndarray]]) -> bool:
    """Check whether a rig of these temperatures, (s, degC (points,)) oldest first, is at rest.

    At rest: all temperatures are equal within REST_K, or none moved by more than REST_K in the last REST_S.
    Thermocouples differ by a degree."""
    now, newest = seen[-1]
    if np.nanmax(newest) - np.nanmin(newest) <= REST_K:
        return True
    window = [t for t_s, t in seen if t_s >= now - REST_S]
    return now - seen[0][0] >= REST_S and bool(
        np.nanmax(np.nanmax(window, axis=0) - np.nanmin(window, axis=0)) <= REST_K
    )
