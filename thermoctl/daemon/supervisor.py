"""The supervisor: starts the daemon's processes, watches them, and makes the amplifier safe on every way out.

    supervisor ── loop        reads, controls, drives; alone and real-time
              ├── poller      one for each slow device (hal.board.run_poller)
              ├── recorder    ring -> recording
              ├── commands    the Unix socket
              └── reference   an idle loop beside it, when loop.reference is on

The loop ends: the amplifier is disabled through a back end of the supervisor's own and the daemon ends with it
(systemd starts it again, into SAFE, with the estimates that were kept). Any other process ends or hangs: it is started
again, the loop runs on. The supervisor
ends: the kernel tells every child (PDEATHSIG) and the loop disables the amplifier. The loop stands still: it is killed,
as if it had ended.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, MutableMapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import structlog

from hal.backend import HardwareError, disable_amplifier, make_backend, slow_devices
from hal.board import Board, run_poller
from thermoctl.control import arming, faults
from thermoctl.control.law import COMPILED
from thermoctl.daemon import keep, readings
from thermoctl.daemon import loop as loops
from thermoctl.daemon.assemble import compensator, law_parameters, shared_name
from thermoctl.daemon.command_server import Commands, listen, serve
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.display import LATE_REMEDY
from thermoctl.daemon.lock import hold
from thermoctl.daemon.reload import reload_settings
from thermoctl.daemon.shared import BEATS, LOOP_PID, RESUMED, WARNINGS, Shared
from thermoctl.settings import Settings
from thermoctl.signals import INDEX
from thermoctl.yamlfile import InputError

HANG_S = 15.0  # a helper that did no round for so long is killed and started again
READY_S = 60.0  # the first tick comes within this: devices connect before it
STALL_S = (
    1.0  # a loop that made no tick for so long (or for protection.late_s, where a rig forgives more) is ended
)
LOOK_S, LOOK_LONGEST_S = (
    0.1,
    0.2,
)  # between two looks; a longer one tells of a machine that stood, not of the loop
LOOP_STOP_S, STOP_S = 3.0, 10.0  # the loop, or a helper, that was asked to stop is killed after this
RESTART_S = 0.5  # pause before a child is started again, doubled up to
RESTART_LONGEST_S = 30.0
TELL_AGAIN_S = 10.0  # a fault that comes and goes is logged once in this time
EXIT_OK, EXIT_FAILED, EXIT_INPUT, EXIT_HARDWARE = 0, 1, 2, 3

RECORDER, COMMANDS, REFERENCE = range(3)
"""The helpers' places among shared.BEATS."""

_fork = multiprocessing.get_context("fork")
Log = Callable[..., None]


def console_log(event: str, **values: Any) -> None:
    """One line on stderr: event and key=value pairs; systemd's journal adds time and unit."""
    structlog.wrap_logger(structlog.PrintLogger(sys.stderr), processors=[_line]).msg(event, **values)


def _line(_logger: Any, _method: str, values: MutableMapping[str, Any]) -> str:
    event = values.pop("event")
    return " ".join([f"thermoctl: {event}", *(f"{k}={v}" for k, v in values.items() if v is not None)])


class _Stop:
    """Set by SIGTERM; each call also counts a heartbeat of the helper.

    SIGINT is left to the supervisor: the terminal sends it to the children, too.
    """

    def __init__(self, shared: Shared | None = None, beat: int = 0) -> None:
        self.asked, self.shared, self.beat = False, shared, beat
        signal.signal(signal.SIGTERM, self._ask)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    def _ask(self, *_: Any) -> None:
        self.asked = True

    def __call__(self) -> bool:
        if self.shared is not None:
            self.shared.counters[BEATS + self.beat] += 1  # asked once a round: a round done
        return self.asked


def safe_amplifier(settings: Settings, log: Log) -> bool:
    """Disable the amplifier over a link of the supervisor's own, when the loop no longer can.

    No other device is opened.
    """
    try:
        disable_amplifier(settings)
        return True
    except (HardwareError, InputError, OSError) as e:
        log("the amplifier could not be disabled from here; its own watchdog must do it", error=e)
        return False


