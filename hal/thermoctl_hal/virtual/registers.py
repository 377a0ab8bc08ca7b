"""The virtual register device: a Modbus unit over TCP or RTU, fed by the plant."""

from __future__ import annotations

import contextlib
import re
import socket

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.profile import Register, typed
from thermoctl_hal.virtual.device import PtyDevice, channel_of
from thermoctl_hal.virtual.modbus import ModbusUnit
from thermoctl_hal.virtual.plants import Readings

MEANS = ("voltage_v", "current_a")  # roles whose register holds the mean since its last refresh
MAX_EXCEPTION = 11  # largest exception code of Modbus
MAX_REQUEST = 1024  # bytes: longest input read at once (TCP) or kept in the buffer (RTU)


class ModbusOnWire(PtyDevice):
    """A register device over TCP or RTU. Voltage and current are means since the last refresh."""

    def __init__(self, binding: Binding, rig: Readings) -> None:
        super().__init__(binding, rig, binding.port.removeprefix("rtu:"))
        self.unit = ModbusUnit(binding.address)
        tcp = re.fullmatch(r"tcp:(.+):(\d+)", binding.port)
        self._address = (tcp[1].strip("[]"), int(tcp[2])) if tcp else None
        self._server: socket.socket | None = None
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        self._buffer = bytearray()
        self._open: set[str] = set()
        self._sums = [0.0] * len(binding.bounds)
        self._summed = 0
        self._every = max(
            1, round(1 / (max(b.channel.rate_hz for b in binding.bounds) * rig.stepper.period_s))
        )
        self.verbs = {v: self.flag(self.unit, v) for v in ("silent", "half", "corrupt")}
        self.verbs |= {"exception": self._exception, "open": self._open_sensor, "close": self._close_sensor}
        self._refresh()

    def _exception(self, argument: str) -> None:
        if not argument.isdigit() or int(argument) > MAX_EXCEPTION:
            raise InputError(
                f"exception: a code 1..{MAX_EXCEPTION}, or 0 for none, was expected, found '{argument}'"
            )
        self.unit.exception = int(argument)

    def _channel(self, argument: str) -> str:
        names = [b.channel.name for b in self.binding.bounds]
        if argument not in names:
            raise InputError(f"no channel '{argument}'{suggest(argument, names)}; bound: {', '.join(names)}")
        return argument

    def _open_sensor(self, argument: str) -> None:
        self._open.add(self._channel(argument))
        self._refresh()

    def _close_sensor(self, argument: str) -> None:
        self._open.discard(self._channel(argument))
        self._refresh()

    def plug(self) -> None:
        """Connect the device to its wire (again)."""
        if self._address is None:
            super().plug()
        elif self._server is None:
            self._server = socket.create_server(
                self._address, family=socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
            )
            self._server.setblocking(False)

    def unplug(self) -> None:
        """Pull the cable."""
        super().unplug()
        for client, _ in self._clients.values():
            client.close()
        self._clients.clear()
        if self._server is not None:
            self._server.close()
            self._server = None

    def descriptors(self) -> list[int]:
        """Return the descriptors to wait on for input."""
        if self._server is not None:
            return [self._server.fileno(), *self._clients]
        return super().descriptors()

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer the input on `descriptor`."""
        if descriptor == self.pty.master:
            self._buffer += self.pty.receive()
            del self._buffer[:-MAX_REQUEST]
            if answer := self.unit.feed_rtu(self._buffer):
                self.pty.send(answer)
        elif self._server is not None and descriptor == self._server.fileno():
            self._accept(self._server)
        elif descriptor in self._clients:
            self._answer(descriptor)

    def _accept(self, server: socket.socket) -> None:
        with contextlib.suppress(OSError):
            client, _ = server.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client.fileno()] = (client, bytearray())

    def _answer(self, descriptor: int) -> None:
        client, buffer = self._clients[descriptor]
        try:
            data = client.recv(MAX_REQUEST)
            buffer += data
            if answer := self.unit.feed_tcp(buffer):
                client.send(answer)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            client.close()
            del self._clients[descriptor]

    def tick(self, now_s: float, tick: int) -> None:
        """Add to the means, and refresh the registers when they are due."""
        for i, b in enumerate(self.binding.bounds):
            if channel_of(b.role) in MEANS and b.role in self.rig.index:
                self._sums[i] += self.rig.true(b.role)
        self._summed += 1
        if self._summed >= self._every:
            self._refresh()

    def _refresh(self) -> None:
        for i, b in enumerate(self.binding.bounds):
            register = typed(b.channel.source, Register)
            if b.channel.name in self._open and register.sentinels:
                raw: float | None = register.sentinels[0]
            elif channel_of(b.role) in MEANS and b.role in self.rig.index and self._summed:
                mean = self._sums[i] / self._summed
                raw = self.raw(b, self.rig.measured(self.rig.index[b.role], mean))
            else:
                raw = self.reading(b)
            self.unit.store(register, raw or 0.0)
            self._sums[i] = 0.0
        self._summed = 0
