"""The catalogue of left-out physics, read from files (config/effects/*.yaml, and a user's own folders)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl import yamlfile
from thermoctl.diagnose.places import PLACES
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.shipped import shipped

CATALOGUE = shipped("config/effects")
KEYS = (
    "effect",
    "title",
    "where",
    "needs",
    "reads",
    "change",
    "variants",
    "shapes",
    "parameters",
    "dims",
    "prior",
    "caution",
    "excited_by",
    "mimics",
    "source",
)
SHAPES = (
    "onsets",
    "windows",
    "times",
    "lags",
    "delays",
    "periods",
    "phases",
    "end_levels",
    "high_levels",
    "drive_levels",
    "small_levels",
    "speeds",
    "creep_speeds",
    "distances",
)
CHANGES = (
    "flow",
    "rate",
    "value",
    "storage",
    "node",
    "split",
    "drive",
    "spill",
    "exponent",
    "resistance",
    "straight",
)


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    - `trial`: its value in screening, an expression of the amplitudes s, s2, s3 and of shapes
    - `shape`: the shape that it is
    - `null`: its value where the effect is absent
    - `at_zero`: the simpler effect that this one is where the parameter is 0"""

    name: str
    unit: str | None
    low: float
    high: float
    null: float
    trial: Expr | None
    shape: str | None
    per_recording: bool
    typical: float | None
    origin: str | None  # 'first_air': low and high are relative to the first ambient temperature
    at_zero: str | None = None

    @property
    def amplitude(self) -> bool:
        """Does it scale with an amplitude of the screening?"""
        return self.trial is not None and any(re.fullmatch(r"s\d?", n) for n in ex.names(self.trial))


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue."""

    name: str
    title: str
    where: str
    needs: tuple[str, ...]
    changes: tuple[tuple[Mapping[str, Any], ...], ...]  # the change and its variants
    shapes: Mapping[str, str]
    parameters: tuple[EffectParameter, ...]
    dims: tuple[tuple[float, ...], ...]
    excited_by: str
    mimics: tuple[str, ...]
    source: str
    caution: str | None = None  # limits of a finding of it, in words
    prior: Expr | None = None  # -2 log of how likely its parameters' values are, beyond their bounds
    reads: tuple[str, ...] = ()  # nodes and inputs by name: an effect of one's own rig


def catalogue(folders: Sequence[Path] = (CATALOGUE,)) -> dict[str, Effect]:
    """Return all entries of these folders; a later one replaces one of the same name. Raises InputError."""
    found = {}
    for folder in folders:
        files = sorted(Path(folder).glob("*.yaml"))
        if not files:
            raise yamlfile.InputError(f"{folder}: no effect files (*.yaml) here")
        for file in files:
            effect = _read(yamlfile.load(file))
            found[effect.name] = effect
    return found


def _read(root: yamlfile.Node) -> Effect:
    top = root.value
    if not isinstance(top, dict):
        raise root.error("an effect file must be a mapping")
    for key, node in top.items():
        if key not in KEYS:
            raise node.error(
                f"unknown key '{key}'; allowed are {', '.join(KEYS)}{yamlfile.suggest(key, KEYS)}"
            )
    for key in ("effect", "title", "where", "change", "parameters", "source"):
        if key not in top:
            raise root.error(f"an effect needs '{key}'")
    if top["where"].value not in PLACES:
        raise top["where"].error(
            f"where must be one of {', '.join(PLACES)}{yamlfile.suggest(str(top['where'].value), PLACES)}"
        )
    shapes = top["shapes"].plain() if "shapes" in top else {}
    for key, kind in shapes.items():
        if kind not in SHAPES:
            raise top["shapes"].value[key].error(f"a shape must be one of {', '.join(SHAPES)}")
    parameters = []
    amplitudes = 0
    for key, node in top["parameters"].value.items():
        p = node.plain()
        if not isinstance(p, dict):
            raise node.error(f"parameter '{key}' must be a mapping")
        try:
            trial = ex.parse(str(p["trial"])) if "trial" in p else None if "shape" in p else ex.parse("s")
        except ex.ExpressionError as e:
            raise node.error(str(e)) from None
        if trial is not None:
            amplitudes = max(
                [amplitudes, *(int(n[1:] or 1) for n in ex.names(trial) if re.fullmatch(r"s\d?", n))]
            )
        parameters.append(
            EffectParameter(
                key,
                p.get("unit"),
                float(p.get("low", -np.inf)),
                float(p.get("high", np.inf)),
                float(p.get("null", 0.0)),
                trial,
                p.get("shape"),
                bool(p.get("per_recording")),
                p.get("typical"),
                p.get("origin"),
                p.get("at_zero"),
            )
        )
    try:
        prior = ex.parse(str(top["prior"].value)) if "prior" in top else None
    except ex.ExpressionError as e:
        raise top["prior"].error(str(e)) from None
    dims = (
        tuple(map(tuple, top["dims"].plain()))
        if "dims" in top
        else tuple(tuple(1.0 if i == k else 0.0 for i in range(amplitudes)) for k in range(amplitudes))
        or ((1.0,),)
    )
    for node in [top["change"], *(top["variants"].value if "variants" in top else [])]:
        for item in node.value if isinstance(node.value, list) else []:
            if (
                not isinstance(item.value, dict)
                or len(item.value) != 1
                or next(iter(item.value)) not in CHANGES
            ):
                raise item.error(f"a change must be one of {', '.join(CHANGES)}")
    changes = (
        tuple(top["change"].plain()),
        *(tuple(v) for v in (top["variants"].plain() if "variants" in top else [])),
    )
    return Effect(
        top["effect"].value,
        top["title"].value,
        top["where"].value,
        tuple(top["needs"].plain()) if "needs" in top else (),
        changes,
        shapes,
        tuple(parameters),
        dims,
        top["excited_by"].value if "excited_by" in top else "",
        tuple(top["mimics"].plain()) if "mimics" in top else (),
        top["source"].value,
        top["caution"].value if "caution" in top else None,
        prior,
        tuple(top["reads"].plain()) if "reads" in top else (),
    )
