"""Calibrations on disk: one YAML file each, in a folder that only the program writes.

A file holds the compensator's coefficients with units and sampling, the fit's figures, the rig's name and the
date. It lists the SHA-256 of each recording used. `current` in the folder names the one in use; older ones
stay for a roll back. A file is refused when its checksum, its shape or its rig do not fit."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thermoctl.control.model import UNITS, CompensatorModel
from thermoctl.files import safe_file
from thermoctl.files.yamlfile import InputError, Node, kind_of, load

FORMAT = "thermoctl-model/1"
_ENTRIES = {"rig": str, "created": str, "units": dict, "fingerprints": dict, "figures": dict, "model": dict}
_CHOOSE = "'thermoctl model rollback NAME' chooses one of the folder"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,80}")


@dataclass(frozen=True)
class Calibration:
    """A model and its origin.

    Rig name, `created` (UTC), fingerprints {file name: sha256}, figures {name: number}."""

    model: CompensatorModel
    rig: str
    created: str
    fingerprints: dict[str, str]
    figures: dict[str, Any]


def fingerprint(path: str | Path) -> str:
    """SHA-256 of a file."""
    with Path(path).open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def save_model(
    path: str | Path,
    model: CompensatorModel,
    rig: str,
    recordings: Sequence[str | Path] = (),
    figures: dict[str, Any] | None = None,
    replace: bool = False,
) -> Path:
    """Write a calibration; the file appears whole or not at all.

    Raises InputError when it exists (only `replace` overwrites a calibration) or cannot be written."""
    path = Path(path)
    if path.exists() and not replace:
        raise InputError(f"{path}: exists; calibrations are never overwritten, choose another name")
    numbers = {k: _plain(v) for k, v in asdict(model).items()}
    content: dict[str, Any] = {
        "format": FORMAT,
        "rig": rig,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "units": UNITS,
        "fingerprints": {Path(r).name: fingerprint(r) for r in recordings},
        "figures": _plain(figures or {}),
        "model": numbers,
    }
    content["checksum"] = _checksum(content)
    safe_file.make_folder(path.parent)
    safe_file.write_text(
        path,
        "# Written by thermoctl; edit nothing here, make another calibration instead.\n"
        + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120),
    )
    return path


def load_calibration(path: str | Path, rig: str | None = None) -> Calibration:
    """Read a calibration (a file, or a folder: its current one).

    Raises InputError for another format, a wrong checksum, missing or extra entries, numbers that do not fit
    together, and for a rig of another name."""
    path = Path(path)
    if path.is_dir():
        path = current(path)
    root = load(path)
    content = root.plain()
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise root.error(f"not a calibration; 'format: {FORMAT}' was expected")
    _check_entries(root, content)
    if rig is not None and content["rig"] != rig:
        raise root.value["rig"].error(
            f"the calibration is of rig '{content['rig']}', this one is '{rig}'; calibrate this rig"
        )
    node: Node = root.value["model"]
    numbers: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in content["model"].items()}
    try:
        model = CompensatorModel(**numbers)
    except TypeError as e:
        raise node.error(
            f"not the entries of a model of this version ({e}); calibrate this rig again"
        ) from None
    except ValueError as e:
        raise node.error(f"{e}; calibrate this rig again") from None
    return Calibration(model, content["rig"], content["created"], content["fingerprints"], content["figures"])


def _check_entries(root: Node, content: dict[str, Any]) -> None:
    """Raise InputError where the file lacks an entry, has one of another kind or unit, or was changed."""
    lacking = {*_ENTRIES, "checksum"} - set(content)
    if lacking:
        raise root.error(f"'{sorted(lacking)[0]}' is missing; the file is not whole")
    for key, kind in _ENTRIES.items():
        if not isinstance(content[key], kind):
            wanted = "text" if kind is str else "a mapping"
            raise root.value[key].error(f"{key}: {wanted} was expected, found {kind_of(root.value[key])}")
    if content["checksum"] != _checksum({k: v for k, v in content.items() if k != "checksum"}):
        raise root.value["checksum"].error(
            "the checksum does not fit: the file was changed after it was written; "
            "use another calibration ('thermoctl model list')"
        )
    for name, unit in content["units"].items():
        if unit != UNITS.get(name):
            node = root.value["units"].value[name]
            raise node.error(f"{name}: '{unit}', expected '{UNITS.get(name)}'; calibrate this rig again")


def load_model(
    path: str | Path, rig: str | None = None, points: tuple[str, ...] | None = None
) -> CompensatorModel:
    """Return the compensator's model of a calibration, for the daemon.

    Raises as `load_calibration`, and InputError for a model of other points than these (None: any)."""
    model = load_calibration(path, rig).model
    if points is not None and (model.points not in ((), points) or len(model.C) != len(points)):
        raise InputError(
            f"{path}: the model is of {', '.join(model.points) or f'{len(model.C)} points'}, the rig has the points "
            f"{', '.join(points)}: calibrate this rig, or list its points in the model's order"
        )
    return model if points is None else replace(model, points=points)


def install(
    folder: str | Path,
    model: CompensatorModel,
    rig: str,
    recordings: Sequence[str | Path] = (),
    figures: dict[str, Any] | None = None,
) -> Path:
    """Save a calibration as the folder's newest and make it current; the one before stays for a roll back."""
    folder = Path(folder)
    number = 1 + max((int(re.findall(r"\d+", p.name)[0]) for p in history(folder)), default=0)
    path = save_model(
        folder / f"{number:04d}-{datetime.now(UTC):%Y%m%dT%H%M%S}.yaml", model, rig, recordings, figures
    )
    safe_file.write_text(folder / "current", path.name + "\n")
    return path


