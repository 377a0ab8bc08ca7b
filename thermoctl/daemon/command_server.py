"""The server's side of the command socket, in a process of its own; control_socket.py is the client's side.

The file permissions of the socket (owner and group) decide who may connect. Each command that moves anything
is logged with the kernel's peer credentials. Every size that a client decides is limited.
"""

from __future__ import annotations

import contextlib
import grp
import json
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from thermoctl.configuration.settings import Settings
from thermoctl.control import arming
from thermoctl.control.model import Parameters
from thermoctl.daemon.answers.display import fault_lines
from thermoctl.daemon.answers.snapshot import latency, status
from thermoctl.daemon.control_socket import settled
from thermoctl.daemon.reload import jumps
from thermoctl.daemon.tick import arrival
from thermoctl.daemon.tick.assemble import in_force, law_parameters
from thermoctl.daemon.tick.loop import RELOAD
from thermoctl.daemon.tick.shared import TRIAL, Shared
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.option import LIVE_STEP, TRIAL_FACTOR
from thermoctl.rig.signals import AT
from thermoctl_hal.rig.make import can_drive

MAX_LINE = 65536  # bytes of one request
MAX_CLIENTS = 32
ANSWER_S = 1.0  # time within which the loop must take a command


class Commands:
    """Obeys the requests.

    Gains on trial (command `gains`) last as long as the connection that armed the rig, and no longer than the
    rig is armed. They are given up by disarming, by the connection's end, by a reload and before arming.
    A command process that replaces one that was killed gives them up, too.

    `reload_settings(settings in force, settings at the start)` reads the file again and returns (settings,
    parameters, applied keys, keys that need a restart)."""

    def __init__(
        self,
        shared: Shared,
        settings: Settings,
        reload_settings: Callable[[Settings, Settings], tuple[Settings, Parameters, list[str], list[str]]],
        log: Callable[..., None],
    ):
        self.shared, self.started = shared, settings
        # This process may replace one that was killed after a reload.
        self.settings = in_force(settings, shared.parameters.get())
        self.reload_settings, self.log = reload_settings, log
        self.expected_hz = arrival.expected_hz(settings)
        self.can_drive = can_drive(settings)
        # Gains of a command process that was killed; the file still has the gains before it.
        if shared.counters[TRIAL]:
            with contextlib.suppress(InputError):
                self.settings = reload_settings(settings, settings)[0]
            with contextlib.suppress(InputError):  # the loop is not there: the next arming tries again
                self.let_go("the command process before this one")

    def answer(self, line: bytes, peer: str, holds: bool = False) -> dict[str, Any]:
        """Answer one request line; nothing that a client sends raises an exception.

        holds: whether the client's connection is the one that armed the rig."""
        answer = self._answer(line, peer, holds)
        return {"axis": self.started.axis, **answer} if self.started.axis else answer

    def _answer(self, line: bytes, peer: str, holds: bool) -> dict[str, Any]:
        try:
            request = json.loads(line)
            if not isinstance(request, dict) or not isinstance(request.get("command"), str):
                raise ValueError("expected an object with a 'command'")
        except (ValueError, RecursionError) as e:
            return {"ok": False, "error": f"not a request: {e}"}
        name = request["command"]
        if name == "status":
            slow = arrival.slow_readings(self.shared, self.expected_hz)
            counted = arrival.device_counters(self.shared)
            return {"ok": True, **status(self.shared), "slow": slow, "device_counters": counted}
        if name == "latency":
            return {"ok": True, **latency(self.shared, self.settings.loop.period_s)}
        if name == "signals":
            return {"ok": True, "signals": [[s.name, s.unit, s.meaning] for s in self.shared.row.signals]}
        actions: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "arm": self._arm,
            "disarm": self._disarm,
            "setpoint": self._setpoint,
            "reload": self._reload,
            "may_reload": self._may_reload,
            "gains": partial(self._gains, holds),
        }
        action = actions.get(name)
        if action is None:
            return {
                "ok": False,
                "error": f"unknown command '{name[:40]}'; "
                "expected status, latency, signals, arm, disarm, setpoint, reload or gains",
            }
        try:
            answer = action(request)
        except InputError as e:
            answer = {"ok": False, "state": self._state(), "error": str(e)}
        self.log(
            "command",
            name=name,
            peer=peer,
            ok=answer["ok"],
            value=request.get("value"),
            error=str(answer["error"]).splitlines()[0] if "error" in answer else None,
        )
        return answer

    def _state(self) -> str:
        return status(self.shared)["state"]

    def _send(self, kind: float, value: float = 0.0) -> None:
        """Hand a command to the loop and wait until the loop has taken it."""
        if not self.shared.mailbox.push(kind, value):
            raise InputError("the loop does not take commands: its mailbox is full (is it running?)")
        position = self.shared.mailbox.pushed
        head = self.shared.ring.head
        deadline = time.monotonic() + ANSWER_S
        while self.shared.mailbox.taken < position or self.shared.ring.head < head + 3:
            if time.monotonic() > deadline:
                raise InputError(f"the loop did not take the command within {ANSWER_S} s (is it running?)")
            time.sleep(0.001)

    def _result(self, wanted: str, refusal: str) -> dict[str, Any]:
        now = status(self.shared)
        if now["state"] == wanted:
            return {"ok": True, "state": now["state"], "setpoint_um": now["setpoint_um"]}
        lines = fault_lines(now["faults"])
        return {
            "ok": False,
            "state": now["state"],
            "error": "\n  ".join(
                [f"{refusal}: the state is {now['state']}{' because of' if lines else ''}", *lines]
            ),
        }

    def _arm(self, request: dict[str, Any]) -> dict[str, Any]:
        if not self.can_drive:
            raise InputError(
                "not armed: no device of hal.devices takes the command (a profile with 'drive'): "
                "this rig measures, it cannot be driven"
            )
        deadline = time.monotonic() + ANSWER_S  # a loop that was just started warms up for 0.1 s
        while not settled(status(self.shared)) and time.monotonic() < deadline:
            time.sleep(0.005)
        held = bool(request.get("held"))
        if self._state() == "ARMED" and held:
            raise InputError(
                "not armed for this command: the rig is ARMED already and in use; `thermoctl disarm` ends that"
            )
        if self._state() == "ARMED":
            return {"ok": True, "state": "ARMED", "setpoint_um": status(self.shared)["setpoint_um"]}
        if self._state() == "FAULT":
            return self._result(
                "ARMED",
                "not armed, a fault is latched: `thermoctl disarm` acknowledges it once its cause is gone",
            )
        self._give_up_trial()
        self._send(arming.ARM)
        answer = self._result("ARMED", "not armed")
        return {**answer, "held": held and answer["ok"]}

    def let_go(self, peer: str) -> None:
        """Disarm after the connection that armed the rig has ended, for whatever reason."""
        if self._state() == "ARMED":
            self._send(arming.DISARM)
            self.log("command", name="disarm", peer=peer, ok=True, why="its connection is gone")
        self._give_up_trial()

    def _give_up_trial(self) -> None:
        """Put the gains of the configuration in force again."""
        if self.shared.counters[TRIAL]:
            self._apply(law_parameters(self.settings))
            self.shared.counters[TRIAL] = 0.0

    def _refuse_jumps(self, new: Parameters) -> None:
        """Raise InputError where these parameters would make the output of an armed rig jump."""
        row = self.shared.ring.newest()
        if row is None or row[AT["state"]] != arming.ARMED:
            return
        numbers = self.shared.parameters.get()
        old = law_parameters(self.started) if numbers is None else Parameters.unpack(numbers)
        found, drive = jumps(old, new), abs(row[AT["control_v"]])
        if drive > new.output_limit:
            found.append(f"control.output_limit {new.output_limit:g}, the drive is {drive:g} now")
        setpoint, low, high = row[AT["setpoint_um"]], new.setpoint_low_um, new.setpoint_high_um
        if not low <= setpoint <= high:
            found.append(
                f"control.setpoint_low_um..high_um {low:g}..{high:g}, the setpoint is {setpoint:g} now"
            )
        if old.compensate != new.compensate:
            found.append(f"compensation.enable {old.compensate > 0.0} -> {new.compensate > 0.0}".lower())
        if abs(row[AT["compensation_um"]]) > new.bound_um:
            now = row[AT["compensation_um"]]
            found.append(f"compensation.bound_um {new.bound_um:g}, the compensation is {now:g} now")
        if found:
            raise InputError(
                f"{self.settings.path}: nothing was changed, the output of the armed rig would move: "
                f"{'; '.join(found)}. While ARMED a reload changes a gain by a factor of {LIVE_STEP:g} at most: go in "
                "steps, or disarm first"
            )

    def _apply(self, parameters: Parameters) -> None:
        self.shared.parameters.put(parameters.pack())
        self._send(RELOAD)

    def _gains(self, holds: bool, request: dict[str, Any]) -> dict[str, Any]:
        """Answer the configuration's gains, or try others over the connection that armed the rig."""
        control = self.settings.control
        names = ("kp", "ti_s", "td_s")
        if not set(names) & set(request):
            return {"ok": True, **{n: getattr(control, n) for n in names}}
        if not holds or self._state() != "ARMED":
            raise InputError(
                "gains not taken: they are tried only over the connection that armed the rig "
                "(`thermoctl tune --write`); others are written into the file, then `thermoctl reload`"
            )
        options = {f.name: f.metadata["option"] for f in fields(control)}
        tried = []
        for n in names:
            value, low, high = request.get(n), options[n].low, options[n].high
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise InputError(
                    f"gains: {n}: a number from {low:g} to {high:g} was expected, found {value!r}"
                )
            tried.append(float(value))
        present = law_parameters(self.settings)
        wanted = replace(present, kp=tried[0], ti_s=tried[1], td_s=tried[2])
        if far := jumps(present, wanted, TRIAL_FACTOR):
            raise InputError(
                f"gains: {'; '.join(far)}: a trial changes each by a factor of {TRIAL_FACTOR:g} at most"
            )
        self.shared.counters[TRIAL] = 1.0
        self._apply(wanted)
        return {"ok": True, "generation": status(self.shared).get("generation")}

    def _disarm(self, request: dict[str, Any]) -> dict[str, Any]:
        self._send(arming.DISARM)
        self._give_up_trial()
        now = self._state()
        if now in ("SAFE", "READY", "OFF"):
            return {"ok": True, "state": now, "held": False}
        return self._result("SAFE", "the amplifier is disabled, but the fault still stands")

    def _setpoint(self, request: dict[str, Any]) -> dict[str, Any]:
        value = request.get("value")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            raise InputError("setpoint: expected a finite number of micrometres as 'value'")
        control = self.settings.control
        if not control.setpoint_low_um <= value <= control.setpoint_high_um:
            raise InputError(
                f"setpoint {value:g} um: outside control.setpoint_low_um..setpoint_high_um "
                f"({control.setpoint_low_um:g}..{control.setpoint_high_um:g})"
            )
        if self._state() != "ARMED":
            return self._result("ARMED", "setpoint not taken, it counts only when armed")
        self._send(arming.SETPOINT, float(value))
        return self._result("ARMED", "setpoint not taken")

    def _may_reload(self, request: dict[str, Any]) -> dict[str, Any]:
        self._refuse_jumps(self.reload_settings(self.settings, self.started)[1])
        return {"ok": True}

    def _reload(self, request: dict[str, Any]) -> dict[str, Any]:
        settings, parameters, applied, restart = self.reload_settings(self.settings, self.started)
        self._refuse_jumps(parameters)
        self._apply(parameters)
        self.shared.counters[TRIAL] = 0.0
        self.settings = settings
        return {
            "ok": True,
            "generation": status(self.shared).get("generation"),
            "applied": applied,
            "needs_restart": restart,
        }


