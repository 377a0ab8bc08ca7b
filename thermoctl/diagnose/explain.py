"""One explanation of the recordings: a plant with some effects added, refitted and scored.

score = -2 log likelihood in coloured noise (evidence.py) + price of the added parameters (Schwarz)
        - 2 log prior of the effects, of their parameters, and of how far the plant's own parameters moved     (smaller is better)
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field

import numpy as np

from thermoctl.diagnose.effects import PLACES, Candidate
from thermoctl.diagnose.evidence import Colour, channels
from thermoctl.diagnose.locate import Suspect
from thermoctl.diagnose.screen import Direction
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.refit import (
    PRIOR_WEIGHT,
    Fit,
    Noise,
    Problem,
    Scale,
    default_noise,
    fit,
    report,
    updated,
)
from thermoctl.plant.simulate import Excitation, SimulationError, compile_plant
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError

MIN_SAMPLES = 40  # fewer measured values than this decide nothing
SPREAD = 0.06, 0.2  # least and greatest spread of parameters round their beliefs, in shares of their ranges


@dataclass
class Explanation:
    """A plant with some effects added, refitted to all recordings."""

    plant: Plant
    effects: list[Candidate]
    fit: Fit
    score: float
    colours: list[Colour]
    raw: float = 0.0  # the score without the price of parameters and priors
    away: np.ndarray = field(
        default_factory=lambda: np.zeros(0)
    )  # the plant's own parameters, from their beliefs
    spread: float = 0.0  # of such distances, that the score was taken with
    own: list[dict[str, str]] = field(default_factory=list)  # per effect: its parameter to the plant's name
    direction: Direction | None = None
    counts: bool = False  # more than chance over the whole catalogue would give
    probability: float = 0.0

    @property
    def last(self) -> Candidate:
        """The effect added last."""
        return self.effects[-1]

    @property
    def white(self) -> bool:
        """Is every residual white? Then noise's chance of whatever is seen in it is known exactly."""
        return all(len(c.ar) == 1 for c in self.colours)


