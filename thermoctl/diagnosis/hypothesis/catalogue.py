"""The catalogue of left-out physics, read from files (config/effects/*.yaml, and a user's own folders)."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl import yamlfile
from thermoctl.diagnosis.hypothesis.places import PLACES
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
    "contains",
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
OWN = {"rate": "rate", "storage": "storage", "resistance": "R"}
"""The symbol that stands, in a change of this kind, for the plant's own expression."""
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
    - `at_zero`: where it is 0 the effect is the simpler one that it contains
    - `of`: 'jump': low and high count in the largest sudden change of what the sensor reads"""

    name: str
    unit: str | None
    low: float
    high: float
    null: float
    trial: Expr | None
    shape: str | None
    per_recording: bool
    typical: float | None
    origin: str | None  # 'first_air': bounds count from the first ambient; 'exponent': null is the outlet's
    at_zero: bool = False
    of: str | None = None

    @property
    def amplitude(self) -> bool:
        """Does it scale with an amplitude of the screening?"""
        return _amplitudes(self.trial) > 0

    def fades(self, shapes: Mapping[str, str]) -> bool:
        """Is the effect absent where this parameter has its null value? `shapes`: those of its effect."""
        return self.amplitude or shapes.get(self.shape or "") in ("small_levels", "lags", "delays")


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
    contains: str | None = None  # the simpler effect that it is for some values of its parameters
    reads: tuple[str, ...] = ()  # nodes and inputs by name: an effect of one's own rig

    def at(self, exponent: float | None) -> Effect | None:
        """Return the entry at an outlet with this exponent in the plant file; None beyond its bounds."""
        own = [p for p in self.parameters if p.origin == "exponent"]
        if exponent is None or not own:
            return self
        if not all(p.low <= exponent <= p.high for p in own):
            return None

        def told(p: EffectParameter) -> EffectParameter:
            """Return the parameter with the outlet's exponent as its null value."""
            if p.origin != "exponent" or p.trial is None:
                return p
            known = {"exponent": ex.num(exponent)}
            trial = ex.substitute(p.trial, lambda e: known.get(str(e.value)) if e.op == "name" else None)
            return dataclasses.replace(p, null=exponent, trial=trial)

        return dataclasses.replace(self, parameters=tuple(map(told, self.parameters)))

    @property
    def timed(self) -> bool:
        """Does it depend on the time itself, or have values of its own in each recording?"""
        named = re.search(r"\bt\b", str(self.changes))
        return bool(named) or any(p.per_recording for p in self.parameters)


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


def contained(entries: Mapping[str, Effect]) -> dict[str, str]:
    """Return the simpler effect that some entries contain."""
    return {e.name: e.contains for e in entries.values() if e.contains}


def _read(root: yamlfile.Node) -> Effect:
    top = _checked(root)

    def plain(key: str, default: Any = ()) -> Any:
        """Return the value of a key, or the default."""
        return top[key].plain() if key in top else default

    shapes = plain("shapes", {})
    for key, kind in shapes.items():
        if kind not in SHAPES:
            raise top["shapes"].value[key].error(f"a shape must be one of {', '.join(SHAPES)}")
    parameters = tuple(_parameter(key, node) for key, node in top["parameters"].value.items())
    amplitudes = max((_amplitudes(p.trial) for p in parameters), default=0)
    return Effect(
        plain("effect"),
        plain("title"),
        plain("where"),
        tuple(plain("needs")),
        _changes(top),
        shapes,
        parameters,
        tuple(map(tuple, plain("dims", np.eye(max(amplitudes, 1)).tolist()))),
        plain("excited_by", ""),
        tuple(plain("mimics")),
        plain("source"),
        plain("caution", None),
        _expression(top["prior"], top["prior"].value) if "prior" in top else None,
        plain("contains", None),
        tuple(plain("reads")),
    )


def _checked(root: yamlfile.Node) -> dict[str, yamlfile.Node]:
    """Return the entries of an effect file that has all that are needed and no unknown one."""
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
    return top


def _expression(node: yamlfile.Node, text: Any) -> Expr:
    try:
        return ex.parse(str(text))
    except ex.ExpressionError as e:
        raise node.error(str(e)) from None


def _parameter(name: str, node: yamlfile.Node) -> EffectParameter:
    p = node.plain()
    if not isinstance(p, dict):
        raise node.error(f"parameter '{name}' must be a mapping")
    trial = p.get("trial", None if "shape" in p else "s")
    return EffectParameter(
        name,
        p.get("unit"),
        float(p.get("low", -np.inf)),
        float(p.get("high", np.inf)),
        float(p.get("null", 0.0)),
        None if trial is None else _expression(node, trial),
        p.get("shape"),
        bool(p.get("per_recording")),
        p.get("typical"),
        p.get("origin"),
        bool(p.get("at_zero")),
        p.get("of"),
    )


def _amplitudes(trial: Expr | None) -> int:
    """Return the number of amplitudes s, or s1, s2, ..., in a trial value."""
    names = ex.names(trial) if trial is not None else ()
    return max((int(n[1:] or 1) for n in names if re.fullmatch(r"s\d*", n)), default=0)


def _changes(top: Mapping[str, yamlfile.Node]) -> tuple[tuple[Mapping[str, Any], ...], ...]:
    """Return the change and its variants."""
    found = [top["change"], *(top["variants"].value if "variants" in top else [])]
    for item in (i for node in found if isinstance(node.value, list) for i in node.value):
        if not isinstance(item.value, dict) or len(item.value) != 1 or next(iter(item.value)) not in CHANGES:
            raise item.error(f"a change must be one of {', '.join(CHANGES)}")
    return tuple(tuple(node.plain()) for node in found)
