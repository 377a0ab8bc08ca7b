"""C source as libraries: compiled by the machine's compiler, cached on disk, loaded."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from thermoctl.files.safe_file import move
from thermoctl.files.yamlfile import InputError


@cache
def _compiler() -> tuple[list[str], str]:
    """Return the C compiler's command and a text that identifies its result (version, processor)."""
    for candidate in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if candidate and (path := shutil.which(candidate.split()[0])):
            version = subprocess.run([path, "--version"], capture_output=True, text=True).stdout.splitlines()[
                :1
            ]
            try:
                flags = next(
                    (
                        line
                        for line in Path("/proc/cpuinfo").read_text().splitlines()
                        if line.startswith("flags")
                    ),
                    "",
                )
            except OSError:
                flags = ""
            command = [
                *candidate.split(),
                # As fast as -O3 in 0.4 of the compiler time; -O1 alone: 7 times slower.
                "-O1",
                "-fexpensive-optimizations",
                "-march=native",
                "-fno-math-errno",
                "-fno-trapping-math",
                "-fPIC",
                "-shared",
                "-w",
            ]
            return command, f"{version}{flags}{command}"
    raise InputError(
        "no C compiler (cc, gcc or clang) was found; install one (Debian: apt-get install gcc) or set CC"
    )


def compiler() -> list[str]:
    """Return the command of the C compiler, without options. Raises InputError where there is none."""
    command = _compiler()[0]
    return command[: command.index("-O1")]


def cache_directory() -> Path:
    """Return the folder of compiled plants: $THERMOCTL_CACHE, else thermoctl/plants in the user's cache."""
    own = os.environ.get("THERMOCTL_CACHE")
    return (
        Path(own)
        if own
        else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thermoctl" / "plants"
    )


def library(source: str, folders: Sequence[Path] = (), key: str = "") -> ctypes.CDLL:
    """Return C source as a loaded library, compiled once a machine. Raises InputError.

    `folders`: those of its headers; `key`: the headers' text, or other text that the content depends on."""
    key = hashlib.sha256((source + key + _compiler()[1]).encode()).hexdigest()[:32]
    folder = cache_directory()
    path = folder / f"{key}.so"
    if not path.exists():
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryDirectory(dir=folder) as work:
                _build(Path(work), source, folders)
                move(Path(work) / "plant.so", path)
        except OSError:  # a read-only home: build for this process only
            with tempfile.TemporaryDirectory() as work:
                _build(Path(work), source, folders)
                return ctypes.CDLL(str(Path(work) / "plant.so"))
        if key[0] == "0":  # only one build in sixteen: listing a full folder takes half a second
            _trim(folder)
    return ctypes.CDLL(str(path))


def _build(work: Path, source: str, folders: Sequence[Path]) -> None:
    (work / "plant.c").write_text(source)
    done = subprocess.run(
        [
            *_compiler()[0],
            *(f"-I{f}" for f in folders),
            "-o",
            str(work / "plant.so"),
            str(work / "plant.c"),
            "-lm",
        ],
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise InputError(f"the C compiler failed on the plant: {done.stderr.strip()[:500]}")


def _trim(folder: Path, keep: int = 2000, age_s: float = 86_400.0) -> None:
    """Delete the oldest beyond `keep`, but none made within a day: a process may be about to load it."""
    made = []
    for path in folder.glob("*.so"):
        with contextlib.suppress(OSError):  # another process trims, too
            made.append((path.stat().st_mtime, path))
    for mtime, path in sorted(made)[:-keep]:
        if time.time() - mtime > age_s:
            path.unlink(missing_ok=True)


__all__ = ["cache_directory", "compiler", "library"]
