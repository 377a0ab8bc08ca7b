"""A rig's plant and recordings, and changes of their form that say the same in another way."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

LOST = 0.02  # of cells, or of rows
SEED = 23
KERNEL = np.array([0.25, 0.5, 0.25])  # passes half at a quarter of the sampling rate, nothing at half
PLAIN = np.array([0.0, 1.0, 0.0])  # no filter: readings as they are
JUMP = 0.02  # of a held input's range
EPOCH = 1_763_870_400.0  # a unix time
SECTIONS = ("inputs", "parameters", "nodes", "flows", "outputs")

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Given:
    """A plant file's content and its recordings, by name; `back`: changed names and what they were."""

    plant: dict[str, Any]
    recordings: dict[str, Columns]
    back: Mapping[str, str] = field(default_factory=dict)

    def inputs(self) -> dict[str, bool]:
        """Each input's column, and whether it goes on straight lines."""
        return {
            i.get("column", name): i.get("between_samples") == "linear"
            for name, i in self.plant["inputs"].items()
        }

    def outputs(self) -> list[str]:
        """The columns that outputs are compared with."""
        return [o.get("column", name) for name, o in self.plant["outputs"].items()]


def _map(rig: Given, change: Callable[[Columns], Columns]) -> Given:
    return Given(rig.plant, {k: change(c) for k, c in rig.recordings.items()}, rig.back)


def names(rig: Given) -> Given:
    """Replace every name, of columns too, by one that says nothing."""
    old = sorted({n for s in SECTIONS for n in rig.plant.get(s, {})})
    columns = sorted({c for r in rig.recordings.values() for c in r} - set(old) - {"t"})
    new = {n: f"q{k}" for k, n in enumerate([*old, *columns])}

    def renamed(x: Any) -> Any:
        if isinstance(x, dict):
            return {
                k: renamed(v) if k not in ("unit", "role", "between_samples") else v for k, v in x.items()
            }
        if isinstance(x, str):
            return re.sub(r"[A-Za-z_]\w*", lambda m: new.get(m[0], m[0]), x)
        return x

    plant = {**rig.plant, "title": "x"}
    for s in SECTIONS:
        plant[s] = {new[n]: renamed(v) for n, v in rig.plant.get(s, {}).items()}
    recordings = {k: {new.get(c, c): v for c, v in r.items()} for k, r in rig.recordings.items()}
    return Given(plant, recordings, {v: k for k, v in new.items()})


def order(rig: Given) -> Given:
    """Reverse keys, columns and recordings."""
    plant = {
        k: dict(reversed(v.items())) if isinstance(v, dict) else v for k, v in reversed(rig.plant.items())
    }
    recordings = {
        k: {"t": c["t"], **{n: c[n] for n in reversed(c) if n != "t"}}
        for k, c in reversed(rig.recordings.items())
    }
    return Given(plant, recordings)


def clock(rig: Given) -> Given:
    """Count seconds from 1970."""
    return _map(rig, lambda c: {**c, "t": c["t"] + EPOCH})


def kelvin(rig: Given) -> Given | None:
    """Give every temperature in kelvin."""
    plant = copy.deepcopy(rig.plant)
    warm = {n for s in ("inputs", "nodes") for n, x in plant.get(s, {}).items() if x.get("unit") == "degC"}
    if not warm:
        return None

    def absolute(text: Any) -> Any:
        if not isinstance(text, str) or text in warm:
            return text
        parts = re.split(r"(\((?:\w+) - (?:\w+)\))", text)  # differences stay as they are
        for k, part in enumerate(parts):
            pair = re.fullmatch(r"\((\w+) - (\w+)\)", part)
            if not (pair and {pair[1], pair[2]} <= warm):
                parts[k] = re.sub(
                    r"[A-Za-z_]\w*", lambda m: f"({m[0]} - 273.15)" if m[0] in warm else m[0], part
                )
        return "".join(parts)

    shifted = []
    for s, columns in (("inputs", True), ("nodes", False), ("outputs", True)):
        for n, x in plant.get(s, {}).items():
            if x.get("unit") == "degC":
                x["unit"] = "K"
                shifted += [x.get("column", n)] if columns else []
                for key in ("initial", "value"):
                    if isinstance(x.get(key), str) and x[key] not in warm:
                        x[key] = f"{absolute(x[key])} + 273.15"
            elif "value" in x:
                x["value"] = absolute(x["value"])
            if "storage" in x:
                x["storage"] = absolute(x["storage"])
    for f in plant.get("flows", {}).values():
        f["rate"] = absolute(f["rate"])
    for p in plant.get("parameters", {}).values():
        if p.get("unit") == "degC":
            p |= {"unit": "K", "value": p["value"] + 273.15}
            if "range" in p:
                p["range"] = [v + 273.15 for v in p["range"]]
    return _map(
        Given(plant, rig.recordings), lambda c: {k: v + 273.15 if k in shifted else v for k, v in c.items()}
    )


