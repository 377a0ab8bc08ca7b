"""From "simulation and recording disagree" to the physics that was left out, and what adding it is worth.

1 refit the plant's own parameters; 2 ask whether anything is wrong; 3 locate; 4 screen the catalogue and refit the best
entries in full; 5 decide: name, set that cannot be told apart, unknown, or nothing; 6 propose the experiment that would
separate rivals; 7 show on data that took no part what the finding is worth. `diagnose` does it all and writes the result.
"""
from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnose import doubt, experiment, locate, observer
from thermoctl.diagnose.effects import CATALOGUE, PLACES, Candidate, Rig, candidates, catalogue
from thermoctl.diagnose.evidence import LARGE, Colour, channels, white_sigma
from thermoctl.diagnose.screen import Direction, Metric, log_p, screen
from thermoctl.plant import expression as ex
from thermoctl.plant import load, save
from thermoctl.plant.language import Plant
from thermoctl.plant.refit import Fit, Noise, Scale, default_noise, fit, report, updated
from thermoctl.plant.simulate import Drive, Model, SimulationError
from thermoctl.recording.table import Table, read_table
from thermoctl.yamlfile import InputError

MIN_SAMPLES = 40            # fewer measured values than this decide nothing
FINALISTS = 12
ACCEPT = 12.0               # an effect must lower the score by this much beyond its parameters' price
NAME = 0.9                  # one explanation is named alone from this probability on
CLEAN = 1.25                # residual rms over sensor noise up to which the sensors allow no more
FAR = 10.0                  # residual (in sensor noise) from which a moving rig is also looked at through an observer
REMAINS = -8.0              # log10 p of an unknown smooth input from which something is left over
NO_COLOUR, SOME_COLOUR = -35.0, -25.0   # the same in white noise's metric: colour of sensors gives no less than the second
TEMPERING = 1.25, 2.0       # how much less the score decides than a perfect likelihood would, in white and in coloured noise
BLOCKS = 16                 # of a single recording, every other one held out
SPREAD = 0.06, 0.2          # least and greatest spread of parameters round their beliefs, in shares of their ranges
MOST_IN_PAIRS = 250         # directions that are looked at two by two
CHI2_MEDIAN = 0.455         # of one degree of freedom
MARGINAL = 200.0            # a gain in score below this is looked at twice
DRAWS = 100                 # draws of noise for the chance that any candidate would look as good


@dataclass
class Explanation:
    """A plant with some effects added, refitted to all recordings."""
    plant: Plant
    effects: list[Candidate]
    fit: Fit
    score: float
    colours: list[Colour]
    raw: float = 0.0                                            # the score without the price of parameters and priors
    away: np.ndarray = field(default_factory=lambda: np.zeros(0))       # the plant's own parameters, from their beliefs
    spread: float = 0.0                                         # of such distances, that the score was taken with
    own: list[dict[str, str]] = field(default_factory=list)     # per effect: its parameter to the plant's name
    direction: Direction | None = None
    probability: float = 0.0

    @property
    def last(self) -> Candidate:
        """The effect added last."""
        return self.effects[-1]


class Case:
    """The recordings and the plant as they came; refits and scores explanations of them."""

    def __init__(self, plant: Plant, tables: Sequence[Table], noise: Sequence[Noise] | None = None,
                 progress: Callable[[str], None] | None = None):
        self.plant, self.tables = plant, list(tables)
        self.progress = progress or (lambda text: None)
        self.model = plant.compile()
        self.drives = [self.model.drive(t) for t in self.tables]
        counts = {o: sum(int(np.isfinite(d.y[:, j]).sum()) for d in self.drives) for j, o in enumerate(self.model.outputs)}
        if max(counts.values(), default=0) < MIN_SAMPLES:
            raise InputError(f"{', '.join(t.path for t in self.tables)}: too little data: "
                             + (f"at most {max(counts.values())} measured values of one output" if any(counts.values())
                                else "no column of an output of the plant (" + ", ".join(o.column for o in plant.outputs.values()) + ")")
                             + f"; {MIN_SAMPLES} or more are needed")
        self.patience = 60.0        # seconds for one refit; set from the time that the plant's own refit took
        self.begun = time.monotonic()
        self.noise = tuple(noise or default_noise(plant, self.drives))
        self.spread = SPREAD[1]     # how far the plant's parameters lie from what was believed, in shares of their ranges

    def explain(self, plant: Plant, effects: list[Candidate], own: list[dict[str, str]], iterations: int = 25,
                tries: int = 0) -> Explanation:
        """Refit a plant to all recordings and score it."""
        model = plant.compile()
        drives = [model.drive(t) for t in self.tables]
        found = fit(model, drives, self.noise, iterations=iterations, tries=tries, seconds=self.patience)
        return self.scored(updated(plant, found, drives), effects, own, found)

    def scored(self, plant: Plant, effects: list[Candidate], own: list[dict[str, str]], found: Fit) -> Explanation:
        """The score of a fit: coloured -2 log likelihood and the price of its parameters."""
        colours = channels(found.residuals, [n.sigma for n in self.noise])
        added = sum(len(self.tables) if plant.parameters[n].per_recording else 1 for o in own for n in o.values())
        price = added * np.log(max(found.samples, 2)) + sum(_surprise(c) + c.surprise(plant) for c in effects)
        raw = sum(c.score for c in colours)
        away, spread = self._away(found)
        self.spread = min(self.spread, spread)
        return Explanation(plant, list(effects), found, raw + float(price) + implausible(away, self.spread), colours, raw, away,
                           self.spread, list(own))

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
                out[o] = float(np.sqrt(np.mean(np.minimum(np.abs(parts), 8 * max(n.sigma, np.median(np.abs(parts)))) ** 2)) / n.sigma)
        return out


def implausible(away: np.ndarray, spread: float) -> float:
    """-2 log density of parameters that lie `away` from the beliefs (Student's t with 3 degrees of freedom: a far one is
    unlikely, not impossible). Of two explanations that fit alike it favours the one that leaves the plant as it was known."""
    return float(4 * np.sum(np.log1p((away / spread) ** 2 / 3)))


