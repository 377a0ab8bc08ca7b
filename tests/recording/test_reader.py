"""Export, recover, list: read back with each format's own library."""

import csv
import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from test_writer import feed, only, settings, ticks

from thermoctl.cli import main
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.reader import export, info, read_rows, recover
from thermoctl.recording.table import Table
from thermoctl.recording.writer import FULL, TIER, RecordingWriter
from thermoctl.rig.signals import INDEX


@pytest.fixture
def recording(tmp_path):
    rows = ticks(1500)
    rows[:, INDEX["wall_s"]] = 1.7e9 + rows[:, INDEX["t_s"]]
    writer = RecordingWriter(settings(tmp_path), {"config": "c", "law": "{}"})
    feed(writer, rows)
    writer.close()
    return only(tmp_path, FULL), rows


def test_rows_for_a_replay_are_the_written_ones(recording, tmp_path):
    path, rows = recording
    back, law = read_rows(path)
    np.testing.assert_array_equal(back, rows)
    assert law == "{}"
    with pytest.raises(InputError, match="no full-rate recording"):
        read_rows(only(tmp_path, TIER))


def test_recover_gives_a_file_that_any_arrow_reader_opens(recording, tmp_path):
    path, rows = recording
    cut = tmp_path / "cut.arrows"
    cut.write_bytes(path.read_bytes()[:-5000])
    assert not info(cut).whole and info(path).whole
    mended = recover(cut, tmp_path / "mended.arrows")
    with pa.ipc.open_stream(tmp_path / "mended.arrows") as f:
        arrow = f.read_all()
    assert mended.whole and mended.rows == arrow.num_rows == info(cut).rows > 0
    np.testing.assert_array_equal(arrow["coil_c"].to_numpy(), rows[: arrow.num_rows, INDEX["coil_c"]])
    with pytest.raises(InputError, match="exists already"):
        recover(cut, tmp_path / "mended.arrows")


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mf4", ".mcap"])
def test_an_export_reads_back_with_the_formats_own_library(recording, tmp_path, suffix):
    path, rows = recording
    out = tmp_path / f"out{suffix}"
    assert export(path, out, ["coil_c", "output_reference_um", "wall_s"], 0.1, 0.9) == 800
    t, coil = rows[100:900, INDEX["t_s"]], rows[100:900, INDEX["coil_c"]]
    if suffix == ".csv":
        with open(out, newline="") as f:
            cells = list(csv.DictReader(f))
        got = tuple(
            np.array([float(c[n] or "nan") for c in cells]) for n in ("t_s", "coil_c", "output_reference_um")
        )
    elif suffix == ".parquet":
        arrow = pa.parquet.read_table(out)
        got = tuple(arrow[n].to_numpy() for n in ("t_s", "coil_c", "output_reference_um"))
        assert arrow["output_reference_um"].null_count == 800
    elif suffix == ".mf4":
        asammdf = pytest.importorskip("asammdf")
        with asammdf.MDF(str(out)) as mdf:
            signal = mdf.get("coil_c")
            got = signal.timestamps, signal.samples, mdf.get("output_reference_um").samples
            assert signal.unit == "degC"
    else:
        mcap = pytest.importorskip("mcap.reader")
        with open(out, "rb") as f:
            messages = [(m.log_time, json.loads(m.data)) for _, _, m in mcap.make_reader(f).iter_messages()]
        assert messages[0][0] == round((1.7e9 + 0.1) * 1e9) and "output_reference_um" not in messages[0][1]
        got = (
            np.array([m["t_s"] for _, m in messages]),
            np.array([m["coil_c"] for _, m in messages]),
            np.full(800, np.nan),
        )
    for have, want in zip(got, (t, coil, np.full(800, np.nan)), strict=True):
        np.testing.assert_array_equal(have, want)
    if suffix != ".mcap":
        again = (read_recording if suffix == ".mf4" else read_table)(out)
        np.testing.assert_array_equal(again.columns["coil_c"], coil)
    assert not [n for n in os.listdir(tmp_path) if n.startswith(".")]


def test_tdms_and_mdf_of_several_rates_are_read(tmp_path):
    nptdms, asammdf = pytest.importorskip("nptdms"), pytest.importorskip("asammdf")
    fast, slow = np.arange(10) * 0.1, np.arange(2) * 0.5
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("g", "x", fast + 1, {"wf_increment": 0.125, "wf_start_offset": 0.0}),
                nptdms.ChannelObject("g", "y", slow + 7, {"wf_increment": 0.5}),
            ]
        )
    table = read_recording(tmp_path / "a.tdms")
    np.testing.assert_array_equal(table.columns["x"], fast + 1)
    assert (
        table.columns["y"][0] == 7.0
        and table.columns["y"][4] == 7.5
        and np.isnan(table.columns["y"]).sum() == 8
    )
    with nptdms.TdmsWriter(tmp_path / "b.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("g", "x", fast)])
    with pytest.raises(InputError, match="name it with --time"):
        read_recording(tmp_path / "b.tdms")
    with asammdf.MDF() as mdf:
        mdf.append([asammdf.Signal(fast + 1, np.arange(10) / 8, name="x")])
        mdf.append([asammdf.Signal(slow + 7, slow, name="y")])
        mdf.save(tmp_path / "c.mf4")
    mdf_table = read_recording(tmp_path / "c.mf4")
    for name in ("x", "y"):
        np.testing.assert_array_equal(mdf_table.columns[name], table.columns[name])
    (tmp_path / "junk.mf4").write_bytes(b"MDF     4.10" + bytes(200))
    (tmp_path / "junk.tdms").write_bytes(b"TDSm" + bytes(20))
    for name in ("junk.mf4", "junk.tdms", "none.tdms"):
        with pytest.raises(InputError, match=name):
            read_recording(tmp_path / name)


def test_commands(recording, tmp_path, capsys):
    path, _ = recording
    assert main(["recordings", "list", str(tmp_path), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [f["rows"] for f in listed] == [15, 1500] and all(f["whole"] for f in listed)
    assert main(["recordings", "info", str(path)]) == 0
    assert "1500 rows" in (text := capsys.readouterr().out) and "coil_c" in text and "config:\n  c" in text
    assert main(["recordings", "export", str(path), str(tmp_path / "x.csv"), "--columns", "coil_x"]) == 2
    assert "did you mean 'coil_c'?" in capsys.readouterr().err
    assert main(["recordings", "export", str(path), str(tmp_path / "x.csv"), "--from", "9"]) == 2
    assert "no rows from 9" in capsys.readouterr().err and not (tmp_path / "x.csv").exists()
    assert main(["recordings", "recover", str(path)]) == 0
    assert "1500 rows" in capsys.readouterr().out
    assert main(["recordings", "list", str(tmp_path / "none")]) == 2


def test_export_of_a_csv_to_parquet(tmp_path):
    write_table(tmp_path / "a.csv", Table("a", "", np.arange(3.0), {"x": np.array([1, np.nan, 3])}))
    assert export(tmp_path / "a.csv", tmp_path / "a.parquet") == 3
    np.testing.assert_array_equal(read_table(tmp_path / "a.parquet").columns["x"], [1, np.nan, 3])
