"""The cases of a proof: folder, state and sealed answer of each.

A case is a folder with plant.yaml and recordings. Answers lie apart (DIR/NAME.yaml, checked against
manifest.sha256) or as answer.yaml inside the case.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from thermoctl.diagnose.catalogue import CATALOGUE
from thermoctl.shipped import shipped
from thermoctl.yamlfile import InputError, load

RECORDINGS = (".csv", ".parquet", ".arrow")


class Run(TypedDict):
    """Outcome of the diagnosis of one case, as in its run.json. `error` is None when it has a result."""

    name: str
    fingerprint: str
    version: str
    error: str | None
    seconds: NotRequired[float | None]
    cpu_s: NotRequired[float]


@dataclass(frozen=True)
class Job:
    """One diagnosis to run.

    Plant file, recordings, folders of effects beside the catalogue's, and recordings that take no part."""

    name: str
    plant: str
    recordings: tuple[str, ...]
    effects: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()

    def fingerprint(self) -> str:
        """Hash the inputs and the program that diagnoses.

        A result with another fingerprint is out of date."""
        entries = [f for folder in map(Path, self.effects) for f in sorted(folder.glob("*.yaml"))]
        return _digest(
            (*map(Path, (self.plant, *self.recordings, *self.held_out)), *entries, *program_files())
        )


def program() -> str:
    """Hash the program that diagnoses and its catalogue."""
    return _digest(program_files())


def program_files() -> list[Path]:
    """Find every file that can change a diagnosis: the code of four packages, the catalogue, the numbers."""
    package = Path(__file__).parents[1]
    parts = ("diagnose", "evidence", "plant", "recording")
    code = [f for part in parts for f in sorted((package / part).glob("*.[ph]*"))]
    return [*sorted(CATALOGUE.glob("*.yaml")), shipped("config") / "diagnosis.yaml", *code]


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


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


def done(job: Job, out: Path) -> bool:
    """Check whether `out` holds this job's result by this version of the program."""
    try:
        run = json.loads((out / "run.json").read_text())
    except (OSError, ValueError):
        return False
    return bool(run.get("fingerprint") == job.fingerprint())


def outcome(job: Job, cases: Path) -> tuple[dict[str, Any] | None, Run]:
    """Read a job's diagnosis (None if it failed) and its outcome, from CASES/NAME."""
    folder = cases / job.name
    run: Run = json.loads((folder / "run.json").read_text())
    path = folder / "diagnosis.json"
    return (json.loads(path.read_text()) if not run["error"] and path.exists() else None), run


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