def _surprise(c: Candidate) -> float:
    """Prior odds as -2 log: a fault in an input's reading, or another form of an entry, is a little less likely. Where a
    displacement lags, its members do (expansion_lag); an encoder does not."""
    if c.effect.name == "sensor_lag" and c.place.output and any(p.output == c.place.output for p in PLACES["displacement"](c.rig)):
        return 5.0
    if c.effect.where == "bending_pair" and any(_free_member(c, side) for side in ("TA", "TB")):
        return 12.0         # with one side's growth already free it is the other side's growth, said in a longer way
    return (6.0 if c.place.input and c.effect.where != "drive" else 0.0) + (1.0 if c.variant else 0.0)


def _free_member(c: Candidate, side: str) -> bool:
    """Does the displacement already hold this side's temperature with a coefficient that a refit moves?"""
    plant = c.rig.plant
    slope = ex.derivative(c.place.symbols["y"], str(c.place.symbols[side].value))
    return any(n in plant.parameters and plant.parameters[n].range for n in ex.names(slope))


def ranges_of(direction: Direction, duration: float) -> dict[str, tuple[float, float]]:
    """Where a refit may move the effect's parameters: physics' bounds, and wide round the screening's estimate."""
    out = {}
    for p in direction.candidate.effect.parameters:
        value = direction.start[p.name]
        kind = direction.candidate.effect.shapes.get(p.shape or "", "")
        if p.shape in ("onset", "start", "end"):
            if value <= duration:
                out[p.name] = (0.0, duration)
            continue
        if p.shape == "phase":
            out[p.name] = (-8.0, 8.0)
            continue
        if p.shape == "period":
            out[p.name] = (0.75 * value, 1.33 * value)
            continue
        if p.shape == "level":
            reach = max(abs(value), 1e-9)
            out[p.name] = (max(p.low, value - 3 * reach), value + 3 * reach) if kind != "small_levels" else (0.0, 5 * reach)
            continue
        if p.shape:
            out[p.name] = (max(p.low, value / 30), min(p.high, value * 30)) if kind != "delays" else (0.0, value * 8)
            continue
        floor, ceiling = direction.candidate.bounds(p)
        if np.isfinite(floor) and np.isfinite(ceiling):
            out[p.name] = (floor, ceiling)
            continue
        reach = 30 * max(abs(value - p.null), 1e-3 * abs(p.null), 1e-12)
        low, high = max(p.low, p.null - reach), min(p.high, p.null + reach)
        if p.name == "C" and value > 0:
            low, high = value / 100, value * 100
        out[p.name] = (low, high)
    return out


def weaker(direction: Direction, share: float = 0.1) -> Direction:
    """The direction with a start at a tenth of its size."""
    effect, start = direction.candidate.effect, dict(direction.start)
    for p in effect.parameters:
        if p.amplitude or effect.shapes.get(p.shape or "") in ("small_levels", "lags", "delays"):
            start[p.name] = p.null + share * (start[p.name] - p.null)
    return dataclasses.replace(direction, start=start)


def extend(base: Plant, direction: Direction, drives: Sequence[Drive]) -> tuple[Plant, dict[str, str]]:
    """The plant with a screened effect at its starting values, and the plant's names of the effect's parameters."""
    duration = max(float(d.t[-1]) for d in drives)
    ranges = ranges_of(direction, duration)
    values: dict[str, Any] = {}
    for p in direction.candidate.effect.parameters:
        value = direction.start[p.name] if p.typical is None else p.typical
        if p.name in ranges:
            low, high = ranges[p.name]
            inside = 1e-4 * (high - low)
            value = float(np.clip(value, low + inside, high - inside))
        values[p.name] = value
    plant = direction.candidate.extend(values, ranges)
    return plant, {p.name: direction.candidate.own(p.name) for p in direction.candidate.effect.parameters
                   if direction.candidate.own(p.name) in plant.parameters}


# ---------------------------------------------------------------------------------------------------- one more effect

@dataclass
class Round:
    """One look at the catalogue from one explanation."""
    base: Explanation
    metric: Metric
    rig: Rig
    directions: list[Direction]
    chance: np.ndarray | None
    inflation: float | None = None
    finalists: list[Explanation] = field(default_factory=list)

    def p_any(self) -> float:
        """The chance that noise alone makes some candidate look as good as the best one."""
        if not self.directions or self.chance is None:
            return 1.0
        best = self.directions[0].log_p
        hits = int(np.sum(self.chance <= best))
        if hits:
            return (hits + 1) / (len(self.chance) + 1)
        floor = float(np.quantile(self.chance, 0.1))        # beyond the draws: the tail goes on as it does there
        return float(min(1 / (len(self.chance) + 1), 0.1 * 10 ** (best - floor)))


def look(case: Case, base: Explanation, entries: Mapping[str, Any], draws: int = DRAWS, coloured: bool = False) -> Round:
    """Screen the catalogue from an explanation; `coloured`: in the metric of the residual's own colour."""
    model = base.fit.model
    drives = [model.drive(t) for t in case.tables]
    for d in drives:
        model.prepare(d, base.fit.values[drives.index(d)])
    metric = Metric(dataclasses.replace(base.fit, noise=_colours(base)) if coloured else base.fit, drives)
    rig = Rig(base.plant, drives, [t.columns for t in case.tables])
    found = [c for c in candidates(rig, entries) if c.key not in {e.key for e in base.effects}]
    noise = np.random.default_rng(1).standard_normal((len(metric.residual), draws)) if draws else None
    ranked, chance = screen(metric, rig, found, noise)
    return Round(base, metric, rig, ranked, chance)


def finalists(ranked: Sequence[Direction], count: int = FINALISTS) -> list[Direction]:
    """The best directions, and the best of each effect that is not far behind: one per (effect, place)."""
    taken: dict[tuple[str, str], Direction] = {}
    if not ranked:
        return []
    best = ranked[0].gain
    for d in ranked:
        if d.candidate.key not in taken and d.gain > 12:
            taken[d.candidate.key] = d
    ordered = list(taken.values())
    out = ordered[:count]
    names = {d.candidate.effect.name for d in out}
    for d in ordered[count:]:
        if d.candidate.effect.name not in names and d.gain > 0.3 * best and len(out) < count + 8:
            out.append(d)
            names.add(d.candidate.effect.name)
    return out


