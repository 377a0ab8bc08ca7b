"""Modbus devices, TCP and RTU.

No other module uses pymodbus, which renames its interface in minor releases.

Ports: "tcp:host:port" or "rtu:/dev/serial/by-id/...". Channels are registers; neighbours are read in one
block. The profile gives the word order of a value of several words; bytes inside a word are big-endian, by
the protocol. Sentinel numbers, such as an open thermocouple's, make the channel an ERROR while the others
stay OK. After a lost or damaged answer, or while the device is busy, the last values are kept. A refused
block is read register by register, so that one illegal address does not invalidate its neighbours.
"""

from __future__ import annotations

import logging
import math
import re
import struct
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import serial
from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException

from hal.backend import HardwareError, Sample
from hal.binding import Binding, register_hint
from hal.device import Device
from hal.profile import FIELD_TYPES, Modbus, Register, typed
from hal.serial_port import open_port
from hal.wire import crc16

EXCEPTIONS = {
    1: ("illegal function", "try the other 'kind' (input, holding)"),
    2: ("illegal register address", "check 'register' and 'kind'; addresses count from 0"),
    3: ("illegal value", "it may not give so many registers at once: lower 'max_block'"),
    4: ("device failure", "the device reports a failure of its own: check it and its sensors"),
    5: ("acknowledge", "it is still at work on an earlier request: lower 'rate_hz'"),
    6: ("device busy", "another master may be asking it, or we ask too often: lower 'rate_hz'"),
    8: ("memory parity error", "the device's memory is damaged: restart it"),
    10: (
        "gateway path unavailable",
        "the gateway has no line for this unit: check its configuration and 'address'",
    ),
    11: (
        "gateway target silent",
        "no unit of this address answers behind the gateway: check 'address', power and line",
    ),
}
"""Modbus exception codes: the text, and what to do."""
BUSY, PASSING = (5, 6), (5, 6, 10, 11)  # requests repeated at once; never an ERROR of the channel itself
ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3
REFUSED = (ILLEGAL_ADDRESS, ILLEGAL_VALUE)  # one register may be the cause: the block is read one by one
FUNCTIONS = {"holding": 3, "input": 4}  # Modbus function code of a kind of register
MIN_FRAME, SHOWN = 4, 12  # bytes: the shortest RTU frame; the first bytes of a bad answer in a message
BUSY_TRIES, BUSY_PAUSE_S = 3, 0.02
LOST_POLLS = 3  # polls without any answer, after which the link is opened again


class NoAnswer(Exception):
    """No valid answer to a request: lost, cut short, wrong checksum, another unit."""


@dataclass(frozen=True)
class Block:
    """Registers read by one request; `members` are (number of the bound channel, register)."""

    kind: str
    address: int
    count: int
    members: tuple[tuple[int, Register], ...]


def plan_blocks(registers: Iterable[tuple[int, Register]], max_gap: int, max_block: int) -> list[Block]:
    """Plan the fewest requests for (number of the channel, register).

    Registers of one kind share a block of up to max_block registers over gaps <= max_gap."""
    blocks: list[Block] = []
    for i, r in sorted(registers, key=lambda item: (item[1].kind, item[1].address)):
        last = blocks[-1] if blocks else None
        if (
            last
            and last.kind == r.kind
            and r.address - last.address - last.count <= max_gap
            and r.address + r.words - last.address <= max_block
        ):
            count = max(last.count, r.address + r.words - last.address)
            blocks[-1] = Block(r.kind, last.address, count, (*last.members, (i, r)))
        else:
            blocks.append(Block(r.kind, r.address, r.words, ((i, r),)))
    return blocks


def decode(words: Sequence[int], register: Register) -> float:
    """Return the raw number in `words` (uint16, in the order of the wire)."""
    ordered = words if register.word_order == "big" else words[::-1]
    data = struct.pack(f">{len(ordered)}H", *ordered)
    return float(struct.unpack(">" + FIELD_TYPES[register.type], data)[0])


