"""`demo`: a simulated rig of its own, armed and moving, with the monitor's view in front of it.

The demo drives only its own child: configuration, socket, lock, log and recordings lie in a folder beside
the rig's socket. Before it arms, moves or disarms, it checks that its child holds the lock.
"""

from __future__ import annotations

import contextlib
import dataclasses
import select
import signal
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from thermoctl.configuration.settings import Settings, effective, load_settings
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.lock import holder
from thermoctl.daemon.service import START_S, STOP_S, Background
from thermoctl.daemon.views.dashboard import make_server, url
from thermoctl.daemon.views.monitor import errors, ramp_of, remember, screen
from thermoctl.daemon.views.watch import Watch
from thermoctl.files.safe_file import make_folder, write_text
from thermoctl.files.shipped import state_folder
from thermoctl.files.yamlfile import InputError
from thermoctl.interrupt import SIGNALS

MOTION, CYCLE_S = ((0.0, 240.0), (70.0, 200.0)), 90.0
"""Corners (s in the cycle, setpoint um). 240 um need 0.78 A and 2.9 W: +2 um of shaft in a minute."""
MEAN_S = 2.0  # averaging time of the displayed growth: a single reading has 0.01 um of noise
SHOWN_UM = 0.2  # smallest growth that is compared with the residual of compensation; below it noise dominates
STALL_S = 10.0  # longest stall of the machine without a fault in the demo
DASHBOARD = "127.0.0.1:8765"


def demo(settings: Settings, seconds: float | None = None) -> int:
    """Start a daemon of its own, arm, move and show it until Ctrl-C or for `seconds`.

    Returns 1 when a fault is active at the end, 3 when the daemon did not start. Raises InputError for a
    rig that is not simulated, and while another demo runs here."""
    if settings.hal.backend != "simulated":
        raise InputError(
            f"{settings.path}: demo moves a simulated rig only, and this one's back end is '{settings.hal.backend}'; "
            "for it: `thermoctl run` or `start`, then `thermoctl arm`; for the demo: --config config/simulated.yaml"
        )
    own = _own(settings)
    show = _Demo(own, Console())
    try:
        return show.run(seconds)
    except KeyboardInterrupt:
        if not show.was_ready:
            raise
        return 0
    finally:
        before = {n: signal.signal(n, signal.SIG_IGN) for n in SIGNALS}  # no signal interrupts the end
        show.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def demo_folder(settings: Settings) -> Path:
    """Return the folder of everything that the demo of this configuration writes."""
    return (state_folder(settings.path) or Path(settings.socket.path).parent) / "demo"


def _own(settings: Settings) -> Any:
    """Write the configuration of the demo into its folder: this rig, with files of its own.

    Its time counts ticks, so that a stalled machine slows the rig down instead of faulting it."""
    folder, beside = demo_folder(settings), Path(settings.path).absolute().parent
    make_folder(folder)
    hal = settings.hal
    own = dataclasses.replace(
        settings,
        loop=dataclasses.replace(settings.loop, pace="tick"),
        protection=dataclasses.replace(settings.protection, late_s=STALL_S),
        hal=dataclasses.replace(
            hal, plant=str(beside / hal.plant), truth=str(beside / hal.truth) if hal.truth else ""
        ),
        recording=dataclasses.replace(settings.recording, directory=str(folder / "recordings")),
        socket=dataclasses.replace(settings.socket, path=str(folder / "rig.sock")),
        rig_socket="",  # a lock of its own, also for one axis of a rig
    )
    if (pid := holder(own)) is not None:
        raise InputError(f"{folder}: another demo runs here (pid {pid}); stop it first")
    (folder / "rig.state").unlink(missing_ok=True)  # no saved estimates: the simulated rig starts cold
    path = folder / "rig.yaml"
    write_text(path, f"# Written by `thermoctl demo` from {settings.path}.\n{effective(own)}")
    return load_settings(path)