def compete(case: Case, seen: Round, chosen: Sequence[Direction]) -> list[Explanation]:
    """Refit each direction in full; best score first."""
    def tried(direction: Direction) -> Explanation | None:
        try:
            plant, own = extend(seen.base.plant, direction, seen.metric.drives)
            e = case.explain(plant, [*seen.base.effects, direction.candidate], [*seen.base.own, own])
        except (SimulationError, InputError, np.linalg.LinAlgError):
            return None
        e.direction = direction
        return e

    def one(direction: Direction) -> Explanation | None:
        e = tried(direction)
        if e is None or e.raw > seen.base.raw:      # led astray by a start too far out: once more from nearer to nothing
            again = tried(weaker(direction))
            e = again if e is None or (again is not None and again.score < e.score) else e
        return e
    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        done = [e for e in pool.map(one, chosen) if e is not None]
    case.reprice([seen.base, *done])
    done.sort(key=lambda e: e.score)
    return done


def pairs(seen: Round, count: int = 4) -> list[tuple[Direction, Direction]]:
    """Pairs of directions that explain much more together than the better one alone: effects that nearly cancel. From the
    same first-order rows, without a refit: with a, b the two scores and c the cosine, gain = (a^2 + b^2 - 2abc) / (1 - c^2)."""
    alone = [d for d in seen.directions if d.vector is not None and d.dims == 1][:MOST_IN_PAIRS]
    if len(alone) < 2:
        return []
    vectors = np.stack([d.vector for d in alone], axis=1).astype(float)     # type: ignore[misc]
    score = vectors.T @ seen.metric.residual
    cosine = vectors.T @ vectors
    a, b = score[:, None], score[None, :]
    joint = (a ** 2 + b ** 2 - 2 * a * b * cosine) / np.maximum(1 - cosine ** 2, 1e-3)
    joint[np.tril_indices(len(alone))] = 0.0
    out: list[tuple[Direction, Direction]] = []
    for flat in np.argsort(-joint, axis=None)[:200]:
        i, j = np.unravel_index(flat, joint.shape)
        first, second = alone[int(i)], alone[int(j)]
        if joint[i, j] < max(first.gain, second.gain) + 2 * ACCEPT or len(out) >= count:
            break
        keys = {first.candidate.key, second.candidate.key}
        if len(keys) == 2 and all({x.candidate.key, y.candidate.key} != keys for x, y in out):
            out.append((first, second))
    return out


def compete_pairs(case: Case, seen: Round, chosen: Sequence[tuple[Direction, Direction]]) -> list[Explanation]:
    """Refit each pair in full; best score first."""
    def both(item: tuple[Direction, Direction]) -> Explanation | None:
        first, second = item
        try:
            plant, own = extend(seen.base.plant, first, seen.metric.drives)
            moved = dataclasses.replace(second, candidate=_on(second.candidate, plant))
            plant, other = extend(plant, moved, seen.metric.drives)
            e = case.explain(plant, [*seen.base.effects, first.candidate, moved.candidate], [*seen.base.own, own, other])
        except (SimulationError, InputError, LookupError, np.linalg.LinAlgError):
            return None
        e.direction = dataclasses.replace(moved, dims=first.dims + second.dims)
        return e
    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        done = [e for e in pool.map(both, chosen) if e is not None]
    case.reprice([seen.base, *done])
    return sorted(done, key=lambda e: e.score)


# ------------------------------------------------------------------------------------------------------------ the whole

@dataclass
class Diagnosis:
    """All that was found; `result` is the contract's JSON."""
    verdict: str
    base: Explanation                       # refit only
    final: Explanation
    rivals: list[Explanation]
    rounds: list[Round]
    suspects: list[locate.Suspect]
    missing: locate.Missing | None
    held: dict[str, Any]
    notes: list[str]
    next_experiment: dict[str, Any] | None
    before: dict[str, float]
    result: dict[str, Any] = field(default_factory=dict)


def examine(case: Case, entries: Mapping[str, Any], most: int = 3) -> Diagnosis:
    """Run the whole chain on a case, without writing anything."""
    notes: list[str] = []
    start = _unfitted(case)
    case.progress("refitting the plant's own parameters")
    begun = time.monotonic()
    base = case.explain(case.plant, [], [], iterations=40, tries=0)
    if max(case.excess(base).values(), default=0.0) > 1.5:
        again = case.explain(case.plant, [], [], iterations=40, tries=40)
        if again.score < base.score - 1:
            base = again
    case.patience = max(4.0, 6 * (time.monotonic() - begun))
    _check_noise(case, base, notes)
    base = case.scored(base.plant, [], [], base.fit)
    if quiet := _quiet(case, base):
        return Diagnosis("consistent", base, base, [], [look(case, base, entries)], [], None, held_out(case, base, base), [*notes, quiet], None,
                         start)
    first = look(case, base, entries)
    clock = _clock(case, base, base, first, CLEAN)
    followed = None
    if clock:
        most = 0        # a shifted clock that leaves nothing to explain
    elif max(case.excess(base).values(), default=0.0) > FAR and Rig(base.plant, case.drives, [t.columns for t in case.tables]).velocities:
        followed = _following(case, base, entries, most)
    if followed:
        current, reference, rivals = followed
        rounds = [first]
        if max(case.excess(current).values()) >= CLEAN and len(current.effects) < most:
            more, others, looks = search(case, base, entries, most, current)
            if len(more.effects) > len(current.effects):
                current = reference = more
                rivals, rounds = others, [*rounds, *looks]
    else:
        current, rivals, rounds = search(case, base, entries, most, first=first)
        reference = current
    left_over = False
    if not clock and not current.effects and first.p_any() < 1e-3:
        # In white noise's metric something stands out, but nothing counts: the residual's own colour decides.
        case.progress("screening in the colour of the residual")
        tinted = look(case, base, entries, coloured=True)
        if tinted.directions:
            best = tinted.directions[0]
            left_over = tinted.p_any() < 1e-3 and log_p(best.gain / inflation(tinted.directions), best.dims) < _threshold(tinted)
        if left_over:
            tinted.finalists = compete(case, tinted, finalists(tinted.directions))
            if tinted.finalists and counts(case, tinted, tinted.finalists[0], entries):
                current = reference = tinted.finalists[0]
                rivals = tinted.finalists[1:]
    clock = clock or _clock(case, base, current, first)
    if clock:
        current = reference = base
        rivals = []
    if current.effects:
        case.progress("trying the findings on data that took no part")
        kept = prune(case, base, current, notes)
        if kept is not current:
            current, reference = kept, kept
            rivals = [r for r in rivals if len(r.effects) == len(kept.effects)]
    suspects = locate.suspects(first.metric) if first.directions and first.p_any() < 1e-3 else []
    excess = case.excess(current)
    worst = max(excess.values(), default=0.0)
    before_worst = max(case.excess(base).values(), default=0.0)
    case.reprice([base, current, reference, *rivals])
    _weigh(reference, rivals)
    current.probability = reference.probability
    held = held_out(case, base, current)
    if current.effects:
        share = (worst ** 2 - 1) / max(before_worst ** 2 - 1, 1e-9)
        explained = worst < CLEAN or (share < 0.02 and worst < LARGE)
        if explained and remains(case, current):
            verdict = "unexplained"
            notes.append("beside what is named, something remains in the residual that no entry of the catalogue explains")
        elif explained:
            verdict = "explained" if current.probability >= NAME else "ambiguous"
        else:
            verdict = "unexplained"
            if _energy(case, current) > 0.55 * _energy(case, base):
                current, rivals, worst = base, [], before_worst     # what was found explains too little to be named
                held = held_out(case, base, current)
            notes.append(f"what remains ({worst:.1f} times the sensor's noise at worst) no entry of the catalogue explains")
    else:
        verdict = "unexplained" if before_worst > LARGE or left_over or remains(case, current) else "consistent"
    if clock:
        verdict, left_over = "unexplained", True
        notes.insert(0, clock)
    elif refused := doubt.other_rig(current.fit, [d.y for d in case.drives], excess, LARGE, list(case.plant.parameters)):
        verdict, current, rivals = "unexplained", base, []
        held = held_out(case, base, base)
        notes.insert(0, refused)
    notes += [c.effect.caution for c in current.effects if c.effect.caution]
    missing = None
    if verdict != "consistent":
        nodes = [s for s in suspects if s.kind == "node"]
        if nodes:
            at = rounds[0]
            missing = locate.missing_flow(at.metric, nodes[0].name, _signals(case, at))
    return Diagnosis(verdict, base, current, rivals, rounds, suspects, missing, held, notes, None, start)


