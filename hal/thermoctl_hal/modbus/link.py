"""Modbus connections: opened once for all the devices of a port, one request at a time.

Ports: "tcp:host:port" (Modbus TCP), "rtu:/dev/serial/by-id/..." (a serial line) and
"rtu:socket://host:port" (RTU frames over TCP, as serial device servers forward them).

    TCP     transaction id, 0, length (uint16 each), unit, PDU      the answer repeats id, unit and function
    RTU     unit, PDU, CRC                                          the answer repeats unit and function

Messages and frames are pymodbus'; no other module uses it. Its client gives up on bytes that real devices
send beside an answer, so connections are ours.

Bytes that arrived before a request, such as a late answer, are dropped. An answer on a serial line does not
name its register. So after a lost answer a unit is asked for an echo (function 8) first. Units answer in
order: everything before the echo is late. A server that closes the connection after an answer is connected
again for the next request. One that is silent after connecting gets more time at each connection, before the
first reading; a command never waits for that. On a serial line the echo of the request and bytes before the
answer are passed over. Behind the request of another master comes its answer, which may be to another
register: no answer is taken from there on.
"""

from __future__ import annotations

import os
import re
import select
import struct
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from thermoctl.extras import load
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.line import NETWORK, connected, open_port
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.base.wire import checksum

FUNCTIONS = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
"""Modbus function code that reads a kind."""
BITS = ("coil", "discrete")
WRITE_COIL, ECHO, WRITE_SEVERAL = 5, 8, 16  # ECHO: Return Query Data
ECHO_WAITS = 3  # time-outs in which the answer to ECHO is waited for
REFUSAL = 0x80  # bit of the function code of an exception
EXCEPTION_CODES = range(1, 12)
# Bytes of the shortest RTU frame; number of bytes of a bad answer that a message shows.
MIN_RTU, SHOWN = 4, 12
READ_SIZE = 8  # bytes of an RTU request for registers or bits
OTHERS_S = 0.1  # time in which a unit answers another master
HEAD, LONGEST_PDU = 7, 253  # bytes of a TCP frame before its PDU, and of the longest PDU
SETTLE_S = (0.0, 1.0, 3.0, 6.0, 10.0)
"""Pause between connecting and the first reading: one step more after each connection that gave no answer."""
GAP_CHARACTERS, GAP_MIN_S = 3.5, 1.75e-3  # silence between two RTU frames
LOOK_S = 0.005  # time between two looks whether another device has to be served
CHUNK = 4096
ATTEMPTS = 3  # largest number of times that a request is sent, if the server closes the connection
_HOST = r"(\[[^]]+\]|[^:/]+):(\d+)/?"
_PORT = re.compile(rf"(?:tcp:|(?P<rtu>rtu:{NETWORK})){_HOST}")


class NoAnswer(Exception):
    """No valid answer to a request: lost, cut short, wrong checksum, another unit."""


class _Closed(Exception):
    """The other end closed the connection."""


@dataclass(frozen=True)
class _Request:
    """A request: unit, PDU and the bytes of the frame; transaction id of TCP."""

    unit: int
    pdu: bytes
    frame: bytes
    transaction: int = 0

    @property
    def function(self) -> int:
        """Return the function code."""
        return self.pdu[0]


@dataclass
class _Echo:
    """Requests by function 8 to a unit, and all bytes that came since the first."""

    unit: int
    waits: int = 0
    frame: bytes = b""
    received: bytes = b""

    def next_frame(self, number: int) -> bytes:
        """Return the next request; its number distinguishes the answers."""
        self.frame = _with_crc(struct.pack(">BBHH", self.unit, ECHO, 0, number))
        return self.frame

    def is_answered(self, line_echoes: bool) -> bool:
        """Return whether the newest request was answered by the same frame, or one by an exception.

        line_echoes: the adapter sends our own bytes back, too."""
        exceptions = (_with_crc(bytes((self.unit, ECHO | REFUSAL, code))) for code in EXCEPTION_CODES)
        is_refused = any(e in self.received for e in exceptions)
        return is_refused or self.received.count(self.frame) > line_echoes


