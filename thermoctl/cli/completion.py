"""Shell completions, made from the argument parser, and their installation."""

from __future__ import annotations

import argparse
from pathlib import Path

import shtab

from thermoctl.files import safe_file
from thermoctl.files.yamlfile import InputError

PLACES = {  # places below the root where the shells look for local files
    "bash": "usr/local/share/bash-completion/completions/thermoctl",
    "zsh": "usr/local/share/zsh/site-functions/_thermoctl",
}
REMEDY = "run it as root, or give --root"


def install(parser: argparse.ArgumentParser, root: str | Path = "/") -> list[Path]:
    """Write the completions of bash and zsh below `root`; return their paths.

    Raises InputError when one cannot be written."""
    written = []
    for shell, place in PLACES.items():
        path = Path(root, place)
        safe_file.make_folder(path.parent, REMEDY)
        safe_file.write_text(path, shtab.complete(parser, shell), REMEDY)
        written.append(path)
    return written


def uninstall(root: str | Path = "/") -> list[Path]:
    """Remove the files of `install`; return their paths. Raises InputError when one cannot be removed."""
    there = [p for p in (Path(root, place) for place in PLACES.values()) if p.exists()]
    for path in there:
        try:
            path.unlink()
        except OSError as e:
            raise InputError(f"{path}: cannot be removed: {e.strerror}; run it as root") from None
    return there


def completion(parser: argparse.ArgumentParser, shell: str) -> None:
    """Print a shell's completion script."""
    print(shtab.complete(parser, shell))
