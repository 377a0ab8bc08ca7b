"""Every entry of the catalogue at every place of a plant, and the plant with it.

`candidates` lists them; `Candidate.extend` gives the plant with one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from thermoctl.diagnosis.hypothesis.builder import Builder
from thermoctl.diagnosis.hypothesis.effect import Effect, EffectParameter
from thermoctl.diagnosis.hypothesis.places import FAULTS, PLACES, Place, askable
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.fitting.residuals import Prior
from thermoctl.plant.language import Input, Output, Plant

Key = tuple[str, str]  # (effect, where)


@dataclass
class Candidate:
    """An effect at a place, in one of its variants, with one choice of the signals that it needs.

    `symbols`: these signals. `label`: of the variant and the choice."""

    effect: Effect
    place: Place
    rig: Rig
    variant: int = 0
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    label: str = ""

    @property
    def key(self) -> Key:
        """Return (effect, place), the names in the result."""
        return self.effect.name, self.place.where

    def own(self, parameter: str) -> str:
        """Return the name in the plant of one of the effect's parameters, or of a node that it adds."""
        return f"{parameter}_{self.effect.name}_{re.sub(r'[^A-Za-z0-9_]', '_', self.place.where)}"

    @property
    def reading(self) -> Output | Input | None:
        """Return the output or recorded input at the place, None where it is none."""
        plant, place = self.rig.plant, self.place
        return plant.outputs.get(place.output or "") or plant.inputs.get(place.input or "")

    def bounds(self, p: EffectParameter) -> tuple[float, float]:
        """Return the physical bounds of a parameter, from the catalogue and the recordings."""
        origin = self.rig.first_air(self.rig.drives[0]) if p.origin == "first_air" else 0.0
        unit = self.rig.largest_jump(self.reading) if p.of == "jump" and self.reading else 1.0
        return origin + unit * p.low, origin + unit * p.high

    @property
    def jumps(self) -> bool:
        """Does the reading depend on held inputs, which change in steps?"""
        y, inputs = self.place.symbols.get("y"), self.rig.plant.inputs
        return y is not None and any(
            i in self.rig.moving_inputs and not inputs[i].linear for i in ex.names(y)
        )

    def beliefs(self, plant: Plant) -> list[Prior]:
        """Return the priors of the effect's parameters in `plant`, for each recording."""
        if self.effect.prior is None:
            return []
        # a parameter that all recordings share has one prior, of which each recording gets an equal part
        share = 1.0 if any(p.per_recording for p in self.effect.parameters) else 1.0 / len(self.rig.drives)
        own = {p.name: self.own(p.name) for p in self.effect.parameters}
        known = {q: name(n) for q, n in own.items() if n in plant.parameters}
        out = []
        for d in self.rig.drives:
            recorded = {"duration": num(float(d.t[-1] - d.t[0])), "first_air": num(self.rig.first_air(d))}
            prior = ex.fill(self.effect.prior, {**recorded, **known})
            out.append(Prior(d.name, ex.mul(num(share), prior)))
        return out

    def extend(
        self, values: Mapping[str, float], ranges: Mapping[str, tuple[float, float]] | None = None
    ) -> Plant:
        """Return the plant with the effect. `values`, `ranges`: by parameter of the effect."""
        return Builder(self, values, ranges or {}).plant()


def _choices(rig: Rig, effect: Effect, place: Place) -> list[dict[str, Expr]]:
    """Return every choice of the signals that an effect needs beside its place."""
    choices: list[dict[str, Expr]] = [{}]
    for need in effect.needs:
        if need in place.symbols:
            continue
        found = rig.signals(need, place.nodes.get("v"))
        if need == "T" and effect.where == "displacement":
            found = sorted(ex.names(place.symbols["y"]) & set(found)) or found
        choices = [{**c, need: name(s)} for c in choices for s in found if s != place.where]
    return choices


def candidates(rig: Rig, effects: Mapping[str, Effect]) -> list[Candidate]:
    """Return every effect at every place where it can act, with every choice of the signals it needs.

    A plant with trusted sensors has no faults of readings."""
    out = []
    for effect in effects.values():
        if rig.plant.trusted and effect.where in FAULTS:
            continue
        if not set(effect.reads) <= rig.plant.nodes.keys() | rig.plant.inputs.keys():
            continue
        for place in PLACES[effect.where](rig):
            here = effect.at(place.exponent)
            if here is None or not askable(rig, place):
                continue
            for variant in range(len(effect.changes)):
                for k, choice in enumerate(_choices(rig, effect, place)):
                    candidate = Candidate(here, place, rig, variant, choice, f"{variant}{k}")
                    if not candidate.jumps and any("straight" in c for c in effect.changes[variant]):
                        continue  # without a held input it would equal the variant without `straight`
                    out.append(candidate)
    return out
