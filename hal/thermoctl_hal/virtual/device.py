"""Base of the virtual rig's devices: the pseudo-terminal, and the readings of the plant."""

from __future__ import annotations

import contextlib
import os
import tty
from collections.abc import Callable
from pathlib import Path

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.binding import Binding, Bound
from thermoctl_hal.virtual.plants import Readings

SUPPLY_V = 24.0
MAX_READ = 4096


class Pty:
    """A pseudo-terminal whose slave has a symbolic link at `path`."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        self.master = self._slave = -1

    def plug(self) -> None:
        """Make the terminal and its link."""
        if self.master >= 0:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.master, self._slave = os.openpty()  # the slave stays open: the master lives while nobody listens
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        if self.path.is_symlink():
            self.path.unlink()
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Hang up: the other side reads an error, as from an unplugged USB adapter."""
        if self.master < 0:
            return
        with contextlib.suppress(OSError):
            self.path.unlink()
        os.close(self.master)
        os.close(self._slave)
        self.master = self._slave = -1

    def send(self, data: bytes) -> None:
        """Send the bytes that fit; a listener that does not read loses the rest, as on a real line."""
        if self.master >= 0:
            with contextlib.suppress(BlockingIOError, OSError):
                os.write(self.master, data)

    def receive(self) -> bytes:
        """Return the bytes that the other side has sent."""
        try:
            return os.read(self.master, MAX_READ)
        except (BlockingIOError, OSError):
            return b""


class VirtualDevice:
    """One device of the rig. `verbs` are the commands of the control socket to it, beside plug and unplug."""

    def __init__(self, binding: Binding, rig: Readings) -> None:
        self.binding, self.rig, self.name = binding, rig, binding.name
        self.verbs: dict[str, Callable[[str], None]] = {}

    def plug(self) -> None:
        """Connect the device to its wire (again)."""
        raise NotImplementedError

    def unplug(self) -> None:
        """Pull the cable."""
        raise NotImplementedError

    def descriptors(self) -> list[int]:
        """Return the descriptors to wait on for input."""
        raise NotImplementedError

    def ready(self, descriptor: int, now_s: float) -> None:
        """Take the input that has arrived."""

    def tick(self, now_s: float, tick: int) -> None:
        """Advance one period."""

    def flag(self, owner: object, attribute: str) -> Callable[[str], None]:
        """Make the verb `<attribute> on|off`."""

        def switch(argument: str) -> None:
            """Set the attribute. Raises InputError unless the argument is 'on' or 'off'."""
            if argument not in ("on", "off"):
                raise InputError(f"{attribute}: on or off was expected, found '{argument}'")
            setattr(owner, attribute, argument == "on")

        return switch

    def raw(self, bound: Bound, value: float) -> float:
        """Return the device's raw number for a role's value: the inverse of the profile's scale."""
        return (value - bound.offset) / bound.scale

    def reading(self, bound: Bound) -> float | None:
        """Return the sensor's raw reading now; None where the plant has no such role."""
        if channel_of(bound.role) == "supply_v":
            return self.raw(bound, SUPPLY_V)
        return self.raw(bound, self.rig.sense(bound.role)) if bound.role in self.rig.index else None


def channel_of(role: str) -> str:
    """Return the channel of a role: without the axis."""
    return role.rpartition(".")[2]


class PtyDevice(VirtualDevice):
    """A device on a serial port of its own."""

    def __init__(self, binding: Binding, rig: Readings, port: str | Pty) -> None:
        super().__init__(binding, rig)
        self.pty = Pty(port) if isinstance(port, str) else port

    def plug(self) -> None:
        """Connect the device to its wire (again)."""
        self.pty.plug()

    def unplug(self) -> None:
        """Pull the cable."""
        self.pty.unplug()

    def descriptors(self) -> list[int]:
        """Return the descriptors to wait on for input."""
        return [self.pty.master] if self.pty.master >= 0 else []
