"""Recordings of many rigs in a folder or an object store: find them, fetch one, name its rig."""

from __future__ import annotations

import glob
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.writer import NAME, TIER

SUFFIXES = (".parquet", ".csv", ".arrow", TIER)


def find_recordings(folder: str | Path) -> list[str]:
    """Find all recordings below a folder, or below a path of an object store (s3://BUCKET/RIGS).

    Recordings are our 10 Hz tiers and Parquet, CSV and Arrow files. Raises InputError without one."""
    if "://" in str(folder):
        fs, root = _store(str(folder))
        try:
            paths = sorted(fs.unstrip_protocol(p) for p in fs.find(root) if p.endswith(SUFFIXES))
        except Exception as e:  # each store raises what its own library raises
            raise InputError(f"{folder}: cannot be listed: {e}") from None
    elif not Path(folder).is_dir():
        raise InputError(f"{folder}: not a folder; one with the rigs' recordings was expected")
    else:
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
        if together and ("://" in name or Path(name).is_dir()):
            out += find_recordings(name)
        elif glob.has_magic(name) and not Path(name).exists():
            matches = sorted(glob.glob(name, recursive=True))
            if not matches:
                raise InputError(f"{name}: no file matches; a pattern of recordings was expected")
            out += matches
        else:
            out.append(name)
    return out


def _store(url: str) -> tuple[Any, str]:
    """Return (file system, path in it) of an address. The store's library finds its own credentials."""
    fsspec = load("fsspec", url)
    try:
        store: tuple[Any, str] = fsspec.core.url_to_fs(url)
        return store
    except (ImportError, ValueError) as e:
        raise InputError(f"{url}: {e}") from None


@contextmanager
def local(path: str) -> Iterator[str]:
    """Yield a local path: the file itself, or a temporary copy of one in an object store."""
    if "://" not in path:
        yield path
        return
    fs, inside = _store(path)
    with tempfile.TemporaryDirectory(prefix="thermoctl-fleet") as folder:
        copy = f"{folder}/{Path(inside).name}"
        try:
            fs.get_file(inside, copy)
        except Exception as e:  # as above
            raise InputError(f"{path}: cannot be fetched: {e}") from None
        yield copy


def rig_of(path: str) -> str:
    """Name the rig of a recording by the file's name, if this program gave it, else by its folder."""
    match = NAME.match(Path(path).name)
    return match["rig"] if match else Path(path).parent.name
