"""Binary frames and lines of text as makers send them: each dialect from a profile alone.

The frames are made here, byte by byte, and not by our own encoder. The dialects are those of the review of
foreign devices (issue 24).
"""

import os
import struct
import termios
import zlib

import pytest

from tests.devices.harness import HEAD, POSITION, Line, make, wait
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import ERROR, ROLE, Sample
from thermoctl_hal.base.checksum import algorithm, names
from thermoctl_hal.base.wire import checksum
from thermoctl_hal.profiles.read import load_profile

P = ROLE["position_um"]


@pytest.fixture
def line():
    found = Line()
    yield found
    found.close()


def crc(data, width, poly, init, reflect, xor_out):
    """A CRC bit by bit, as the catalogue defines it."""
    value, top, mask = init, 1 << width - 1, (1 << width) - 1
    for byte in data:
        value ^= (int(f"{byte:08b}"[::-1], 2) if reflect else byte) << width - 8
        for _ in range(8):
            value = (value << 1 ^ poly if value & top else value << 1) & mask
    return (int(f"{value:0{width}b}"[::-1], 2) if reflect else value) ^ xor_out


def binary(frame, fields, field="x", channel=""):
    return (
        f"{HEAD}bus: serial-binary\nframe: {{{frame}, fields: [{fields}]}}\n"
        f"channels:\n  position: {{field: {field}, {POSITION}{channel}}}\n"
    )


