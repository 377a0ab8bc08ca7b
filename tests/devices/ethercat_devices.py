"""EtherCAT devices for the tests: a coupler, a terminal of thermocouples, a CiA-402 drive."""

from __future__ import annotations

import struct

from tests.devices.ethercat import Entry, Slave

BECKHOFF, MAXON = 0x2, 0xFB


def coupler() -> Slave:
    """EK1100: no process data, no mailbox."""
    return Slave("EK1100", BECKHOFF, 0x044C2C52, [], coe=False)


def channel(n: int) -> list[Entry]:
    """The entries of a thermocouple channel: status bits, value."""
    index = 0x6000 + 16 * n
    bits = [(1, 1), (2, 1), (3, 2), (5, 2), (7, 1), (0, 7), (15, 1), (16, 1), (17, 16)]
    return [(index if sub else 0, sub, size) for sub, size in bits]


class Terminal(Slave):
    """EL3314: status word and value in 0.1 degC of four channels. `values`: status, value."""

    def __init__(self, product: int = 0x0CF23052, watched: bool = True) -> None:
        self.values = [[0, 215 + 10 * k] for k in range(4)]
        super().__init__("EL3314", BECKHOFF, product, [channel(k) for k in range(4)], watched=watched)

    def open_wire(self, k: int) -> None:
        self.values[k] = [0x4042, 32767]

    def inputs(self) -> bytes:
        return b"".join(struct.pack("<Hh", *v) for v in self.values)


class Drive(Slave):
    """A drive of one axis: states of CiA 402, torque in thousandths, current in mA, position."""

    OBJECTS = {
        (0x1000, 0): ("I", 402),
        (0x6060, 0): ("b", 0),
        (0x6040, 0): ("H", 0),
        (0x6041, 0): ("H", 0x40),
        (0x603F, 0): ("H", 0),
        (0x6071, 0): ("h", 0),
        (0x607A, 0): ("i", 0),
        (0x6064, 0): ("i", 0),
        (0x6075, 0): ("I", 0),
        (0x30D1, 2): ("i", 0),
    }

    def __init__(self, watched: bool = True, product: int = 0x61500000) -> None:
        self.word, self.error, self.command, self.enabled_count, self.last_control = 0x40, 0, 0, 0, 0
        self.position, self.current, self.moved = 5000, 0, 0
        default_rx: list[Entry] = [(0x6040, 0, 16), (0x607A, 0, 32)]
        super().__init__(
            "EPOS4",
            MAXON,
            product,
            [[(0x6041, 0, 16)]],
            [default_rx],
            dict(self.OBJECTS),
            fixed=False,
            watched=watched,
        )

    def stop(self) -> None:
        self.word, self.command = (0x08 if self.error else 0x40), 0

    def trip(self, error: int) -> None:
        """A fault of its own, or with error 0 a stop by itself."""
        self.error = error
        self.stop()

    def output(self) -> int:
        """The torque that acts."""
        return self.command if self.word == 0x27 else 0

    def take(self, outputs: bytes) -> None:
        control, command = struct.unpack("<H" + ("h" if len(outputs) == 4 else "i"), outputs)
        was, self.last_control, self.command = self.word, control, command
        if was == 0x08:
            if control & 0x80:
                self.word, self.error = 0x40, 0
        elif not control & 2:
            self.word = 0x40
        elif control & 0x0F == 0x06:
            self.word = 0x21
        elif control & 0x0F == 0x07 and was in (0x21, 0x23, 0x27):
            self.word = 0x23
        elif control & 0x0F == 0x0F and was in (0x23, 0x27):
            self.enabled_count += was == 0x23
            self.word = 0x27
        if self.word == 0x27 and len(outputs) == 6:
            self.moved = max(self.moved, abs(command - self.position))
            self.position = command

    def inputs(self) -> bytes:
        values = {
            (0x6041, 0): self.word,
            (0x603F, 0): self.error,
            (0x30D1, 2): 2 * self.output() + self.current,
            (0x6064, 0): self.position,
        }
        data = b""
        for n in range(1, self.objects[0x1A00, 0][1] + 1):
            entry = self.objects[0x1A00, n][1]
            item = entry >> 16, entry >> 8 & 0xFF
            data += struct.pack("<" + self.objects[item][0], values[item])
        return data