def _quiet(case: Case, base: Explanation) -> str | None:
    moving = any(np.ptp(d.u[:, j]) > 0 for d in case.drives for j in range(d.u.shape[1]))
    flat = dataclasses.replace(base.fit, residuals=[d.y for d in case.drives])
    return doubt.still(flat, case.noise, moving)


def _clock(case: Case, base: Explanation, found: Explanation, first: Round, within: float = np.inf) -> str | None:
    """Does one channel run ahead of the others, rather than physics being missing? The channel is shifted back, the plant
    refitted, and the score held against that of the best explanation; its residual must then be `within` so many sigmas."""
    if first.p_any() > 1e-3:
        return None
    guess = doubt.early(first.metric)
    if guess is None or guess.gain < 0.3 * first.directions[0].gain:
        return None
    case.progress(f"trying whether {guess.output} runs ahead of the others")
    column = case.plant.outputs[guess.output].column
    step = max(float(np.median(np.diff(t.t))) for t in case.tables)
    best, seconds = base, 0.0
    ahead = guess.seconds
    for _ in range(5):
        total = round((seconds + ahead) / step) * step
        if total <= 0 or total == seconds:
            break
        shifted = Case(case.plant, [doubt.later(t, column, total) for t in case.tables], case.noise)
        shifted.patience = case.patience
        try:
            e = shifted.explain(base.plant, [], [])
        except SimulationError:
            break
        if e.raw / max(e.fit.samples, 1) >= best.raw / max(best.fit.samples, 1):
            break
        best, seconds = e, total
        again = doubt.early(Metric(e.fit, shifted.drives))
        if again is None or again.output != guess.output:
            break
        ahead = again.seconds
    per_sample = base.fit.samples / max(best.fit.samples, 1)        # the shift takes a few samples away
    if seconds > 0 and best.raw * per_sample < found.raw - ACCEPT and max(case.excess(best).values()) < within:
        return (f"{guess.output}: its clock runs about {seconds:.3g} s ahead of the other channels' (shifted back, the residual falls from "
                f"{base.fit.rms()[guess.output]:.3g} to {best.fit.rms()[guess.output]:.3g}); no sensor reads ahead of time. "
                "Put the channels on one clock and diagnose again")
    return None


def inflation(ranked: Sequence[Direction]) -> float:
    """How much larger than by chance the catalogue's gains are: noise whose colour the model of noise does not quite hold
    makes all of them larger. The median over entries without a shape, drawn towards 1 where they are few (Devlin & Roeder
    1999, genomic control)."""
    plain = [d.gain for d in ranked if d.dims == 1 and not d.candidate.effect.shapes]
    if not plain:
        return 1.0
    return max(1.0, (len(plain) * float(np.median(plain)) / CHI2_MEDIAN + 10) / (len(plain) + 10))


def counts(case: Case, seen: Round, e: Explanation, entries: Mapping[str, Any]) -> bool:
    """Is an explanation better than what chance alone would make of the best of all candidates? The gain in score is held
    against the smallest chance p that pure noise showed over the whole catalogue."""
    assert e.direction is not None
    gain = seen.base.raw - e.raw
    if 0 < gain < MARGINAL:
        if seen.inflation is None:      # beside what was found: an effect that is found inflates no longer
            seen.inflation = inflation(look(case, e, entries, draws=0, coloured=True).directions)
        gain /= seen.inflation
    if seen.chance is None:
        return e.score < seen.base.score - ACCEPT
    if log_p(max(seen.base.fit.cost - e.fit.cost, 0.0), e.direction.dims) < NO_COLOUR and smooth(case, e) > SOME_COLOUR:
        return True         # with it the residual is white; without it a sensor would need a colour such as none has
    return gain > 0 and log_p(gain, e.direction.dims) < _threshold(seen)


def _threshold(seen: Round) -> float:
    return (min(float(np.min(seen.chance)), -3.5) if seen.chance is not None else -5.0) - 0.3


