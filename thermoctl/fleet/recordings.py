"""Recordings that a command line names: in folders of rigs, and by patterns."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.writer import NAME, TIER

SUFFIXES = (".parquet", ".csv", ".arrow", TIER)


def find_recordings(folder: str | Path) -> list[str]:
    """Find all recordings below a folder: 10 Hz tiers, Parquet, CSV and Arrow files.

    Raises InputError without one."""
    paths = sorted(str(p) for p in Path(folder).rglob("*") if p.is_file() and p.name.endswith(SUFFIXES))
    if not paths:
        raise InputError(
            f"{folder}: no recordings in it; files ending in {', '.join(SUFFIXES)} were expected"
        )
    return paths


def expanded(given: Sequence[str], together: bool) -> list[str]:
    """Return recordings, with the files that match in place of each pattern (`runs/2026-*.csv`).

    `together`: folders, too, by all recordings in them. Raises InputError where nothing matches."""
    out: list[str] = []
    for name in given:
        if together and Path(name).is_dir():
            out += find_recordings(name)
        elif glob.has_magic(name) and not Path(name).exists():
            matches = sorted(glob.glob(name, recursive=True))
            if not matches:
                raise InputError(f"{name}: no file matches; a pattern of recordings was expected")
            out += matches
        else:
            out.append(name)
    return out


def rig_of(path: str) -> str:
    """Name the rig of a recording by the file's name, if this program gave it, else by its folder."""
    match = NAME.match(Path(path).name)
    return match["rig"] if match else Path(path).parent.name
