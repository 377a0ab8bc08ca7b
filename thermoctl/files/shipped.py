"""Find the files that come with the program, and copy them for a start in another folder.

They lie beside the package in a checkout, and under share/thermoctl after installation from a wheel.
"""

from __future__ import annotations

import os
import shutil
import site
import sys
from pathlib import Path

from thermoctl.files.safe_file import whole_files
from thermoctl.files.yamlfile import InputError

_CHECKOUT = Path(__file__).resolve().parents[2]
_INSTALLED = [Path(base) / "share/thermoctl" for base in (sys.prefix, site.getuserbase())]
COPIED = {"config": "config", "docs/examples": "examples"}
"""Folders that `thermoctl init` copies, and their names there."""


def shipped(folder: str) -> Path:
    """Return a folder of these files, such as `config/effects` or `systemd`."""
    places = [base / folder for base in (_CHECKOUT, *_INSTALLED)]
    return next((p for p in places if p.is_dir()), places[1])


def state_folder(config: str | Path) -> Path | None:
    """Return the user's folder for what a run of an installed configuration writes; None for another one.

    It is thermoctl in $XDG_STATE_HOME. Nothing is written beside installed files."""
    if not any(base.resolve() in Path(config).resolve().parents for base in _INSTALLED):
        return None
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "thermoctl"


def _copy(source: Path, target: Path) -> None:
    """Copy a folder. Raises the first OSError, where shutil.copytree raises a list of all of them."""
    target.mkdir(parents=True)
    for entry in source.iterdir():
        if entry.is_dir():
            _copy(entry, target / entry.name)
        else:
            shutil.copy2(entry, target / entry.name)


def init(folder: str) -> int:
    """Copy configurations, device profiles, plants and examples into a folder.

    Raises InputError where one of them exists there or cannot be written."""
    for name in COPIED.values():
        target = Path(folder) / name
        if target.exists():
            raise InputError(f"{target}: exists already and is kept; give another folder")
    with whole_files(folder) as part:
        for source, name in COPIED.items():
            _copy(shipped(source), part / name)
    for name in COPIED.values():
        print(f"wrote {Path(folder) / name}")
    rig = Path(folder) / "config/rig.yaml"
    print(
        f"next: `thermoctl demo` shows the simulated rig; for your own, edit {rig} until `thermoctl check {rig}` says good "
        f"(each line says what to do); without hardware `thermoctl virtual-rig --config {rig.with_name('wire.yaml')}` plays one"
    )
    return 0