def search(case: Case, base: Explanation, entries: Mapping[str, Any], most: int,
           start: Explanation | None = None, first: Round | None = None) -> tuple[Explanation, list[Explanation], list[Round]]:
    """Add effects (to `start`, if given) while the evidence asks for them; then take each out again. `first`: the look from
    there, where it was taken. Returns the best explanation, its rivals and the looks that were taken."""
    case.progress("screening the catalogue")
    current = start or base
    rounds = [first or look(case, current, entries)]
    rivals: list[Explanation] = []
    while len(current.effects) < most:
        seen = rounds[-1]
        if seen.p_any() > 1e-3 and max(case.excess(current).values(), default=0.0) < CLEAN:
            break
        chosen = finalists(seen.directions)
        if not chosen:
            break
        case.progress(f"refitting {len(chosen)} explanations")
        seen.finalists = compete(case, seen, chosen)
        # The best score that also predicts: a rival that merely fits better gives way to the next.
        before = unseen_errors(case, current.plant)
        best = next((e for e in seen.finalists[:4] if counts(case, seen, e, entries)
                     and pooled_gain(case, before, unseen_errors(case, e.plant))[2] < 1.0), None)
        if best is None and not current.effects and seen.p_any() < 1e-3 and time.monotonic() - case.begun < 45:
            case.progress("looking for two effects that hide each other")
            together = compete_pairs(case, seen, pairs(seen))
            best = next((e for e in together if counts(case, seen, e, entries)), None)
            seen.finalists = together + seen.finalists if best else seen.finalists
        if best is None:
            break
        current, rivals = best, [e for e in seen.finalists if e is not best and e.score > best.score - 2 * ACCEPT]
        if len(current.effects) >= most:
            break
        case.progress("screening again")
        rounds.append(look(case, current, entries))
        if len(current.effects) == 1 and max(case.excess(current).values()) > LARGE and time.monotonic() - case.begun < 40:
            # A first choice made beside other missing physics can be wrong: the runners-up get their second effect, too.
            best = None
            others: list[Explanation] = []
            for other in _runners_up(seen.finalists):
                again = rounds[-1] if other is current else look(case, other, entries, draws=0)
                found = compete(case, again, finalists(again.directions, 6))
                if found and (best is None or found[0].score < best.score):
                    best, others = found[0], found[1:]
            if best is not None and best.score < current.score - ACCEPT:
                current, rivals = best, others
                rounds.append(look(case, current, entries))
    if len(current.effects) > 1:
        current, rivals = _backward(case, base, current, rivals, entries)
    return current, rivals, rounds


def _following(case: Case, base: Explanation, entries: Mapping[str, Any],
               most: int) -> tuple[Explanation, Explanation, list[Explanation]] | None:
    """The search with the plant held to the recordings by an observer, then proved in the free run. Returns (explanation
    in the free run, the same under the observer, its rivals there)."""
    case.progress("looking again with the plant held to the recording")
    for trust in (0.01, 0.1):
        model = base.plant.compile()
        plant = observer.follows(base.plant, model, [model.drive(t) for t in case.tables], case.noise, trust)
        if plant is None:
            return None
        try:
            held = Case(plant, case.tables, case.noise, case.progress)
            held.patience = case.patience
            start = held.explain(plant, [], [], iterations=25)
            found, rivals, _ = search(held, start, entries, most)
            if not found.effects:
                continue
            free = case.explain(observer.without(found.plant), found.effects, found.own, iterations=40)
        except (SimulationError, InputError, np.linalg.LinAlgError):
            continue
        if _energy(case, free) < 0.1 * _energy(case, base):
            return free, found, rivals
    return None


def _runners_up(found: Sequence[Explanation], count: int = 3) -> list[Explanation]:
    """The leaders, one per effect."""
    out: list[Explanation] = []
    for e in found:
        if e.last.effect.name not in {o.last.effect.name for o in out}:
            out.append(e)
    return out[:count]


def _colours(e: Explanation) -> tuple[Noise, ...]:
    return tuple(Noise(c.sigma, 0.0, c.ar, c.ma) for c in e.colours)


def smooth(case: Case, e: Explanation, coloured: bool = False) -> float:
    """log10 p of the best smooth unknown input at one node or on one sensor; 0 where there is none."""
    drives = [e.fit.model.drive(t) for t in case.tables]
    for r, d in enumerate(drives):
        e.fit.model.prepare(d, e.fit.values[r])
    metric = Metric(dataclasses.replace(e.fit, noise=_colours(e)) if coloured else e.fit, drives)
    found = locate.suspects(metric)
    return found[0].log_p if found else 0.0


def remains(case: Case, e: Explanation) -> bool:
    """Does a smooth unknown input still explain more of the residual than noise of the residual's own colour would let it, or
    more than the colour of any sensor would?"""
    return smooth(case, e, coloured=True) < REMAINS or (not e.effects and smooth(case, e) < NO_COLOUR)


def _energy(case: Case, e: Explanation) -> float:
    """Residual energy beyond the sensors' noise, summed over outputs."""
    return sum(max(x * x - 1.0, 0.0) for x in case.excess(e).values())


def _unfitted(case: Case) -> dict[str, float]:
    """Residual rms per output of the plant as it came."""
    parts = []
    for d in case.drives:
        try:
            parts.append(d.y - case.model.run(d).y)
        except SimulationError:
            parts.append(np.full_like(d.y, np.nan))
    return _rms(case.model, parts)


def _rms(model: Model, residuals: Sequence[np.ndarray]) -> dict[str, float]:
    stacked = np.concatenate(list(residuals))
    return {o: float(np.sqrt(np.nanmean(stacked[:, j] ** 2))) for j, o in enumerate(model.outputs)
            if np.isfinite(stacked[:, j]).any()}


def _check_noise(case: Case, base: Explanation, notes: list[str]) -> None:
    """The white part of the residual against what the plant says of its sensors."""
    changed = []
    for j, (o, n) in enumerate(zip(case.plant.outputs.values(), case.noise, strict=True)):
        white = white_sigma([r[:, j] for r in base.fit.residuals])
        if white > 1.3 * n.sigma:
            notes.append(f"{o.name}: its white noise is {white:.3g} {o.unit or ''}, more than the plant's {n.sigma:.3g}; "
                         "the larger figure is used")
            changed.append(Noise(white))
        else:
            changed.append(n)
    case.noise = tuple(changed)


