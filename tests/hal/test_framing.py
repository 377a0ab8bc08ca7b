"""Bytes on serial lines: known check values, damage, and recovery after it."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoctl_hal.base.latency_timer import latency_timer_ms, set_latency_timer
from thermoctl_hal.base.line import MAX_LINE, LineReader
from thermoctl_hal.base.profile import BinaryFrame
from thermoctl_hal.base.wire import Framer, checksum

SPEC = BinaryFrame(
    b"\xaa\x55", (("sequence", "uint16"), ("counts", "int32"), ("status", "uint8")), sequence="sequence"
)


@pytest.mark.parametrize("name,check", [("ccitt-false", 0x29B1), ("xmodem", 0x31C3), ("modbus", 0x4B37)])
def test_crc_check_values(name, check):
    assert checksum(name, b"123456789") == check


def test_a_frame_is_these_bytes():
    frame = Framer(SPEC).encode(1, -2, 0)
    assert frame[:10] == bytes.fromhex("aa55 07 0100 feffffff 00".replace(" ", ""))
    assert frame[10:] == checksum("ccitt-false", frame[2:10]).to_bytes(2, "little")


def test_a_frame_may_arrive_byte_by_byte():
    framer = Framer(SPEC)
    counts = [framer.feed(bytes([b])) for b in Framer(SPEC).encode(9, 123456, 0)]
    assert counts == [0] * 11 + [1]
    assert framer.newest == (9, 123456, 0)


def test_each_damaged_byte_is_noticed_and_the_next_frame_is_read():
    good = Framer(SPEC).encode(1, 77, 0)
    for at in range(len(good)):
        for bit in range(8):
            damaged = bytearray(good)
            damaged[at] ^= 1 << bit
            framer = Framer(SPEC)
            framer.feed(bytes(damaged))
            assert framer.newest == ()
            framer.feed(Framer(SPEC).encode(2, 78, 0))
            framer.feed(Framer(SPEC).encode(3, 79, 0))  # where the length byte was hit, one frame may be lost
            assert framer.newest == (3, 79, 0)


def test_gaps_of_the_sequence_are_counted_also_over_its_end():
    framer = Framer(SPEC)
    for sequence in (65533, 65534, 1, 2):
        framer.feed(framer.encode(sequence, 0, 0))
    assert (framer.frames, framer.lost) == (4, 2)


frames = st.tuples(st.integers(0, 65535), st.integers(-(2**31), 2**31 - 1), st.integers(0, 255))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=40), frames), min_size=1, max_size=6), st.integers(1, 17))
def test_true_frames_are_found_between_garbage_however_the_bytes_are_cut(pieces, size):
    """Garbage that holds no sync: every frame is read, in order, and every garbage byte is counted."""
    encoder, framer, seen = Framer(SPEC), Framer(SPEC), []
    stream = b""
    garbage_bytes = 0
    for garbage, values in pieces:
        garbage = garbage.replace(b"\xaa", b"\x00")
        garbage_bytes += len(garbage)
        stream += garbage + encoder.encode(*values)
    for at in range(0, len(stream), size):
        for byte in stream[at : at + size]:
            if framer.feed(bytes([byte])):
                seen.append(framer.newest)
    assert seen == [values for _, values in pieces]
    assert framer.skipped == garbage_bytes


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=20))
def test_any_bytes_leave_the_framer_small_and_able(chunks):
    framer = Framer(SPEC)
    for chunk in chunks:
        framer.feed(chunk)
        assert framer.pending < framer.size
    framer.feed(b"\x00" * 300)  # whatever half frame was pending is judged
    framer.feed(framer.encode(5, 55, 0))
    assert framer.newest == (5, 55, 0)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.from_regex(r"[ -~]{1,60}", fullmatch=True), max_size=10),
    st.integers(1, 9),
    st.sampled_from([b"\r\n", b"\n", b"\r"]),
)
def test_lines_come_out_whole(lines, size, end):
    reader, out = LineReader(), []
    stream = b"".join(line.encode() + end for line in lines)
    for at in range(0, len(stream), size):
        out += reader.feed(stream[at : at + size])
    assert out == [line.encode() for line in lines]


def test_a_line_without_end_is_dropped_and_memory_stays_bounded():
    reader = LineReader()
    for _ in range(100):
        assert reader.feed(b"x" * 1000) == []
        assert len(reader._buffer) <= MAX_LINE
    assert reader.feed(b"tail\nV=1\n") == [b"V=1"]
    assert reader.bad == 1


def test_latency_timer_is_set_where_the_adapter_has_one(tmp_path):
    timer = tmp_path / "bus/usb-serial/devices/ttyUSB7/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    assert set_latency_timer("/dev/ttyUSB7", 1, str(tmp_path))
    assert latency_timer_ms("/dev/ttyUSB7", str(tmp_path)) == 1
    assert not set_latency_timer("/dev/ttyACM0", 1, str(tmp_path) + "/none")
    assert latency_timer_ms("/dev/ttyACM0", str(tmp_path)) is None


def test_the_meter_pattern_takes_its_line():
    pattern = re.compile(r"V=(?P<volts>[-+.0-9eE]+) A=(?P<amperes>[-+.0-9eE]+)$")
    assert pattern.match("V=+3.1250 A=-0.6250")["amperes"] == "-0.6250"
