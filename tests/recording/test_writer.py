"""The recorder's files: whatever happens, what was acknowledged opens."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import thermoctl.recording.writer as writing
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import read_table
from thermoctl.recording.stream import open_stream
from thermoctl.recording.writer import FULL, TIER, RecordingWriter, recording_files
from thermoctl.rig.signals import INDEX, SIGNALS

RNG = np.random.default_rng(1)


def ticks(n, start=0):
    """n ticks at 1 kHz: a ramp in position, noise, NaN where a sensor is absent."""
    rows = np.zeros((n, len(SIGNALS)))
    number = np.arange(start, start + n)
    rows[:, INDEX["t_s"]] = number * 1e-3
    rows[:, INDEX["tick"]] = number
    rows[:, INDEX["position_um"]] = number * 0.01
    rows[:, INDEX["coil_c"]] = RNG.normal(25, 0.1, n)
    rows[:, INDEX["output_reference_um"]] = np.nan
    rows[:, -1] = RNG.normal(size=n)  # coil_age_s: the end of a batch
    rows[:, INDEX["fault_bits"]] = np.where(number == 1234, 4.0, 1.0)
    return rows


def settings(directory, **changes):
    return SimpleNamespace(
        **{
            "directory": str(directory),
            "file_mb": 512.0,
            "file_s": 3600.0,
            "budget_gb": 1.0,
            "tier_budget_gb": 1.0,
            **changes,
        }
    )


def feed(writer, rows, piece=100):
    return sum(writer.write(rows[i : i + piece]) for i in range(0, len(rows), piece))


def only(directory, kind):
    (path,) = recording_files(Path(directory), kind)
    return path


def test_every_row_comes_back_with_what_the_file_says_about_itself(tmp_path):
    rows = ticks(2345)
    writer = RecordingWriter(settings(tmp_path), {"config": "rig: {name: a}", "law": "{}"}, rig="bench 3")
    assert feed(writer, rows) == 0 and writer.close() == 0
    path = only(tmp_path, FULL)
    table = read_table(path)
    assert path.name.startswith("bench_3-") and table.meta["config"] == "rig: {name: a}"
    for name, i in INDEX.items():
        np.testing.assert_array_equal(table.columns[name], rows[:, i], err_msg=name)
    np.testing.assert_array_equal(table.t, rows[:, INDEX["t_s"]])
    unit = open_stream(path).schema.field("coil_c").metadata
    assert unit[b"unit"] == b"degC"


def test_the_tier_is_min_mean_and_max_of_each_tenth(tmp_path):
    rows = ticks(2345)
    writer = RecordingWriter(settings(tmp_path), {})
    feed(writer, rows, 77)
    writer.close()
    tier = read_table(only(tmp_path, TIER))
    assert len(tier) == 24
    coil = rows[:2300, INDEX["coil_c"]].reshape(23, 100)
    np.testing.assert_allclose(tier.columns["coil_c"][:23], coil.mean(axis=1), rtol=1e-14)
    np.testing.assert_array_equal(tier.columns["coil_c_min"][:23], coil.min(axis=1))
    np.testing.assert_array_equal(tier.columns["coil_c_max"][:23], coil.max(axis=1))
    assert np.isnan(tier.columns["output_reference_um"]).all()
    assert tier.columns["fault_bits"][12] == 5.0 and tier.columns["fault_bits"][11] == 1.0
    np.testing.assert_allclose(tier.t, np.arange(24) * 0.1, atol=1e-12)


def test_cut_at_any_byte_everything_before_opens(tmp_path):
    writer = RecordingWriter(settings(tmp_path), {"config": "x"})
    rows = ticks(3000)
    ends = []  # (bytes on disk, rows acknowledged)
    for i in range(0, 3000, 500):
        writer.write(rows[i : i + 500])
        writer.flush()
        ends.append((os.path.getsize(writer.path), i + 500))
    path = writer.path
    writer.close()
    data = path.read_bytes()
    cuts = (
        RNG.integers(0, len(data), 120).tolist()
        + [e + d for e, _ in ends for d in (-1, 0, 1)]
        + [0, 1, len(data)]
    )
    for cut in cuts:
        copy = tmp_path / "cut.arrows"
        copy.write_bytes(data[:cut])
        expected = max((n for size, n in ends if size <= cut), default=0)
        if expected:
            np.testing.assert_array_equal(read_table(copy).columns["tick"], np.arange(expected))
        else:
            with pytest.raises(InputError, match="cut.arrows"):
                read_table(copy)
        copy.write_bytes(data[:cut] + bytes(4096))  # a file system that had reserved the block
        if expected:  # zeros are never taken for ticks
            table = read_table(copy)
            assert len(table) >= expected
            np.testing.assert_array_equal(table.columns["tick"], rows[: len(table), INDEX["tick"]])
            np.testing.assert_array_equal(
                table.columns["coil_age_s"], rows[: len(table), INDEX["coil_age_s"]]
            )


CHILD = """
import sys
sys.path.insert(0, {here!r})
from test_writer import RecordingWriter, settings, ticks
writer = RecordingWriter(settings({folder!r}), {{}})
n = 0
while True:
    writer.write(ticks(100, n))
    n += 100
    print(n, flush=True)
