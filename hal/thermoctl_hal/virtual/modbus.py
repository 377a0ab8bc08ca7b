"""A Modbus device as bytes on a wire: TCP and RTU framing, functions 3 and 4, exceptions.

Pure: bytes in, bytes out.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

from thermoctl_hal.base.message import clipped
from thermoctl_hal.base.profile import REGISTER_TYPES, Register
from thermoctl_hal.base.wire import checksum

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4


def encode(value: float, register: Register) -> list[int]:
    """Return the words of a raw number; whole types are rounded and clipped to their range."""
    letter, value = REGISTER_TYPES[register.type], clipped(value, register)
    packed = struct.pack(">" + letter, value if letter in "fd" else int(value))
    words = list(struct.unpack(f">{len(packed) // 2}H", packed))
    return words if register.word_order == "big" else words[::-1]


@dataclass
class ModbusUnit:
    """One unit: `registers[kind]` maps address to word.

    Injected faults: `exception` (answer every request with this code), `silent`, `half` (send half of the
    answer), `corrupt` (RTU: a wrong CRC)."""

    unit_id: int
    registers: dict[str, dict[int, int]] = field(default_factory=lambda: {"input": {}, "holding": {}})
    exception: int = 0
    silent: bool = False
    half: bool = False
    corrupt: bool = False

    def store(self, register: Register, raw: float) -> None:
        """Put a raw number into its registers."""
        for i, word in enumerate(encode(raw, register)):
            self.registers[register.kind][register.address + i] = word

    def answer(self, request: bytes) -> bytes:
        """Return the answer PDU to a request PDU (function code first)."""
        function = request[0]
        if self.exception:
            return bytes((function | 0x80, self.exception))
        if function not in (3, 4):
            return bytes((function | 0x80, ILLEGAL_FUNCTION))
        if len(request) != 5:
            return bytes((function | 0x80, ILLEGAL_VALUE))
        address, count = struct.unpack(">HH", request[1:])
        if not 1 <= count <= 125:
            return bytes((function | 0x80, ILLEGAL_VALUE))
        bank = self.registers["holding" if function == 3 else "input"]
        words: Sequence[int] = [bank.get(a, -1) for a in range(address, address + count)]
        # Reserved registers between used ones read as zero; a request that touches none of ours is refused.
        if all(w < 0 for w in words):
            return bytes((function | 0x80, ILLEGAL_ADDRESS))
        return struct.pack(f">BB{count}H", function, 2 * count, *(max(w, 0) for w in words))

    def feed_tcp(self, buffer: bytearray) -> bytes:
        """Take complete requests off the buffer; return the answers with their MBAP header."""
        out = bytearray()
        while len(buffer) >= 8:
            transaction, protocol, length, unit = struct.unpack_from(">HHHB", buffer)
            if protocol != 0 or not 2 <= length <= 254:
                buffer.clear()  # not Modbus
                break
            if len(buffer) < 6 + length:
                break
            pdu = bytes(buffer[7 : 6 + length])
            del buffer[: 6 + length]
            if self.silent or unit != self.unit_id:
                continue
            answer = self.answer(pdu)
            frame = struct.pack(">HHHB", transaction, 0, len(answer) + 1, unit) + answer
            out += frame[: len(frame) // 2] if self.half else frame
        return bytes(out)

    def feed_rtu(self, buffer: bytearray) -> bytes:
        """Take complete RTU requests (8 bytes for functions 3 and 4) off the buffer; return the answers.

        Garbage is skipped byte by byte."""
        out = bytearray()
        while len(buffer) >= 8:
            if checksum("modbus", bytes(buffer[:6])) != int.from_bytes(buffer[6:8], "little"):
                del buffer[0]
                continue
            unit, pdu = buffer[0], bytes(buffer[1:6])
            del buffer[:8]
            if self.silent or unit != self.unit_id:
                continue
            body = bytes((unit,)) + self.answer(pdu)
            crc = checksum("modbus", body) ^ (0x5A5A if self.corrupt else 0)
            frame = body + crc.to_bytes(2, "little")
            out += frame[: len(frame) // 2] if self.half else frame
        return bytes(out)
