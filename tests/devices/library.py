"""The devices of the library as emulators: what each one answers, byte by byte, from its manual's facts.

`CASES[name]` makes the device at its wire: (port, emulator), the readings to expect, a fault, and the channel that
the fault makes bad. Framing is that of tests/devices/emulators.py or of this file, not ours.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.devices.emulators import ModbusLine, Port, SlcanAdapter, Unit, encode, words
from tests.devices.ethercat import Slave
from tests.devices.ethercat_cable import Cable, why_not
from tests.devices.ethercat_devices import Drive, Terminal, coupler


@dataclass
class Device:
    """An emulated device. expected: channel -> reading; `fault` breaks `bad`; send: what it sends by itself."""

    port: str
    wire: Port | Cable
    expected: dict[str, float]
    fault: Callable[[], None]
    bad: str
    send: Callable[[], None] = field(default=lambda: None)
    address: int | None = None
    exact: float = 1e-3


def modbus(
    folder: Path,
    tables: dict[int, dict[int, int]],
    expected: dict[str, float],
    broken: tuple[int, int, int],
    bad: str,
    tcp: bool = False,
) -> Device:
    """A Modbus unit 1, strict: a request that touches another register is refused. broken: function, address, word."""
    unit = Unit(tables)
    wire = Port(ModbusLine({1: unit}, not tcp).take, None if tcp else folder / "wire")
    port = f"tcp:127.0.0.1:{wire.number}" if tcp else f"rtu:{folder}/wire"
    function, address, word = broken
    return Device(port, wire, expected, lambda: unit.set(function, address, [word]), bad)


def row(first: int, values: list[int]) -> dict[int, int]:
    return {first + k: v & 0xFFFF for k, v in enumerate(values)}


def floats(values: dict[int, float]) -> dict[int, int]:
    return {a + k: w for a, v in values.items() for k, w in enumerate(words(v, "f"))}


def longs(values: dict[int, int]) -> dict[int, int]:
    """32 bits, low word first."""
    return {a + k: w for a, v in values.items() for k, w in enumerate(words(v, "i", True))}


NAN = 0x7FC0


def temperatures(folder: Path, kind: str) -> Device:
    """Modules with several channels."""
    if kind == "adam-6015":
        tables = {3: row(0, [round((21.5 + 50) / 200 * 65535)] * 7), 1: row(120, [0] * 7)}
        return modbus(folder, tables, {f"t{k}": 21.5 for k in range(7)}, (1, 122, 1), "t2", True)
    if kind == "adam-6018":
        tables = {3: row(0, [round(100.0 / 1370 * 65535)] * 8), 1: row(120, [0] * 8)}
        return modbus(folder, tables, {f"t{k}": 100.0 for k in range(8)}, (1, 127, 1), "t7", True)
    if kind == "m-7018":
        tables = {4: row(0, [215 + 10 * k for k in range(8)]) | {128: 2512}}
        expected = {f"t{k}": 21.5 + k for k in range(8)} | {"cold_junction": 25.12}
        return modbus(folder, tables, expected, (4, 3, 32767), "t3")
    if kind == "tm-th8":
        tables = {4: row(0, [-1234] * 8), 2: row(128, [0] * 8)}
        return modbus(folder, tables, {f"t{k}": -12.34 for k in range(8)}, (2, 128, 1), "t0")
    if kind == "m-7015":
        return modbus(
            folder, {4: row(0, [2150] * 6)}, {f"t{k}": 21.5 for k in range(6)}, (4, 5, 0x8000), "t5"
        )
    if kind == "pet-7015":
        tables = {4: row(0, [-4321] * 7)}
        return modbus(folder, tables, {f"t{k}": -43.21 for k in range(7)}, (4, 6, 32767), "t6", True)
    if kind == "pet-7018z":
        tables = {4: row(0, [215 + 10 * k for k in range(10)])}
        return modbus(folder, tables, {f"t{k}": 21.5 + k for k in range(10)}, (4, 9, 32767), "t9", True)
    if kind == "wb-m1w2":
        tables = {4: {7: 344, 8: 0xFFF0}, 2: {16: 1, 17: 1}}
        return modbus(folder, tables, {"t0": 21.5, "t1": -1.0}, (2, 17, 0), "t1")
    if kind == "labjack":
        values = {7000 + 2 * k: 293.15 + k for k in range(4)} | {60052: 301.5}
        expected = {f"t{k}": 293.15 + k for k in range(4)} | {"device": 301.5}
        return modbus(folder, {3: floats(values)}, expected, (3, 7002, 0xC61C), "t1", True)
    if kind == "status first":
        tables = {4: row(0, [0, 215, 0, -35])}
        return modbus(folder, tables, {"t0": 21.5, "t1": -3.5}, (4, 2, 0x41), "t1", True)
    if kind == "z-4tc":
        return modbus(folder, {3: row(1, [215] * 4)}, {f"t{k}": 21.5 for k in range(4)}, (3, 4, 32000), "t3")
    tables = {3: floats({2 * k: 20.0 + k for k in range(8)}) | {16: 77}}
    return modbus(
        folder, tables, {f"t{k}": 20.0 + k for k in range(8)} | {"heartbeat": 77}, (3, 6, NAN), "t3", True
    )


def meters(folder: Path, kind: str) -> Device:
    """Power meters and current inputs."""
    if kind == "sdm":
        values = {0: 230.5, 6: -1.25, 12: 288.0, 70: 50.02}
        expected = dict(zip(("voltage", "current", "power", "frequency"), values.values(), strict=True))
        return modbus(folder, {4: floats(values)}, expected, (4, 0, NAN), "voltage")
    if kind == "sdm72":
        values = {0: 229.0, 2: 230.0, 4: 231.0, 6: 1.0, 8: 2.0, 10: 3.0, 52: 1380.0}
        names = *(f"voltage_{k}" for k in (1, 2, 3)), *(f"current_{k}" for k in (1, 2, 3)), "power"
        return modbus(
            folder,
            {4: floats(values)},
            dict(zip(names, values.values(), strict=True)),
            (4, 8, NAN),
            "current_2",
        )
    if kind == "pzem-004t":
        tables = {4: {0: 2301, 1: 0x86A0, 2: 0x0000, 3: 1234, 4: 0}}
        return modbus(
            folder, tables, {"voltage": 230.1, "current": 34.464, "power": 123.4}, (4, 0, 60000), "voltage"
        )
    if kind == "pzem-017":
        tables = {4: row(0, [4805, 1250, 6006, 0, 0, 0, 0, 0])}
        return modbus(
            folder, tables, {"voltage": 48.05, "current": 12.5, "power": 600.6}, (4, 6, 0xFFFF), "voltage"
        )
    if kind == "em111":
        tables = {4: longs({0: 2305, 2: -1250, 4: -2881})}
        return modbus(
            folder, tables, {"voltage": 230.5, "current": -1.25, "power": -288.1}, (4, 1, 0x7FFF), "voltage"
        )
    if kind == "em21":
        tables = {4: longs({0: 2305, 12: 1250})}
        return modbus(folder, tables, {"voltage_1": 230.5, "current_1": 1.25}, (4, 13, 0x7FFF), "current_1")
    if kind == "wb-mao4":
        return modbus(folder, {3: {0: 12000}, 2: {16: 0}}, {"i0": 12.0}, (2, 16, 1), "i0")
    if kind == "ai":
        tables = {4: row(0, [4000 + k for k in range(8)])}
        return modbus(folder, tables, {f"i{k}": 4 + k / 1000 for k in range(8)}, (4, 2, 60000), "i2")
    return modbus(folder, {3: {0: 12000}}, {"i0": 12.0}, (3, 0, 60000), "i0")


def line(
    folder: Path,
    asked: bytes,
    good: bytes,
    broken: bytes,
    expected: dict[str, float],
    bad: str,
    address: int | None = None,
) -> Device:
    """A device that answers a request with text (or bytes); every other request gets no answer."""
    answer = [good]
    rest = [b""]

    def take(data: bytes) -> bytes:
        rest[0] += data
        count = rest[0].count(asked)
        rest[0] = b"" if count else rest[0][-len(asked) :]
        return answer[0] * count

    def fault() -> None:
        answer[0] = broken

    wire = Port(take, folder / "wire")
    return Device(f"{folder}/wire", wire, expected, fault, bad, address=address)


def crc8(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x07 if value & 0x80 else value << 1) & 0xFF
    return value


def aksim(status: int) -> bytes:
    body = b"1" + ((0x40000 << 4) | status).to_bytes(3, "big")
    return body + bytes([crc8(body)])


def tmcl(status: int) -> bytes:
    body = struct.pack(">BBBBi", 2, 1, status, 6, -1500)
    return body + bytes([sum(body) & 255])


def can_device(
    folder: Path, frames: Callable[[bool], list[tuple[int, bool, bytes]]], **more: object
) -> Device:
    """A device that sends frames by itself. frames(broken) are those of one round."""
    broken = [False]
    wire = Port(SlcanAdapter().take, folder / "wire")

    def fault() -> None:
        broken[0] = True

    def send() -> None:
        for frame in frames(broken[0]):
            wire.send(encode(frame))

    return Device(f"slcan:{folder}/wire@500000", wire, fault=fault, send=send, **more)  # type: ignore[arg-type]


def ivts(broken: bool) -> list[tuple[int, bool, bytes]]:
    status = 0x40 if broken else 0x00
    values = (0x521, 1234), (0x522, 48050), (0x525, 253)
    return [(i, False, struct.pack(">BBi", i - 0x521, status | 3, v)) for i, v in values]


def odrive(broken: bool) -> list[tuple[int, bool, bytes]]:
    node = 3 << 5
    current = float("nan") if broken else 1.5
    return [
        (node | 1, False, struct.pack("<IBBBB", 0, 1, 0, 0, 0)),
        (node | 20, False, struct.pack("<ff", 0.0, current)),
        (node | 23, False, struct.pack("<ff", 24.25, 0.1)),
    ]


def vesc(broken: bool) -> list[tuple[int, bool, bytes]]:
    return [
        (0x900 | 60, True, struct.pack(">ihh", 1000, 12, 100)),
        (0x1B00 | 60, True, struct.pack(">ihh", 7, 2000 if broken else 482, 0)),
    ]


def drive(
    folder: Path, objects: dict[tuple[int, int], tuple[str, int]], expected: dict[str, float], bad: str
) -> Device:
    """A CANopen drive that answers SDO reads; its fault: the object of `bad` has a number out of range."""
    broken: list[tuple[int, int]] = []

    def node(frame: tuple[int, bool, bytes]) -> list[tuple[int, bool, bytes]]:
        can_id, _, data = frame
        if can_id != 0x601:
            return []
        command, index, sub = struct.unpack_from("<BHB", data)
        if command != 0x40 or (index, sub) not in objects:
            return [(0x581, False, struct.pack("<BHBI", 0x80, index, sub, 0x06020000))]
        letter, value = objects[index, sub]
        value = {"h": 32767, "H": 65535, "i": 2**31 - 1}[letter] if (index, sub) in broken else value
        size = struct.calcsize(letter)
        return [
            (
                0x581,
                False,
                struct.pack("<BHB" + letter, 0x43 | (4 - size) << 2, index, sub, value).ljust(8, b"\0"),
            )
        ]

    wire = Port(SlcanAdapter(node).take, folder / "wire")
    return Device(f"slcan:{folder}/wire", wire, expected, lambda: broken.append(list(objects)[-1]), bad)


def ethercat(
    slaves: Callable[[], list[Slave]], expected: dict[str, float], fault: tuple[object, ...], bad: str
) -> Device:
    """Slaves at a virtual cable. fault: position, name and arguments, as of `Cable.ask`."""
    if reason := why_not():
        pytest.skip(reason)
    wire = Cable(slaves)
    return Device(wire.name, wire, expected, lambda: wire.ask(*fault), bad)


def drawing(current: int) -> Drive:
    """A drive that draws a current without being enabled, mA."""
    drive = Drive()
    drive.current = current
    return drive


STATE = {(0x6041, 0): ("H", 0x0250), (0x603F, 0): ("H", 0)}
EIGHT = b"".join(b"%+07.1f" % (20.5 + k) for k in range(8))
KELVIN = b",".join(b"%+.3f" % (293.15 + k) for k in range(8))
CASES: dict[str, Callable[[Path], Device]] = {
    "advantech-adam-6015": lambda d: temperatures(d, "adam-6015"),
    "advantech-adam-6018": lambda d: temperatures(d, "adam-6018"),
    "advantech-adam-4018-ascii": lambda d: line(
        d, b"#0A\r", b">" + EIGHT + b"\r", b">" + EIGHT[:7] + b"+9999.9" + EIGHT[14:] + b"\r",
        {f"t{k}": 20.5 + k for k in range(8)}, "t1", 10,
    ),
    "icpdas-m-7018": lambda d: temperatures(d, "m-7018"),
    "icpdas-tm-th8": lambda d: temperatures(d, "tm-th8"),
    "icpdas-m-7015": lambda d: temperatures(d, "m-7015"),
    "icpdas-pet-7015": lambda d: temperatures(d, "pet-7015"),
    "icpdas-pet-7018z": lambda d: temperatures(d, "pet-7018z"),
    "wirenboard-wb-m1w2": lambda d: temperatures(d, "wb-m1w2"),
    "wirenboard-wb-mao4-20ma": lambda d: meters(d, "wb-mao4"),
    "labjack-t7": lambda d: temperatures(d, "labjack"),
    "wago-750-461": lambda d: temperatures(d, "status first"),
    "beckhoff-bk9050-kl3312": lambda d: temperatures(d, "status first"),
    "seneca-z-4tc": lambda d: temperatures(d, "z-4tc"),
    "siemens-s7-1200": lambda d: temperatures(d, "plc"),
    "waveshare-analog-input-8ch": lambda d: meters(d, "ai"),
    "waveshare-analog-output-8ch": lambda d: meters(d, "ao"),
    "eastron-sdm120": lambda d: meters(d, "sdm"),
    "eastron-sdm230": lambda d: meters(d, "sdm"),
    "eastron-sdm72d": lambda d: meters(d, "sdm72"),
    "peacefair-pzem-004t": lambda d: meters(d, "pzem-004t"),
    "peacefair-pzem-017": lambda d: meters(d, "pzem-017"),
    "carlo-gavazzi-em111": lambda d: meters(d, "em111"),
    "carlo-gavazzi-em21": lambda d: meters(d, "em21"),
    "mitutoyo-digimatic-line": lambda d: line(d, b"1\r", b"01A+00012.345\r", b"911\r", {"position": 12345.0}, "position"),
    "sylvac-d50s": lambda d: line(d, b"?\r", b"-000.123\r", b"ERR2\r", {"position": -123.0}, "position"),
    "heidenhain-nd-287": lambda d: line(
        d, b"\x02", b"-     5.2300   R\r\n", b"       ......  \r\n", {"position": -5230.0}, "position"
    ),
    "rls-e201-9q": lambda d: line(d, b"?", b"-4321:0\r", b"E\r", {"position": -4321.0}, "position"),
    "rls-aksim-2-uart": lambda d: line(d, b"1", aksim(3), aksim(1), {"angle": 90.0}, "angle"),
    "keyence-dl-rs1a-gt2": lambda d: line(
        d, b"M0\r\n", b"M0,+001.2345,-000.0001\r\n", b"ER,M0,65\r\n", {"position": 1234.5}, "position"
    ),
    "keyence-dl-rs1a-il": lambda d: line(d, b"M0\r\n", b"M0,-01.234\r\n", b"M0,-99.999\r\n", {"position": -1234.0}, "position"),
    "lakeshore-218": lambda d: line(
        d, b"KRDG? 0\r\n", KELVIN + b"\r\n", KELVIN.replace(b"+294.150", b"+0.000") + b"\r\n",
        {f"t{k}": 293.15 + k for k in range(8)}, "t1",
    ),
    "keysight-34401a": lambda d: line(
        d, b"READ?\n", b"+1.25000000E-01\r\n", b"+9.90000000E+37\r\n", {"current": 0.125}, "current"
    ),
    "kepco-bop-scpi": lambda d: line(
        d, b"MEAS:CURR?;:OUTP?\n", b"2.5000E-1;0\n", b"9.9E37;0\n", {"current": 0.25, "output": 0}, "current"
    ),
    "trinamic-tmcm-1640": lambda d: line(
        d, bytes([1, 6, 150, 0, 0, 0, 0, 0, 157]), tmcl(100), tmcl(4), {"current": -1.5}, "current", 1
    ),
    "isabellenhuette-ivt-s": lambda d: can_device(
        d, ivts, expected={"current": 1.234, "voltage": 48.05, "temperature": 25.3}, bad="current"
    ),
    "odrive-cansimple": lambda d: can_device(
        d, odrive, expected={"state": 1, "fault": 0, "current": 1.5, "supply": 24.25}, bad="current", address=3
    ),
    "vesc-can": lambda d: can_device(d, vesc, expected={"current": 1.2, "supply": 48.2}, bad="supply", address=60),
    "maxon-epos4": lambda d: drive(
        d, STATE | {(0x30D1, 2): ("i", -1500)}, {"state": 0x250, "fault": 0, "current": -1.5}, "current",
    ),
    "nanotec-c5-e": lambda d: drive(
        d, STATE | {(0x6077, 0): ("h", -250)}, {"state": 0x250, "fault": 0, "current": -0.25}, "current"
    ),
    "beckhoff-el3314": lambda d: ethercat(
        lambda: [coupler(), Terminal()], {f"t{k}": 21.5 + k for k in range(4)}, (2, "open_wire", 3), "t3"
    ),
    "maxon-epos4-ethercat": lambda d: ethercat(
        lambda: [drawing(-1500)], {"state": 0x40, "fault": 0, "current": -1.5}, (1, "current", 20000), "current"
    ),
    "copley-accelnet": lambda d: drive(
        d, STATE | {(0x2201, 0): ("h", 481), (0x221C, 0): ("h", -150)},
        {"state": 0x250, "fault": 0, "current": -1.5, "supply": 48.1}, "current",
    ),
}  # fmt: skip
UNTRIED = {"mjbots-moteus": "CAN FD: tried in test_drives.py, because a Lawicel adapter has none"}
