"""The command `reproduce`."""

from __future__ import annotations

from pathlib import Path

from thermoctl.reproduction import study


def reproduce(config: str, plant: str, out: str, seeds: int, quick: bool) -> int:
    """Run `thermoctl reproduce`: write the whole report; 1 when a goal is missed."""
    return 0 if study.reproduce(plant, config, Path(out), seeds, not quick) else 1