X24 = struct.pack(">i", -123456)[1:]
BISS = struct.pack("<I", 0x5 << 29 | 0x123456 << 4 | 0b0011)
DIALECTS = {
    "24 bits, big-endian, XOR": (
        binary("sync: [0x02], length: false, endian: big, crc: xor8", "{name: x, type: int24}"),
        b"\x02" + X24 + bytes([X24[0] ^ X24[1] ^ X24[2]]),
        -123456,
    ),
    "sum of the frame with its sync, and a tail": (
        binary(
            "sync: [0xAA, 0x01], length: false, crc: sum8, crc_over: frame, tail: [0x0D, 0x0A]",
            "{name: x, type: uint40}",
        ),
        b"\xaa\x01"
        + (987654321).to_bytes(5, "little")
        + bytes([sum(b"\xaa\x01" + (987654321).to_bytes(5, "little")) & 255])
        + b"\r\n",
        987654321,
    ),
    "CRC-8, constant length byte": (
        binary("sync: [0x55, 0x04], length: false, crc: CRC-8/SAE-J1850", "{name: x, type: int32}"),
        b"\x55\x04" + struct.pack("<i", -7) + bytes([crc(struct.pack("<i", -7), 8, 0x1D, 0xFF, False, 0xFF)]),
        -7,
    ),
    "CRC-32 of Ethernet, big-endian": (
        binary(
            "sync: [1, 2, 3, 4], crc: CRC-32, crc_endian: big, crc_over: payload", "{name: x, type: float64}"
        ),
        b"\1\2\3\4\x08" + struct.pack("<d", 2.5) + struct.pack(">I", zlib.crc32(struct.pack("<d", 2.5))),
        2.5,
    ),
    "no checksum": (
        binary("sync: [0xC0, 0xDE], length: false, crc: none", "{name: x, type: int16}"),
        b"\xc0\xde" + struct.pack("<h", -321),
        -321,
    ),
    "BCD with the sign in a status byte": (
        binary(
            "sync: [0xFE], length: false, endian: big, crc: none, tail: [0xFF]",
            "{name: status, type: uint8}, {name: x, type: bcd24, sign: {field: status, mask: 0x80, minus: 0x80}}",
        ),
        b"\xfe\x81\x12\x34\x56\xff",
        -123456,
    ),
    "bit fields of a BiSS word behind a bridge": (
        binary(
            "sync: [0x42], length: false, crc: CRC-8/MAXIM-DOW, invalid: {field: flags, mask: 3, good: 3}",
            "{name: word, type: uint32}, {name: flags, of: word, bits: 2}, {name: x, of: word, low_bit: 4, bits: 25}",
        ),
        b"\x42" + BISS + bytes([crc(BISS, 8, 0x31, 0, True, 0)]),
        0x123456,
    ),
    "bit field with a sign": (
        binary(
            "sync: [0x42], length: false, endian: big, crc: none",
            "{name: word, type: uint16}, {name: x, of: word, low_bit: 2, bits: 14, signed: true}",
        ),
        b"\x42" + struct.pack(">H", (-1000 & 0x3FFF) << 2),
        -1000,
    ),
    "ASCII hexadecimal between STX and ETX": (
        binary("sync: [2], length: false, crc: none, tail: [3]", "{name: x, type: hex6}"),
        b"\x0201E240\x03",
        123456,
    ),
    "ASCII digits behind a sign character": (
        binary(
            "sync: [0x58], length: false, crc: none, tail: [0x0D]",
            "{name: s, type: uint8}, {name: x, type: digits7, sign: {field: s, minus: 0x2D}}",
        ),
        b"X-0012345\r",
        -12345,
    ),
    "two byte orders in one frame, unused bytes": (
        binary(
            "sync: [9], length: false, crc: none",
            "{type: skip3}, {name: x, type: int16, endian: big}, {name: y, type: int16}",
        ),
        b"\x09\x00\xff\x00" + struct.pack(">h", 258) + struct.pack("<h", 3),
        258,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DIALECTS)
def test_a_binary_dialect_is_read_from_a_profile_alone(tmp_path, line, name):
    profile, frame, expected = DIALECTS[name]
    device, sample = make(tmp_path, profile, line.path), Sample()
    device.connect()
    try:
        if algorithm(device.binding.profile.bus_spec.crc).kind != "none":  # damage is noticed
            line.write(frame[:-4] + bytes([frame[-4] ^ 1]) + frame[-3:])
            wait(lambda: device.counters()["errors"] > 0, lambda: device.read(sample, 1.0))
            assert sample.value[P] != expected
        for _ in range(3):
            line.write(frame)
            wait(lambda: sample.fresh[P], lambda: device.read(sample, 1.0), name)
            assert sample.value[P] == expected
            sample.fresh[:] = False
    finally:
        device.disconnect()


def test_bad_digits_and_bad_flags_are_errors(tmp_path, line):
    bcd = binary("sync: [0xFE], length: false, crc: none, tail: [0xFF]", "{name: x, type: bcd16}")
    device, sample = make(tmp_path, bcd, line.path), Sample()
    device.connect()
    line.write(b"\xfe\x3c\x12\xff")
    wait(lambda: sample.status[P] == ERROR, lambda: device.read(sample, 1.0))
    device.disconnect()
    profile, frame, _ = DIALECTS["bit fields of a BiSS word behind a bridge"]
    device, sample = make(tmp_path, profile, line.path), Sample()
    device.connect()
    bad = bytes([frame[1] & 0xFE]) + frame[2:5]
    line.write(b"\x42" + bad + bytes([crc(bad, 8, 0x31, 0, True, 0)]))
    wait(lambda: sample.status[P] == ERROR, lambda: device.read(sample, 1.0))
    device.disconnect()


def test_frames_of_another_device_are_ignored(tmp_path, line):
    profile = binary(
        "sync: [0x10], length: false, crc: xor8", "{name: id, type: uint8, equals: 3}, {name: x, type: uint8}"
    )
    device, sample = make(tmp_path, profile, line.path), Sample()
    device.connect()
    line.write(b"\x10\x04\x09\x0d")
    wait(lambda: device._framer.others == 1, lambda: device.read(sample, 1.0))
    assert not sample.fresh[P] and "'equals'" in device.silence()
    line.write(b"\x10\x03\x09\x0a")
    wait(lambda: sample.fresh[P], lambda: device.read(sample, 1.0))
    assert sample.value[P] == 9
    device.disconnect()


def test_an_encoder_without_sync_is_asked(tmp_path, line):
    """As small absolute encoders behind RS-485: one byte asks, position and CRC-8 answer."""
    profile = binary(
        "sync: [], length: false, endian: big, crc: CRC-8/SMBUS, request: ['0x31'], request_hz: 500".replace(
            "'0x31'", "0x31"
        ),
        "{name: x, type: uint16}",
    )
    device, sample = make(tmp_path, profile, line.path), Sample()
    device.connect()
    now = [0.0]

    def step():
        now[0] += 0.001
        for _ in line.read():
            body = struct.pack(">H", 4321)
            line.write(body[: 1 if now[0] < 0.02 else 2] + bytes([crc(body, 8, 0x07, 0, False, 0)]))
        device.read(sample, now[0])

    wait(lambda: sample.fresh[P], step)  # the first answers are cut short: the next request starts anew
    assert sample.value[P] == 4321
    device.disconnect()


def text(pattern, more="", channel="", line=""):
    return (
        f"{HEAD}bus: serial-lines\n{line}text:\n  pattern: '{pattern}'\n{more}"
        f"channels:\n  position: {{field: x, {POSITION}{channel}}}\n"
    )


NMEA = "$PGAUGE,{},um*{:02X}\r\n"


def nmea(value, wrong=0):
    body = f"PGAUGE,{value},um"
    total = 0
    for c in body.encode():
        total ^= c
    return f"${body}*{total ^ wrong:02X}\r\n".encode()


LINES = {
    "hexadecimal": (text("(?P<x>[-+][0-9A-F]+)$", channel=", base: 16"), b"+1E5\r\n", 485, b"+1G5\r\n"),
    "decimal comma": (text("(?P<x>[-+0-9,]+)$", "  decimal: ','\n"), b"-1,5\r\n", -1.5, b"-1.5\r\n"),
    "blanks between sign and digits": (text("(?P<x>[-+] *[0-9.]+)$"), b"-   5.23\r\n", -5.23, b"-   -5.23\n"),
    "sign behind the digits": (text("(?P<x>[0-9.]+)(?P<s>[-+])$", channel=", sign: s"), b"5.23-\n", -5.23, b"5.23 \n"),
    "lines that end with ETX": (text("\\x02(?P<x>[-+0-9.]+)$", "  end: '\\x03'\n"), b"\x02+7.5\x03", 7.5, b"7.5\x03"),
    "NMEA checksum": (text("\\$PGAUGE,(?P<x>[-+0-9.]+),um", "  checksum: {crc: xor8}\n"), nmea(12.25), 12.25, nmea(12.25, 1)),
    "checksum of another maker": (
        text("(?P<x>[-+0-9.]+):", "  checksum: {crc: sum8, pattern: '(?P<data>.*):(?P<sum>..)$'}\n"),
        b"1.5:%02X\r" % (sum(b"1.5") & 255),
        1.5,
        b"1.5:00\r",
    ),
    "unit in the line, inches": (
        text(
            "(?P<x>[-+0-9.]+) (?P<u>[a-z]+)$", channel=", unit_field: u, unit_factors: {mm: 1000, in: 25400}"
        ),
        b"0.5 in\r\n",
        12700,
        b"0.5 ft\r\n",
    ),
    "exponent": (text("X(?P<x>[-+0-9.E]+)$"), b"X+1.25E+2\r\n", 125, b"X+1.25E+\r\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", LINES)
def test_a_text_dialect_is_read_from_a_profile_alone(tmp_path, line, name):
    profile, good, expected, bad = LINES[name]
    device, sample = make(tmp_path, profile, line.path), Sample()
    device.connect()
    line.write(bad + bad)  # the first one may be the rest of a line from before
    wait(lambda: device.counters()["errors"] > 0, lambda: device.read(sample, 1.0), name)
    assert not sample.fresh[P] and "gave no reading; received" in device.silence()
    line.write(good)
    wait(lambda: sample.fresh[P], lambda: device.read(sample, 1.0), name)
    assert sample.value[P] == pytest.approx(expected)
    device.disconnect()


def test_a_line_of_seven_bits_and_even_parity(tmp_path, line):
    profile = text("(?P<x>[-+0-9.]+)$", line="line: {baud: 9600, data_bits: 7, parity: E, stop_bits: 2}\n")
    device = make(tmp_path, profile, line.path)
    device.connect()
    assert (device._port.bytesize, device._port.parity, device._port.stopbits) == (
        7,
        "E",
        2,
    )  # a pty has 8 bits
    assert termios.tcgetattr(device._fd)[0] & termios.INPCK  # pyserial ignores a wrong parity
    device.disconnect()


def test_a_channel_in_inches_converts(tmp_path):
    profile = text("(?P<x>[-+0-9.]+)$").replace("unit: um", "unit: in")
    bound = make(tmp_path, profile, "/dev/none").binding.bounds[0]
    assert bound.scale == 25400


def test_every_checksum_of_the_catalogue_gives_its_check_value():
    import crccheck.crc

    known = {n.upper(): c for c in crccheck.crc.ALLCRCCLASSES for n in c._names}
    seen = 0
    for name in names():
        a = algorithm(name)
        if a.kind == "crc":
            wanted = (
                known.get(name)
                or known[
                    {"ccitt-false": "CRC-16/IBM-3740", "xmodem": "CRC-16/XMODEM", "modbus": "CRC-16/MODBUS"}[
                        name
                    ]
                ]
            )
            assert checksum(name, b"123456789") == wanted._check_result, name
            seen += 1
    assert seen > 70
    assert checksum("CRC-32/ISO-HDLC", b"123456789") == zlib.crc32(b"123456789")
    data = os.urandom(50)
    assert checksum("sum8-negated", data) + sum(data) & 255 == 0
    assert checksum("sum16", data) == sum(data)


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("crc: xor8", "crc: CRC-16/KERMT", r"did you mean 'CRC-16/KERMIT'"),
        ("type: int24", "type: int23", "did you mean 'int"),
        ("name: x, type: int24", "name: x", "'type' is missing, or 'of'"),
        ("name: x, type: int24", "name: w, type: int24}, {name: x, of: w, low_bit: 20, bits: 5", "not inside 'w'"),
        ("name: x, type: int24", "name: x, type: int24, sign: {field: y, minus: 1}", "sign: 'y' is no field"),
        ("sync: [0x02]", "sync: []", "none is for a device that answers a 'request'"),
        ("crc: xor8", "crc: xor8, request: [1]", "'request' and 'request_hz' belong together"),
        ("crc: xor8", "crc: xor8, crc_over: all", "'all' is not one of after-sync, frame, payload"),
    ],
)  # fmt: skip
def test_mistakes_are_told_with_their_place(tmp_path, old, new, message):
    good = DIALECTS["24 bits, big-endian, XOR"][0]
    assert old in good
    (tmp_path / "p.yaml").write_text(good.replace(old, new))
    with pytest.raises(InputError, match=rf"p.yaml:\d+:\d+: .*{message}"):
        load_profile(tmp_path / "p.yaml")


