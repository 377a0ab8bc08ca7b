"""A recording that another program's own library wrote is diagnosed as the CSV is: the same plant, the same numbers."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from thermoctl.cli import main
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table
from thermoctl.recording.foreign.logger import read_recording

EXAMPLE = Path(__file__).resolve().parents[2] / "docs/examples/heater"


def write(path, t, columns):
    """As the maker of a data logger would: with the format's library alone."""
    if path.suffix == ".parquet":
        pa.parquet.write_table(pa.table({"t": t, **columns}), path)
    elif path.suffix == ".mf4":
        asammdf = pytest.importorskip(
            "asammdf", reason="asammdf is not installed: pip install 'thermoctl[formats]'"
        )
        with asammdf.MDF() as mdf:
            mdf.append([asammdf.Signal(v, t, name=n) for n, v in columns.items()])
            mdf.save(path)
    else:
        nptdms = pytest.importorskip(
            "nptdms", reason="npTDMS is not installed: pip install 'thermoctl[formats]'"
        )
        step = {"wf_increment": float(t[1] - t[0]), "wf_start_offset": float(t[0])}
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment([nptdms.ChannelObject("rig", n, v, step) for n, v in columns.items()])


@pytest.mark.parametrize("suffix", [".parquet", ".mf4", ".tdms"])
def test_a_foreign_recording_is_held_against_the_plant_as_a_csv_is(suffix, tmp_path, capsys):
    model = compile_plant(load(EXAMPLE / "plant.yaml"))
    csv = read_table(EXAMPLE / "run_1.csv")
    path = tmp_path / f"run_1{suffix}"
    write(path, csv.t, csv.columns)
    foreign, ours = (model.excitation(t) for t in (read_recording(path), csv))
    for name in ("t", "u", "y"):
        assert np.allclose(getattr(foreign, name), getattr(ours, name), rtol=0, atol=1e-9)
    said = []
    for recording in (EXAMPLE / "run_1.csv", path):
        assert main(["simulate", "--plant", str(EXAMPLE / "plant.yaml"), str(recording)]) == 0
        said.append(re.findall(r"[-+]?\d+\.\d+", capsys.readouterr().out))
    assert said[0] == said[1] and len(said[0]) >= 2
    # and it is refused as a CSV is
    spoilt = {n: v for n, v in csv.columns.items() if n != "heat"}
    write(tmp_path / f"spoilt{suffix}", csv.t, spoilt)
    files = [str(EXAMPLE / "plant.yaml"), str(tmp_path / f"spoilt{suffix}"), "--out", str(tmp_path / "out")]
    assert main(["diagnose", "--plant", *files]) == 2
    assert "no column 'heat'" in capsys.readouterr().err and not (tmp_path / "out").exists()