class Link:
    """An open port. `users` counts its devices; `broken`: to be opened again.

    `is_urgent` says that another device of the port must be served now: a reading is broken off then."""

    def __init__(self, port: str, line: LineSettings, timeout_s: float) -> None:
        self.port, self.line, self.users, self.broken = port, line, 0, False
        self._lock = threading.Lock()
        self.is_urgent: Callable[[], bool] = lambda: False
        self._transaction = 0
        self._echoes = False  # does the line send our own bytes back?
        self._answered = False
        self._free_s = 0.0  # time from which the next RTU frame may begin
        self._settled_s = 0.0  # time from which the first reading may begin
        self._lost: set[tuple[int, int]] = set()  # unit and function of reads without an answer in time
        self._late: dict[int, _Echo] = {}  # by unit: function 8 was sent, its answer is waited for
        self._is_rtu = port.startswith("rtu:")
        messages, framers = (load(f"pymodbus.{name}", port) for name in ("pdu", "framer"))
        self._invalid = load("pymodbus", port).ModbusException
        self._requests, self._answers = messages.DecodePDU(True), messages.DecodePDU(False)
        self._framer = (framers.FramerRTU if self._is_rtu else framers.FramerSocket)(self._answers)
        self._network = _PORT.fullmatch(port)
        if self._network is None and (not self._is_rtu or port.startswith(f"rtu:{NETWORK}")):
            raise HardwareError(
                f"port '{port}': tcp:host:port, rtu:/dev/... or rtu:socket://host:port was expected"
            )
        self._open(timeout_s)
        if self._network is not None:
            self._settled_s = self._free_s + SETTLE_S[_SILENT.get(port, 0)]

    def _open(self, timeout_s: float) -> None:
        """Open the port. Raises HardwareError."""
        if self._network is None:
            self._line = open_port(self.port[4:], self.line)
        else:
            self._line = connected(self.port, self._network[2], self._network[3], max(timeout_s, 1.0))
        self._free_s = time.monotonic()

    def close(self) -> None:
        """Close the port. A network port that never answered gets more time at its next opening."""
        if self._network is not None and not self._answered:
            _SILENT[self.port] = min(_SILENT.get(self.port, 0) + 1, len(SETTLE_S) - 1)
        self._line.close()

    def read(self, kind: str, address: int, count: int, unit: int, timeout_s: float) -> list[int] | int:
        """Return registers (uint16) or bits (0, 1), or the exception code that the unit answers with.

        Raises NoAnswer, or HardwareError when the link is gone."""
        size = -(-count // 8) if kind in BITS else 2 * count
        request = self._request(FUNCTIONS[kind], dev_id=unit, address=address, count=count)
        answer = self._ask(request, timeout_s)
        if answer[0] & REFUSAL:
            return answer[1]
        if answer[1] != size or len(answer) != 2 + size:
            raise NoAnswer(
                f"wrong length: {len(answer) - 2} bytes of data were answered, {size} were asked for: check 'type' and "
                "'max_block'"
            )
        try:
            decoded = self._answers.decode(answer)
        except (self._invalid, struct.error, IndexError) as e:
            raise NoAnswer(f"no valid answer: {answer[:SHOWN].hex(' ')} ({e})") from None
        return [int(b) for b in decoded.bits[:count]] if kind in BITS else list(decoded.registers)

    def write(self, function: int, address: int, words: list[int], unit: int, timeout_s: float) -> int:
        """Write a coil (5), a register (6) or registers (16); return 0, or the exception code.

        Raises NoAnswer, or HardwareError when the link is gone."""
        value = {"bits": [bool(words[0])]} if function == WRITE_COIL else {"registers": words}
        request = self._request(function, dev_id=unit, address=address, **value)
        answer = self._ask(request, timeout_s)
        if answer[0] & REFUSAL:
            return answer[1] or 4
        if answer != _pdu(request)[:5]:
            raise NoAnswer(f"another value was confirmed ({answer.hex(' ')}): check 'register' and 'type'")
        return 0

    def _request(self, function: int, **content: Any) -> Any:
        """Return pymodbus' request of a function code."""
        return self._requests.lookupPduClass(bytes((0, function)))(**content)

    def _ask(self, message: Any, timeout_s: float) -> bytes:
        """Return the PDU of the answer. Raises NoAnswer, or HardwareError when the link is gone."""
        with self._lock:
            if self.broken:
                raise HardwareError(f"{self.port}: the connection is gone")
            try:
                answer = self._ask_again(message, timeout_s)
            except HardwareError:  # no new connection could be made
                self.broken = True
                raise
            except OSError as e:
                self.broken = True
                self._line.close()
                raise HardwareError(f"{self.port}: the connection is gone ({e})") from None
            self._answered, self._settled_s = True, 0.0
            _SILENT.pop(self.port, None)
            return answer

    def _ask_again(self, message: Any, timeout_s: float) -> bytes:
        """Return the answer. If a server that answered before closes the connection, ask over a new one."""
        for left in reversed(range(ATTEMPTS)):
            try:
                return self._ask_once(message, timeout_s)
            except (_Closed, ConnectionError) as e:
                if self._network is None:
                    raise OSError("it was unplugged") from None
                if not left or not self._answered:
                    raise OSError(str(e) or "the server closes it without an answer") from None
            self._line.close()
            self._open(timeout_s)
        raise AssertionError("the last attempt raises")

    def _ask_once(self, message: Any, timeout_s: float) -> bytes:
        """Send a request and wait for its answer. Raises NoAnswer, _Closed, OSError."""
        self._transaction = message.transaction_id = self._transaction % 0xFFFF + 1
        frame = self._framer.buildFrame(message)
        request = _Request(message.dev_id, _pdu(message), frame, self._transaction)
        key = request.unit, request.function
        if key in self._lost:
            self._catch_up(request, timeout_s)
        self._settle(request)
        time.sleep(max(0.0, self._free_s - time.monotonic()))
        self._drop()
        end = time.monotonic() + timeout_s
        self._send(request.frame, end)
        received = b""
        while self._arrives(request, end):
            received += self._take()
            answer = self._found_rtu(received, request) if self._is_rtu else _found_tcp(received, request)
            if answer is not None:
                self._rest()
                return answer
        self._rest()
        if self._is_rtu and request.function in FUNCTIONS.values():
            self._lost.add(key)
        raise NoAnswer(self._why(received, request, timeout_s))

    def _settle(self, request: _Request) -> None:
        """Wait before the first reading from a silent server. Raises NoAnswer when it `is_urgent`."""
        while request.function in FUNCTIONS.values() and time.monotonic() < self._settled_s:
            if self.is_urgent():
                raise NoAnswer("broken off: another device is served, or the program ends")
            time.sleep(LOOK_S)

    def _arrives(self, request: _Request, end_s: float) -> bool:
        """Wait for bytes until `end_s`; a reading waits no longer when it `is_urgent`."""
        is_reading = request.function in FUNCTIONS.values()
        while (left := end_s - time.monotonic()) > 0.0 and not (is_reading and self.is_urgent()):
            if select.select([self._line], [], [], min(left, LOOK_S))[0]:
                return True
        return False

    def _rest(self) -> None:
        """Keep the silence that must follow an RTU frame."""
        characters = GAP_CHARACTERS * (2 + self.line.data_bits + self.line.stop_bits) / self.line.baud
        self._free_s = time.monotonic() + (max(GAP_MIN_S, characters) if self._is_rtu else 0.0)

    def _drop(self) -> None:
        """Drop the bytes that came before this request, and the answer to another master.

        It takes OTHERS_S at most: a command that disables must go out beside a master that never stops.
        Raises _Closed, OSError."""
        last, end = b"", time.monotonic() + OTHERS_S
        while (left := end - time.monotonic()) > 0.0:
            if not select.select([self._line], [], [], left if self._is_rtu and _is_read(last) else 0.0)[0]:
                return
            last = (last + self._take())[-READ_SIZE:]

    def _catch_up(self, request: _Request, timeout_s: float) -> None:
        """Send function 8 and wait for its answer; everything before that is late and dropped.

        A unit is asked for registers again after ECHO_WAITS times without one: it may not know function 8.
        Raises NoAnswer, _Closed, OSError."""
        unit, end = request.unit, time.monotonic() + timeout_s
        time.sleep(max(0.0, self._free_s - time.monotonic()))
        self._drop()
        if (unit, request.function) not in self._lost:
            return
        echo = self._late.setdefault(unit, _Echo(unit))
        echo.waits += 1
        if self._found_rtu(echo.received, request) is None:  # else it is at work, and slow
            self._send(echo.next_frame(request.transaction), end)
        while unit in self._late and self._arrives(request, end):
            self._take()
        self._rest()
        if unit not in self._late:
            return
        if echo.waits == ECHO_WAITS:
            self._caught_up(unit)
        raise NoAnswer(self._why(b"", request, timeout_s))

    def _caught_up(self, unit: int) -> None:
        del self._late[unit]
        self._lost = {key for key in self._lost if key[0] != unit}

    def _take(self) -> bytes:
        try:
            data = os.read(self._line.fileno(), CHUNK)
        except BlockingIOError:
            return b""
        if not data:
            raise _Closed
        for unit, echo in list(self._late.items()):  # answers to function 8, whichever unit is asked now
            echo.received = (echo.received + data)[-CHUNK:]
            if echo.is_answered(self._echoes):
                self._caught_up(unit)
        return data

    def _send(self, data: bytes, end_s: float) -> None:
        while data:
            left = end_s - time.monotonic()
            if left <= 0.0 or not select.select([], [self._line], [], left)[1]:
                raise NoAnswer("the line takes no bytes: check its adapter, or the network")
            data = data[os.write(self._line.fileno(), data) :]

    def _found_rtu(self, received: bytes, request: _Request) -> bytes | None:
        """Return the answer's PDU, if it is there: behind the echo of the request, zeros and other bytes."""
        at = 0
        is_write = request.function in (WRITE_COIL, 6)
        if received.startswith(request.frame) and (not is_write or self._echoes):
            at = len(request.frame)
            self._echoes = True
        for begin in range(at, len(received) - MIN_RTU):
            if _is_of_another(received[begin : begin + READ_SIZE], request):
                return None  # its answer is next
            if received[begin] != request.unit:
                continue
            size = _rtu_size(received[begin:], request)
            frame = received[begin : begin + size]
            if size and len(frame) == size and _has_good_crc(frame):
                return frame[1:-2]
        return None

    def _why(self, data: bytes, request: _Request, timeout_s: float) -> str:
        """Say what came instead of the answer, and which key of the profile may be wrong."""
        if self._is_rtu and data.startswith(request.frame):
            data = data[len(request.frame) :]
            if not data:
                return f"only the echo of the request came back: check wiring and address {request.unit}"
        if not data:
            return (
                f"no answer within {timeout_s:g} s: check power, wiring, address {request.unit} and the line's "
                "settings; a slow device needs a longer 'timeout_s', one that is mute at gaps max_gap: 0"
            )
        more = " .." if len(data) > SHOWN else ""
        text = f"no valid answer: {len(data)} bytes came ({data[:SHOWN].hex(' ')}{more})"
        if not self._is_rtu:
            return f"{text}: {_wrong_tcp(data, request)}"
        frames = (data[i : i + READ_SIZE] for i in range(len(data)))
        other = next((f for f in frames if _is_of_another(f, request)), None)
        if other is not None:
            return (
                f"another master asks unit {other[0]} on this line ({other.hex(' ')}): a line has one master"
            )
        data = data.lstrip(b"\0") if request.unit else data
        if len(data) < MIN_RTU or not _has_good_crc(data):
            return f"{text} with a wrong CRC, or cut short: check the baud rate, parity, termination and other masters"
        if data[0] != request.unit:
            return f"{text} of unit {data[0]}, unit {request.unit} was asked: check 'address'"
        if data[1] & ~REFUSAL != request.function:
            return f"{text} with function {data[1]}, {request.function} was asked for: check 'kind'"
        return f"{text} of a wrong length: check 'type' and 'max_block'"


def _pdu(message: Any) -> bytes:
    return bytes((message.function_code,)) + message.encode()


def _rtu_size(data: bytes, request: _Request) -> int:
    """Return the bytes of the RTU answer at the beginning of `data`, 0 where it is none to this request."""
    if data[1] == request.function | REFUSAL:
        return 5
    if data[1] != request.function:
        return 0
    return 8 if request.function in (WRITE_COIL, 6, WRITE_SEVERAL) else 5 + data[2]


def _is_read(frame: bytes) -> bool:
    """Return whether a frame asks a unit for registers or bits.

    An answer with three bytes of bits is as long."""
    if len(frame) != READ_SIZE or frame[1] not in FUNCTIONS.values() or not _has_good_crc(frame):
        return False
    return frame[2] != READ_SIZE - 5 or frame[1] not in (FUNCTIONS[kind] for kind in BITS)


def _is_of_another(frame: bytes, request: _Request) -> bool:
    """Return whether another master sent this frame."""
    return frame != request.frame and _is_read(frame)


def _with_crc(body: bytes) -> bytes:
    return body + checksum("modbus", body).to_bytes(2, "little")


def _has_good_crc(frame: bytes) -> bool:
    return checksum("modbus", frame[:-2]) == int.from_bytes(frame[-2:], "little")


def _frames(data: bytes) -> tuple[list[tuple[int, int, int, bytes]], bytes]:
    """Return the TCP frames of `data` as (transaction, protocol, unit, PDU), and the bytes behind them."""
    frames = []
    while len(data) > HEAD:
        transaction, protocol, length, unit = struct.unpack_from(">HHHB", data)
        if protocol or not 2 <= length <= LONGEST_PDU + 1 or len(data) < HEAD - 1 + length:
            break
        frames.append((transaction, protocol, unit, data[HEAD : HEAD - 1 + length]))
        data = data[HEAD - 1 + length :]
    return frames, data


def _found_tcp(received: bytes, request: _Request) -> bytes | None:
    """Return the PDU of the answer that repeats transaction, unit and function, if it is there."""
    for transaction, _, unit, pdu in _frames(received)[0]:
        same = transaction == request.transaction and unit == request.unit
        if same and pdu[0] & ~REFUSAL == request.function and len(pdu) > 1:
            return pdu
    return None


def _wrong_tcp(data: bytes, request: _Request) -> str:
    """Say what is wrong with TCP bytes that are no answer."""
    frames, rest = _frames(data)
    if not frames:
        if len(rest) > HEAD and rest[2:4] == b"\0\0" and struct.unpack(">H", rest[4:6])[0] > len(rest) - 6:
            return f"wrong length: {struct.unpack('>H', rest[4:6])[0]} bytes are announced, {len(rest) - 6} came: cut short"
        return "cut short, or no Modbus TCP; RTU frames over TCP are port: rtu:socket://host:port"
    transaction, _, unit, pdu = frames[-1]
    if transaction != request.transaction:
        return (
            f"transaction id {transaction}, {request.transaction} was asked: an answer to an earlier request (raise "
            "'timeout_s'), or a gateway that does not repeat it (port: rtu:socket://host:port, if it forwards RTU)"
        )
    if unit != request.unit:
        return f"unit {unit}, unit {request.unit} was asked: address: {unit}"
    if pdu[0] & ~REFUSAL != request.function:
        return f"function {pdu[0]}, {request.function} was asked: check 'kind'"
    return f"wrong length: {len(pdu)} bytes of function {pdu[0]}"


_LINKS: dict[str, Link] = {}
_SILENT: dict[str, int] = {}  # network port -> connections in a row that gave no answer
_LOCKS: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)  # a dead port delays no other one


def join(port: str, line: LineSettings, timeout_s: float) -> Link:
    """Return the link of this port, opened by its first user. Raises HardwareError."""
    with _LOCKS[port]:
        link = _LINKS.get(port)
        if link is None or link.broken:
            link = _LINKS[port] = Link(port, line, timeout_s)
        link.users += 1
        return link


def leave(link: Link) -> None:
    """End the use of a link; its last user closes it."""
    with _LOCKS[link.port]:
        link.users -= 1
        if link.users <= 0:
            link.close()
            if _LINKS.get(link.port) is link:
                del _LINKS[link.port]
