"""The diagnosis as one object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thermoctl.diagnosis.curves import Curve, curves_of
from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed
from thermoctl.diagnosis.evidence.held_out import Worth
from thermoctl.diagnosis.evidence.unknown import Left
from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.law.find import FoundLaw
from thermoctl.diagnosis.law.refit import PlacedLaw
from thermoctl.diagnosis.search.beam import Searched
from thermoctl.diagnosis.verdict import OVERRULED
from thermoctl.diagnosis.verdict.decide import Decision, Probabilities
from thermoctl.diagnosis.verdict.families import Family
from thermoctl.diagnosis.verdict.misfit import Energy
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.plant.units import check_units


@dataclass(frozen=True)
class Diagnosis:
    """The outcome of a diagnosis.

    - `best`: the leading hypothesis; `null`: the plant without any effect, refitted in white noise
    - `left`, `before`: the residual of `best` and of `null`
    - `energy`: energies of each hypothesis' residuals (verdict/misfit.py)
    - `physics`: result of `misfit.standing`: each effect's probability of being physics, by hypothesis
    - `unknown`: a sentence on a missing flow that no output shows alone; empty where it is not likely
    - `asked`: for the effects that were tested (verdict/confirm.py), the probability that they are confirmed
    - `families`: effects that imitate each other, of which one is certain (verdict/families.py)
    - `missing_flow`: if nothing is found, the rms of the flow into `before.node` with which the plant fits
    - `laws`: the laws among the findings"""

    case: Case
    searched: Searched
    posterior: Probabilities
    best: Fitted
    null: Fitted
    left: Left
    before: Left
    worth: Worth
    decision: Decision
    energy: Mapping[Keys, Energy]
    physics: Mapping[Keys, Mapping[Key, float]]
    unknown: str
    asked: Mapping[Key, float]
    families: tuple[Family, ...] = ()
    missing_flow: float | None = None
    laws: tuple[FoundLaw, ...] = ()

    @property
    def shown(self) -> tuple[Placed, ...]:
        """Return the effects that the result reports as findings."""
        effects = [e for e in self.best.hypothesis.effects if not isinstance(e, PlacedLaw)]
        if self.decision.verdict == "ambiguous":
            return tuple(effects)
        return tuple(e for e in effects if e.key in self.decision.named or e.key in self.of_family)

    @cached_property
    def of_family(self) -> Mapping[Key, Family]:
        """Return effects of the plant with their families, which are certain: these are the findings."""
        if self.decision.verdict in ("consistent", "unexplained"):
            return {}
        mine = self.best.hypothesis.keys
        several = [f for f in self.families if len({e for e, _ in f.members}) > 1]
        return {next(k for k in f.members if k in mine): f for f in several if mine & {*f.members}}

    @property
    def refused(self) -> Keys:
        """Return the effects that are not named because other data do not confirm them."""
        return frozenset(self.asked) - {*self.decision.named}

    @property
    def contradicted(self) -> Keys:
        """Return the effects with which recordings set aside are predicted worse."""
        return self.best.hypothesis.keys if self.decision.row == OVERRULED else frozenset()

    @property
    def law(self) -> FoundLaw | None:
        """Return the first of the laws."""
        return next(iter(self.laws), None)

    @property
    def extends(self) -> bool:
        """Return whether the outcome has an effect or a law more than the original plant."""
        return bool(self.shown or self.laws)

    @property
    def final(self) -> Fitted:
        """Return the hypothesis that the result shows: `best` if it extends the plant, else `null`."""
        return self.best if self.extends else self.null

    @cached_property
    def plant(self) -> Plant:
        """The plant of `final`, to be written; without units of what was added where they do not fit."""
        extended, known = self.final.plant, self.case.plant.parameters
        try:
            check_units(extended)
        except InputError:
            added = {q: replace(p, unit=None) for q, p in extended.parameters.items() if q not in known}
            return replace(extended, parameters={**extended.parameters, **added})
        return extended

    @property
    def remainder(self) -> Left:
        """Return the residual of the hypothesis `final`."""
        return self.left if self.extends else self.before

    @cached_property
    def came(self) -> list[np.ndarray] | None:
        """Errors (N, outputs), by recording, of the plant as given; None if it cannot be simulated."""
        model = compile_plant(self.case.plant)
        try:
            return [x.y - model.run(x).y for x in self.case.drives(model)]
        except SimulationError:
            return None


def curves(d: Diagnosis) -> list[Curve]:
    """Return the measured and simulated outputs: those held out, then those of the fit."""
    after = d.best.fit.residuals if d.extends else ()
    fitted = {"before": d.came or (), "refit_only": d.null.fit.residuals, "after": after}
    aside = {k: v for k, v in d.worth.errors.items() if d.extends or k != "after"}
    plant, model = d.case.plant, d.null.fit.model
    return [
        *curves_of(plant, [model.excitation(t) for t in d.worth.tables], aside, True),
        *curves_of(plant, d.case.drives(model), fitted, False),
    ]