class Case:
    """The recordings and the plant as they came; refits and scores explanations of them."""

    def __init__(
        self,
        plant: Plant,
        tables: Sequence[Table],
        noise: Sequence[Noise] | None = None,
        progress: Callable[[str], None] | None = None,
    ):
        self.plant, self.tables = plant, list(tables)
        self.progress = progress or (lambda text: None)
        self.model = compile_plant(plant)
        self.drives = [self.model.excitation(t) for t in self.tables]
        counts = {
            o: sum(int(np.isfinite(d.y[:, j]).sum()) for d in self.drives)
            for j, o in enumerate(self.model.outputs)
        }
        if max(counts.values(), default=0) < MIN_SAMPLES:
            raise InputError(
                f"{', '.join(t.path for t in self.tables)}: too little data: "
                + (
                    f"at most {max(counts.values())} measured values of one output"
                    if any(counts.values())
                    else "no column of an output of the plant ("
                    + ", ".join(o.column for o in plant.outputs.values())
                    + ")"
                )
                + f"; {MIN_SAMPLES} or more are needed"
            )
        self.patience = 60.0  # CPU seconds for one refit; set from the time that the plant's own refit took
        self.begun = time.process_time()
        self.noise = tuple(noise or default_noise(plant, self.drives))
        self.unseen: dict[
            tuple[int, bool], tuple[Plant, list[np.ndarray]]
        ] = {}  # held-out errors that are known (heldout.py)
        self.left: dict[
            int, tuple[Explanation, Suspect | None]
        ] = {}  # what explanations leave, where it is known (remains.py)
        self.spread = SPREAD[
            1
        ]  # how far the plant's parameters lie from what was believed, in shares of their ranges

    def drives_of(self, e: Explanation) -> list[Excitation]:
        """The recordings as an explanation's plant reads them."""
        return [e.fit.model.excitation(t) for t in self.tables]

    def explain(
        self,
        plant: Plant,
        effects: list[Candidate],
        own: list[dict[str, str]],
        iterations: int = 25,
        tries: int = 0,
        goal: float = np.inf,
    ) -> Explanation:
        """Refit a plant to all recordings and score it; `goal`: a cost that it does not go on for when that is out of reach."""
        model = compile_plant(plant)
        drives = [model.excitation(t) for t in self.tables]
        found = fit(
            model,
            drives,
            self.noise,
            iterations=iterations,
            tolerance=1e-3,
            tries=tries,
            seconds=self.patience,
            goal=goal,
            priors=[b for c in effects for b in c.beliefs(plant)],
        )
        return self.scored(updated(plant, found, drives), effects, own, found)

    def polished(self, e: Explanation) -> Explanation:
        """The same explanation fitted in the colour of its residual, whose standard errors that colour widens; as it is where
        it is white, or where that fits visibly worse (what is missing is no colour)."""
        if e.white:
            return e
        model = compile_plant(e.plant)
        drives = [model.excitation(t) for t in self.tables]
        try:
            found = fit(
                model, drives, noise_of(e.colours), iterations=15, seconds=self.patience, priors=e.fit.priors
            )
        except (SimulationError, np.linalg.LinAlgError):
            return e
        better = dataclasses.replace(e, plant=updated(e.plant, found, drives), fit=found)
        before, after = self.excess(e), self.excess(better)
        return better if all(after[o] < 1.01 * before[o] for o in before) else e

    def scored(
        self, plant: Plant, effects: list[Candidate], own: list[dict[str, str]], found: Fit
    ) -> Explanation:
        """The score of a fit: coloured -2 log likelihood and the price of its parameters."""
        colours = channels(found.residuals, [n.sigma for n in self.noise])
        price = occam(found, {n for o in own for n in o.values()}) + sum(
            surprise(c) + c.surprise(plant) for c in effects
        )
        raw = sum(c.score for c in colours)
        away, spread = self._away(found)
        self.spread = min(self.spread, spread)
        return Explanation(
            plant,
            list(effects),
            found,
            raw + float(price) + implausible(away, self.spread),
            colours,
            raw,
            away,
            self.spread,
            list(own),
        )

    def _away(self, found: Fit) -> tuple[np.ndarray, float]:
        """The plant's own parameters' distances from the beliefs, and their spread over those that the data determine."""
        sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(found.hessian, hermitian=True)), 0.0))
        away, known = [], []
        for k, (q, r) in enumerate(found.unknowns):
            p = self.plant.parameters.get(q)
            if p is None or not p.range:
                continue
            belief = p.values.get(self.tables[r].name, p.value) if r is not None else p.value
            z = Scale(p)
            away.append(z.z(float(found.values[r or 0, found.model.parameters.index(q)])) - z.z(belief))
            if sd[k] < 0.1:
                known.append(abs(away[-1]))
        spread = 1.4826 * float(np.median(known)) if len(known) >= 5 else SPREAD[1]
        return np.array(away), float(np.clip(spread, *SPREAD))

    def reprice(self, explanations: Sequence[Explanation]) -> None:
        """Bring scores to the one spread of parameters that is known by now."""
        for e in explanations:
            e.score += implausible(e.away, self.spread) - implausible(e.away, e.spread)
            e.spread = self.spread

    def excess(self, e: Explanation) -> dict[str, float]:
        """Residual rms over sensor noise, per output that was measured."""
        out = {}
        for j, (o, n) in enumerate(zip(e.fit.model.outputs, self.noise, strict=True)):
            parts = np.concatenate([r[:, j] for r in e.fit.residuals])
            parts = parts[np.isfinite(parts)]
            if len(parts):
                out[o] = float(
                    np.sqrt(
                        np.mean(np.minimum(np.abs(parts), 8 * max(n.sigma, np.median(np.abs(parts)))) ** 2)
                    )
                    / n.sigma
                )
        return out


def noise_of(colours: Sequence[Colour]) -> tuple[Noise, ...]:
    """The noise of a fit that colours describe."""
    return tuple(Noise(c.sigma, 0.0, c.ar, c.ma) for c in colours)


