"""Decide by experiments: diagnose, run the proposed experiment on the rig, diagnose again with its data."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from thermoctl.diagnosis.experiment.file import FILES
from thermoctl.diagnosis.experiment.propose import LEAST_BITS
from thermoctl.files.safe_file import write_text


def worth_running(proposed: Mapping[str, Any] | None) -> bool:
    """Return whether a proposed experiment tells enough for rig time."""
    return proposed is not None and proposed["bits"] >= LEAST_BITS


def resolve(
    diagnosed: Callable[[Sequence[str]], dict[str, Any]],
    recordings: Sequence[str],
    out: Path,
    record: Callable[[Path, Path], None],
    rounds: int,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Diagnose; while a proposed experiment is worth it, run it and diagnose again, `rounds` times at most.

    `diagnosed(recordings)` writes a result into `out`; `record(experiment, recording)` runs an experiment
    file on the rig; `say` is called in each round. The last result lists the experiments and verdicts in
    `resolved`."""
    paths, history = list(recordings), []
    result = diagnosed(paths)
    for k in range(1, rounds + 1):
        if not worth_running(result["next_experiment"]):
            break
        before = {
            "verdict": result["verdict"],
            "findings": [(f["effect"], f["where"], f["probability"]) for f in result["findings"]],
        }
        say(f"round {k}: {before['verdict']}; running: {result['next_experiment']['profile']}")
        recording = out / f"round_{k}.csv"
        record(out / FILES[0], recording)
        history.append(
            {**before, "experiment": result["next_experiment"]["profile"], "recording": str(recording)}
        )
        paths.append(str(recording))
        result = diagnosed(paths)
    result["resolved"] = history
    write_text(out / "diagnosis.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    return result
