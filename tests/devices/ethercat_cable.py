"""A pair of virtual cables: a master opens one end, a process with EtherCAT slaves answers at the other.

The slaves are in a process of their own because a master may hold the interpreter's lock while it waits.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import select
import socket
import subprocess
from collections.abc import Callable
from typing import Any

from tests.devices.ethercat import Slave, answer

ETHERCAT = 0x88A4


class Wire:
    """What the tests may do to the slaves, inside their process: by name, over a pipe."""

    def __init__(self, slaves: list[Slave]) -> None:
        self.slaves, self.cut, self.lost, self.short = slaves, len(slaves), 0, 0
        self.frames = 0
        self.lost_at: dict[int, int] = {}  # register: how many frames to it get lost

    def serve(self, name: str, pipe: Any) -> None:
        """Answer frames and the test's requests until the pipe is closed."""
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERCAT)) as link:
            link.bind((name, ETHERCAT))
            pipe.send("ready")
            while True:
                for ready in select.select([link, pipe], [], [], 0.005)[0]:
                    if ready is pipe:
                        try:
                            self._ask(pipe)
                        except (EOFError, OSError):
                            return
                    else:
                        self._frame(link)
                for slave in self.slaves:
                    slave.watch()

    def _frame(self, link: socket.socket) -> None:
        try:
            frame = link.recv(2048)
        except OSError:
            return
        self.frames += 1
        there = list(itertools.takewhile(lambda s: s.present, self.slaves[: self.cut]))
        for slave in there:
            slave.watch()
        if self.lost_at.get(register := int.from_bytes(frame[20:22], "little")):
            self.lost_at[register] -= 1
        elif self.lost:
            self.lost -= 1
        elif there:
            with contextlib.suppress(OSError):
                link.send(answer(frame, there))

    def _ask(self, pipe: Any) -> None:
        position, key, arguments = pipe.recv()
        target = self if position == 0 else self.slaves[position - 1]
        found = getattr(target, key)
        if callable(found):
            found = found(*arguments)
        elif arguments:
            setattr(target, key, arguments[0])
        pipe.send(found)


class Cable:
    """A pair of virtual cables: the master opens `name`, the slaves stand at the other end."""

    _numbers = itertools.count()

    def __init__(self, make: Callable[[], list[Slave]]) -> None:
        number = next(self._numbers)
        self.name, self.far = f"ec{os.getpid() % 10**6}m{number}", f"ec{os.getpid() % 10**6}s{number}"
        ip("link", "add", self.name, "type", "veth", "peer", "name", self.far)
        for end in (self.name, self.far):
            with contextlib.suppress(OSError, subprocess.CalledProcessError):
                ip("link", "set", end, "addrgenmode", "none")
            ip("link", "set", end, "up")
        context = multiprocessing.get_context("fork")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_run, args=(make, self.far, other, self._pipe), daemon=True)
        self._process.start()
        other.close()
        assert self._pipe.recv() == "ready"

    def ask(self, position: int, key: str, *arguments: Any) -> Any:
        """Read or write an attribute, or call a method, of slave `position` (0: the wire)."""
        self._pipe.send((position, key, arguments))
        return self._pipe.recv()

    def plug(self) -> None:
        ip("link", "set", self.far, "up")

    def unplug(self) -> None:
        ip("link", "set", self.far, "down")

    def close(self) -> None:
        self._pipe.close()
        self._process.join(5)
        ip("link", "del", self.name)


def _run(make: Callable[[], list[Slave]], name: str, pipe: Any, other: Any) -> None:
    other.close()
    Wire(make()).serve(name, pipe)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def why_not() -> str:
    """Return why no virtual cable can be had here, '' where it can."""
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERCAT)).close()
        name = f"ecp{os.getpid() % 10**6}"
        ip("link", "add", f"{name}a", "type", "veth", "peer", "name", f"{name}b")
        ip("link", "del", f"{name}a")
    except PermissionError:
        return "raw sockets need CAP_NET_RAW"
    except (OSError, subprocess.CalledProcessError) as e:
        return f"a virtual cable (ip link add ... type veth) needs CAP_NET_ADMIN: {e}"
    return ""