def milliwatt(rig: Given) -> Given | None:
    """Give power in mW, and with it energy and conductance."""
    plant = copy.deepcopy(rig.plant)
    if not any(f.get("unit") == "W" for f in plant.get("flows", {}).values()):
        return None
    scaled, columns = set(), []
    for s in ("inputs", "parameters"):
        for n, x in plant[s].items():
            unit = str(x.get("unit", ""))
            if re.match(r"[WJ]\b", unit):
                x["unit"] = "m" + unit
                scaled.add(n)
                if s == "inputs":
                    columns.append(x.get("column", n))
                for key in ("value", "range"):
                    if key in x:
                        x[key] = [1000 * v for v in x[key]] if key == "range" else 1000 * x[key]
    for f in plant["flows"].values():
        if f.get("unit") == "W":
            f["unit"] = "mW"
            if not scaled & set(re.findall(r"[A-Za-z_]\w*", f["rate"])):
                f["rate"] = f"1000 * ({f['rate']})"
    return _map(
        Given(plant, rig.recordings), lambda c: {k: 1000 * v if k in columns else v for k, v in c.items()}
    )


def _steady(rig: Given, c: Columns) -> np.ndarray:
    """Rows (N,) at which no held input is another than before."""
    same = np.ones(len(c["t"]), bool)
    for name, linear in rig.inputs().items():
        if not linear:
            same[1:] &= c[name][1:] == c[name][:-1]
    same[[0, -1]] = False
    return same


def cells_lost(rig: Given) -> Given:
    """Lose LOST of the cells; those of held inputs where they stay."""
    random = np.random.default_rng(SEED)

    def change(c: Columns) -> Columns:
        steady, out = _steady(rig, c), dict(c)
        for name in c:
            lost = random.random(len(c["t"])) < LOST
            lost &= steady | (name in rig.outputs()) | rig.inputs().get(name, False)
            lost[0] = False
            if name != "t":
                out[name] = np.where(lost, np.nan, c[name])
        return out

    return _map(rig, change)


def rows_lost(rig: Given) -> Given:
    """Lose LOST of the rows, where no held input changes."""
    random = np.random.default_rng(SEED)

    def change(c: Columns) -> Columns:
        kept = ~((random.random(len(c["t"])) < LOST) & _steady(rig, c))
        return {k: v[kept] for k, v in c.items()}

    return _map(rig, change)


