"""The daemon's processes: the main function of each, and how the supervisor starts, watches and ends them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from thermoctl.configuration.settings import Settings
from thermoctl.daemon import keep
from thermoctl.daemon.command_server import Commands, listen, serve
from thermoctl.daemon.journal import Log
from thermoctl.daemon.reload import reload_settings
from thermoctl.daemon.tick import loop as loops
from thermoctl.daemon.tick.assemble import compensator, law_parameters, shared_name
from thermoctl.daemon.tick.shared import BEATS, NO_MODEL, RESUMED, Shared
from thermoctl.files.yamlfile import InputError
from thermoctl.log import bind, console_log, failed
from thermoctl_hal.base.backend import Backend, HardwareError
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.make import make_backends, slow_devices
from thermoctl_hal.rig.poller import ports, run_poller

HANG_S = 15.0  # a helper without a round for this time is killed and started again
STOP_S = 10.0  # a helper that does not end within this time after the request is killed
RESTART_S = 0.5  # pause before a child is started again; doubled at each restart
RESTART_LONGEST_S = 30.0  # longest pause; a child that ran longer than this starts again after RESTART_S
EXIT_OK, EXIT_FAILED, EXIT_INPUT, EXIT_HARDWARE = 0, 1, 2, 3

RECORDER, COMMANDS, REFERENCE = range(3)
"""The helpers' indices among shared.BEATS."""

_fork = multiprocessing.get_context("fork")


class Stop:
    """Set by SIGTERM; each call also counts a heartbeat of the helper.

    SIGINT is left to the supervisor: the terminal sends it to the children, too."""

    def __init__(self, shared: Shared | None = None, beat: int = 0) -> None:
        self.asked, self.shared, self.beat = False, shared, beat
        signal.signal(signal.SIGTERM, self._ask)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    def _ask(self, *_: Any) -> None:
        self.asked = True

    def __call__(self) -> bool:
        if self.shared is not None:
            # A helper calls this once a round, so that it counts rounds.
            self.shared.counters[BEATS + self.beat] += 1
        return self.asked


def _loop_process(settings: Settings, shared: list[Shared], board: Any) -> int:
    """Tick all axes. shared: the segment of each axis."""
    stop = Stop()
    loops.die_with_parent()
    backends = make_backends(settings, board)
    try:
        start_s = time.monotonic()
        for backend in backends if settings.hal.backend != "devices" else backends[:1]:
            backend.open()  # devices are opened together
        rigs = [_rig(*axis, start_s) for axis in zip(settings.parts, shared, backends, strict=True)]
        guard(rigs, settings.parts)

        def warn(text: str) -> None:
            """Log a warning."""
            console_log("warning", what=text)

        kept = loops.become_real_time(settings, warn)
        further = list(zip(rigs[1:], shared[1:], strict=True))
        loops.run_loop(settings, shared[0], rigs[0], stop, further=further)
        for file in kept:
            os.close(file)
    finally:
        for backend in backends:
            backend.write(0.0, False)
        for backend in backends:
            backend.close()
    return EXIT_OK


def _rig(settings: Settings, shared: Shared, backend: Backend, start_s: float) -> loops.Axis:
    """Make the rig of one axis, with the estimates of the previous run where they are recent."""
    model, parameters, period_s = compensator(settings), law_parameters(settings), settings.loop.period_s
    own = (shared.ring, shared.mailbox, shared.parameters, shared.state)
    remarks, channels = shared.make_remarks(period_s), settings.channels
    rig = loops.Axis(backend, model, parameters, period_s, *own, start_s, remarks, channels)
    shared.counters[NO_MODEL] = float(not settings.compensation.model)
    _resume(settings, shared, rig)
    return rig


def guard(rigs: list[loops.Axis], parts: Sequence[Settings]) -> None:
    """Let each axis with `on_other_axis_fault: disarm` watch the others."""
    for rig, settings in zip(rigs, parts, strict=True):
        if settings.protection.on_other_axis_fault == "disarm":
            rig.guards = [other for other in rigs if other is not rig]


def _resume(settings: Settings, shared: Shared, rig: loops.Axis) -> None:
    """Restore the previous run's estimates, when they are recent and of this model."""
    state, age_s, why = keep.load(keep.kept_path(settings), rig.law.model)
    if state is not None:
        try:
            rig.law.resume(state, age_s)
            shared.counters[RESUMED] = 1.0
            rig.keep_state()  # start of a replay of this run
        except ValueError as e:
            state, why = None, str(e)
    console_log(
        "estimates",
        kept=state is not None,
        age_s=round(age_s, 1) if state is not None else None,
        why=why or None,
    )


def _recorder_process(settings: Settings, shared: Shared) -> int:
    from thermoctl.daemon.recorder import make_recorder, record

    stop = Stop(shared, RECORDER)
    loops.die_with_parent()
    record(make_recorder(settings, shared, console_log), stop)
    return EXIT_OK


def _command_process(settings: Settings, shared: Shared) -> int:
    stop = Stop(shared, COMMANDS)
    loops.die_with_parent()
    path = Path(settings.socket.path)
    listener = listen(path, settings.socket.group)
    try:
        serve(listener, Commands(shared, settings, reload_settings, console_log), stop)
    finally:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
    return EXIT_OK