def _signals(case: Case, seen: Round) -> dict[str, list[np.ndarray]]:
    out: dict[str, list[np.ndarray]] = {}
    rig = seen.rig
    for j, i in enumerate(rig.plant.inputs):
        if i in rig.moving_inputs:
            out[i] = [d.u[:, j] for d in seen.metric.drives]
    for k, n in enumerate(seen.metric.model.states):
        out[n] = [run.x[:, k] for run in seen.metric.runs]
    for c in rig.spare:
        out[c] = [np.nan_to_num(t.columns[c]) for t in case.tables]
    return out


def _backward(case: Case, base: Explanation, current: Explanation, rivals: list[Explanation],
              entries: Mapping[str, Any]) -> tuple[Explanation, list[Explanation]]:
    """With several effects: take each one out, look again at what would fill its place, and keep the best."""
    for _ in range(2):
        changed = False
        for k in range(len(current.effects)):
            without = leave_out(case, base, current, k)
            if without is None:
                continue
            if without.score < current.score + ACCEPT / 2:
                case.progress("one effect is not needed beside the others")
                return (without, [])
            seen = look(case, without, entries, draws=0)
            found = compete(case, seen, finalists(seen.directions, 8))
            if found and found[0].score < current.score - 2:
                if found[0].last.key != current.effects[k].key:
                    changed = True
                current, rivals = found[0], found[1:]
            elif found and k == len(current.effects) - 1:
                rivals = [f for f in found if f.last.key != current.effects[k].key]
        if not changed:
            break
    return current, rivals


def leave_out(case: Case, base: Explanation, current: Explanation, k: int) -> Explanation | None:
    """The explanation without its effect k, refitted; None where that cannot be simulated."""
    plant, effects, own = base.plant, [], []
    try:
        for i, (c, names) in enumerate(zip(current.effects, current.own, strict=True)):
            if i == k:
                continue
            values = {p: current.plant.parameters[n].value for p, n in names.items()}
            ranges = {p: current.plant.parameters[n].range or (-np.inf, np.inf) for p, n in names.items()}
            c = _on(c, plant)
            plant = c.extend(values, ranges)
            effects.append(c)
            own.append(names)
        return case.explain(plant, effects, own) if effects else base
    except (SimulationError, InputError, LookupError):
        return None


def prune(case: Case, base: Explanation, current: Explanation, notes: list[str]) -> Explanation:
    """Drop effects that do not lower the error on data that took no part: the interval of the gain must exclude zero."""
    while current.effects:
        weakest: tuple[float, Explanation, Candidate] | None = None
        for k, c in enumerate(current.effects):
            without = leave_out(case, base, current, k)
            if without is None:
                continue
            before, after = (unseen_errors(case, e.plant) for e in (without, current))
            high = pooled_gain(case, before, after)[2]
            if not high < 1.0 and (weakest is None or high > weakest[0]):
                weakest = (high, without, c)
        if weakest is None:
            return current
        notes.append(f"{weakest[2].effect.name} at {weakest[2].place.where} fits better but does not predict held-out data "
                     "better; it is not counted")
        current = weakest[1]
    return current


def _on(c: Candidate, plant: Plant) -> Candidate:
    """The same effect at the same place of another plant. Raises LookupError where that has no such place."""
    rig = Rig(plant, c.rig.drives, c.rig.columns)
    same = [x for x in candidates(rig, {c.effect.name: c.effect}) if (x.key, x.variant, x.label) == (c.key, c.variant, c.label)]
    if not same:
        raise LookupError(f"{c.effect.name} has no place {c.place.where} any more")
    return same[0]


def _weigh(current: Explanation, rivals: Sequence[Explanation]) -> None:
    """Posterior over the explanations that were refitted, tempered; the same effect at the same place counts once."""
    best: dict[tuple, Explanation] = {}
    for e in [current, *rivals]:
        key = tuple(sorted(c.key for c in e.effects))
        if key not in best or e.score < best[key].score:
            best[key] = e
    scores = np.array([e.score for e in best.values()])
    white = all(len(c.ar) == 1 for c in min(best.values(), key=lambda e: e.score).colours)
    weights = np.exp(-0.5 * (scores - scores.min()) / TEMPERING[0 if white else 1])
    weights /= weights.sum()
    for e, w in zip(best.values(), weights, strict=True):
        e.probability = float(min(w, 0.995))


# ----------------------------------------------------------------------------------------------------------- held out

def folds(case: Case) -> list[tuple[list[int], list[Table], list[Table]]]:
    """(test recordings, training tables, test tables): each recording in turn; a single one is cut into blocks, of which
    every other one is held out, and then the others."""
    if len(case.tables) > 1:
        return [([r], [t for q, t in enumerate(case.tables) if q != r], [case.tables[r]]) for r in range(len(case.tables))]
    (table,) = case.tables
    span = (table.t - table.t[0]) / max(float(table.t[-1] - table.t[0]), 1e-300)
    odd = (np.minimum(span * BLOCKS, BLOCKS - 1).astype(int) % 2).astype(bool)
    measured = {o.column for o in case.plant.outputs.values()}

    def masked(keep: np.ndarray) -> Table:
        columns = {k: np.where(keep, v, np.nan) if k in measured else v for k, v in table.columns.items()}
        return dataclasses.replace(table, columns=columns)
    return [([0], [masked(~held)], [masked(held)]) for held in (odd, ~odd)]


def unseen_errors(case: Case, plant: Plant, refit: bool = True) -> list[np.ndarray]:
    """Free-run errors (N, outputs) on each fold's test data, the plant fitted to that fold's training data only."""
    out: list[np.ndarray] = []
    for _, train, test in folds(case):
        model = plant.compile()
        drives = [model.drive(t) for t in test]
        try:
            dx0 = None
            if refit:
                training = [model.drive(t) for t in train]
                found = fit(model, training, case.noise, iterations=15, seconds=case.patience)
                model = Model(updated(plant, found, training), model.code)
                if train[0].path == test[0].path:       # one recording, split: its start took part
                    dx0 = found.dx0[0]
            out += [_but_for_start(case, model, d) if dx0 is None and model.uncertain
                    else d.y - model.run(model.prepare(d), None, dx0).y for d in drives]
        except SimulationError:
            out += [np.full_like(d.y, np.nan) for d in drives]
    return out


