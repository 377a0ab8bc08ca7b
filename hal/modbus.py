"""Modbus devices, TCP and RTU: the only module that knows pymodbus (which renames its interface in minor releases).

Ports: "tcp:host:port" or "rtu:/dev/serial/by-id/...". Channels are registers; neighbours are read in one block. A value
of several words is put together by its word order (bytes inside a word are big-endian, by the protocol); sentinel
numbers, such as an open thermocouple's, make the channel an ERROR while the others stay OK.
"""

from __future__ import annotations

import logging
import math
import re
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import serial
from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from hal.backend import HardwareError, Sample
from hal.devices import Device
from hal.profile import FIELD_TYPES, Binding, Modbus, Register
from hal.serial_port import open_port

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal register address",
    3: "illegal value",
    4: "device failure",
    5: "acknowledge",
    6: "device busy",
    8: "memory parity",
    10: "gateway path",
    11: "gateway target silent",
}


@dataclass(frozen=True)
class Block:
    """Registers read by one request; `members` are (number of the bound channel, register)."""

    kind: str
    address: int
    count: int
    members: tuple[tuple[int, Register], ...]


def plan_blocks(registers: Sequence[Register], spec: Modbus) -> list[Block]:
    """The fewest requests: neighbours of one kind share a block over gaps <= max_gap, up to max_block registers."""
    blocks: list[Block] = []
    for i, r in sorted(enumerate(registers), key=lambda item: (item[1].kind, item[1].address)):
        last = blocks[-1] if blocks else None
        if (
            last
            and last.kind == r.kind
            and r.address - last.address - last.count <= spec.max_gap
            and r.address + r.words - last.address <= spec.max_block
        ):
            count = max(last.count, r.address + r.words - last.address)
            blocks[-1] = Block(r.kind, last.address, count, (*last.members, (i, r)))
        else:
            blocks.append(Block(r.kind, r.address, r.words, ((i, r),)))
    return blocks


def decode(words: Sequence[int], register: Register) -> float:
    """The raw number in `words` (uint16, as the wire has them)."""
    ordered = words if register.word_order == "big" else words[::-1]
    return float(
        struct.unpack(">" + FIELD_TYPES[register.type], struct.pack(f">{len(ordered)}H", *ordered))[0]
    )


class ModbusDevice(Device):
    """A register device, polled: `poll` reads every bound channel once and blocks up to the profile's timeout."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self._client: Any = None
        self._blocks = plan_blocks([b.channel.source for b in binding.bounds], binding.profile.bus_spec)
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what it would log, we raise

    def connect(self) -> None:
        """Open the connection or the serial port. Raises HardwareError."""
        spec: Modbus = self.binding.profile.bus_spec
        port, line = self.binding.port, self.binding.profile.line
        tcp = re.fullmatch(r"tcp:(\[[^]]+\]|[^:]+):(\d+)", port)
        try:
            if tcp:
                self._client = ModbusTcpClient(
                    tcp[1].strip("[]"), port=int(tcp[2]), timeout=spec.timeout_s, retries=0
                )
            elif port.startswith("rtu:"):
                open_port(port[4:], line, self.name).close()  # its message is better, and it sets the latency
                self._client = ModbusSerialClient(
                    port[4:],
                    baudrate=line.baud,
                    parity=line.parity,
                    stopbits=line.stop_bits,
                    timeout=spec.timeout_s,
                    retries=0,
                )
            else:
                raise HardwareError(f"{self.name}: port '{port}': tcp:host:port or rtu:/dev/... was expected")
            connected = self._client.connect()
        except (OSError, ModbusException, serial.SerialException) as e:
            raise HardwareError(f"{self.name}: {port}: cannot be opened ({e})") from None
        if not connected:
            self._client.close()
            raise HardwareError(f"{self.name}: {port}: nobody answers: check power, network and address")

    def disconnect(self) -> None:
        """Close the connection."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def poll(self, sample: Sample) -> None:
        """Read every block. A device that answers with an exception makes the block's channels ERROR; one that does not
        answer raises HardwareError."""
        for block in self._blocks:
            read = (
                self._client.read_input_registers
                if block.kind == "input"
                else self._client.read_holding_registers
            )
            try:
                answer = read(block.address, count=block.count, device_id=self.binding.address)
            except (ModbusException, OSError, serial.SerialException) as e:
                self.counts["errors"] += 1
                raise HardwareError(f"{self.name}: {self.binding.port}: no valid answer ({e})") from None
            now_s = time.monotonic()
            problem = ""
            if answer.isError():
                code = getattr(answer, "exception_code", 0)
                problem = f"answered exception {code} ({EXCEPTIONS.get(code, 'unknown')})"
            elif len(answer.registers) != block.count:
                problem = f"answered {len(answer.registers)} registers of {block.count}"
            if problem:
                self.counts["errors"] += 1
            else:
                self.counts["frames"] += 1
            for i, register in block.members:
                if problem:
                    self.fail(
                        sample,
                        i,
                        f"{problem} to {block.kind} registers {block.address}.."
                        f"{block.address + block.count - 1}: check the register map",
                    )
                    continue
                at = register.address - block.address
                raw = decode(answer.registers[at : at + register.words], register)
                if raw in register.sentinels or math.isnan(raw):
                    self.fail(sample, i, f"register {register.address} reads {raw:g}: open or missing sensor")
                else:
                    self.put(sample, i, raw, now_s)
