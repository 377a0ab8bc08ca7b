"""One diagnosis on a Dask cluster: the same bytes as here, also when a worker dies."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from tests.proof.test_proof import a_dask_by_hand
from thermoctl.diagnosis import workers as dask_workers
from thermoctl.diagnosis.run import diagnose
from thermoctl.diagnosis.workers import cluster
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

LOST = "{from: block, rate: 3e-9 * ((block + 273.15)**4 - (air + 273.15)**4), unit: W}"


def rig(folder, rows: int = 400, recordings: int = 2):
    """Return the plant of one block, and recordings of it with radiation."""
    path = folder / "plant.yaml"
    path.write_text(ONE_BLOCK.replace("flows:\n", f"flows:\n  concealed: {LOST}\n"))
    model, t, tables = compile_plant(load(path)), np.arange(float(rows)), []
    for k in range(recordings):
        heat = 12.0 * np.random.default_rng(k).integers(0, 2, 8)[(8 * t // rows).astype(int)]
        tables.append(
            model.measure(Table(f"run_{k}", f"run_{k}", t, {"heat": heat, "air": 20 + 0 * t}), seed=k)
        )
    path.write_text(ONE_BLOCK)
    return load(path), tables


def test_the_problem_of_one_recording_computes_the_same_in_another_process(tmp_path):
    plant, tables = rig(tmp_path)
    model = compile_plant(plant)
    drives = [model.prepare(model.excitation(t)) for t in tables]
    whole = Problem(model, drives, default_noise(plant, drives))
    values, dx0 = whole.unpack(whole.z_plant)
    sent = pickle.loads(pickle.dumps(whole.alone(1)))
    here = whole._part(1, values[1], dx0[1], True, False, whole.huber)
    there = sent._part(0, values[1], dx0[1], True, False, whole.huber)
    assert here.cost == there.cost
    for name in ("unknowns", "gradient", "matrix", "residual"):
        assert np.array_equal(getattr(here, name), getattr(there, name), equal_nan=True)


def test_an_address_without_a_scheduler_is_refused(monkeypatch):
    monkeypatch.setattr(dask_workers, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler"), cluster("tcp://127.0.0.1:1"):
        pass


@pytest.mark.slow
def test_a_killed_worker_changes_no_byte(tmp_path):
    plant, tables = rig(tmp_path, 2000, 3)
    diagnose(plant, tables, tmp_path / "here")
    with a_dask_by_hand(tmp_path) as (address, workers), cluster(address):

        def progress(text):
            if "refit 2 of" in text:
                workers[0].kill()

        diagnose(plant, tables, tmp_path / "there", progress=progress)
        assert workers[0].poll() is not None
    here, there = (json.loads((tmp_path / d / "diagnosis.json").read_text()) for d in ("here", "there"))
    assert here | {"seconds": 0} == there | {"seconds": 0}
    assert (tmp_path / "here" / "plant.yaml").read_bytes() == (tmp_path / "there" / "plant.yaml").read_bytes()