def _loop_process(settings: Settings, shared: Shared, board: Any) -> int:
    stop = _Stop()
    loops.die_with_parent()
    backend = make_backend(settings, board)
    backend.open()
    try:
        rig = loops.Rig(
            backend,
            compensator(settings),
            law_parameters(settings),
            settings.loop.period_s,
            shared.ring,
            shared.mailbox,
            shared.parameters,
            shared.state,
            time.monotonic(),
            shared.make_remarks(settings.loop.period_s),
        )
        _resume(settings, shared, rig)

        def warn(text: str) -> None:
            shared.counters[WARNINGS] += 1
            console_log("warning", what=text)

        kept = loops.become_real_time(settings, warn)
        loops.run_loop(settings, shared, rig, stop)
        for file in kept:
            os.close(file)
    finally:
        backend.write(0.0, False)
        backend.close()
    return EXIT_OK


def _resume(settings: Settings, shared: Shared, rig: loops.Rig) -> None:
    """Restore the estimates of the run before, when they are recent and of this model."""
    state, age_s, why = keep.load(keep.kept_path(settings), rig.law.model)
    if state is not None:
        try:
            rig.law.resume(state, age_s)
            shared.counters[RESUMED] = 1.0
            rig.keep_state()  # where a replay of this run begins
        except ValueError as e:
            state, why = None, str(e)
    console_log(
        "estimates",
        kept=state is not None,
        age_s=round(age_s, 1) if state is not None else None,
        why=why or None,
    )


def _recorder_process(settings: Settings, shared: Shared, board: Any) -> int:
    from thermoctl.daemon.recorder import make_recorder, record

    stop = _Stop(shared, RECORDER)
    loops.die_with_parent()
    record(make_recorder(settings, shared, console_log), stop)
    return EXIT_OK


def _command_process(settings: Settings, shared: Shared, board: Any) -> int:
    stop = _Stop(shared, COMMANDS)
    loops.die_with_parent()
    path = Path(settings.socket.path)
    listener = listen(path, settings.socket.group)
    try:
        serve(listener, Commands(shared, settings, reload_settings, console_log), stop)
    finally:
        listener.close()
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
    return EXIT_OK


def _tuner_process(settings: Settings, shared: Shared, board: Any) -> int:
    from thermoctl.daemon import tuner

    stop = _Stop()
    loops.die_with_parent()
    tuning = tuner.Tuning(
        compensator(settings),
        settings.rig.name,
        Path(settings.compensation.model),
        lambda text: console_log("tuned", what=text),
    )
    tuner.run(shared, tuning, stop)
    return EXIT_OK


def _reference_process(settings: Settings, shared: Shared, board: Any) -> int:
    stop = _Stop(shared, REFERENCE)
    loops.die_with_parent()
    loops.become_real_time(settings, lambda text: None)
    loops.run_reference(settings, shared, stop)
    return EXIT_OK


def _poller_process(settings: Settings, shared: Shared, board: Any, device: str) -> int:
    loops.die_with_parent()
    run_poller(settings, device, board.name)
    return EXIT_OK


class _Child:
    """One process: how it is started, and when it may be started again.

    beats: returns the rounds it has done; None: it is not watched.
    """

    def __init__(
        self, name: str, main: Callable[..., int], *arguments: Any, beats: Callable[[], float] | None = None
    ):
        self.name, self.main, self.arguments, self.beats = name, main, arguments, beats
        self.heard, self.heard_at = -1.0, 0.0
        self.process: Any = None
        self.again_at, self.pause_s = 0.0, RESTART_S

    def start(self) -> None:
        self.process = _fork.Process(
            target=_run_child, args=(self.name, self.main, self.arguments), name=self.name
        )
        self.process.start()
        self.started = self.heard_at = time.monotonic()

    def hangs(self, now: float) -> bool:
        """Return whether it lives and has not done a round for HANG_S."""
        if self.beats is None or not self.alive:
            return False
        if (beats := self.beats()) != self.heard:
            self.heard, self.heard_at = beats, now
        return now - self.heard_at > HANG_S

    @property
    def alive(self) -> bool:
        return self.process is not None and self.process.is_alive()

    def end(self, limit_s: float = STOP_S) -> None:
        """Ask it to stop; kill it when it does not."""
        if self.alive:
            self.process.terminate()
            self.process.join(limit_s)
            if self.process.is_alive():
                self.process.kill()
                self.process.join()


def _run_child(name: str, main: Callable[..., int], arguments: tuple[Any, ...]) -> None:
    try:
        code = main(*arguments)
    except InputError as e:
        console_log(f"{name} ended", error=e)
        code = EXIT_INPUT
    except HardwareError as e:
        console_log(f"{name} ended", error=e)
        code = EXIT_HARDWARE
    sys.exit(code)


