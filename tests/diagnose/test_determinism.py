"""The same bytes of diagnosis.json on one thread and two, whatever the hash seed, on a loaded machine."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import blas

from tests.diagnose.test_engine import LAGGED, _write, written
from thermoctl.diagnosis import diagnose as diagnosis
from thermoctl.diagnosis import threads
from thermoctl.files.yamlfile import InputError


def test_two_runs_at_once_on_one_and_on_two_threads_write_the_same_bytes(tmp_path):
    files = _write(tmp_path / "case", LAGGED, 5)
    plant = str(tmp_path / "case" / "plant.yaml")
    outs, started = [tmp_path / "1", tmp_path / "2"], []
    for n, out in enumerate(outs, 1):
        names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "PYTHONHASHSEED")
        env = os.environ | dict.fromkeys(names, str(n))
        words = f"-m thermoctl.cli diagnose --quiet --plant {plant} --out {out}".split()
        command = [sys.executable, *words, *files]
        started.append(subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL))
    assert [p.wait(timeout=300) for p in started] == [0, 0]
    assert set(written(outs[0])) == {"diagnosis.json", "memory.json", "plant.yaml", "report.html"}
    assert written(outs[0]) == written(outs[1])


def test_a_diagnosis_runs_on_one_thread_and_gives_the_others_back(monkeypatch):
    blas.dnrm2(np.ones(3))  # scipy's own copy is loaded
    controls = threads._controls()
    before = [get() for get, _ in controls]
    for _, put in controls:
        put(2)
    seen: list[int] = []

    def stop(*_: object) -> None:
        seen.extend(get() for get, _ in controls)
        raise InputError("seen enough")

    monkeypatch.setattr(diagnosis, "split", stop)
    try:
        with pytest.raises(InputError, match="seen enough"):
            diagnosis.diagnose(None, [], {}, None)
        assert set(seen) == {1}
        assert {get() for get, _ in controls} == {2}
    finally:
        for (_, put), n in zip(controls, before, strict=True):
            put(n)