def standard_errors(e: Explanation, drives: Sequence[Excitation]) -> dict[str, float]:
    """Of each parameter of the effects: the Gauss-Newton one, or half the width over which the likelihood falls by two (-2 log by
    3.84) over 1.96 where that is wider: an onset, a threshold, the depth of a dead zone have no slope to go by."""
    problem = Problem(e.fit.model, drives, e.fit.noise, e.fit.priors)
    problem.set_outlier_limits(e.fit.residuals)
    z = e.fit.z
    least, _, _, _ = problem.evaluate(z, False)
    fall = 3.84 * max(e.fit.cost / max(e.fit.samples - len(z), 1), 1.0)
    known = {x.name: x.sd for x in report(e.fit)}
    out = {}
    for name in (n for own in e.own for n in own.values()):
        k = next((k for k, (q, r) in enumerate(e.fit.unknowns) if q == name and r is None), None)
        if name not in known or k is None:
            out[name] = known.get(name, 0.0)
            continue
        slope = Scale(e.plant.parameters[name]).slope(
            float(e.fit.values[0, e.fit.model.parameters.index(name)])
        )

        def falls(by: float, k: int = k) -> bool:
            moved = z.copy()
            moved[k] += by
            try:
                return problem.evaluate(moved, False)[0] - least > fall
            except SimulationError:
                return True

        widest = max(1.96 * known[name] / slope, 1e-7)
        for sign, room in ((1.0, 1.0 - z[k]), (-1.0, z[k])):
            low, high = 0.0, widest
            while high < room and not falls(sign * high):
                low, high = high, 2 * high
            for _ in range(4 if low else 0):
                middle = 0.5 * (low + min(high, room))
                low, high = (low, middle) if falls(sign * middle) else (middle, high)
            widest = max(widest, low)
        out[name] = widest * slope / 1.96
    return out


def occam(found: Fit, added: Set[str]) -> float:
    """The price of added parameters: Schwarz's log n each; of those that physics has a belief of Laplace's, log det of what is
    known of them by data and belief over what was believed."""
    believed = {n for b in found.priors for n in ex.names(b.neg2_log)}
    price = float(
        sum(q in added and q not in believed for q, _ in found.unknowns) * np.log(max(found.samples, 2))
    )
    told = np.array([q in believed for q, _ in found.unknowns])
    if told.any():
        floor = PRIOR_WEIGHT**2 * np.eye(int(told.sum()))
        price += float(
            np.linalg.slogdet(found.hessian)[1]
            - np.linalg.slogdet(found.hessian[np.ix_(~told, ~told)])[1]
            - np.linalg.slogdet(found.prior_hessian[np.ix_(told, told)] + floor)[1]
        )
    return price


def implausible(away: np.ndarray, spread: float) -> float:
    """-2 log density of parameters that lie `away` from the beliefs (Student's t with 3 degrees of freedom: a far one is
    unlikely, not impossible). Of two explanations that fit alike it favours the one that leaves the plant as it was known."""
    return float(4 * np.sum(np.log1p((away / spread) ** 2 / 3)))


def surprise(c: Candidate) -> float:
    """Prior odds as -2 log: a fault in an input's reading, or another form of an entry, is a little less likely. Where a
    displacement lags, its members do (expansion_lag); an encoder does not."""
    if (
        c.effect.name == "sensor_lag"
        and c.place.output
        and any(p.output == c.place.output for p in PLACES["displacement"](c.rig))
    ):
        return 5.0
    if c.effect.where == "bending_pair" and any(_free_member(c, side) for side in ("TA", "TB")):
        return 12.0  # with one side's growth already free it is the other side's growth, said in a longer way
    return (6.0 if c.place.input and c.effect.where != "drive" else 0.0) + (1.0 if c.variant else 0.0)


def _free_member(c: Candidate, side: str) -> bool:
    """Does the displacement already hold this side's temperature with a coefficient that a refit moves?"""
    plant = c.rig.plant
    now = ex.substitute(c.place.symbols["y"], lambda e: e.args[0] if e.op == "delay" else None)
    slope = ex.derivative(now, str(c.place.symbols[side].value))
    return any(n in plant.parameters and plant.parameters[n].range for n in ex.names(slope))