def _tuner_process(settings: Settings, shared: Shared) -> int:
    from thermoctl.daemon import tuner

    stop = Stop()
    loops.die_with_parent()
    tuning = tuner.Tuning(
        compensator(settings),
        settings.rig.name,
        Path(settings.compensation.model),
        lambda text: console_log("tuned", what=text),
        channels=settings.channels,
    )
    tuner.run(shared, tuning, stop)
    return EXIT_OK


def _reference_process(settings: Settings, shared: Shared) -> int:
    stop = Stop(shared, REFERENCE)
    loops.die_with_parent()
    loops.become_real_time(settings, lambda text: None)
    loops.run_reference(settings, shared, stop)
    return EXIT_OK


def _poller_process(settings: Settings, board: Any, device: str) -> int:
    """Poll the devices of a port, of which `device` is one."""
    loops.die_with_parent()
    groups = ports(slow_devices(settings))
    run_poller(next(g for g in groups if device in (d.name for d in g)), board.name)
    return EXIT_OK


class Child:
    """One process: how it is started, and when it may be started again.

    beats: returns the rounds it has done; None: it is not watched."""

    def __init__(
        self, name: str, main: Callable[..., int], *arguments: Any, beats: Callable[[], float] | None = None
    ):
        self.name, self.main, self.arguments, self.beats = name, main, arguments, beats
        self.heard, self.heard_at = -1.0, 0.0
        self.process: Any = None
        self.again_at, self.pause_s = 0.0, RESTART_S

    def start(self) -> None:
        """Start the process. Raises OSError where the system has none left, or no memory."""
        self.process = _fork.Process(
            target=_run_child, args=(self.name, self.main, self.arguments), name=self.name
        )
        self.started = self.heard_at = time.monotonic()
        self.process.start()

    def hangs(self, now: float) -> bool:
        """Return whether the process runs without a completed round for HANG_S."""
        if self.beats is None or not self.alive:
            return False
        if (beats := self.beats()) != self.heard:
            self.heard, self.heard_at = beats, now
        return now - self.heard_at > HANG_S

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process is not None and self.process.is_alive()

    def ask(self) -> None:
        """Ask it to stop."""
        if self.alive:
            self.process.terminate()

    def end(self, limit_s: float = STOP_S) -> None:
        """Ask it to stop; kill it when it does not."""
        if self.alive:
            self.ask()
            self.process.join(limit_s)
            if self.process.is_alive():
                self.process.kill()
                self.process.join()


def _run_child(name: str, main: Callable[..., int], arguments: tuple[Any, ...]) -> None:
    bind(axis=arguments[0].axis)
    try:
        code = main(*arguments)
    except InputError as e:
        console_log(f"{name} ended", error=e)
        code = EXIT_INPUT
    except HardwareError as e:
        console_log(f"{name} ended", error=e)
        code = EXIT_HARDWARE
    except Exception as e:
        failed(name, e)
        code = EXIT_FAILED
    sys.exit(code)


def restart(children: list[Child], now: float, log: Log) -> None:
    """Kill each child that hangs, and start each that has ended again after its pause."""
    for child in children:
        if child.hangs(now):
            log(f"{child.name} hangs: killed", seconds=round(now - child.heard_at, 1))
            child.process.kill()
            child.heard_at = now  # kill it only once
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
            try:
                child.start()
            except OSError as e:
                log(f"{child.name} cannot be started; the loop runs on", error=e)


def make_children(settings: Settings, shared: list[Shared]) -> tuple[Board | None, Child, list[Child]]:
    """Make the board of slow readings (None without slow devices), the loop and the helpers.

    shared: the segment of each axis; an axis has a recorder, a command socket and a tuner of its own."""
    slow = slow_devices(settings) if settings.hal.backend == "devices" else []
    board = Board.create(shared_name(settings) + "-board", len(settings.channels.names)) if slow else None

    def child(
        name: str, main: Callable[..., int], own: Settings, s: Shared, beat: int | None = None
    ) -> Child:
        """Return a helper of an axis; `beat`: place of its heartbeat in `s`, None: it is not watched."""
        beats = None if beat is None else partial(s.beats, beat)
        return Child(f"{name} {own.axis}".strip(), main, own, s, beats=beats)

    others: list[Child] = []
    if board is not None:
        for device, *_ in ports(slow):
            name, beats = f"poller {device.name}", partial(board.beat, device.roles)
            others.append(Child(name, _poller_process, settings, board, device.name, beats=beats))
    for axis in zip(settings.parts, shared, strict=True):
        if settings.recording.enable:
            others.append(child("recorder", _recorder_process, *axis, RECORDER))
        others.append(child("commands", _command_process, *axis, COMMANDS))
        if axis[0].compensation.tune:
            others.append(child("tuner", _tuner_process, *axis))
    if settings.loop.reference:
        others.append(child("reference", _reference_process, settings, shared[0], REFERENCE))
    return board, Child("loop", _loop_process, settings, shared, board), others
