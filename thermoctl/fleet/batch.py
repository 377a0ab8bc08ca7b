"""Diagnose many cases in parallel through Dask, and skip those already done.

Workers are separate processes: a case that kills its worker does not stop the others.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from thermoctl import __version__
from thermoctl.diagnosis.run import diagnose_files
from thermoctl.extras import load
from thermoctl.files.safe_file import make_folder, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.jobs import Job, Run, done
from thermoctl.interrupt import held

RETRIES = 3  # number of workers that may die on one case before it counts as failed

OnCase = Callable[[int, int, Run], None]  # cases done, cases to do, the newest


def run_one(job: Job, out: str) -> Run:
    """Diagnose one case in this process; OUT/run.json is written last. A bad case raises nothing.

    `cpu_s` there is the processor time of this process and its children, such as the compiler."""
    started, cpu = time.monotonic(), _cpu()
    error = None
    try:
        diagnose_files(job.plant, job.recordings, out, [Path(e) for e in job.effects], job.held_out)
    except InputError as e:
        error = str(e)
    except Exception as e:  # a crash of one does not end the others
        error = f"{type(e).__name__}: {e}"
    run = _run(job, error, round(time.monotonic() - started, 2))
    run["cpu_s"] = round(_cpu() - cpu, 2)
    write_text(make_folder(out) / "run.json", json.dumps(run) + "\n")
    return run


def _cpu() -> float:
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def _run(job: Job, error: str | None, seconds: float | None) -> Run:
    return {
        "name": job.name,
        "fingerprint": job.fingerprint(),
        "version": __version__,
        "error": error,
        "seconds": seconds,
    }


def _dask() -> tuple[Any, Any]:
    """Return dask and distributed; their import takes a second. Raises InputError where one is missing."""
    many = "many rigs or cases"
    return load("dask", many), load("distributed", many)


@contextmanager
def cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """Open a Dask client of the scheduler at the address, else of local single-threaded processes."""
    dask, distributed = _dask()
    options = {
        "distributed.scheduler.allowed-failures": RETRIES,
        "distributed.worker.daemon": False,
        "distributed.comm.timeouts.connect": "60s",
    }
    with dask.config.set(options), ExitStack() as opened:
        try:
            with held():  # a half-made cluster cannot be closed
                address = scheduler or opened.enter_context(
                    distributed.LocalCluster(
                        n_workers=workers or os.cpu_count(),
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address="127.0.0.1:0",
                        memory_limit=0,
                        silence_logs=50,
                    )
                )
                client = opened.enter_context(distributed.Client(address))
            yield client
        finally:
            with held():
                opened.close()


def run_all(
    jobs: Sequence[Job],
    out: Path,
    scheduler: str | None = None,
    workers: int | None = None,
    task: Callable[[Job, str], Run] = run_one,
    progress: OnCase | None = None,
) -> int:
    """Run every job that is not done yet into OUT/NAME; return how many were run.

    `task` is called in a worker."""
    waiting = [j for j in jobs if not done(j, out / j.name)]
    if not waiting:
        return 0
    _, distributed = _dask()
    with cluster(scheduler, workers) as client:
        futures = {
            client.submit(task, j, str(out / j.name), pure=False, key=f"case-{j.name}"): j for j in waiting
        }
        for count, future in enumerate(distributed.as_completed(list(futures)), 1):
            job = futures[future]
            if future.status == "error":  # RETRIES workers died with this job
                run = _run(job, f"{type(future.exception()).__name__}: {future.exception()}", None)
                write_text(make_folder(out / job.name) / "run.json", json.dumps(run) + "\n")
            else:
                run = future.result()
            if progress:
                progress(count, len(waiting), run)
    return len(waiting)


class Reporter:
    """Progress on stderr: one line a case with the time that is left."""

    def __init__(self) -> None:
        self.started = time.monotonic()

    def __call__(self, count: int, total: int, run: Run) -> None:
        left = (time.monotonic() - self.started) / count * (total - count)
        what = f" {run['error']}" if run["error"] else ""
        print(
            f"[{count}/{total}] {run['name']} {run.get('seconds') or 0:.0f} s, {left / 60:.1f} min left{what}",
            file=sys.stderr,
            flush=True,
        )
