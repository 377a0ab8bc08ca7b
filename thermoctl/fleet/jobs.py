"""Diagnoses to run: their files, their outcome, and a fingerprint that shows if a result is out of date."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE
from thermoctl.files.kept import reading
from thermoctl.files.shipped import shipped

_SOURCE = (".py", ".pyx", ".pxd", ".h")  # suffixes of code


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
    parts = ("checks", "diagnosis", "plant", "recording")
    code = [f for part in parts for f in sorted((package / part).rglob("*.*")) if f.suffix in _SOURCE]
    return [*sorted(CATALOGUE.glob("*.yaml")), shipped("config") / "diagnosis.yaml", *code]


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def done(job: Job, out: Path) -> bool:
    """Check whether `out` holds this job's result by this version of the program."""
    try:
        run = json.loads((out / "run.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(run, dict) and run.get("fingerprint") == job.fingerprint()


def outcome(job: Job, cases: Path) -> tuple[dict[str, Any] | None, Run]:
    """Read a job's diagnosis (None if it failed) and its outcome, from CASES/NAME."""
    folder = cases / job.name
    run: Run = json.loads((folder / "run.json").read_text())
    path = folder / "diagnosis.json"
    if run["error"] or not path.exists():
        return None, run
    with reading(path, "the result of a diagnosis", f"delete {folder} and run this again"):
        return json.loads(path.read_bytes()), run
