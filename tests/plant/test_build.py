"""Compiled plants on disk: what is kept, and where nothing can be kept."""

from pathlib import Path

import numpy as np
import pytest

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import loads
from thermoctl.plant.native.build import run_compiler
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

BODY = """format: thermoctl-plant/1
inputs: {{P: {{unit: W}}}}
parameters: {{C: {{value: 40, range: [10, 90]}}, G: {{value: 0.8, range: [0.1, 3]}}}}
nodes: {{T: {{storage: C, initial: 0}}}}
flows: {{heat: {{into: T, rate: P}}, out: {{from: T, rate: {rate}}}}}
outputs: {{y: {{value: T}}}}"""
RATES = ("G * T", "G * T + 0.1 * P", "G * T**2", "G * abs(T)**1.5")  # two linear, two not


def heated(rate: str) -> np.ndarray:
    t = np.arange(20.0)
    run = compile_plant(loads(BODY.format(rate=rate))).simulate(Table("r", "r", t, {"P": t}))
    return np.asarray(run.y[:, 0])


@pytest.fixture
def fresh(monkeypatch):
    monkeypatch.setattr("thermoctl.plant.simulation.compile._LOADED", {})


def test_plants_of_as_many_states_share_one_compiled_integrator(tmp_path: Path, monkeypatch, fresh):
    monkeypatch.setenv("THERMOCTL_CACHE", str(tmp_path))
    for rate in (*RATES, *RATES):
        heated(rate)
    assert len(list(tmp_path.glob("*.so"))) == len(RATES)
    assert len(list(tmp_path.glob("*.o"))) == 2 and len(list(tmp_path.iterdir())) == len(RATES) + 2


def test_where_no_cache_can_be_written_a_plant_is_compiled_for_this_process(
    tmp_path: Path, monkeypatch, fresh
):
    monkeypatch.setenv("THERMOCTL_CACHE", str(tmp_path / "kept"))
    expected = heated(RATES[2])
    monkeypatch.setattr("thermoctl.plant.simulation.compile._LOADED", {})
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("THERMOCTL_CACHE", str(tmp_path / "file" / "cache"))
    assert np.array_equal(heated(RATES[2]), expected)
    assert (tmp_path / "file").read_text() == ""


def test_a_compiler_that_fails_gives_one_line_and_needs_no_room_elsewhere(tmp_path: Path):
    """gcc wrote its own files to /tmp: where that was full, nothing could be simulated."""
    fails = 'echo "in file a.c:" >&2; echo "error: no room in $TMPDIR" >&2; echo "  5 | x" >&2; exit 1'
    with pytest.raises(InputError, match=f"failed on the plant: error: no room in {tmp_path}$"):
        run_compiler(["sh", "-c", fails], "the plant", str(tmp_path))
