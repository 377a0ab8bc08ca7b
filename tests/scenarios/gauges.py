"""A binary encoder and a text gauge that stream the stage's position; a thermocouple module's and a power meter's registers.

What breaks them are plain attributes; `mend` puts them back.
"""

from __future__ import annotations

import math
import random
import struct

from tests.scenarios.lines import modbus_crc
from tests.scenarios.plant import BODIES, Plant

ENCODER_HZ, GAUGE_HZ = 1000, 500
SYNC = b"\x7e\x81"
K_SPAN_C, OPEN = 1370.0, 0xFFFF  # type K range of the module; what an open thermocouple reads


class Streamer:
    """`mute`; `divider`: every n-th frame only; `frozen`; `offset_um`; `sign`; `shape` how the bytes look."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self.count, self.held_um = plant, 0, 0.0
        self.random = random.Random(11)
        self.mend()

    def mend(self) -> None:
        """As the maker built it."""
        self.mute = self.frozen = False
        self.divider, self.offset_um, self.sign, self.shape = 1, 0.0, 1.0, "good"

    def reading_um(self, sigma: float) -> float:
        """What the sensor measures now."""
        if not self.frozen:
            self.held_um = self.sign * self.plant.x_um + self.offset_um + self.random.gauss(0.0, sigma)
        return self.held_um

    def noise(self, size: int) -> bytes:
        """Bytes that are no frame."""
        return bytes(self.random.randrange(256) for _ in range(size))


class Encoder(Streamer):
    """sync 7E 81 | counter uint8 | flags uint8 | position int32 in nm, big-endian | CRC of Modbus of what follows sync.

    shape: 'good', 'crc' (wrong checksum), 'half' (each frame is cut), 'invalid' (flag bit 0), 'rubbish' (40 bytes before
    each frame)."""

    def frame(self) -> bytes:
        """The next frame, or nothing."""
        self.count += 1
        if self.mute or self.count % self.divider:
            return b""
        flags = 1 if self.shape == "invalid" else 0
        body = struct.pack(">BBi", self.count & 0xFF, flags, round(self.reading_um(0.004) * 1000))
        crc = modbus_crc(body)
        if self.shape == "crc":
            crc = bytes((crc[0] ^ 0x5A, crc[1]))
        data = SYNC + body + crc
        if self.shape == "half":
            return data[: len(data) // 2]
        return self.noise(40) + data if self.shape == "rubbish" else data


class TextGauge(Streamer):
    """Lines like "X +00012.34 um"; shape: 'good', 'garbage', 'cut' (no line ends), 'error' ("X ERR"), 'comma'."""

    def frame(self) -> bytes:
        """The next line, or nothing."""
        self.count += 1
        if self.count % (ENCODER_HZ // GAUGE_HZ * self.divider) or self.mute:
            return b""
        if self.shape == "garbage":
            return self.noise(18).replace(b"\n", b"?") + b"\r\n"
        if self.shape == "error":
            return b"X ERR\r\n"
        line = b"X %+09.2f um" % self.reading_um(0.03)
        if self.shape == "comma":
            line = line.replace(b".", b",")
        return line if self.shape == "cut" else line + b"\r\n"


class Thermocouples:
    """Registers of a module with eight type K inputs: uint16 0..65535 over 0..1370 degC (`tenths` False), or int16 tenths.

    `open`: numbers of inputs whose wire is broken."""

    def __init__(self, plant: Plant, tenths: bool = False) -> None:
        self.plant, self.tenths = plant, tenths
        self.mend()

    def mend(self) -> None:
        """All wires whole."""
        self.open: list[int] = []

    def read(self, address: int) -> int | None:
        """Register 0..7: coil, bobbin, magnet, stator, and air for the rest."""
        if not 0 <= address < 8:
            return None
        if address in self.open:
            return 0x7FFF if self.tenths else OPEN
        bodies = self.plant.t_c
        celsius = bodies[address] if address < len(BODIES) else 22.0
        celsius = self.plant.noisy(celsius, 0.03)
        return round(celsius * 10) & 0xFFFF if self.tenths else round(celsius / K_SPAN_C * 65535)


class PowerMeter:
    """Registers of a meter with floats, high word first, at 0 (V) and 6 (A); nothing between.

    `frozen`: the same numbers for ever; `nan`: no numbers."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self.words, self.held = plant, (0, 0), {0: 0.0, 6: 0.0}
        self.mend()

    def mend(self) -> None:
        """It measures."""
        self.frozen = self.nan = False

    def read(self, address: int) -> int | None:
        """A register; the two words of a float are of one moment."""
        if address in (0, 6):
            if not self.frozen:
                value, sigma = (self.plant.volts, 0.002) if address == 0 else (self.plant.i_a, 0.0005)
                self.held[address] = self.plant.noisy(value, sigma)
            number = math.nan if self.nan else self.held[address]
            self.words = struct.unpack(">HH", struct.pack(">f", number))
            return self.words[0]
        return self.words[1] if address in (1, 7) else None