class _Notify:
    """Sends sd_notify messages without a library; does nothing where systemd did not start us."""

    def __init__(self) -> None:
        self.address = os.environ.get("NOTIFY_SOCKET", "")

    def __call__(self, text: str) -> None:
        if not self.address:
            return
        address = "\0" + self.address[1:] if self.address.startswith("@") else self.address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s, contextlib.suppress(OSError):
            s.connect(address)
            s.sendall(text.encode())


class _Watcher:
    """Logs changes of state, faults and the devices' messages: the loop itself logs nothing.

    Faults are logged with their cause first. While the law warms up (OFF) nothing is a fault.
    """

    def __init__(self, shared: Shared, log: Log):
        self.shared, self.log = shared, log
        self.position, self.before = 0, (float(arming.OFF), 0.0)
        self.told: dict[str, float] = {}
        self.changes = [0] * len(faults.CHANNELS)
        self.code: Any = None

    def look(self) -> None:
        rows, self.position, _ = self.shared.ring.read(self.position)
        if not len(rows):
            return
        self._devices(rows[-1])
        pairs = rows[:, [INDEX["state"], INDEX["fault_bits"]]]
        pairs[pairs[:, 0] == arming.OFF, 1] = 0.0
        changed = np.flatnonzero((np.diff(np.vstack([self.before, pairs]), axis=0) != 0).any(axis=1))
        new = 0
        for k in changed[:20]:
            state, bits = pairs[k]
            before_state, before_bits = self.before if k == 0 else pairs[k - 1]
            if state != before_state:
                self.log(
                    "state",
                    tick=int(rows[k, INDEX["tick"]]),
                    was=arming.STATES[int(before_state)],
                    now=arming.STATES[int(state)],
                )
                self.told.clear()
            new |= int(bits) & ~int(before_bits)
        self.before = (pairs[-1, 0], pairs[-1, 1])
        if new:
            self._faults(rows[-1], new)

    def _faults(self, row: np.ndarray, new: int) -> None:
        """Log the faults of `new`, causes first, including those that have cleared by now."""
        row = row.copy()
        row[INDEX["fault_bits"]] = float(int(row[INDEX["fault_bits"]]) | new)
        for f in readings.standing_faults(self.shared, row, readings.readings(self.shared, row)):
            name = f["name"]
            if not new >> faults.BIT[name] & 1 or f["t_s"] - self.told.get(name, -np.inf) < TELL_AGAIN_S:
                continue
            self.told[name] = f["t_s"]
            if f["late_s"]:
                self.log("late", ms=round(f["late_s"] * 1e3), before=name, remedy=repr(LATE_REMEDY))
            self.log(
                f["severity"],
                tick=f["tick"],
                name=name,
                follows=f["follows"] or None,
                device=repr("; ".join(f["messages"])) if f["messages"] else None,
                meaning=repr(f["meaning"]),
                remedy=None if f["follows"] else repr(f["remedy"]),
            )

    def _devices(self, row: np.ndarray) -> None:
        """Log new messages of the devices, and the drive's error code.

        A channel is logged again only after TELL_AGAIN_S.
        """
        if row[INDEX["state"]] == arming.OFF:
            return
        for c, role in enumerate(faults.CHANNELS):
            said = self.shared.remarks.get(c)
            if said is None or said[0] == self.changes[c]:
                continue
            self.changes[c] = said[0]
            if said[1] - self.told.get(role, -np.inf) >= TELL_AGAIN_S:
                self.told[role] = said[1]
                self.log("device", role=role, at_s=round(said[1], 3), message=repr(said[2]))
        code = readings.drive_code(self.shared, row)
        numbers = self.shared.areas["remark_numbers"][1:].tolist()
        if code is not None and numbers != self.code:
            self.code = numbers
            self.log("device", role="amplifier_fault", message=repr(f"the drive reports {code['text']}"))


