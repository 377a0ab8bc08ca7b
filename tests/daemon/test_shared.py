"""Shared memory between the loop and its readers: order, loss, torn rows, leftovers, other versions."""

import multiprocessing
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermoctl.daemon.answers.snapshot import latency
from thermoctl.daemon.tick.clock import now_ns, sleep_until
from thermoctl.daemon.tick.ring import Box, Histogram, Mailbox, Record, Ring, unpack_readings
from thermoctl.daemon.tick.shared import Shared, percentiles
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.signals import OUTPUTS


def ring(slots=8, columns=3):
    return Ring(np.zeros(1, np.uint64), np.zeros((slots, columns)))


@given(st.lists(st.integers(0, 25), max_size=30))
def test_a_reader_gets_every_row_once_or_is_told_how_many_it_lost(bursts):
    r, position, written, expected = ring(), 0, 0, 0
    for burst in bursts:
        for _ in range(burst):
            r.write(np.full(3, float(written)))
            written += 1
        rows, position, lost = r.read(position)
        assert position == written and lost == max(0, burst - 7)
        expected += lost
        np.testing.assert_array_equal(rows[:, 0], np.arange(expected, written))
        expected = written
    newest = r.newest()
    assert (newest is None) == (written == 0)
    if written:
        assert newest[0] == written - 1


def _write_rows(name, count):
    shared = Shared.attach(name)
    row = np.zeros(shared.ring.columns)
    for k in range(count):
        row[:] = k
        shared.ring.write(row)
    os._exit(0)


@pytest.fixture
def name():
    return f"thermoctl-test-{os.getpid()}"


def test_rows_from_another_process_are_whole_and_in_order(name):
    """A writer without a pause against a reader: no torn row, no row twice, losses counted exactly."""
    shared = Shared.create(name)
    try:
        count = 60_000
        writer = multiprocessing.get_context("fork").Process(target=_write_rows, args=(name, count))
        writer.start()
        position, seen, lost_all, last = 0, 0, 0, -1.0
        while position < count:
            rows, position, lost = shared.ring.read(position, 2000)
            lost_all += lost
            seen += len(rows)
            if len(rows):
                assert (rows == rows[:, :1]).all() and (np.diff(rows[:, 0]) == 1).all() and rows[0, 0] > last
                last = rows[-1, 0]
            assert writer.is_alive() or writer.exitcode == 0
        writer.join()
        assert seen + lost_all == count and last == count - 1
    finally:
        shared.remove()


def _create_and_die(name):
    Shared.create(name).counters[0] = 7.0
    os._exit(1)


def test_a_left_over_segment_is_replaced_and_a_foreign_one_refused(name):
    first = Shared.create(name)
    with pytest.raises(InputError, match="another daemon holds this rig, and may drive it"):
        Shared.create(name)
    first.remove()
    killed = multiprocessing.get_context("fork").Process(target=_create_and_die, args=(name,))
    killed.start()
    killed.join()
    second = Shared.create(name)
    try:
        assert second.counters[0] == 0.0 and second.ring.head == 0
        second.areas["header"][1] = 99
        with pytest.raises(InputError, match="of another version"):
            Shared.attach(name)
    finally:
        second.remove()
    with pytest.raises(InputError, match="no daemon runs"):
        Shared.attach(name)


def test_mailbox_keeps_order_and_refuses_when_full():
    box = Mailbox(np.zeros(2, np.uint64), np.zeros((4, 2)))
    assert box.take() is None
    assert [box.push(k, 10.0 * k) for k in range(5)] == [True] * 4 + [False]
    assert [box.take() for _ in range(5)] == [(k, 10.0 * k) for k in range(4)] + [None]
    assert box.pushed == box.taken == 4


def test_box_gives_the_last_vector():
    box = Box(np.zeros(1, np.uint64), np.zeros(5))
    assert box.get() is None
    box.put(np.array([1.0, 2.0]))
    box.put(np.array([3.0, np.nan, 5.0]))
    np.testing.assert_array_equal(box.get(), [3.0, np.nan, 5.0])
    with pytest.raises(ValueError, match="do not fit"):
        box.put(np.zeros(5))


def _count(name):
    shared = Shared.attach(name)
    counts = shared.areas["lateness"]
    while True:
        counts[:] = 0
        counts[:] = 1


def test_latency_is_told_while_the_loop_counts_on():
    """Bins that fill while they are read ended the command process once in some hundred runs of the tests."""
    name = f"thermoctl-test-{os.getpid()}-counting"
    shared = Shared.create(name)
    child = multiprocessing.get_context("fork").Process(target=_count, args=(name,), daemon=True)
    child.start()
    try:
        filled = 0
        deadline = now_ns() + 60_000_000_000
        while filled < 300 and now_ns() < deadline:
            filled += len(latency(shared, 1e-3)["lateness"]["bins_us"]) > 0
        assert filled >= 300
    finally:
        child.kill()
        child.join()
        shared.remove()


def test_histogram_and_percentiles():
    counts, largest = np.zeros(101, np.uint64), np.zeros(1)
    h = Histogram(counts, largest)
    values = np.random.default_rng(1).uniform(-1, 120, 5000)
    for v in values:
        h.add(v)
    assert counts.sum() == 5000 and counts[100] == (values >= 100).sum() and largest[0] == values.max()
    (p50,) = percentiles(counts, (0.5,))
    assert abs(p50 - np.percentile(values, 50)) < 1.5
    assert np.isnan(percentiles(np.zeros(4, np.uint64))).all()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3), st.integers(0, 15)), min_size=9, max_size=72))
def test_readings_pack_into_exact_numbers(channels):
    fresh, status, delay = np.array(channels, dtype=np.uint8).T.copy()
    n = len(channels)
    delay[:7] = 0  # of temperatures only
    words = sum(-(-count // size) for count, size in ((n, 52), (n, 26), (n - 7, 13)))
    outputs = np.arange(100.0, 100.0 + len(OUTPUTS) + n - 8)
    row, values = np.zeros(3 + n + words + len(outputs)), np.arange(float(n))
    record = Record(row, 3)
    record.bind(values, fresh, status, delay, outputs)
    row[:3] = 7, 8.5, 9
    record.fill()
    first = 3 + len(OUTPUTS)
    bits = slice(first + n, first + n + words)
    parts = [row[:3], row[3:first], row[first : bits.start], row[bits.stop :]]
    expected = [7, 8.5, 9, *outputs[: len(OUTPUTS)], *values, *outputs[len(OUTPUTS) :]]
    np.testing.assert_array_equal(np.concatenate(parts), expected)
    assert (row[bits] < 2.0**52).all()
    again = np.zeros((3, n), np.uint8)
    unpack_readings(row[bits], *again)
    np.testing.assert_array_equal(again, [fresh, status, delay])
    with pytest.raises(ValueError, match="words of bits"):
        unpack_readings(row[bits][1:], *again)


@pytest.mark.parametrize("spin_ns", [0, 200_000])
def test_sleep_until_is_never_early(spin_ns):
    for _ in range(20):
        deadline = now_ns() + 500_000
        now = sleep_until(deadline, spin_ns)
        assert now >= deadline and now_ns() >= now
    assert sleep_until(now_ns() - 1000) >= now