"""


@pytest.mark.parametrize("lines", [7, 23, 61])
def test_kill_9_loses_at_most_one_second(tmp_path, lines):
    code = CHILD.format(here=str(Path(__file__).parent), folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        for _ in range(lines):
            line = child.stdout.readline()
        child.kill()
    assert len(read_table(only(tmp_path, FULL))) >= int(line) - 1000


def test_files_turn_over_by_size_and_age_and_the_oldest_go(tmp_path):
    clock = SimpleNamespace(now=0.0)
    s = settings(tmp_path, budget_gb=2e-3, tier_budget_gb=1e-4, file_s=60.0)
    made, writer = 1, RecordingWriter(s, {}, clock=lambda: clock.now)
    for i in range(260):
        rows = ticks(500, i * 500)
        rows[:, INDEX["drive"]] = RNG.normal(size=500)
        writer.write(rows)
        if writer.full:
            writer.close()
            made, writer = made + 1, RecordingWriter(s, {}, clock=lambda: clock.now)
        assert sum(p.stat().st_size for p in recording_files(tmp_path, FULL)) <= 2e6
    last = writer.path
    writer.close()
    kept = recording_files(tmp_path, FULL)
    assert 1 < len(kept) < made and kept[-1] == last
    assert read_table(last).columns["tick"][-1] == 260 * 500 - 1
    assert sum(p.stat().st_size for p in recording_files(tmp_path, TIER)[:-1]) <= 1e5
    writer = RecordingWriter(s, {}, clock=lambda: clock.now)
    assert not writer.full
    clock.now += 60.0
    assert writer.full
    writer.close()


@pytest.mark.parametrize("right, wrong", [(1.8e9, 1.9e9), (1.8e9, 1e6)])
def test_a_wrong_clock_costs_no_recording_of_today(tmp_path, right, wrong):
    """Files of a clock that was ahead stayed for ever; each new file was deleted as the oldest instead."""
    s = settings(tmp_path, budget_gb=2e-4, tier_budget_gb=1e-4)
    wall, made = SimpleNamespace(now=wrong), []
    for k in range(16):
        wall.now = (right if k >= 8 else wrong) + 100 * k
        writer = RecordingWriter(s, {}, wall=lambda: wall.now)
        rows = ticks(500, 500 * k)
        rows[:, INDEX["drive"]] = RNG.normal(size=500)
        feed(writer, rows)
        made.append(writer.path)
        writer.close()
    kept = [k for k, path in enumerate(made) if path.exists()]
    assert kept == list(range(16 - len(kept), 16)) and 1 < len(kept) < 8


def test_what_is_not_ours_is_never_deleted(tmp_path):
    for name in ("thesis.arrows", "rig-20260101T000000.000Z.csv"):
        (tmp_path / name).write_bytes(bytes(10_000))
    old = tmp_path / "rig-20200101T000000.000Z.arrows"
    old.write_bytes(bytes(10_000_000))
    RecordingWriter(settings(tmp_path, budget_gb=1e-3), {}).close()
    assert not old.exists()
    assert {"thesis.arrows", "rig-20260101T000000.000Z.csv"} <= set(os.listdir(tmp_path))


def test_a_full_disk_loses_rows_is_counted_and_comes_back(tmp_path, monkeypatch):
    clock, said = SimpleNamespace(now=0.0), []
    writer = RecordingWriter(settings(tmp_path), {}, log=said.append, clock=lambda: clock.now)
    assert feed(writer, ticks(1002)) == 0
    before, real = writer.path, os.write

    def full(fd, data):
        real(fd, bytes(data)[:50])  # half a batch fits, then it is full
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(writing.os, "write", full)
        lost = feed(writer, ticks(2004, 1002))
        assert lost > 1000 and "No space left" in writer.error and len(said) <= 3 and not writer.full
        clock.now += 5.0
        assert writer.full
        lost += writer.close()
    assert len(read_table(before)) + lost == 3006
    writer = RecordingWriter(settings(tmp_path), {}, log=said.append)
    assert feed(writer, ticks(1002, 3006)) + writer.close() == 0


def test_a_place_that_cannot_be_written_is_said_not_raised(tmp_path):
    (tmp_path / "file").write_text("")
    said = []
    writer = RecordingWriter(settings(tmp_path / "file" / "below"), {}, log=said.append)
    assert feed(writer, ticks(1002)) + writer.close() == 1002
    assert len(said) == 1 and "Not a directory" in said[0]


def test_a_full_disk_deletes_nothing_and_leaves_no_empty_file(tmp_path, monkeypatch):
    feed(old := RecordingWriter(settings(tmp_path), {}), ticks(1002))
    old.close()
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    said, clock, room = [], SimpleNamespace(now=0.0), [0]
    real = os.write

    def full(fd, data):
        if len(data) > room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        room[0] -= len(data)
        return real(fd, data)

    monkeypatch.setattr(writing.os, "write", full)
    for size in (0, 40_000):  # no room for the beginning; room for the beginning, none for the rows
        room[0] = size
        for again in range(3):
            writer = RecordingWriter(settings(tmp_path), {}, log=said.append, clock=lambda: clock.now)
            assert feed(writer, ticks(1002, 2000 + again)) + writer.close() == 1002
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before
    assert set(said) == {f"{tmp_path}: No space left on device; free some space"}


def test_a_recording_is_readable_from_its_first_moment_and_names_the_time(tmp_path):
    writer = RecordingWriter(settings(tmp_path), {}, wall=lambda: 1.75e9)
    assert open_stream(writer.path).schema.metadata[b"begins"] == b"2025-06-15T15:06:40.000+00:00"
    writer.close()


def _replace(path):
    path.with_suffix(".copy").write_bytes(path.read_bytes())
    path.with_suffix(".copy").replace(path)


@pytest.mark.parametrize(
    "disturb", [os.unlink, _replace, lambda p: os.truncate(p, 2000)], ids=["gone", "other", "cut"]
)
def test_a_recording_that_another_program_changed_is_not_written_on(tmp_path, disturb):
    """Ticks of an hour were lost without a word where a tool had put a copy in the file's place, or had cut it."""
    said = []
    writer = RecordingWriter(settings(tmp_path), {}, log=said.append)
    assert feed(writer, ticks(1002)) == 0 and said == [""]
    disturb(writer.path)
    assert 0 < feed(writer, ticks(502, 1002)) <= 502
    assert writer.full and "deleted, moved or changed; a new file begins" in said[1]
    writer.close()
    again = RecordingWriter(settings(tmp_path), {}, log=said.append)
    assert feed(again, ticks(1002, 2000)) == 0 == again.close()
    assert read_table(recording_files(tmp_path, FULL)[-1]).columns["tick"][0] == 2000


def test_a_file_where_the_folder_belongs_is_no_full_disk(tmp_path):
    (tmp_path / "rec").write_text("")
    said = []
    writer = RecordingWriter(settings(tmp_path / "rec"), {}, log=said.append)
    assert "a file stands where a folder belongs" in said[0] and "space" not in said[0]
    assert feed(writer, ticks(1002, 1002)) + writer.close() == 1002
