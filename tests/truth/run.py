"""Diagnose one case without report and experiment; keep result and search."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import resource
import time
from pathlib import Path
from typing import Any, cast

from thermoctl import __version__
from thermoctl.diagnosis import diagnose as engine
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.data.case import Budget
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import Thresholds, limits
from thermoctl.diagnosis.relabelled import relabelled
from thermoctl.diagnosis.threads import one_thread
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.jobs import Job, Run
from thermoctl.plant import load, save
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import SimulationError

KEPT = "sought.pickle"


def diagnose(job: Job, out: str) -> Run:
    """Write OUT/diagnosis.json and then OUT/run.json. CPU seconds count compilers that ran, too."""
    folder, error, result = Path(out), None, None
    folder.mkdir(parents=True, exist_ok=True)
    started, cpu = time.monotonic(), _cpu()
    try:
        with one_thread():
            result = _result(job, folder / KEPT)
    except (InputError, SimulationError) as e:
        error = str(e)
    except Exception as e:  # a crash is a result
        error = f"{type(e).__name__}: {e}"
    run: Run = {
        "name": job.name,
        "fingerprint": job.fingerprint(),
        "version": __version__,
        "error": error,
        "seconds": round(time.monotonic() - started, 2),
        "cpu_s": round(_cpu() - cpu, 2),
    }
    if result is not None:
        _write(folder / "diagnosis.json", result)
    _write(folder / "run.json", run)
    return run


def _result(job: Job, path: Path) -> dict[str, Any]:
    found = sought(job, limits())
    diagnosis = engine.decided(found)
    if engine.undecided(diagnosis, job.held_out):
        found = sought(job, limits(), False)
        diagnosis = engine.decided(found)
    _keep(found, path)
    if wrong := relabelled(diagnosis):
        raise InputError(str(wrong[0]))
    save(diagnosis.plant, path.with_name("plant.yaml"))
    load(path.with_name("plant.yaml"))
    return contract(diagnosis)


def sought(job: Job, numbers: Thresholds, aside: bool = True) -> engine.Sought:
    """Return the search of a job; `aside` as in the engine. Raises InputError, SimulationError."""
    plant = load(job.plant)
    tables, apart = (read_recordings(plant, files) for files in (job.recordings, job.held_out))
    return engine.sought(plant, tables, catalogue((CATALOGUE,)), numbers, apart, aside=aside)


def _keep(sought: engine.Sought, path: Path) -> None:
    """Keep a search without its budget, which holds functions, and without the sums of its screening."""
    budget = sought.case.budget
    case = dataclasses.replace(sought.case, budget=cast(Budget, None))
    searched = dataclasses.replace(sought.searched, norms=())
    lean = dataclasses.replace(sought, case=case, searched=searched)
    path.write_bytes(pickle.dumps((lean, budget.fits, budget.fits_done, budget.untried), -1))


def kept(out: Path) -> engine.Sought:
    """Return the search of a diagnosis that OUT keeps."""
    sought, fits, done, untried = pickle.loads((out / KEPT).read_bytes())
    budget = Budget(fits, fits_done=done, untried=untried)
    return dataclasses.replace(sought, case=dataclasses.replace(sought.case, budget=budget))


def _cpu() -> float:
    """CPU seconds of this process and of its children that ended."""
    own, others = (resource.getrusage(x) for x in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def _write(path: Path, content: Any) -> None:
    part = path.with_name(f".{path.name}-{os.getpid()}")
    part.write_text(json.dumps(content) + "\n")
    os.replace(part, path)
