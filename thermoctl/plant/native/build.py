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
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from thermoctl.files.safe_file import move
from thermoctl.files.yamlfile import InputError


@cache
def _compiler() -> tuple[list[str], str]:
    """Return the C compiler's command and a text that identifies its result (version, processor)."""
    for candidate in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if candidate and (path := shutil.which(candidate.split()[0])):
            stated = subprocess.run([path, "--version"], capture_output=True, text=True).stdout
            version = stated.splitlines()[:1]
            try:
                lines = Path("/proc/cpuinfo").read_text().splitlines()
                flags = next((line for line in lines if line.startswith("flags")), "")
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


def run_compiler(command: Sequence[str], what: str, work: str) -> None:
    """Run the C compiler with its own temporary files in `work`. Raises InputError with its first error."""
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "TMPDIR": work})
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        first = next((line for line in said if "error" in line), said[0] if said else "it says nothing")
        raise InputError(f"the C compiler failed on {what}: {first.strip()[:500]}")


def cache_directory() -> Path:
    """Return the folder of compiled plants: $THERMOCTL_CACHE, else thermoctl/plants in the user's cache."""
    own = os.environ.get("THERMOCTL_CACHE")
    return (
        Path(own)
        if own
        else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thermoctl" / "plants"
    )


def library(source: str, folders: Sequence[Path] = (), key: str = "", beside: str = "") -> ctypes.CDLL:
    """Return C source as a loaded library, compiled once a machine. Raises InputError.

    `folders`: those of its headers; `key`: the headers' text, or other text that the content depends on.
    `beside`: more source, compiled once for all libraries that contain it, on its own."""
    return ctypes.CDLL(str(_built(source, folders, key, beside, ".so")))


def _built(source: str, folders: Sequence[Path], key: str, beside: str, suffix: str) -> Path:
    """Return the cached file of a library (.so) or an object (.o), made if it is missing."""
    name = hashlib.sha256((source + beside + key + _compiler()[1]).encode()).hexdigest()[:32]
    objects = None
    for folder in _folders():
        path = folder / f"{name}{suffix}"
        if path.exists():
            return path
        if objects is None:
            objects = [_built(beside, folders, key, "", ".o")] if beside else []
        with contextlib.suppress(OSError):  # a read-only home: the next folder
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            _build(path, source, folders, objects)
            if name[0] == "0":  # only one build in sixteen: listing a full folder takes half a second
                _trim(folder)
            return path
    raise InputError(
        f"{cache_directory()} and the temporary folder cannot be written: no room for a plant's code"
    )


def _folders() -> Iterator[Path]:
    """Yield the cache, then a folder that goes with this process."""
    yield cache_directory()
    yield Path(_own_folder().name)


@cache
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    """Return a folder that goes with this process."""
    return tempfile.TemporaryDirectory()


def _build(path: Path, source: str, folders: Sequence[Path], objects: Sequence[Path]) -> None:
    """Compile C source to a library or an object; a file that another process made meanwhile is replaced."""
    with tempfile.TemporaryDirectory(dir=path.parent) as work:
        text, made = Path(work) / "plant.c", Path(work) / path.name
        text.write_text(source)
        kind = ["-shared", *map(str, objects), "-lm"] if path.suffix == ".so" else ["-c"]
        command = [*_compiler()[0], *(f"-I{f}" for f in folders), "-o", str(made), str(text), *kind]
        run_compiler(command, "the plant", work)
        move(made, path)


def _trim(folder: Path, keep: int = 2000, age_s: float = 86_400.0) -> None:
    """Delete the oldest libraries beyond `keep`.

    None made within a day: a process may be about to load it."""
    made = []
    for path in folder.glob("*.so"):
        with contextlib.suppress(OSError):  # another process trims, too
            made.append((path.stat().st_mtime, path))
    for mtime, path in sorted(made)[:-keep]:
        if time.time() - mtime > age_s:
            path.unlink(missing_ok=True)


__all__ = ["cache_directory", "compiler", "library", "run_compiler"]