def columns_added(rig: Given) -> Given:
    """Add columns that have nothing to do with the rig."""
    random = np.random.default_rng(SEED)

    def change(c: Columns) -> Columns:
        n = len(c["t"])
        walk = np.cumsum(random.standard_normal(n))
        steps = np.repeat(random.integers(0, 5, n // 40 + 1), 40)[:n].astype(float)
        return {
            **c,
            "humidity": 45 + walk / np.ptp(walk),
            "door": steps,
            "supply": 24 + random.normal(0, 0.1, n),
        }

    return _map(rig, change)


def thinned(rig: Given, kernel: np.ndarray = KERNEL) -> Given:
    """Keep every second row, after a low-pass filter that neither delays nor passes half the sampling rate.

    A held input is its mean until the next kept row; readings beside its jumps would mix both, and are left out."""
    held = [n for n, linear in rig.inputs().items() if not linear]

    def change(c: Columns) -> Columns:
        smooth = {n: v if n == "t" else _smooth(v, kernel) for n, v in c.items()}
        jump = np.zeros(len(c["t"]) + 3, bool)
        for n in held:
            jump[2:-2] |= np.abs(np.diff(c[n])) > JUMP * np.ptp(c[n])
        beside = jump[:-3] | jump[1:-2] | jump[2:-1] | jump[3:]
        for n in rig.outputs():
            smooth[n] = np.where(beside, np.nan, smooth[n])
        means = {n: 0.5 * (smooth[n][:-1] + smooth[n][1:]) for n in held}
        return {n: means.get(n, v)[: len(c["t"]) - 1 : 2] for n, v in smooth.items()}

    return _map(rig, change)


def _smooth(v: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """A signal (N,) after the filter; its ends as they were, since a recording's start is stated."""
    return np.concatenate([v[:1], np.convolve(v, kernel, "valid"), v[-1:]])


def noise_stated(factor: float) -> Callable[[Given], Given]:
    """State the sensors' noise wrongly by a factor."""

    def change(rig: Given) -> Given:
        plant = copy.deepcopy(rig.plant)
        for o in plant["outputs"].values():
            o["noise"] *= factor
        return Given(plant, rig.recordings)

    return change


def one_of_unknown_start(rig: Given) -> Given:
    """Keep the first recording, with starts that may be anywhere: those of a recording that begins in its middle."""
    plant = copy.deepcopy(rig.plant)
    (first, c), *_ = rig.recordings.items()
    reads = {o["value"]: (n, o) for n, o in plant["outputs"].items()}
    for n, x in plant.get("nodes", {}).items():
        if n in reads:
            output, o = reads[n]
            column = c[o.get("column", output)]
            x["initial"], x["initial_sigma"] = f"first({output})", float(np.nanstd(column))
        elif x.get("unit") == "degC":
            x["initial_sigma"] = 20.0
        else:
            values = [
                np.nanstd(c[o.get("column", k)]) for k, o in plant["outputs"].items() if n in str(o["value"])
            ]
            x["initial_sigma"] = float(max(values, default=1.0))
    read = " ".join(
        str(v) for s in ("nodes", "flows", "outputs") for x in plant[s].values() for v in x.values()
    )
    plant["inputs"] = {n: x for n, x in plant["inputs"].items() if re.search(rf"\b{n}\b", read)}
    return Given(plant, {first: c})


def cut(rig: Given) -> Given:
    """Cut each recording in two."""
    halves = {}
    for name, c in rig.recordings.items():
        middle = len(c["t"]) // 2
        halves[f"{name}_a"] = {k: v[:middle] for k, v in c.items()}
        halves[f"{name}_b"] = {k: v[middle:] for k, v in c.items()}
    return Given(rig.plant, halves)


Change = Callable[[Given], Given | None]
# by name: what both sides have in common, and the change
CHANGES: dict[str, tuple[Change | None, Change]] = {
    "names": (None, names),
    "order": (None, order),
    "clock": (None, clock),
    "kelvin": (None, kelvin),
    "milliwatt": (None, milliwatt),
    "cells": (None, cells_lost),
    "rows": (None, rows_lost),
    "columns": (None, columns_added),
    "thinned": (None, thinned),
    "halved": (None, noise_stated(0.5)),
    "doubled": (None, noise_stated(2.0)),
    "cut": (one_of_unknown_start, cut),
}


def together(*changes: Change) -> Callable[[Given], Given]:
    """Several changes, one after the other."""

    def change(rig: Given) -> Given:
        for c in changes:
            changed = c(rig)
            assert changed is not None
            rig = Given(changed.plant, changed.recordings, changed.back or rig.back)
        return rig

    return change
