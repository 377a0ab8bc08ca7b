"""The supervisor: starts the daemon's processes, watches them, and disables the amplifier on every way out.

    supervisor ── loop        reads, controls, drives; alone and real-time
              ├── poller      one for each slow device (thermoctl_hal.rig.board.run_poller)
              ├── recorder    ring -> recording
              ├── commands    the Unix socket
              ├── tuner       learns the expansion model, when compensation.tune is on
              └── reference   an idle loop beside it, when loop.reference is on

A rig with axes has one loop and its pollers; recorder, commands and tuner are an axis each.

The loop ends: the supervisor disables every amplifier over its own link, and the daemon ends. systemd
starts it again, into SAFE, with the estimates that were kept. The loop stands still: it is killed, then
as if it had ended. Any other process ends or hangs: it is started again while the loop runs on. The
supervisor ends: the kernel signals every child (PDEATHSIG), and the loop disables the amplifiers.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from functools import partial
from pathlib import Path

from thermoctl.configuration.settings import Settings
from thermoctl.control.law import COMPILED
from thermoctl.daemon import keep
from thermoctl.daemon.command_server import check_place
from thermoctl.daemon.control_socket import ask, refused_reload
from thermoctl.daemon.journal import Log, Watcher
from thermoctl.daemon.lock import hold, is_retaken
from thermoctl.daemon.processes import (
    EXIT_FAILED,
    EXIT_HARDWARE,
    EXIT_INPUT,
    EXIT_OK,
    Child,
    make_children,
    restart,
)
from thermoctl.daemon.tick import loop as loops
from thermoctl.daemon.tick.assemble import (
    check_mode,
    compensator,
    law_parameters,
    rig_identity,
    shared_name,
    unknown_group,
)
from thermoctl.daemon.tick.shared import LOOP_PID, Shared
from thermoctl.daemon.unsaved import Unsaved
from thermoctl.files.safe_file import WriteError
from thermoctl.files.yamlfile import InputError
from thermoctl.log import bind, console_log, take_over
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.rig.make import disable_amplifier

END_S = 60  # longest time for the end: the recorder's last rows on a slow disk
RELOAD_S = 30.0  # longest time for a reload on a slow machine
READY_S = 60.0  # time limit of the first tick: devices connect before it
STALL_S = 1.0  # a loop without a tick for this time, or for protection.late_s if longer, is ended
LOOK_S = 0.1  # time between two checks
# At most this much time between two checks counts as silence of the loop: beyond it, the supervisor itself
# was stopped.
LOOK_LONGEST_S = 0.2
NOTIFY_S = 0.1  # longest time for systemd to take a message: one that hangs must not hold the supervisor
LOOP_STOP_S = 3.0  # a loop that does not end within this time after the request is killed


def safe_amplifier(settings: Settings, log: Log) -> bool:
    """Disable the amplifier over a link of the supervisor's own, when the loop no longer can.

    No other device is opened."""
    try:
        disable_amplifier(settings)
        return True
    except (HardwareError, InputError, OSError) as e:
        log("the amplifier could not be disabled from here; its own watchdog must do it", error=e)
        return False


class _Notify:
    """Sends sd_notify messages without a library; does nothing when systemd did not start the daemon."""

    def __init__(self) -> None:
        self.address = os.environ.get("NOTIFY_SOCKET", "")

    def __call__(self, text: str) -> None:
        if not self.address:
            return
        address = "\0" + self.address[1:] if self.address.startswith("@") else self.address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s, contextlib.suppress(OSError):
            s.settimeout(NOTIFY_S)
            s.connect(address)
            s.sendall(text.encode())


def run(settings: Settings, log: Log = console_log) -> int:
    """Run the daemon until SIGTERM or SIGINT; return its exit status.

    Raises InputError when it cannot be started."""
    take_over()
    bind(rig=rig_identity(settings))
    if not COMPILED:
        log(
            "warning",
            what="the law runs interpreted, not compiled: far too slow for a rig; run `make install`",
        )
    if line := unknown_group(settings):
        raise InputError(f"{settings.path}: {line}")
    lock = hold(settings)
    for part in settings.parts:
        check_place(Path(part.socket.path))
        compensator(part)
        law_parameters(part)
        check_mode(part)
        if part.compensation.tune:  # loaded only on demand, because it loads scipy
            from thermoctl.daemon import tuner

            tuner.check(part)
    shared: list[Shared] = []
    board = None
    try:
        for part in settings.parts:
            shared.append(Shared.create(shared_name(part), part.channels))
        bind(run=shared[0].run)
        board, loop, others = make_children(settings, shared)
        return _Supervision(settings, shared, loop, others, log, lock).run()
    finally:
        for s in shared:
            s.remove()
        if board is not None:
            board.close()
        os.close(lock)


class _Supervision:
    """One run of the daemon: starts the processes and watches them until a signal or the loop's end."""

    def __init__(
        self, settings: Settings, shared: list[Shared], loop: Child, others: list[Child], log: Log, lock: int
    ) -> None:
        self.settings, self.loop, self.others, self.log, self.lock = settings, loop, others, log, lock
        self.axes = list(zip(settings.parts, shared, map(compensator, settings.parts), strict=True))
        self.shared = shared[0]
        self.asked: list[int] = []
        self.reloading = Child("reload", _reload, settings, log)  # beside this one, which feeds the watchdog
        self.reload_asked: list[int] = []
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda n, _: self.asked.append(n))
        signal.signal(signal.SIGHUP, lambda *_: self.reload_asked.append(1))
        self.notify = _Notify()
        logs = [partial(log, axis=part.axis) if part.axis else log for part in settings.parts]
        self.watchers = [Watcher(s, said) for s, said in zip(shared, logs, strict=True)]
        self.unkept = [Unsaved(s, "estimates", said) for s, said in zip(shared, logs, strict=True)]
        self.started = self.kept_at = self.looked = time.monotonic()
        self.ready, self.ticks, self.stood_s = False, 0, 0.0
        self.stall_s = max(STALL_S, *(part.protection.late_s for part in settings.parts))

    def run(self) -> int:
        """Supervise; return the daemon's exit status."""
        code: int | None = None
        try:
            for child in (self.loop, *self.others):
                child.start()
            while code is None and not self.asked:
                time.sleep(LOOK_S)
                self._look()
                now = time.monotonic()
                self._count_ticks(now)
                code = self._loop_failure()
                if code is None:
                    self._maintain(now)
        finally:
            self._end()
        self.log("stopped", ticks=self.shared.ring.head)
        return EXIT_OK if code is None else code

    def _count_ticks(self, now: float) -> None:
        """Feed systemd's watchdog after new ticks; measure the time without any."""
        self.stood_s, self.looked = self.stood_s + min(now - self.looked, LOOK_LONGEST_S), now
        head = self.shared.ring.head
        if head != self.ticks:
            self.ticks, self.stood_s = head, 0.0
            if self.ready:
                self.notify("WATCHDOG=1")
        if not self.ready and head > loops.STATE_EVERY // 5:
            self.ready = True
            self.notify(f"READY=1\nMAINPID={os.getpid()}")
            self.log("ready", ticks=head, seconds=round(now - self.started, 2))

    def _loop_failure(self) -> int | None:
        """Return the exit status when the loop has ended or hangs (then it is killed), else None."""
        if not self.loop.alive and not self.asked:  # a signal to the whole group ends both
            code = self.loop.process.exitcode
            self.log("the loop ended", exit=code)
            return code if code in (EXIT_INPUT, EXIT_HARDWARE) else EXIT_FAILED
        if self.stood_s > (self.stall_s if self.ticks > 0 else READY_S):
            pid = int(self.shared.counters[LOOP_PID])
            self.log("the loop stands still: ended", seconds=round(self.stood_s, 1), pid=pid)
            self.loop.process.kill()
            self.loop.process.join()
            return EXIT_FAILED
        return None

    def _maintain(self, now: float) -> None:
        """Restart helpers, save the estimates, reload on SIGHUP."""
        restart(self.others, now, self.log)
        if now - self.kept_at > keep.EVERY_S:
            self.kept_at = now
            self._keep()
            with contextlib.suppress(InputError):  # tried again
                if is_retaken(self.settings, self.lock):
                    self.log("the lock file was deleted: taken again; let no program clean its folder")
        if self.reload_asked and not self.reloading.alive:
            self.reload_asked.clear()
            try:
                self.reloading.start()
            except OSError as e:
                self.log("reload", error=e)

    def _look(self) -> None:
        for watcher in self.watchers:
            watcher.look()

    def _keep(self) -> None:
        for (part, shared, model), tell in zip(self.axes, self.unkept, strict=True):
            state = shared.state.get()
            if state is not None:
                try:
                    keep.save(keep.kept_path(part), model, state[2:])
                    tell("")
                except WriteError as e:
                    tell(e.why)

    def _end(self) -> None:
        """End all processes, the loop first; disable the amplifier where the loop did not end well."""
        self.notify(f"STOPPING=1\nWATCHDOG_USEC={END_S * 1_000_000}")  # the watchdog is not fed from here on
        ended_by_itself = not self.loop.alive
        self.loop.end(LOOP_STOP_S)
        if ended_by_itself or self.loop.process.exitcode != 0:
            safe_amplifier(self.settings, self.log)
        self._look()
        self._keep()
        for child in (*self.others, self.reloading):
            child.ask()
        for child in (*self.others, self.reloading):
            child.end()


def _reload(settings: Settings, log: Log) -> int:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    loops.die_with_parent()
    if settings.axes and (why := refused_reload([part.socket.path for part in settings.axes], RELOAD_S)):
        log("reload", error=why)
        return EXIT_FAILED
    for part in settings.parts:
        try:
            answer = ask(part.socket.path, {"command": "reload"}, RELOAD_S)
            log("reload", **{"axis": part.axis or None, **answer})
        except InputError as e:
            log("reload", axis=part.axis or None, error=e)
    return EXIT_OK
