"""Diagnose one case without report and experiment, and keep what the table needs."""

from __future__ import annotations

import json
import os
import resource
import time
from pathlib import Path
from typing import Any

from thermoctl import __version__
from thermoctl.diagnose import diagnosis as engine
from thermoctl.diagnose.catalogue import CATALOGUE, catalogue
from thermoctl.diagnose.limits import limits
from thermoctl.diagnose.result import contract
from thermoctl.diagnose.threads import one_thread
from thermoctl.fleet.jobs import Job, Run
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulate import SimulationError
from thermoctl.yamlfile import InputError


def diagnose(job: Job, out: str) -> Run:
    """Write OUT/diagnosis.json and then OUT/run.json. CPU seconds count compilers that ran, too."""
    folder, error, result = Path(out), None, None
    folder.mkdir(parents=True, exist_ok=True)
    started, cpu = time.monotonic(), _cpu()
    try:
        with one_thread():
            result = _result(job)
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


def _result(job: Job) -> dict[str, Any]:
    plant = load(job.plant)
    tables, apart = (read_recordings(plant, files) for files in (job.recordings, job.held_out))
    return contract(engine.diagnose(plant, tables, catalogue((CATALOGUE,)), limits(), apart))


def _cpu() -> float:
    """CPU seconds of this process and of its children that ended."""
    own, others = (resource.getrusage(x) for x in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def _write(path: Path, content: Any) -> None:
    part = path.with_name(f".{path.name}-{os.getpid()}")
    part.write_text(json.dumps(content) + "\n")
    os.replace(part, path)