def _but_for_start(case: Case, model: Model, d: Drive) -> np.ndarray:
    """Free-run error on a recording that took no part, less what its uncertain start explains at first order: where it began
    is no physics, and a free axis carries an error of its start to the end."""
    run = model.run(model.prepare(d), None, None, sensitivities=True)
    assert run.dy is not None
    error = d.y - run.y
    good = np.isfinite(error)
    scale = np.array([n.sigma for n in case.noise])
    by_start = run.dy[:, :, len(model.active):]
    prior = np.array([model.plant.nodes[n].initial_sigma or 1.0 for n in model.uncertain])
    rows, left = (by_start / scale[None, :, None])[good] * prior, (error / scale)[good]
    shift = np.linalg.solve(rows.T @ rows + np.eye(len(prior)), rows.T @ left) * prior
    return error - by_start @ shift


def pooled_gain(case: Case, before: Sequence[np.ndarray], after: Sequence[np.ndarray],
                draws: int = 400) -> tuple[float, float, float]:
    """Ratio of held-out rms after / before over all outputs in units of their noise, with its 90 % interval (paired block
    bootstrap), whose upper end is a one-sided 95 % bound."""
    sigma = np.array([n.sigma for n in case.noise])
    pairs = []
    for a, b in zip(before, after, strict=True):
        if not np.isfinite(b[np.isfinite(a)]).all():
            return np.inf, np.inf, np.inf
        x, y = np.nansum((a / sigma) ** 2, axis=1), np.nansum((b / sigma) ** 2, axis=1)
        block = max(5, len(x) // 20)
        n = len(x) // block
        x, y = x[:n * block].reshape(n, block).sum(1), y[:n * block].reshape(n, block).sum(1)
        pairs += [(p, q) for p, q in zip(x, y, strict=True) if p > 0]
    values = np.array(pairs)
    if len(values) < 4:
        return 1.0, 0.0, np.inf
    index = np.random.default_rng(3).integers(0, len(values), (draws, len(values)))
    ratio = np.sqrt(values[index, 1].sum(1) / np.maximum(values[index, 0].sum(1), 1e-300))
    return (float(np.sqrt(values[:, 1].sum() / values[:, 0].sum())), float(np.quantile(ratio, 0.05)),
            float(np.quantile(ratio, 0.95)))


def held_out(case: Case, base: Explanation, final: Explanation) -> dict[str, Any]:
    """Fit the plant's own parameters, and those of the explanation, without some of the data; errors on that data."""
    out = {"before": unseen_errors(case, case.plant, refit=False), "refit_only": unseen_errors(case, base.plant)}
    out["after"] = unseen_errors(case, final.plant) if final.effects else out["refit_only"]
    figures: dict[str, Any] = {f"held_out_{k}": _rms(case.model, v) for k, v in out.items()}
    figures["gain"] = _gain(case, out["refit_only"], out["after"]) if final.effects else {}
    return figures


def _gain(case: Case, before: Sequence[np.ndarray], after: Sequence[np.ndarray], draws: int = 400) -> dict[str, Any]:
    """Per output: held-out rms ratio after / refit only with a 95 % interval by paired block bootstrap."""
    rng = np.random.default_rng(2)
    out = {}
    for j, o in enumerate(case.model.outputs):
        pairs = []
        for a, b in zip(before, after, strict=True):
            good = np.isfinite(a[:, j]) & np.isfinite(b[:, j])
            if good.sum() < 20:
                continue
            block = max(5, int(good.sum()) // 25)
            x, y = a[good, j] ** 2, b[good, j] ** 2
            n = len(x) // block
            pairs += list(zip(x[:n * block].reshape(n, block).mean(1), y[:n * block].reshape(n, block).mean(1), strict=True))
        if len(pairs) < 4:
            continue
        values = np.array(pairs)
        index = rng.integers(0, len(values), (draws, len(values)))
        ratio = np.sqrt(values[index, 1].sum(1) / np.maximum(values[index, 0].sum(1), 1e-300))
        out[o] = {"ratio": float(np.sqrt(values[:, 1].sum() / max(values[:, 0].sum(), 1e-300))),
                  "interval": [float(np.quantile(ratio, 0.025)), float(np.quantile(ratio, 0.975))]}
    return out


# ------------------------------------------------------------------------------------------------------------- result

def result(case: Case, d: Diagnosis) -> dict[str, Any]:
    """The contract's JSON (thermoctl-diagnosis/1)."""
    estimates = {e.name: e for e in report(d.final.fit)}
    excess = case.excess(d.base)
    findings = []
    if d.verdict != "consistent":
        for c, own in zip(d.final.effects, d.final.own, strict=True):
            findings.append(_finding(d, c, own, estimates))
    shown = []
    if d.final.effects:
        seen = {tuple(sorted(c.key for c in d.final.effects))}
        for e in sorted(d.rivals, key=lambda e: -e.probability):
            key = tuple(sorted(c.key for c in e.effects))
            if key in seen or e.probability < 0.005:
                continue
            seen.add(key)
            shown.append({"effect": e.last.effect.name, "where": e.last.place.where, "probability": round(e.probability, 4)})
    mismatch: list[dict[str, Any]] = []
    for o, x in excess.items():
        if d.verdict == "consistent" or x < 1.1:
            continue
        node = next((s.name for s in d.suspects if s.kind == "node"), None)
        index = d.base.fit.model.outputs.index(o)
        rms = d.base.fit.rms()[o]
        entry: dict[str, Any] = {"channel": o, "rms": rms, "expected_rms": case.noise[index].sigma, "node": node}
        if d.missing is not None:
            unit = next((f.unit for f in case.plant.flows.values() if d.missing.node in (f.source, f.target) and f.unit), None)
            entry |= {"missing_flow_rms": d.missing.rms, "missing_flow_unit": unit, "when": d.missing.when,
                      "follows": d.missing.follows}
        mismatch.append(entry)
    mismatch.sort(key=lambda m: -m["rms"] / max(m["expected_rms"], 1e-300))
    return _clean({
        "format": "thermoctl-diagnosis/1", "verdict": d.verdict, "findings": findings, "alternatives": shown,
        "mismatch": mismatch,
        "fit": {"before": d.before, "refit_only": d.base.fit.rms(), "after": d.final.fit.rms(),
                **{k: v for k, v in d.held.items() if k.startswith("held_out")}},
        "held_out_gain": d.held.get("gain", {}),
        "next_experiment": d.next_experiment,
        "suspects": [{"kind": s.kind, "name": s.name, "gain": s.gain, "dims": s.dims} for s in d.suspects[:6]],
        "chance": d.rounds[0].p_any() if d.rounds else 1.0,
        "not_seen": not_seen(d) if d.verdict == "consistent" else [],
        "parameters": [dataclasses.asdict(e) for e in report(d.final.fit, case.drives)],
        "notes": d.notes})


def _finding(d: Diagnosis, c: Candidate, own: Mapping[str, str], estimates: Mapping[str, Any]) -> dict[str, Any]:
    plant = d.final.plant
    values = {p: plant.parameters[n].value for p, n in own.items()}
    equation = _equation(d, c)
    when = None
    if "T0" in values and "T1" in values:
        when = [[values["T0"], min(values["T1"], max(float(x.t[-1]) for x in d.rounds[0].metric.drives))]]
    elif "T0" in values:
        when = [[values["T0"], max(float(x.t[-1]) for x in d.rounds[0].metric.drives)]]
    parameters = {n: {"value": plant.parameters[n].value, "sd": estimates[n].sd if n in estimates else 0.0,
                      "unit": plant.parameters[n].unit} for n in own.values()}
    figures = ", ".join(f"{p} = {v:.4g}" + (f" {plant.parameters[own[p]].unit}" if plant.parameters[own[p]].unit not in (None, "1") else "")
                        for p, v in values.items())
    everyone = [d.final, *d.rivals]
    held = sum(e.probability for e in everyone if c.key in {x.key for x in e.effects})
    probability = min(held / max(sum(e.probability for e in everyone), 1e-9), 0.995) if d.rivals else d.final.probability
    return {"effect": c.effect.name, "where": c.place.where, "when": when, "probability": round(probability, 4),
            "equation": equation, "parameters": parameters,
            "summary": f"{c.effect.title} at {c.place.where}: {equation} with {figures}."}


def _equation(d: Diagnosis, c: Candidate) -> str:
    before, after = c.rig.plant, d.final.plant
    new = [f for f in after.flows.values() if f.name not in before.flows and f.name in _changed(c, after)]
    if new:
        return str(new[-1].rate)
    p = c.place
    if p.output and p.output in after.outputs:
        return str(after.outputs[p.output].value)
    if p.flow and p.flow in after.flows:
        return str(after.flows[p.flow].rate)
    n = p.nodes.get("T")
    return str(after.nodes[n].storage) if n in after.nodes else c.effect.title      # type: ignore[index]


def _changed(c: Candidate, plant: Plant) -> set[str]:
    mine = {c.own(p.name) for p in c.effect.parameters}
    return {f.name for f in plant.flows.values() if ex.names(f.rate) & mine}


def not_seen(d: Diagnosis) -> list[dict[str, Any]]:
    """Per effect and place the smallest size that would have been seen (five sigmas of its amplitude's estimate)."""
    out = []
    for direction in d.rounds[0].directions:
        amplitude = next((p for p in direction.candidate.effect.parameters if p.amplitude), None)
        if amplitude is None or direction.gain <= 0:
            continue
        size = abs(direction.start[amplitude.name] - amplitude.null) / np.sqrt(direction.gain) * 5
        out.append({"effect": direction.candidate.effect.name, "where": direction.candidate.place.where,
                    "smallest": size, "parameter": amplitude.name, "unit": amplitude.unit,
                    "left_after_refit": direction.excited})
    return sorted(out, key=lambda e: (e["effect"], e["where"]))


def _clean(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _clean(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_clean(v) for v in value]
    if isinstance(value, (np.floating, float)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def diagnose(plant_path: str | Path, recording_paths: Sequence[str | Path], out_dir: str | Path,
             effects: Sequence[Path] = (), progress: Callable[[str], None] | None = None,
             drivable: Sequence[str] = (), limits: experiment.Limits = experiment.NONE) -> dict[str, Any]:
    """Diagnose recordings against a plant file and write diagnosis.json, plant.yaml and report.html into `out_dir`, and where
    nothing is decided next_experiment.yaml and .csv, all or nothing. `drivable`: inputs that an experiment may drive (default:
    those that moved and are not the surroundings), `limits` of inputs and outputs that it keeps. Returns the JSON's content.
    Raises InputError for unusable inputs."""
    begun = time.monotonic()
    plant = load(plant_path)
    if not recording_paths:
        raise InputError("no recording was given; one or more were expected")
    tables = [read_table(p) for p in recording_paths]
    names = [t.name for t in tables]
    if len(set(names)) < len(names):
        tables = [dataclasses.replace(t, name=f"{Path(t.path).parent.name}_{t.name}") for t in tables]
    case = Case(plant, tables, progress=progress)
    entries = catalogue((CATALOGUE, *effects))
    try:
        found = examine(case, entries)
    except SimulationError as e:
        raise InputError(f"{plant_path}: the plant cannot follow these recordings at all: {e}") from None
    proposed = experiment.propose(case, found, drivable, limits)
    found.next_experiment = proposed[0] if proposed else None
    found.result = result(case, found)
    found.result["seconds"] = round(time.monotonic() - begun, 1)
    out = Path(out_dir)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        part = Path(folder)
        save(found.final.plant, part / "plant.yaml", note=f"{Path(plant_path).name}, refitted"
             + "".join(f"; with {c.effect.name} at {c.place.where}" for c in found.final.effects))
        load(part / "plant.yaml")
        from thermoctl.diagnose.page import write_report
        write_report(case, found, part / "report.html")
        (part / "diagnosis.json").write_text(json.dumps(found.result, indent=1, allow_nan=False) + "\n")
        written = experiment.write(part, case, *proposed) if proposed else []
        out.mkdir(parents=True, exist_ok=True)
        for stale in experiment.FILES:
            (out / stale).unlink(missing_ok=True)
        for name in ("plant.yaml", "report.html", "diagnosis.json", *written):
            shutil.move(str(part / name), str(out / name))
    return found.result
