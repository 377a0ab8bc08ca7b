"""Modbus: request and answer bytes, blocks, types, and what a sick device answers."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoctl_hal.base.profile import Register
from thermoctl_hal.base.wire import checksum
from thermoctl_hal.modbus.device import decode, plan_blocks
from thermoctl_hal.virtual.modbus import ModbusUnit, encode


def register(address, type="int16", kind="input", order="big"):
    return Register(kind, address, type, order, ())


def rtu(body):
    return body + checksum("modbus", body).to_bytes(2, "little")


def test_read_input_registers_bytes():
    unit = ModbusUnit(1)
    unit.store(register(8), 2225)
    request = bytes.fromhex("01 04 0008 0001".replace(" ", ""))
    assert rtu(request).hex() == "010400080001b008"  # the CRC as every Modbus tool has it
    assert unit.feed_rtu(bytearray(rtu(request))) == rtu(bytes.fromhex("01040208b1"))
    tcp = bytearray.fromhex("0007 0000 0006 01 04 0008 0001".replace(" ", ""))
    assert unit.feed_tcp(tcp).hex() == "00070000000501040208b1"


def test_exceptions():
    unit = ModbusUnit(1)
    unit.store(register(0), 1)
    assert unit.answer(b"\x06\x00\x00\x00\x01").hex() == "8601"  # function not known
    assert unit.answer(b"\x04\x03\xe7\x00\x01").hex() == "8402"  # no such register
    assert unit.answer(b"\x04\x00\x00\x00\x7e").hex() == "8403"  # more than 125
    unit.exception = 6
    assert unit.answer(b"\x04\x00\x00\x00\x01").hex() == "8406"


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=40))
def test_rtu_finds_the_request_behind_garbage(garbage):
    unit = ModbusUnit(1)
    unit.store(register(0), 5)
    request = rtu(b"\x01\x04\x00\x00\x00\x01")
    buffer = bytearray(garbage)
    unit.feed_rtu(buffer)
    buffer += bytes(8)  # ends whatever frame the garbage began
    unit.feed_rtu(buffer)
    buffer += request
    assert unit.feed_rtu(buffer).endswith(rtu(b"\x01\x04\x02\x00\x05"))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.binary(max_size=60), max_size=10))
def test_any_tcp_bytes_are_survived(chunks):
    unit, buffer = ModbusUnit(1), bytearray()
    for chunk in chunks:
        buffer += chunk
        unit.feed_tcp(buffer)
        assert len(buffer) < 400


@given(
    st.sampled_from(["int16", "uint16", "int32", "uint32", "int64", "float32", "float64"]),
    st.sampled_from(["big", "little"]),
    st.integers(0, 30000),
)
def test_types_and_word_orders_round_trip(type, order, value):
    r = register(0, type, order=order)
    assert decode(encode(value, r), r) == value


def test_float_words_are_these():
    words = list(struct.unpack(">HH", struct.pack(">f", 3.125)))
    assert words == [0x4048, 0x0000]
    assert decode([0x0000, 0x4048], register(0, "float32", order="little")) == 3.125


def test_neighbours_share_a_block_over_small_gaps_only():
    registers = [register(a) for a in range(12)] + [
        register(16, "int32"),
        register(40),
        register(3, kind="holding"),
    ]
    blocks = plan_blocks(enumerate(registers), max_gap=8, max_block=100)
    assert [(b.kind, b.address, b.count) for b in blocks] == [
        ("holding", 3, 1),
        ("input", 0, 18),
        ("input", 40, 1),
    ]
    assert sorted(i for b in blocks for i, _ in b.members) == list(range(15))
    assert [b.count for b in plan_blocks(enumerate(registers[:12]), 8, 5)] == [5, 5, 2]


@given(
    st.lists(
        st.tuples(st.integers(0, 300), st.sampled_from(["int16", "float32", "int64"])),
        min_size=1,
        max_size=20,
    ),
    st.integers(0, 20),
    st.integers(4, 125),
)
def test_blocks_cover_every_register_and_keep_the_limit(items, gap, limit):
    registers = [register(a, t) for a, t in items]
    blocks = plan_blocks(enumerate(registers), gap, limit)
    for b in blocks:
        assert 1 <= b.count <= limit
        for _, r in b.members:
            assert b.address <= r.address and r.address + r.words <= b.address + b.count
    assert sorted(i for b in blocks for i, _ in b.members) == list(range(len(registers)))


@pytest.mark.parametrize("raw,low,high", [(1e9, 32767, 32767), (-1e9, -32768, -32768)])
def test_a_reading_beyond_the_register_is_held_at_its_end(raw, low, high):
    assert low <= decode(encode(raw, register(0)), register(0)) <= high