def current(folder: str | Path) -> Path:
    """Return the calibration in use in a folder. Raises InputError when there is none."""
    marker = Path(folder) / "current"
    try:
        name = marker.read_text(encoding="utf-8", errors="replace").strip()
    except FileNotFoundError:
        raise InputError(f"{folder}: no calibration is current; make one with 'thermoctl identify'") from None
    except OSError as e:
        raise InputError(f"{marker}: cannot be read: {safe_file.reason(e)}; {_CHOOSE}") from None
    if not _NAME.fullmatch(name) or not (Path(folder) / name).is_file():
        raise InputError(f"{marker}: names {name[:90]!r}, which is not there; {_CHOOSE}")
    return Path(folder) / name


def history(folder: str | Path) -> list[Path]:
    """Return all calibrations of a folder, oldest first."""
    return sorted(Path(folder).glob("[0-9]*-*.yaml"))


def roll_back(folder: str | Path, name: str | None = None) -> Path:
    """Make an older calibration current: `name`, or the one before the present. It is checked first."""
    files = history(folder)
    if name is None:
        now = current(folder)
        older = [p for p in files if p.name < now.name]
        if not older:
            raise InputError(
                f"{folder}: {now.name} is the oldest calibration; there is nothing to go back to"
            )
        path = older[-1]
    else:
        path = Path(folder) / name
        if path not in files:
            raise InputError(
                f"{folder}: no calibration '{name}'; there are {', '.join(p.name for p in files) or 'none'}"
            )
    load_calibration(path)
    safe_file.write_text(Path(folder) / "current", path.name + "\n")
    return path


def _plain(v: Any) -> Any:
    if isinstance(v, np.ndarray):
        return v.tolist()
    if isinstance(v, np.generic):
        return v.item()
    if isinstance(v, dict):
        return {str(k): _plain(w) for k, w in v.items()}
    if isinstance(v, list | tuple):
        return [_plain(w) for w in v]
    return v


def _checksum(content: dict[str, Any]) -> str:
    return hashlib.sha256(repr(_canonical(content)).encode()).hexdigest()


def _canonical(v: Any) -> Any:
    """Return data in canonical form: numbers by value (1 equals 1.0), mappings in order of key."""
    if isinstance(v, dict):
        return [(k, _canonical(v[k])) for k in sorted(v)]
    if isinstance(v, list):
        return [_canonical(w) for w in v]
    return float(v) if isinstance(v, int | float) and not isinstance(v, bool) else v