class _Demo:
    """The daemon of `settings` as a child, and what the terminal shows of it."""

    def __init__(self, settings: Settings, console: Console):
        self.settings, self.console = settings, console
        self.child = Background(settings, dies_with_us=True)
        self.page = ""
        self.growth = Growth()
        self.slips: deque[tuple[float, int]] = deque()
        self.faulty = self.was_ready = False

    def ask(self, command: str, **more: Any) -> dict[str, Any]:
        """Send a request to our own child. Raises InputError where it does not hold the lock."""
        if holder(self.settings) != self.child.pid:
            raise InputError(f"{self.settings.socket.path}: the demo's daemon does not run")
        return ask(self.settings.socket.path, {"command": command, **more})

    def run(self, seconds: float | None) -> int:
        """Arm, move and show the rig for `seconds`, or until q is pressed; return the exit status.

        1: a fault in the last status (warnings do not count), or the child has ended. 3: the child was not
        READY within START_S. Raises InputError when arming is refused or the child has lost its lock."""
        if not self._ready():
            sys.stderr.write(self.child.said())
            return 3
        self.was_ready = True
        answer = self.ask("arm")
        if not answer["ok"]:
            raise InputError(answer["error"])
        with self._dashboard():
            self._show(seconds)
        return int(self.faulty or self.child.poll() is not None)

    def close(self) -> None:
        """Disarm and end the child; print the result."""
        with contextlib.suppress(InputError):
            self.ask("disarm")
        self.child.terminate()
        self.child.wait(STOP_S)
        if not self.was_ready:
            return
        say = self.console.print
        say(self.growth.sentence(), highlight=False)
        folder = Path(self.settings.path).parent
        say(
            f"Stopped; the amplifier is disabled. Recording: {folder}/recordings, log: {self.child.log}",
            highlight=False,
        )
        say(
            "Next: `thermoctl start`, `arm`, `setpoint 100` and `dashboard` do the same by hand.",
            highlight=False,
        )

    def _ready(self) -> bool:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and self.child.poll() is None:
            with contextlib.suppress(InputError):
                if self.ask("status")["state"] == "READY":
                    return True
            time.sleep(0.1)
        return False

    @contextlib.contextmanager
    def _dashboard(self) -> Iterator[None]:
        """Serve the page on DASHBOARD, or on a free port where that is taken."""
        watch = Watch(self.settings)
        try:
            server = make_server(self.settings, DASHBOARD, watch)
        except InputError:
            server = make_server(self.settings, "127.0.0.1:0", watch)
        for work in (watch.run, server.serve_forever):
            threading.Thread(target=work, daemon=True).start()
        self.page = url(server)
        try:
            yield
        finally:
            watch.stop()
            server.shutdown()
            server.server_close()

    def _show(self, seconds: float | None) -> None:
        begin, moved = time.monotonic(), -1.0
        trails: dict[str, deque[float]] = {}
        interval_s = 0.25 if self.console.is_terminal else 1.0
        origin_s = self.ask("status")["uptime_s"]
        with contextlib.ExitStack() as stack:
            live = None
            if self.console.is_terminal:
                stack.enter_context(_keys())
                live = stack.enter_context(Live(console=self.console, auto_refresh=False))
            else:
                print(f"dashboard {self.page}", flush=True)
            while self.child.poll() is None and (seconds is None or time.monotonic() - begin < seconds):
                status = self.ask("status")
                self.faulty = any(f["severity"] != "warning" for f in status["faults"])
                at_s = status["uptime_s"] - origin_s
                if status["state"] == "ARMED" and (due := corner(at_s))[0] > moved:
                    self.ask("setpoint", value=due[1])
                    moved = due[0]
                self.growth.add(status)
                remember(trails, status)
                if live is None:
                    print(self._line(status), flush=True)
                    time.sleep(interval_s)
                    continue
                latency = self.ask("latency")
                view = screen(status, latency, trails, self.console.width, ramp_of(self.console))
                live.update(Group(*self._head(status), view), refresh=True)
                key = _key(interval_s)
                if key == "q":
                    return
                if key == "a" and status["state"] == "FAULT":
                    self.ask("disarm")
                    moved = -1.0 if self.ask("arm")["ok"] else moved

    def _head(self, status: dict[str, Any]) -> list[Text]:
        """Return the lines above the monitor's screen: growth, page, late ticks, and help with a fault."""
        lines = [
            Text(self.growth.sentence(), "bold"),
            Text(f"dashboard {self.page}   q or Ctrl-C stops", "dim"),
        ]
        now = time.monotonic()
        self.slips.append((now, status["slips"]))
        while now - self.slips[0][0] > 1.0:
            self.slips.popleft()
        late = status["slips"] - self.slips[0][1]
        if late > 50:
            stalled = f"this machine stalled: {late} ticks skipped in the last second; the rig's time stopped meanwhile"
            lines.append(Text(stalled, "yellow"))
        if status["state"] == "FAULT":
            first = status["faults"][0]
            lines.append(Text(f"{first['name']}: {first['meaning']} -> {first['remedy']}", "red"))
            lines.append(Text("press a to acknowledge the fault and arm again, q to stop", "bold red"))
        lines.append(Text())
        return lines

    def _line(self, status: dict[str, Any]) -> str:
        with_, without = errors(status)
        error = "-" if with_ is None else f"{with_:+.3f} um (without compensation {without:+.3f} um)"
        line = (
            f"{status['state']} tick {status['ticks']} setpoint {status['setpoint_um']:.1f} um, error {error}"
            f", coil {next(iter(status['temperatures_c'].values())):.2f} C, {status['slips']} slips"
        )
        if status["state"] == "FAULT":
            names = ", ".join(f["name"] for f in status["faults"])
            line += f"; {names}: `thermoctl disarm --config {self.settings.path}` acknowledges, `arm` goes on"
        return line