class _Client:
    """One connection; `holds`: the rig stays armed only as long as the connection lasts."""

    def __init__(self, connection: socket.socket, peer: str):
        self.connection, self.peer, self.received, self.unsent = connection, peer, b"", b""
        self.holds = False


def check_place(path: Path) -> None:
    """Raise InputError where a file that is no socket is at the socket's path."""
    if path.exists() and not path.is_socket():
        raise InputError(f"{path}: a file that is no socket is there, and is kept; give another socket.path")


def listen(path: Path, group: str | None) -> socket.socket:
    """Return a listening socket at `path`, for owner and group.

    Raises InputError where it cannot be made."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_place(path)
        path.unlink(missing_ok=True)
    except OSError as e:
        raise InputError(f"{path}: cannot listen: {e.strerror}; check socket.path") from None
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        if group:
            os.chown(path, -1, grp.getgrnam(group).gr_gid)
        os.chmod(path, 0o660)
    except (OSError, KeyError) as e:
        listener.close()
        why = f"no group '{group}' on this system" if isinstance(e, KeyError) else e.strerror or str(e)
        raise InputError(f"{path}: cannot listen: {why}; check socket.path and socket.group") from None
    finally:
        os.umask(before)
    listener.listen(8)
    listener.setblocking(False)
    return listener


def serve(listener: socket.socket, commands: Commands, stopping: Callable[[], bool]) -> None:
    """Answer requests until `stopping()`; drop a client that sends too much.

    A socket that was deleted is made again: without it no command would reach an armed rig."""
    path = Path(listener.getsockname())
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    while not stopping():
        if not path.exists():
            selector.unregister(listener)
            listener.close()
            listener = listen(path, commands.started.socket.group)
            selector.register(listener, selectors.EVENT_READ)
            commands.log("the command socket was deleted: made again; let no program clean its folder")
        for key, events in selector.select(timeout=0.2):
            if key.fileobj is listener:
                _accept(listener, selector)
            else:
                _serve_client(key.data, events, selector, commands)
    selector.close()
    listener.close()


def _accept(listener: socket.socket, selector: selectors.BaseSelector) -> None:
    try:
        connection, _ = listener.accept()
    except OSError:
        return
    if len(selector.get_map()) > MAX_CLIENTS:
        connection.close()
        return
    connection.setblocking(False)
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    selector.register(connection, selectors.EVENT_READ, _Client(connection, f"uid {uid} pid {pid}"))


def _serve_client(client: _Client, events: int, selector: selectors.BaseSelector, commands: Commands) -> None:
    """Do at most one read, one request and one write, so that no client delays another.

    Nothing is read from a client that has not taken its answer."""
    try:
        if events & selectors.EVENT_READ:
            data = client.connection.recv(MAX_LINE)
            if not data:
                raise OSError("closed")
            client.received += data
        if not client.unsent and b"\n" in client.received:
            line, client.received = client.received.split(b"\n", 1)
            answer = commands.answer(line, client.peer, client.holds)
            client.holds = answer.pop("held", client.holds)
            client.unsent = json.dumps(answer).encode() + b"\n"
        if not client.unsent and len(client.received) > MAX_LINE:
            raise OSError("an endless line")
        if client.unsent:
            with contextlib.suppress(BlockingIOError):
                client.unsent = client.unsent[client.connection.send(client.unsent) :]
        busy = client.unsent or b"\n" in client.received
        selector.modify(client.connection, selectors.EVENT_WRITE if busy else selectors.EVENT_READ, client)
    except OSError:
        selector.unregister(client.connection)
        client.connection.close()
        if client.holds:
            with contextlib.suppress(InputError):  # the loop is gone, too
                commands.let_go(client.peer)
