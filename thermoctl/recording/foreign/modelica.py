"""The result file of Dymola and OpenModelica: trajectories in the matrices of a MATLAB file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from thermoctl.recording.foreign.sheet import Cells
from thermoctl.recording.foreign.units import spelled

_UNIT = re.compile(r"\[([^\]|]+)[^\]]*\]\s*$")  # `Angle [rad|deg]`


def trajectories(
    content: Mapping[str, Any], notes: list[str]
) -> tuple[dict[str, Cells], dict[str, str]] | None:
    """Return the columns that change with the time, and their units; None for another file.

    Of the rows of an event, which have one time, the last is kept."""
    kind = [str(line).strip("\0 ") for line in np.ravel(content.get("Aclass", []))]
    if not kind or kind[0] != "Atrajectory":
        return None
    by_column = "binTrans" in kind
    if "data_2" in content:
        matrices = (content[k].T if by_column else content[k] for k in ("dataInfo", "data_2"))
        places, data = (np.asarray(m) for m in matrices)
        names, meanings = (_lines(content.get(k, []), by_column) for k in ("name", "description"))
    else:
        data, names = np.asarray(content["data"]), _lines(content.get("names", []), by_column)
        places, meanings = np.array([(2, k + 1) for k in range(len(names))]), [""] * len(names)
    last = np.append(np.diff(data[:, 0]) != 0, True)
    if not last.all():
        notes.append(f"{np.sum(~last)} rows before an event, or twice, left out")
    columns: dict[str, Cells] = {}
    units = {}
    for name, meaning, (table, column, *_) in zip(names, meanings, places.astype(int), strict=False):
        if table != 1:  # the table of parameters, which are constant
            columns[name] = np.sign(column) * data[last, abs(column) - 1].astype(float)
            if match := _UNIT.search(meaning):
                units[name] = spelled(match[1], name) or ""
    return columns, {n: u for n, u in units.items() if u}


def _lines(text: Any, by_column: bool) -> list[str]:
    """Return the lines of a matrix of letters; `by_column`: it is stored transposed."""
    lines = [str(line) for line in np.ravel(text)]
    return ["".join(letters).rstrip("\0 ") for letters in (zip(*lines, strict=True) if by_column else lines)]
