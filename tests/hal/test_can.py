"""CAN: Lawicel ASCII, SDO and PDO bytes, the CiA-402 state machine, and the drive's own watchdog."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoctl_hal.base.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_OFFLINE,
    AMP_QUICK_STOP,
    HardwareError,
    Sample,
)
from thermoctl_hal.base.cia402 import drive_state, next_control_word
from thermoctl_hal.base.wire import EXTENDED, SlcanParser, encode_slcan
from thermoctl_hal.can.bus import open_can
from thermoctl_hal.virtual.drive import (
    DISABLED,
    ENABLED,
    FAULT,
    HEARTBEAT_LOST,
    PRE_OPERATIONAL,
    Cia402Drive,
    SlcanAdapter,
)


def test_slcan_ascii():
    assert encode_slcan(0x185, b"\x27\x02\xff") == b"t18532702FF\r"
    assert encode_slcan(0x080, b"") == b"t0800\r"
    assert encode_slcan(EXTENDED | 0x18FF1234, b"\x01") == b"T18FF1234101\r"
    assert encode_slcan(EXTENDED | 0x185, b"") == b"T000001850\r"


def test_slcan_answers_and_refusals_between_frames():
    parser = SlcanParser()
    assert parser.feed(b"z\r\r\at1853270") == []
    assert parser.feed(b"2FF\rZ\rt7051057F3A\r") == [
        (0x185, b"\x27\x02\xff"),
        (0x705, b"\x05"),
    ]  # with a time stamp
    assert parser.refused == 1 and parser.bad == 0
    assert parser.feed(b"t18\rtXYZ0\rt1859\rt18512\rq\r") == []
    assert parser.bad == 5


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 0x7FF) | st.integers(EXTENDED, EXTENDED | 0x1FFFFFFF), st.binary(max_size=8)
        ),
        max_size=10,
    ),
    st.integers(1, 9),
)
def test_slcan_round_trip_however_cut(frames, size):
    stream = b"".join(encode_slcan(*f) for f in frames)
    parser, out = SlcanParser(), []
    for at in range(0, len(stream), size):
        out += parser.feed(stream[at : at + size])
    assert out == frames


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=200), max_size=10))
def test_any_bytes_leave_parser_and_adapter_able(chunks):
    parser, adapter = SlcanParser(), SlcanAdapter()
    for chunk in chunks:
        parser.feed(chunk)
        adapter.feed(chunk)
        assert parser.pending <= 64 and len(adapter._rest) <= 64
    parser.feed(b"\r")
    assert parser.feed(b"t1231FF\r") == [(0x123, b"\xff")]
    adapter.feed(b"\rC\rS8\rO\r")
    assert adapter.feed(b"t1231FF\r") == (b"z\r", [(0x123, b"\xff")])


@pytest.mark.parametrize(
    "word,state,towards_on,towards_off",
    [
        (0x0000, AMP_OFFLINE, 0x00, 0x00),
        (0x0250, AMP_DISABLED, 0x06, 0x00),
        (0x0231, AMP_DISABLED, 0x07, 0x00),
        (0x0233, AMP_DISABLED, 0x0F, 0x06),
        (0x0237, AMP_ENABLED, 0x0F, 0x06),
        (0x0217, AMP_QUICK_STOP, 0x00, 0x00),
        (0x021F, AMP_FAULT, 0x00, 0x00),
        (0x0218, AMP_FAULT, 0x00, 0x00),
    ],
)
def test_state_machine(word, state, towards_on, towards_off):
    assert drive_state(word) == state
    assert next_control_word(word, True) == towards_on
    assert next_control_word(word, False) == towards_off


def sdo(drive, request):
    drive.take((0x605, bytes.fromhex(request.replace(" ", ""))), 0.0)
    return next(d for i, d in drive.tick(0.0) if i == 0x585).hex(" ")


def test_sdo_bytes():
    drive = Cia402Drive(5)
    drive.tick(0.0)
    assert sdo(drive, "40 00 10 00 00000000") == "43 00 10 00 92 01 02 00"  # device type: 402
    assert sdo(drive, "2b 17 10 00 14000000") == "60 17 10 00 00 00 00 00"  # heartbeat 20 ms
    assert sdo(drive, "40 17 10 00 00000000") == "4b 17 10 00 14 00 00 00"
    assert sdo(drive, "40 23 45 00 00000000") == "80 23 45 00 00 00 02 06"  # no such object
    assert sdo(drive, "40 18 10 09 00000000") == "80 18 10 09 11 00 09 06"  # no such sub-index
    assert sdo(drive, "23 00 10 00 01000000") == "80 00 10 00 02 00 01 06"  # read-only
    assert sdo(drive, "2f 17 10 00 14000000") == "80 17 10 00 10 00 07 06"  # length
    assert sdo(drive, "21 17 10 00 14000000") == "80 17 10 00 01 00 04 05"  # segmented: not known


def configured() -> Cia402Drive:
    """A drive with PDOs mapped and started, watching node 127 for 100 ms."""
    drive = Cia402Drive(5)
    for request in (
        "23 16 10 01 64007f00",
        "2b 17 10 00 14000000",
        "23 00 16 01 10004060",
        "23 00 16 02 20007120",
        "2f 00 16 00 02000000",
        "23 00 1a 01 10004160",
        "23 00 1a 02 10007860",
        "2f 00 1a 00 02000000",
        "23 00 14 01 05020000",
        "23 00 18 01 85010000",
    ):
        assert sdo(drive, request).startswith("60")
    drive.take((0x000, b"\x01\x05"), 0.0)
    return drive


def enabled() -> Cia402Drive:
    drive = configured()
    drive.take((0x77F, b"\x05"), 0.0)
    for word in (0x06, 0x07, 0x0F):
        drive.take((0x205, struct.pack("<Hi", word, 250_000)), 0.0)
    assert drive.state == ENABLED and drive.command == 250_000
    return drive


def test_pdo_bytes():
    drive = enabled()
    drive.od[0x6078, 0].value = 100
    drive.tick(0.0)
    drive.take((0x080, b""), 0.0)
    assert (0x185, bytes.fromhex("37026400")) in drive.tick(0.001)


def test_enable_needs_every_step():
    drive = configured()
    drive.take((0x205, struct.pack("<Hi", 0x0F, 250_000)), 0.0)
    assert drive.state == DISABLED and drive.command == 0


def test_the_drive_stops_by_itself_when_the_master_dies():
    drive = enabled()
    drive.take((0x77F, b"\x05"), 1.0)
    drive.tick(1.099)
    assert drive.command == 250_000
    frames = drive.tick(1.101)
    assert drive.command == 0 and drive.state == FAULT and drive.nmt == PRE_OPERATIONAL
    assert (0x085, struct.pack("<HB5x", HEARTBEAT_LOST, 1)) in frames
    drive.take((0x205, struct.pack("<Hi", 0x0F, 250_000)), 1.2)
    assert drive.command == 0  # pre-operational: PDOs are not heard


def test_a_fault_stays_until_a_rising_reset_edge():
    drive = enabled()
    drive.fault(0x2310)
    for word in (0x06, 0x07, 0x0F):
        drive.take((0x205, struct.pack("<Hi", word, 1)), 0.0)
    assert drive.state == FAULT and drive.command == 0
    drive.take((0x205, struct.pack("<Hi", 0x80, 0)), 0.0)
    assert drive.state == DISABLED and drive.od[0x603F, 0].value == 0


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0x000, 0x080, 0x205, 0x605, 0x77F, 0x123]), st.binary(max_size=8)),
        max_size=60,
    )
)
def test_no_frames_drive_without_the_steps(frames):
    """Whatever arrives: the drive never drives unless its state is 'operation enabled' and it hears PDOs."""
    drive = configured()
    for k, frame in enumerate(frames):
        drive.take(frame, k * 0.01)
        for can_id, data in drive.tick(k * 0.01):
            assert len(data) <= 8 and can_id <= 0x7FF
        assert drive.command == 0 or drive.state == ENABLED


def test_ports_that_cannot_be():
    for port, word in (
        ("can0", "interface:channel@bitrate"),
        ("slcan:/dev/none@123", "bitrate 123"),
        ("slcan:/dev/none", "no such device"),
        ("socketcan:can77", "is the interface up"),
    ):
        with pytest.raises(HardwareError, match=word):
            open_can(port, ())


def test_library_port_over_the_virtual_interface():
    a, b = open_can("virtual:test_hal", (0x123,)), open_can("virtual:test_hal", ())
    b.send((0x124, b"no"), (0x123, b"yes"))
    assert a.receive() == [(0x123, b"yes")]
    assert a.receive() == []
    a.close()
    b.close()


def test_dbc_device_decodes_what_cantools_encodes(tmp_path):
    from tests.hal.conftest import CONFIG
    from thermoctl.files import yamlfile
    from thermoctl_hal.base.backend import ROLE
    from thermoctl_hal.can.dbc import DbcDevice
    from thermoctl_hal.profiles.bind import bind

    node = yamlfile.loads(
        "{profile: meter-can.yaml, port: 'virtual:dbc', roles: {voltage: voltage_v, current: current_a}}"
    )
    device, sender, sample = DbcDevice(bind(node, CONFIG / "devices")), open_can("virtual:dbc", ()), Sample()
    device.connect()
    sender.send(
        (801, struct.pack("<i", 31250)[:3] + struct.pack("<i", -62500)[:3] + b"\x07\x00"), (801, b"\x01")
    )
    device.read(sample, 1.0)
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(3.125)
    assert sample.value[ROLE["current_a"]] == pytest.approx(-0.625)
    assert device.counts["errors"] == 1  # the short one
    device.disconnect()
    sender.close()