def run(settings: Settings, log: Log = console_log) -> int:
    """Run the daemon until SIGTERM or SIGINT; return its exit status.

    Raises InputError when it cannot be started.
    """
    if not COMPILED:
        log(
            "warning",
            what="the law runs interpreted, not compiled: far too slow for a rig; run `make install`",
        )
    lock = hold(settings)
    compensator(settings)
    law_parameters(settings)
    if settings.compensation.tune:  # loaded only then: it brings scipy with it
        from thermoctl.daemon import tuner

        tuner.check(settings)
    shared = Shared.create(shared_name(settings))
    board, pollers = None, []
    if settings.hal.backend == "devices":
        slow = slow_devices(settings)
        if slow:
            board = Board.create(shared_name(settings) + "-board")
            pollers = [
                _Child(
                    f"poller {d.name}",
                    _poller_process,
                    settings,
                    shared,
                    board,
                    d.name,
                    beats=partial(board.beat, d.roles),
                )
                for d in slow
            ]
    loop = _Child("loop", _loop_process, settings, shared, board)
    others = [
        *pollers,
        _Child("recorder", _recorder_process, settings, shared, board, beats=partial(shared.beats, RECORDER)),
        _Child("commands", _command_process, settings, shared, board, beats=partial(shared.beats, COMMANDS)),
    ]
    if not settings.recording.enable:
        others = [c for c in others if c.name != "recorder"]
    if settings.compensation.tune:
        others.append(_Child("tuner", _tuner_process, settings, shared, board))
    if settings.loop.reference:
        others.append(
            _Child(
                "reference",
                _reference_process,
                settings,
                shared,
                board,
                beats=partial(shared.beats, REFERENCE),
            )
        )
    try:
        return _supervise(settings, shared, loop, others, log)
    finally:
        shared.remove()
        if board is not None:
            board.close()
        os.close(lock)


def _supervise(settings: Settings, shared: Shared, loop: _Child, others: list[_Child], log: Log) -> int:
    asked: list[int] = []
    reload_asked: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, _: asked.append(n))
    signal.signal(signal.SIGHUP, lambda *_: reload_asked.append(1))
    notify, watcher = _Notify(), _Watcher(shared, log)
    code, ready, ticks, stood_s = EXIT_OK, False, 0, 0.0
    started = kept_at = looked = time.monotonic()
    stall_s = max(STALL_S, settings.protection.late_s)
    model = compensator(settings)
    try:
        for child in (loop, *others):
            child.start()
        while not asked:
            time.sleep(LOOK_S)
            watcher.look()
            now = time.monotonic()
            stood_s, looked = stood_s + min(now - looked, LOOK_LONGEST_S), now
            head = shared.ring.head
            if head != ticks:
                ticks, stood_s = head, 0.0
                if ready:
                    notify("WATCHDOG=1")
            if not ready and head > loops.STATE_EVERY // 5:
                ready = True
                notify(f"READY=1\nMAINPID={os.getpid()}")
                log("ready", ticks=head, seconds=round(now - started, 2))
            if not loop.alive and not asked:  # a signal to the whole group ends both
                log("the loop ended", exit=loop.process.exitcode)
                code = (
                    loop.process.exitcode
                    if loop.process.exitcode in (EXIT_INPUT, EXIT_HARDWARE)
                    else EXIT_FAILED
                )
                break
            if stood_s > (stall_s if head > 0 else READY_S):
                log(
                    "the loop stands still: ended",
                    seconds=round(stood_s, 1),
                    pid=int(shared.counters[LOOP_PID]),
                )
                loop.process.kill()
                loop.process.join()
                code = EXIT_FAILED
                break
            _restart(others, now, log)
            if now - kept_at > keep.EVERY_S:
                kept_at = now
                _keep(settings, shared, model)
            if reload_asked:
                reload_asked.clear()
                _reload(settings, log)
    finally:
        notify("STOPPING=1")
        ended_by_itself = loop.alive
        loop.end(LOOP_STOP_S)
        if not ended_by_itself or loop.process.exitcode != 0:
            safe_amplifier(settings, log)
        watcher.look()
        _keep(settings, shared, model)
        for child in others:
            child.end()
    log("stopped", ticks=shared.ring.head)
    return code


def _keep(settings: Settings, shared: Shared, model: Any) -> None:
    state = shared.state.get()
    if state is not None:
        keep.save(keep.kept_path(settings), model, state[2:])


def _restart(children: list[_Child], now: float, log: Log) -> None:
    for child in children:
        if child.hangs(now):
            log(f"{child.name} hangs: killed", seconds=round(now - child.heard_at, 1))
            child.process.kill()
            child.heard_at = now  # one kill; it is gone at the next look
        if child.alive:
            continue
        if child.again_at == 0.0:
            if now - child.started > RESTART_LONGEST_S:
                child.pause_s = RESTART_S
            child.again_at = now + child.pause_s
            log(f"{child.name} ended, started again", exit=child.process.exitcode, after_s=child.pause_s)
            child.pause_s = min(2.0 * child.pause_s, RESTART_LONGEST_S)
        elif now >= child.again_at:
            child.again_at = 0.0
            child.start()


def _reload(settings: Settings, log: Log) -> None:
    try:
        answer = ask(settings.socket.path, {"command": "reload"})
        log("reload", **answer)
    except InputError as e:
        log("reload", error=e)