class ModbusDevice(Device):
    """A register device; `poll` reads every bound channel and blocks up to the profile's timeout."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self.counts["lost"] = 0
        self._client: Any = None
        self._spec = typed(binding.profile.bus_spec, Modbus)
        self._plan()
        self._lost_polls = 0
        self._received = b""  # after the last request
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # our errors say the same

    def _plan(self) -> None:
        registers = [typed(b.channel.source, Register) for b in self.binding.bounds]
        self._blocks = plan_blocks(enumerate(registers), self._spec.max_gap, self._spec.max_block)

    def connect(self) -> None:
        """Open the connection or the serial port. Raises HardwareError."""
        port, line = self.binding.port, self.binding.profile.line
        tcp = re.fullmatch(r"tcp:(\[[^]]+\]|[^:]+):(\d+)", port)
        common: dict[str, Any] = {"timeout": self._spec.timeout_s, "retries": 0, "trace_packet": self._trace}
        try:
            if tcp:
                self._client = ModbusTcpClient(tcp[1].strip("[]"), port=int(tcp[2]), **common)
            elif port.startswith("rtu:"):
                open_port(port[4:], line).close()  # its errors give the remedy, and it sets the latency timer
                self._client = ModbusSerialClient(
                    port[4:], baudrate=line.baud, parity=line.parity, stopbits=line.stop_bits, **common
                )
            else:
                raise HardwareError(f"port '{port}': tcp:host:port or rtu:/dev/... was expected")
            connected = self._client.connect()
        except (OSError, ModbusException, serial.SerialException) as e:
            raise HardwareError(f"{port}: cannot be opened ({e})") from None
        if not connected:
            self._client.close()
            raise HardwareError(f"{port}: nobody answers: check power, network and address")
        self._lost_polls = 0
        self._plan()

    def disconnect(self) -> None:
        """Close the connection."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def poll(self, sample: Sample) -> None:
        """Read every block.

        A lost answer ends this poll, because a late answer must not be taken for the next block's; the last
        values are kept. Raises HardwareError when the link is gone or LOST_POLLS polls in a row had no
        answer."""
        for block in list(self._blocks):
            try:
                self._read(sample, block)
                self._lost_polls = 0
            except NoAnswer as e:
                self.counts["lost"] += 1
                self._lost_polls += 1
                for i, _ in block.members:
                    self.miss(i, f"{self._named(block)}: {e}")
                if self._lost_polls >= LOST_POLLS:
                    raise HardwareError(f"{self.binding.port}: {self._named(block)}: {e}") from None
                at = self._blocks.index(block) + 1  # the next poll starts after this block
                self._blocks = self._blocks[at:] + self._blocks[:at]
                return

    def silence(self) -> str:
        """Report that the poller has posted no reading and no problem yet."""
        return "its poller has posted nothing"

    def _read(self, sample: Sample, block: Block) -> None:
        answer = self._request(block)
        if isinstance(answer, list):
            self._store(sample, block, answer)
        elif answer in REFUSED and (len(block.members) > 1 or block.count > block.members[0][1].words):
            self._read_singly(sample, block)
        else:
            self._refused(sample, block, answer)

    def _read_singly(self, sample: Sample, block: Block) -> None:
        """Read a refused block's registers one by one.

        From now on ask for the refused registers apart, and for the others without the gaps between them."""
        refused: list[Block] = []
        for member in block.members:
            single = Block(block.kind, member[1].address, member[1].words, (member,))
            answer = self._request(single)
            if isinstance(answer, list):
                self._store(sample, single, answer)
            else:
                refused.append(single)
                self._refused(sample, single, answer)
        bad = {i for b in refused for i, _ in b.members}
        good = plan_blocks((m for m in block.members if m[0] not in bad), 0, self._spec.max_block)
        at = self._blocks.index(block)
        self._blocks[at : at + 1] = [*good, *refused]

    def _request(self, block: Block) -> list[int] | int:
        """Return the register values of a block, or the Modbus exception code that the unit answers with.

        Raises NoAnswer, or HardwareError when the link is gone."""
        client, code = self._client, 0
        read = client.read_input_registers if block.kind == "input" else client.read_holding_registers
        for _ in range(BUSY_TRIES):
            self._received = b""
            try:
                answer = read(block.address, count=block.count, device_id=self.binding.address)
            except (ConnectionException, OSError, serial.SerialException) as e:
                self.counts["lost"] += 1
                raise HardwareError(f"{self.binding.port}: the connection is gone ({e})") from None
            except Exception:  # foreign bytes may raise anything in the library
                raise NoAnswer(self._bad_answer()) from None
            if not answer.isError():
                break
            self.counts["errors"] += 1
            code = int(getattr(answer, "exception_code", 0))
            if code not in BUSY:
                return code
            time.sleep(BUSY_PAUSE_S)
        else:
            return code
        words = getattr(answer, "registers", None)
        if answer.function_code != FUNCTIONS[block.kind] or words is None:
            raise NoAnswer(
                f"function {answer.function_code} was answered, {block.kind} registers were asked for"
            )
        if len(words) != block.count:
            raise NoAnswer(f"{len(words)} registers were answered, {block.count} were asked for")
        self.counts["frames"] += 1
        return list(words)

    def _trace(self, sending: bool, data: bytes) -> bytes:
        if not sending:
            self._received = data
        return data

    def _bad_answer(self) -> str:
        data, unit, timeout_s = self._received, self.binding.address, self._spec.timeout_s
        if not data:
            return f"no answer within {timeout_s:g} s: check power, wiring, address {unit} and the line's settings"
        more = " .." if len(data) > SHOWN else ""
        text = f"no valid answer: {len(data)} bytes came ({data[:SHOWN].hex(' ')}{more})"
        if not self.binding.port.startswith("rtu:"):
            return f"{text}: cut short, or no Modbus TCP"
        if len(data) < MIN_FRAME or crc16("modbus", data[:-2]) != int.from_bytes(data[-2:], "little"):
            return f"{text} with a wrong CRC, or cut short: check the baud rate, parity, termination and other masters"
        return f"{text} of unit {data[0]}, unit {unit} was asked: check 'address'"

    def _store(self, sample: Sample, block: Block, words: list[int]) -> None:
        now_s = time.monotonic()
        for i, register in block.members:
            at = register.address - block.address
            raw = decode(words[at : at + register.words], register)
            if raw in register.sentinels or math.isnan(raw):
                self.fail(sample, i, f"register {register.address} reads {raw:g}: open or missing sensor")
            else:
                self.put(sample, i, raw, now_s)

    def _refused(self, sample: Sample, block: Block, code: int) -> None:
        """Note the exception of an answer; it becomes the channel's ERROR when the last reading is stale."""
        name, remedy = EXCEPTIONS.get(code, ("unknown", "see the device's manual"))
        now_s = time.monotonic()
        for i, register in block.members:
            hint = register_hint(register.address) if code == ILLEGAL_ADDRESS else ""
            text = f"{self._named(block)}: exception {code} ({name}): {remedy}{'; ' if hint else ''}{hint}"
            stale_s = self.binding.bounds[i].channel.stale_after_s
            if code not in PASSING and now_s - sample.time_s[self.roles[i]] > stale_s:
                self.fail(sample, i, text)
            else:
                self.miss(i, text)

    @staticmethod
    def _named(block: Block) -> str:
        if len(block.members) == 1:
            return f"{block.kind} register {block.address}"
        return f"{block.kind} registers {block.address}..{block.address + block.count - 1}"
