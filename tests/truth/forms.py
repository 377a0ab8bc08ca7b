"""Other forms of a generated case: coarse readings and late ones, with the same answer, and a late input.

- `coarse`: readings rest on steps of STEP times their noise, and the plant file states these
- `late`: readings are of up to LATE sampling intervals after the recorded time
- `row`: the first input that is held is logged one row late, and the answer says so, too"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thermoctl.files.yamlfile import load

STEP, LATE = 4.0, 0.2
Reading = Callable[[np.ndarray, np.ndarray, Mapping[str, Any], np.random.Generator], np.ndarray]


def _coarse(t: np.ndarray, y: np.ndarray, output: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    step = output.get("resolution")
    return np.round(y / step) * step if step else y


def _late(t: np.ndarray, y: np.ndarray, output: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    good = np.isfinite(y)
    moved = np.interp(t + rng.uniform(0, LATE, len(t)) * np.median(np.diff(t)), t[good], y[good])
    return np.where(good, moved, np.nan)


def _row(t: np.ndarray, u: np.ndarray, column: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([u[:1], u[:-1]])


FORMS: Mapping[str, Reading] = {"coarse": _coarse, "late": _late, "row": _row}


def changed(case: Path, form: str) -> Path:
    """Return the folder of a case's other form, beside that of its world; it is made if it is not there."""
    out = case.parent.with_name(f"{case.parent.name}-{form}") / case.name
    if (out / "answer.yaml").exists():
        return out
    out.mkdir(parents=True, exist_ok=True)
    plant = yaml.safe_load((case / "plant.yaml").read_text())
    if form == "coarse":
        for o in plant["outputs"].values():
            noise, fine = o["noise"], o.get("resolution") or 0.0
            step = STEP * float(noise["white"] if isinstance(noise, dict) else noise)
            o["resolution"] = fine * math.ceil(step / fine) if fine else step
    (out / "plant.yaml").write_text(yaml.safe_dump(plant, sort_keys=False))
    answer, columns = load(case / "answer.yaml").plain(), plant["outputs"]
    if form == "row":
        held = [n for n, i in plant["inputs"].items() if (i or {}).get("between_samples") != "linear"]
        columns = {n: plant["inputs"][n] or {} for n in held[:1]}
        answer["late"] = [["sensor_advance", n] for n in columns]
    rng = np.random.default_rng(int(case.name))
    for path in sorted(case.glob("run_*.csv")):
        with path.open() as lines:
            heads = next(lines).strip().split(",")
        x = dict(zip(heads, np.genfromtxt(path, delimiter=",", skip_header=1).T, strict=True))
        for name, o in columns.items():
            column = o.get("column", name)
            x[column] = FORMS[form](x["t"], x[column], o, rng)
        rows = (
            ",".join("" if math.isnan(v) else repr(float(v)) for v in row)
            for row in zip(*x.values(), strict=True)
        )
        (out / path.name).write_text("\n".join([",".join(heads), *rows]) + "\n")
    (out / "answer.yaml").write_text(yaml.safe_dump(answer, sort_keys=False))
    return out