FIELDS = "bus: serial-binary\nframe: {sync: [170], length: false, crc: none, fields: [%s]}\nchannels:\n  x: {field: x, "
OF = {
    "bits of a typed field": (
        FIELDS % "{name: x, type: uint32, low_bit: 4, bits: 19}",
        "add one for the bits",
    ),
    "a lowest bit alone": (FIELDS % "{name: x, type: uint16, low_bit: 2}", "belong to a field with 'of'"),
    "a sign beside a type": (FIELDS % "{name: x, type: uint16, signed: true}", "as int16"),
    "a type beside 'of'": (
        FIELDS % "{name: a, type: uint16}, {name: x, of: a, bits: 3, type: int8}",
        "no 'type'",
    ),
}
SLAVE = (
    "bus: ethercat\nethercat: {vendor_id: 2, product_code: 3, transmit: [0x6041, 0x6077]}\nchannels:\n  x: {"
)
OF |= {
    "a lowest bit of an input": (
        SLAVE + "byte: 0, type: uint16, low_bit: 4, ",
        "0 bits from bit 4 are not inside",
    ),
    "a sign of an input": (SLAVE + "byte: 0, type: uint16, signed: true, ", "are not inside the 16 bits"),
    "another type than the object's": (
        SLAVE + "object: 0x6077, type: int32, ",
        "type: object 0x6077 has its own",
    ),
}
DRIVE = "bus: can-cia402\ncia402: {eds: a.eds, node_id: 5, command: 0x6071, transmit: [0x6041, 0x2030], mode: 10, "
OF["types beside an EDS file"] = (
    DRIVE + "objects: {0x2030: int16}}\nchannels:\n  x: {",
    "the 'eds' file gives the types",
)


@pytest.mark.parametrize("how", OF)
def test_a_key_that_would_have_no_effect_is_refused(tmp_path, how):
    """Such a key was passed over, and the whole number, with its status bits, was the reading."""
    text, words = OF[how]
    tmp_path.joinpath("a.eds").write_text("[2030]\nDataType=4\n")
    tmp_path.joinpath("p.yaml").write_text(HEAD + text + "unit: um, rate_hz: 10, stale_after_s: 1}\n")
    with pytest.raises(InputError, match=words):
        load_profile(tmp_path / "p.yaml")
