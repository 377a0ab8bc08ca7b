"""The cases of a proof, each with its sealed answer.

A case is a folder with plant.yaml and recordings. Answers lie apart (DIR/NAME.yaml, checked against
manifest.sha256) or as answer.yaml inside the case.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import InputError, load
from thermoctl.fleet.jobs import Job

RECORDINGS = (".csv", ".parquet", ".arrow")


def find_jobs(folder: str | Path, number: int | None = None) -> list[Job]:
    """Find the cases in a folder, in order of their names; `number`: only the first so many.

    Raises InputError without a case."""
    root = Path(folder)
    if not root.is_dir():
        raise InputError(
            f"{root}: no such folder; expected a folder of cases, each with plant.yaml and recordings"
        )
    jobs = []
    for plant in sorted(root.glob("*/plant.yaml")):
        runs = tuple(str(p) for p in sorted(plant.parent.iterdir()) if p.suffix in RECORDINGS)
        if not runs:
            raise InputError(
                f"{plant.parent}: plant.yaml without a recording; expected run_1.csv or the like beside it"
            )
        jobs.append(Job(plant.parent.name, str(plant), runs))
    if not jobs:
        raise InputError(f"{root}: no case in it; expected folders with plant.yaml and recordings")
    return jobs[:number]


def read_answers(jobs: Sequence[Job], answers: Path | None) -> dict[str, dict[str, Any]]:
    """Read the answer of each case. Answers that lie apart must match their manifest.sha256.

    Raises InputError.
    """
    sealed: dict[str, str] = {}
    if answers is not None and (answers / "manifest.sha256").exists():
        for line in (answers / "manifest.sha256").read_text().splitlines():
            digest, name = line.split(maxsplit=1)
            sealed[name] = digest
    found = {}
    for job in jobs:
        path = answers / f"{job.name}.yaml" if answers is not None else Path(job.plant).parent / "answer.yaml"
        if not path.exists():
            raise InputError(
                f"{path}: no answer for case {job.name}; give the folder of answers with --answers"
            )
        content = path.read_bytes()
        if sealed and sealed.get(path.name) != hashlib.sha256(content).hexdigest():
            raise InputError(
                f"{path}: the answer is not the one that was sealed (manifest.sha256); make the set again"
            )
        answer = load(path).plain()
        if not isinstance(answer, dict):
            raise InputError(f"{path}: expected a mapping with verdict, effects and nearly_the_same")
        found[job.name] = answer
    return found
