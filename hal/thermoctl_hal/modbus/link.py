"""Modbus connections: opened once for all the devices of a port, one request at a time.

No other module uses pymodbus, which renames its interface in minor releases.

Ports: "tcp:host:port" (Modbus TCP), "rtu:/dev/serial/by-id/..." (a serial line) and "rtu:socket://host:port"
(RTU frames over TCP, as serial device servers forward them).
"""

from __future__ import annotations

import logging
import re
import threading
from typing import Any

import serial
from pymodbus import FramerType, ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException

from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.base.wire import checksum
from thermoctl_hal.serial.line import NETWORK, open_port

FUNCTIONS = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
"""Modbus function code that reads a kind."""
MIN_FRAME, SHOWN = 4, 12  # bytes: the shortest RTU frame; the first bytes of a bad answer in a message
_HOST = r"(\[[^]]+\]|[^:/]+):(\d+)/?"
_PORT = re.compile(rf"(?:tcp:|(?P<rtu>rtu:{NETWORK})){_HOST}")
_METHODS = {
    "coil": "read_coils",
    "discrete": "read_discrete_inputs",
    "holding": "read_holding_registers",
    "input": "read_input_registers",
}

WRITE_COIL, WRITE_SEVERAL = 5, 16
_WRITERS = {WRITE_COIL: "write_coil", 6: "write_register", WRITE_SEVERAL: "write_registers"}


class NoAnswer(Exception):
    """No valid answer to a request: lost, cut short, wrong checksum, another unit."""


class Link:
    """An open port. `users` counts its devices; `broken`: to be opened again."""

    def __init__(self, port: str, line: LineSettings, timeout_s: float) -> None:
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # our errors say the same
        self.port, self.line, self.users, self.broken = port, line, 0, False
        self._received = b""  # after the last request
        self._lock = threading.Lock()
        common: dict[str, Any] = {"timeout": timeout_s, "retries": 0, "trace_packet": self._trace}
        network = _PORT.fullmatch(port)
        self._is_rtu = port.startswith("rtu:")
        self.client: Any
        try:
            if network:
                framer = FramerType.RTU if self._is_rtu else FramerType.SOCKET
                self.client = ModbusTcpClient(
                    network[2].strip("[]"), port=int(network[3]), framer=framer, **common
                )
            elif self._is_rtu and not port.startswith(f"rtu:{NETWORK}"):
                open_port(port[4:], line).close()  # its errors give the remedy, and it sets the latency timer
                self.client = ModbusSerialClient(
                    port[4:],
                    baudrate=line.baud,
                    bytesize=line.data_bits,
                    parity=line.parity,
                    stopbits=line.stop_bits,
                    **common,
                )
            else:
                raise HardwareError(
                    f"port '{port}': tcp:host:port, rtu:/dev/... or rtu:socket://host:port was expected"
                )
            connected = self.client.connect()
        except (OSError, ModbusException, serial.SerialException) as e:
            raise HardwareError(f"{port}: cannot be opened ({e})") from None
        if not connected:
            self.client.close()
            raise HardwareError(f"{port}: nobody answers: check power, network and address")

    def close(self) -> None:
        """Close the port."""
        self.client.close()

    def read(self, kind: str, address: int, count: int, unit: int, timeout_s: float) -> list[int] | int:
        """Return registers (uint16) or bits (0, 1), or the exception code that the unit answers with.

        Raises NoAnswer, or HardwareError when the link is gone."""
        with self._lock:
            answer = self._ask(_METHODS[kind], address, {"count": count}, unit, timeout_s)
        if answer.isError():
            return int(getattr(answer, "exception_code", 0))
        if kind in ("coil", "discrete"):
            found = [int(b) for b in getattr(answer, "bits", None) or ()]
            values = found[:count] if len(found) == -(-count // 8) * 8 else found
        else:
            values = list(getattr(answer, "registers", None) or ())
        if answer.function_code != FUNCTIONS[kind]:
            raise NoAnswer(f"function {answer.function_code} was answered, {kind} registers were asked for")
        if len(values) != count:
            raise NoAnswer(f"{len(values)} registers were answered, {count} were asked for")
        return values

    def write(self, function: int, address: int, words: list[int], unit: int, timeout_s: float) -> int:
        """Write a coil (5), a register (6) or registers (16); return 0, or the exception code.

        Raises NoAnswer, or HardwareError when the link is gone."""
        method, what = _WRITERS[function], words if function == WRITE_SEVERAL else words[0]
        key = {5: "value", 6: "value", WRITE_SEVERAL: "values"}[function]
        with self._lock:
            answer = self._ask(
                method, address, {key: bool(what) if function == WRITE_COIL else what}, unit, timeout_s
            )
        if answer.isError():
            return int(getattr(answer, "exception_code", 0)) or 4
        if answer.function_code != function:
            raise NoAnswer(f"function {answer.function_code} was answered, {function} was asked for")
        return 0

    def _ask(self, method: str, address: int, what: dict[str, Any], unit: int, timeout_s: float) -> Any:
        if self.broken:  # pymodbus would open the port again, beside the link that replaces this one
            raise HardwareError(f"{self.port}: the connection is gone")
        self._received = b""
        self.client.comm_params.timeout_connect = timeout_s
        try:
            return getattr(self.client, method)(address, **what, device_id=unit)
        except (ConnectionException, OSError, serial.SerialException) as e:
            self.broken = True
            self.client.close()
            raise HardwareError(f"{self.port}: the connection is gone ({e})") from None
        except Exception:  # foreign bytes may raise anything in the library
            raise NoAnswer(self._bad_answer(unit, timeout_s)) from None

    def _trace(self, sending: bool, data: bytes) -> bytes:
        if not sending:
            self._received = data
        return data

    def _bad_answer(self, unit: int, timeout_s: float) -> str:
        data = self._received
        if not data:
            return f"no answer within {timeout_s:g} s: check power, wiring, address {unit} and the line's settings"
        more = " .." if len(data) > SHOWN else ""
        text = f"no valid answer: {len(data)} bytes came ({data[:SHOWN].hex(' ')}{more})"
        if not self._is_rtu:
            return f"{text}: cut short, or no Modbus TCP"
        if len(data) < MIN_FRAME or checksum("modbus", data[:-2]) != int.from_bytes(data[-2:], "little"):
            return f"{text} with a wrong CRC, or cut short: check the baud rate, parity, termination and other masters"
        return f"{text} of unit {data[0]}, unit {unit} was asked: check 'address'"


_LINKS: dict[str, Link] = {}
_LOCK = threading.Lock()


def join(port: str, line: LineSettings, timeout_s: float) -> Link:
    """Return the link of this port, opened by its first user. Raises HardwareError."""
    with _LOCK:
        link = _LINKS.get(port)
        if link is None or link.broken:
            link = _LINKS[port] = Link(port, line, timeout_s)
        link.users += 1
        return link


def leave(link: Link) -> None:
    """End the use of a link; its last user closes it."""
    with _LOCK:
        link.users -= 1
        if link.users <= 0:
            link.close()
            if _LINKS.get(link.port) is link:
                del _LINKS[link.port]