def corner(at_s: float) -> tuple[float, float]:
    """Return the newest (s, setpoint um) of the motion, `at_s` after arming."""
    cycles, within = divmod(at_s, CYCLE_S)
    t, value = max(c for c in MOTION if c[0] <= within)
    return t + cycles * CYCLE_S, value


class Growth:
    """The shaft's growth and its compensated part: means over the newest MEAN_S."""

    def __init__(self) -> None:
        self.values: deque[tuple[float, float, float]] = deque()

    def add(self, status: dict[str, Any]) -> None:
        """Add a status; ignored while the reference moves."""
        with_, without = errors(status)
        if with_ is None or without is None or status["reference_um"] != status["setpoint_um"]:
            return
        now_s = status["uptime_s"]
        self.values.append((now_s, with_, without))
        while now_s - self.values[0][0] > MEAN_S:
            self.values.popleft()

    def sentence(self) -> str:
        """Return the growth and its uncompensated part in one sentence."""
        if not self.values:
            return f"Moving to {MOTION[0][1]:g} um; holding it takes 3 W, which warm the coil and lengthen the shaft."
        left, grown = (abs(float(v)) for v in np.mean(np.array(self.values)[:, 1:], axis=0))
        if grown < SHOWN_UM:
            return f"The shaft has grown {grown:.2f} um so far: in a minute it will be about 2 um."
        times = f": {grown / max(left, 0.005):.0f} times less" if left < grown / 2 else ""
        return f"The shaft has grown {grown:.1f} um; compensation leaves {left:.2f} um{times}."


@contextlib.contextmanager
def _keys() -> Iterator[None]:
    """Read keys one by one, without echo, where the terminal can do that."""
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _key(wait_s: float) -> str:
    """Return the key that was pressed within `wait_s`, or ''."""
    if not sys.stdin.isatty():
        time.sleep(wait_s)
        return ""
    ready, _, _ = select.select([sys.stdin], [], [], wait_s)
    return sys.stdin.read(1) if ready else ""
