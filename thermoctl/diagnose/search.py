"""Search for the missing effects, step by step.

Each step screens the catalogue from a fitted hypothesis, refits the best entries, and keeps the significant ones."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermoctl.diagnose import observer
from thermoctl.diagnose.effects import Candidate, Rig, candidates
from thermoctl.diagnose.evidence import LARGE, least_gain
from thermoctl.diagnose.explain import Case, Explanation, noise_of
from thermoctl.diagnose.heldout import prediction
from thermoctl.diagnose.remains import energy, remains, smooth
from thermoctl.diagnose.screen import FINE_ROWS, ROWS, Direction, Metric, log_p, screen, sharpened
from thermoctl.plant.language import Parameter, Plant
from thermoctl.plant.simulate import Excitation, SimulationError, compile_plant
from thermoctl.yamlfile import InputError

PATIENCE_S = 60.0  # CPU seconds of a diagnosis beyond which it looks at fewer pairs and runners-up,
HASTE_S = 75.0  # and beyond which it looks for no further effect and at fewer rivals of several
FINALISTS, ALIKE = 12, 8  # refitted after a screening, and of one effect
BEGINNINGS = 8  # effects, the best first ones, that are looked at for a second one where something remains
SPONGE = 1.1  # an unknown function of time that leaves much has to fit better than constant physics by this factor in cost
LEADERS = 4  # effects that are refitted once more where parameters ended at the end of their ranges
ACCEPT = 12.0  # an effect must lower the score by this much beyond its parameters' price
CLEAN = 1.25  # residual rms over sensor noise up to which the sensors allow no more
# log10 p in white noise's metric of an effect, and of the best smooth unknown beside it, from which no colour of a sensor is likely
# to have made the first: colour takes up much, or where it is gone leaves nothing
NO_COLOUR = ((-35.0, -25.0), (-20.0, -3.0))
MOST_IN_PAIRS = 250  # directions that are looked at two by two
CHI2_MEDIAN = 0.455  # of one degree of freedom
LOOK = 0.05  # chance of noise looking as good as the best direction, below which the best are refitted
ALARM = 0.005  # chance of noise counting as an effect (twice that in the tail of 1000 draws); unseen data then have their say
STICKING = 300.0  # times slower than it is screened with dry friction may creep, and is begun a second time: what sticks rests for long
THRESHOLDS = 3  # times that a threshold at which an effect jumps is sought, each round a refit
ASTRAY = 0.3  # a refit that gains less than this share of what was screened is begun again, more carefully
INFLATED = 2.0  # gains of the whole catalogue this much larger than by chance may be other physics that is missing, too
MARGINAL = 200.0  # a gain in score below this is looked at twice
DRAWS = 100  # draws of noise for the chance that any candidate would look as good


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
            out[p.name] = (
                0.75 * value,
                max(value, min(1.33 * value, direction.shape.get("longest", np.inf))),
            )
            continue
        if p.shape == "level":
            reach = max(abs(value), 1e-9)
            out[p.name] = (
                (max(p.low, value - 3 * reach), value + 3 * reach)
                if kind != "small_levels"
                else (0.0, 5 * reach)
            )
            continue
        if p.shape:
            least = STICKING if kind == "creep_speeds" else 30
            out[p.name] = (
                (max(p.low, value / least), min(p.high, value * 30))
                if kind != "delays"
                else (0.0, max(value * 8, 0.05 * duration))
            )
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
    return {n: (float(low), float(high)) for n, (low, high) in out.items()}


def weaker(direction: Direction, share: float = 0.1) -> Direction:
    """The direction with a start at a tenth of its size."""
    effect, start = direction.candidate.effect, dict(direction.start)
    for p in effect.parameters:
        if p.amplitude or effect.shapes.get(p.shape or "") in ("small_levels", "lags", "delays"):
            start[p.name] = p.null + share * (start[p.name] - p.null)
    return dataclasses.replace(direction, start=start)


def sticking(direction: Direction) -> Direction | None:
    """The direction with a start at dry friction that sticks, from where creep is no slope to follow; None where nothing creeps."""
    effect = direction.candidate.effect
    start = {
        p.name: direction.start[p.name] / STICKING
        for p in effect.parameters
        if effect.shapes.get(p.shape or "") == "creep_speeds"
    }
    return dataclasses.replace(direction, start={**direction.start, **start}) if start else None


def extend(base: Plant, direction: Direction, drives: Sequence[Excitation]) -> tuple[Plant, dict[str, str]]:
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
    return plant, {
        p.name: direction.candidate.own(p.name)
        for p in direction.candidate.effect.parameters
        if direction.candidate.own(p.name) in plant.parameters
    }


@dataclass
class Round:
    """One look at the catalogue from one explanation."""

    base: Explanation
    metric: Metric
    rig: Rig
    entries: Mapping[str, Any]
    directions: list[Direction]
    chance: np.ndarray | None
    inflation: dict[int, float] = field(default_factory=dict)  # by how many effects were added
    finalists: list[Explanation] = field(default_factory=list)

    def trials(self) -> float:
        """To how many independent looks the catalogue amounts: that many make the smallest p of pure noise what the draws saw."""
        p = np.clip(10.0 ** np.asarray(self.chance), 0.0, 1 - 1e-9)
        return max(1.0, -len(p) / float(np.sum(np.log1p(-p))))

    def p_any(self) -> float:
        """The chance that noise alone makes some candidate look as good as the best one."""
        if not self.directions or self.chance is None:
            return 1.0
        return float(-np.expm1(self.trials() * np.log1p(-min(10.0 ** self.directions[0].log_p, 1 - 1e-9))))


def look(
    case: Case, base: Explanation, entries: Mapping[str, Any], draws: int = DRAWS, coloured: bool = False
) -> Round:
    """Screen the catalogue from a fitted hypothesis, at the places of the original plant.

    A part that an earlier effect added is no place. `coloured`: weight by the residual's own noise model."""
    model = base.fit.model
    drives = [model.excitation(t) for t in case.tables]
    for d in drives:
        model.prepare(d, base.fit.values[drives.index(d)])
    rig = Rig(base.plant, drives, [t.columns for t in case.tables])
    metric = Metric(
        dataclasses.replace(base.fit, noise=noise_of(base.colours)) if coloured else base.fit,
        drives,
        FINE_ROWS if rig.velocities else ROWS,
    )
    added = (base.plant.nodes.keys() | base.plant.flows.keys()) - (
        case.plant.nodes.keys() | case.plant.flows.keys()
    )
    found = [
        c
        for c in candidates(rig, entries)
        if c.key not in {e.key for e in base.effects} and not c.place.parts() & added
    ]
    noise = (
        np.random.default_rng(1).standard_normal((len(metric.sketch(metric.residual[:, None])), draws))
        if draws
        else None
    )
    ranked, chance = screen(metric, rig, found, noise)
    return Round(base, metric, rig, entries, ranked, chance)


def finalists(ranked: Sequence[Direction], count: int = FINALISTS) -> list[Direction]:
    """The best directions, and the best of each effect that is not far behind (of its places at inputs, and of all others: a lag
    of what drives and one of what is read look alike at first order): one per (effect, place)."""

    def kind(d: Direction) -> tuple[str, bool]:
        return d.candidate.effect.name, bool(d.candidate.place.input)

    taken: dict[tuple[str, str], Direction] = {}
    if not ranked:
        return []
    best = ranked[0].gain
    for d in ranked:
        if d.candidate.key not in taken and d.gain > 12:
            taken[d.candidate.key] = d
    ordered = list(taken.values())
    out: list[Direction] = []
    for d in ordered:
        if len(out) < count and sum(o.candidate.effect is d.candidate.effect for o in out) < ALIKE:
            out.append(d)
    names = {kind(d) for d in out}
    for d in ordered:
        if kind(d) not in names and d.gain > 0.3 * best and len(out) < count + 8:
            out.append(d)
            names.add(kind(d))
    return out


def compete(case: Case, seen: Round, chosen: Sequence[Direction]) -> list[Explanation]:
    """Refit each direction in full; best score first. The two strongest set the cost that the others must come near to be followed
    to their end."""
    goal = np.inf

    def tried(direction: Direction, stepwise: bool = False) -> Explanation | None:
        try:
            plant, own = extend(seen.base.plant, direction, seen.metric.drives)
            effects, owns = [*seen.base.effects, direction.candidate], [*seen.base.own, own]
            if stepwise:  # the plant's own parameters first, round the effect as it was screened
                ranges = {n: plant.parameters[n].range for n in own.values()}
                plant = _ranged(
                    case.explain(_ranged(plant, dict.fromkeys(ranges)), effects, owns).plant, ranges
                )
            e = case.explain(plant, effects, owns, goal=goal + 2 * ACCEPT)
        except (SimulationError, InputError, np.linalg.LinAlgError):
            return None
        e.direction = direction
        return e

    strongest = max((d.gain for d in chosen), default=0.0)

    def one(direction: Direction) -> Explanation | None:
        direction = sharpened(seen.metric, seen.rig, direction)
        found = [_stepped(case, e) if (e := tried(direction)) else None]
        stuck = sticking(direction) if direction.gain > 0.5 * strongest else None
        if stuck:
            found.append(tried(stuck))
        for nearer in (
            False,
            True,
        ):  # led astray by its first steps: once more step by step, once from nearer to nothing
            best = min((e for e in found if e is not None), key=lambda e: e.score, default=None)
            gained = (
                0.0 if best is None else max(seen.base.raw - best.raw, seen.base.fit.cost - best.fit.cost)
            )
            if direction.gain > 0.5 * strongest and (
                best is None or best.raw > seen.base.raw or gained < ASTRAY * direction.gain
            ):
                found.append(tried(weaker(direction)) if nearer else tried(direction, stepwise=True))
        return min((e for e in found if e is not None), key=lambda e: e.score, default=None)

    done: list[Explanation] = []
    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        for part in (chosen[:2], chosen[2:]):
            done += [e for e in pool.map(one, part) if e is not None]
            goal = min((e.fit.cost for e in done), default=goal)
        done.sort(key=lambda e: e.score)
        leaders = [e for e in _runners_up(done, LEADERS) if set(e.fit.at_bound) & set(case.plant.parameters)]
        better = {
            id(e): found
            for e, found in zip(leaders, pool.map(lambda e: _released(case, e, goal), leaders), strict=True)
        }
    done = [better.get(id(e), e) for e in done]
    case.reprice([seen.base, *done])
    return _ordered(case, done)


def _stepped(case: Case, e: Explanation) -> Explanation:
    """Refitted with the threshold at which its last effect jumps moved to where it fits best: at a jump a refit has no slope to go by."""
    names = [
        e.own[-1][p.name]
        for p in e.last.effect.parameters
        if e.last.effect.shapes.get(p.shape or "") == "small_levels"
    ]
    if not e.last.variant or not names or names[0] not in e.plant.parameters:
        return e
    for _ in range(THRESHOLDS):
        p = e.plant.parameters[names[0]]
        try:
            best = _threshold(case, e, p)
            if abs(best - p.value) < 0.002 * p.value:
                return e
            plant = dataclasses.replace(
                e.plant, parameters={**e.plant.parameters, p.name: dataclasses.replace(p, value=best)}
            )
            moved = case.explain(plant, e.effects, e.own)
        except (SimulationError, np.linalg.LinAlgError):
            return e
        if moved.score >= e.score:
            return e
        moved.direction, e = e.direction, moved
    return e


def _threshold(case: Case, e: Explanation, p: Parameter) -> float:
    """The value of a parameter that fits best, on finer and finer grids: each is simulated, the other parameters follow at first order."""
    metric = Metric(e.fit, case.drives_of(e), FINE_ROWS)
    k = e.fit.model.parameters.index(p.name)
    low, high = p.range or (0.0, np.inf)

    def cost(value: float) -> float:
        parts = []
        for r, d in enumerate(metric.drives):
            values = e.fit.values[r].copy()
            values[k] = value
            parts.append(metric.rows(r, d.y - metric.model.run(d, values, e.fit.dx0[r]).y))
        return float(np.sum(metric.project(np.concatenate(parts)) ** 2))

    best, ratio = float(e.fit.values[0, k]), 1.3
    costs = {best: cost(best)}
    while ratio > 1.002:
        costs |= {float(v): cost(v) for v in best * ratio ** np.arange(-8.0, 8.5) if low < v < high}
        best = min(costs, key=lambda v: costs[v])
        ratio **= 0.25
    return best


def _ordered(case: Case, done: Sequence[Explanation]) -> list[Explanation]:
    """Best score first; but what soaks up whatever is missing gives way to constant physics that fits about as well."""
    ordered = sorted(done, key=lambda e: e.score)
    if ordered and _soaks(case, ordered[0]):
        rival = next(
            (e for e in ordered if e.fit.cost < SPONGE * ordered[0].fit.cost and not _soaks(case, e)), None
        )
        ordered = [rival, *(e for e in ordered if e is not rival)] if rival else ordered
    return ordered


def _soaks(case: Case, e: Explanation) -> bool:
    """Is the effect added last an unknown function of time beside which much remains? It soaks up whatever else is missing."""
    return any(p.per_recording for p in e.last.effect.parameters) and max(case.excess(e).values()) > LARGE


def _released(case: Case, e: Explanation, goal: float) -> Explanation:
    """Refitted once more with what is pressed against the end of its range back where it was believed: missing physics pushes
    parameters to walls at which they stay when it is found."""
    parameters = {
        n: dataclasses.replace(
            p, value=case.plant.parameters[n].value, values=case.plant.parameters[n].values
        )
        if n in e.fit.at_bound and n in case.plant.parameters
        else p
        for n, p in e.plant.parameters.items()
    }
    try:
        found = case.explain(
            dataclasses.replace(e.plant, parameters=parameters), e.effects, e.own, goal=goal + 2 * ACCEPT
        )
    except (SimulationError, np.linalg.LinAlgError):
        return e
    found.direction = e.direction
    return found if found.score < e.score else e


def _ranged(plant: Plant, ranges: Mapping[str, tuple[float, float] | None]) -> Plant:
    """The plant with other ranges of some parameters; None holds one where it is."""
    return dataclasses.replace(
        plant,
        parameters={
            n: dataclasses.replace(p, range=ranges[n]) if n in ranges else p
            for n, p in plant.parameters.items()
        },
    )


def pairs(seen: Round, count: int = 4) -> list[tuple[Direction, Direction]]:
    """Pairs of directions that explain much more together than the better one alone: effects that nearly cancel. From the
    same first-order rows, without a refit: with a, b the two scores and c the cosine, gain = (a^2 + b^2 - 2abc) / (1 - c^2)."""
    alone = [d for d in seen.directions if d.vector is not None and d.dims == 1][:MOST_IN_PAIRS]
    if len(alone) < 2:
        return []
    vectors = np.stack([d.vector for d in alone], axis=1).astype(float)  # type: ignore[misc]
    score = vectors.T @ seen.metric.residual
    cosine = vectors.T @ vectors
    a, b = score[:, None], score[None, :]
    joint = (a**2 + b**2 - 2 * a * b * cosine) / np.maximum(1 - cosine**2, 1e-3)
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


def compete_pairs(
    case: Case, seen: Round, chosen: Sequence[tuple[Direction, Direction]]
) -> list[Explanation]:
    """Refit each pair in full; best score first."""

    def both(item: tuple[Direction, Direction]) -> Explanation | None:
        first, second = item
        try:
            plant, own = extend(seen.base.plant, first, seen.metric.drives)
            moved = dataclasses.replace(second, candidate=_on(second.candidate, plant))
            plant, other = extend(plant, moved, seen.metric.drives)
            e = case.explain(
                plant, [*seen.base.effects, first.candidate, moved.candidate], [*seen.base.own, own, other]
            )
        except (SimulationError, InputError, LookupError, np.linalg.LinAlgError):
            return None
        e.direction = _both(seen, first, moved)
        return e

    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        done = [e for e in pool.map(both, chosen) if e is not None]
    case.reprice([seen.base, *done])
    return sorted(done, key=lambda e: e.score)


def _both(seen: Round, first: Direction, second: Direction) -> Direction:
    """The second with the dimensions and the looks of both: there are as many more pairs than single directions."""
    return dataclasses.replace(
        second,
        dims=first.dims + second.dims,
        elsewhere=first.elsewhere + second.elsewhere + float(np.log10(0.5 * seen.trials())),
    )


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
    added = len(e.effects) - len(seen.base.effects)
    if 0 < gain < MARGINAL:
        gain = min(gain, least_gain(seen.base.fit.residuals, e.fit.residuals, [n.sigma for n in case.noise]))
        if (
            not e.white and max(case.excess(e).values()) <= LARGE
        ):  # what remains may be noise; beyond that it is other physics
            if (
                added not in seen.inflation
            ):  # beside what was found: an effect that is found inflates no longer
                plain = {k: f for k, f in entries.items() if not f.shapes}
                seen.inflation[added] = inflation(look(case, e, plain, draws=0, coloured=True).directions)
            gain /= seen.inflation[added]
    if seen.chance is None:
        return e.score < seen.base.score - ACCEPT
    # two at once leave a residual white more easily
    white = log_p(max(seen.base.fit.cost - e.fit.cost, 0.0), e.direction.dims) + e.direction.elsewhere
    if added == 1 and any(white < least for least, _ in NO_COLOUR):
        left = smooth(case, e)
        if any(white < least and left > most for least, most in NO_COLOUR):
            return True  # with it the residual is white; without it a sensor would need a colour such as none has
    return _stands(seen, e.direction, gain)


def _stands(seen: Round, direction: Direction | None, gain: float) -> bool:
    """Is a gain in score more than what noise makes of the best of all candidates?"""
    return (
        direction is not None
        and gain > 0
        and log_p(gain, direction.dims) + direction.elsewhere < threshold(seen)
    )


def threshold(seen: Round) -> float:
    """log10 p that an effect must fall below, so that noise alone makes one of the catalogue do so in ALARM of all cases."""
    return min(float(np.log10(ALARM / seen.trials())), -3.5) if seen.chance is not None else -5.0


def search(
    case: Case,
    base: Explanation,
    entries: Mapping[str, Any],
    most: int,
    start: Explanation | None = None,
    first: Round | None = None,
) -> tuple[Explanation, list[Explanation], list[Round]]:
    """Add effects (to `start`, if given) while the evidence asks for them; then take each out again. `first`: the look from
    there, where it was taken. Returns the best explanation, its rivals and the looks that were taken."""
    case.progress("screening the catalogue")
    current = start or base
    rounds = [first or look(case, current, entries)]
    rivals: list[Explanation] = []
    while len(current.effects) < most:
        seen = rounds[-1]
        if seen.p_any() > LOOK and max(case.excess(current).values(), default=0.0) < CLEAN:
            break
        chosen = finalists(seen.directions)
        if not chosen:
            break
        case.progress(f"refitting {len(chosen)} explanations")
        seen.finalists = compete(case, seen, chosen)
        # The best score that surely predicts is gone on with; those that fit better stay its rivals.
        best = None
        for e in seen.finalists[:4]:
            e.counts = counts(case, seen, e, entries)
            if e.counts and predicts(case, current, e) < 1.0:
                best = e
                break
        if best is None and not current.effects and seen.p_any() < LOOK and _spent(case) < PATIENCE_S:
            case.progress("looking for two effects that hide each other")
            together = compete_pairs(case, seen, pairs(seen))
            best = next((e for e in together if counts(case, seen, e, entries)), None)
            beside = next(
                (e for e in seen.finalists[:4] if _stands(seen, e.direction, seen.base.raw - e.raw)), None
            )
            if best is None and beside and seen.inflation.get(1, 1.0) > INFLATED:
                # Beside it the whole catalogue looks good: perhaps not the noise's colour, but other physics.
                single = {e.last.key: e.direction for e in seen.finalists if e.direction}
                together = otherwise(case, seen, look(case, beside, entries, draws=0))
                for e in together:
                    if e.direction:
                        e.direction = _both(seen, single[e.effects[-2].key], e.direction)
                best = next((e for e in together if counts(case, seen, e, entries)), None)
            seen.finalists = together + seen.finalists if best else seen.finalists
        if best is None:
            break
        current, rivals = (
            best,
            [e for e in seen.finalists if e is not best and e.score > best.score - 2 * ACCEPT],
        )
        if len(current.effects) >= most or (len(current.effects) > 1 and _spent(case) > HASTE_S):
            break
        case.progress("screening again")
        rounds.append(look(case, current, entries))
        if (
            len(current.effects) == 1
            and _spent(case) < PATIENCE_S
            and (max(case.excess(current).values()) > LARGE or remains(case, current))
        ):
            found = otherwise(case, seen, rounds[-1])
            if found and found[0].score < current.score - ACCEPT:
                current, rivals = found[0], found[1:]
                if _spent(case) > HASTE_S:
                    break
                rounds.append(look(case, current, entries))
    if len(current.effects) > 1:
        current, rivals = _backward(
            case, base, current, rivals, entries, rounds[0].finalists if not start else []
        )
    return current, rivals, rounds


def _spent(case: Case) -> float:
    """CPU seconds since the diagnosis began."""
    return time.process_time() - case.begun


def otherwise(case: Case, seen: Round, after: Round) -> list[Explanation]:
    """Two effects, best score first: a first choice made beside other missing physics can be wrong, so those that came near it
    (`seen.finalists`) are looked at again, as the choice itself was (`after`), and the most promising get their second effect, too."""
    promising = []
    for e in (e for e in _runners_up(seen.finalists, BEGINNINGS) if e is after.base or not _soaks(case, e)):
        if _spent(case) > PATIENCE_S:
            break
        again = after if e is after.base else look(case, e, after.entries, draws=0)
        if again.directions:
            promising.append((e.fit.cost - again.directions[0].gain, again))
    best: list[Explanation] = []
    for _, again in sorted(promising, key=lambda p: p[0])[:3]:
        if best and _spent(case) > HASTE_S:
            break
        found = compete(case, again, finalists(again.directions, 6))
        if found and (not best or found[0].score < best[0].score):
            best = found
    return best


def following(
    case: Case, base: Explanation, entries: Mapping[str, Any], most: int
) -> tuple[Explanation, Explanation, list[Explanation]] | None:
    """The search with the plant held to the recordings by an observer, then proved in the free run. Returns (explanation
    in the free run, the same under the observer, its rivals there)."""
    case.progress("looking again with the plant held to the recording")
    for trust in (0.01, 0.1):
        model = compile_plant(base.plant)
        plant = observer.follows(
            base.plant, model, [model.excitation(t) for t in case.tables], case.noise, trust
        )
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
        if energy(case, free) < 0.1 * energy(case, base):
            return free, found, rivals
    return None


def _runners_up(found: Sequence[Explanation], count: int = 3) -> list[Explanation]:
    """The leaders, one per effect."""
    out: list[Explanation] = []
    for e in found:
        if e.last.effect.name not in {o.last.effect.name for o in out}:
            out.append(e)
    return out[:count]


def _backward(
    case: Case,
    base: Explanation,
    current: Explanation,
    rivals: list[Explanation],
    entries: Mapping[str, Any],
    alone: Sequence[Explanation],
) -> tuple[Explanation, list[Explanation]]:
    """With several effects: take each one out, look again at what would fill its place, and keep the best. What else could
    fill a place is a rival, so that each effect's probability is its own; an effect that is left over by itself has those that
    competed with it `alone`."""
    for _ in range(2):
        changed = False
        late = _spent(case) > HASTE_S
        others: list[Explanation] = []
        for k in range(len(current.effects)):
            without = leave_out(case, base, current, k)
            if without is None:
                continue
            if without.score < current.score + ACCEPT / 2:
                case.progress("one effect is not needed beside the others")
                if without.score > base.score - ACCEPT:
                    return base, []
                if len(without.effects) > 1:
                    return _backward(case, base, without, [], entries, alone)
                return without, [e for e in alone if len(e.effects) == 1 and e.last.key != without.last.key]
            seen = look(case, without, entries, draws=0)
            found = compete(case, seen, finalists(seen.directions, 4 if late else 8))
            key = current.effects[k].key
            if found and found[0].score < current.score - 2:
                changed |= found[0].last.key != key
                current = found[0]
            others += [
                f for f in found if f is not current and f.last.key not in {c.key for c in current.effects}
            ]
        rivals = others or rivals
        if not changed or late:
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


def predicts(case: Case, before: Explanation, after: Explanation) -> float:
    """Below 1 where an explanation predicts data that took no part better: the upper end of the ratio of errors' interval, so that
    a sensor's colour is not taken for physics; where the residual is white, and chance known, the ratio itself."""
    gain = prediction(case, before, after)
    return gain[0] if after.white else gain[2]


def prune(case: Case, base: Explanation, current: Explanation, notes: list[str]) -> Explanation:
    """Drop effects that do not lower the error on data that took no part."""
    while current.effects:
        weakest: tuple[float, Explanation, Candidate] | None = None
        for k, c in enumerate(current.effects):
            without = leave_out(case, base, current, k)
            if without is None:
                continue
            high = predicts(case, without, current)
            if not high < 1.0 and (weakest is None or high > weakest[0]):
                weakest = (high, without, c)
        if weakest is None:
            return current
        notes.append(
            f"{weakest[2].effect.name} at {weakest[2].place.where} fits better but does not predict held-out data "
            "better; it is not counted"
        )
        current = weakest[1]
    return current


def _on(c: Candidate, plant: Plant) -> Candidate:
    """The same effect at the same place of another plant. Raises LookupError where that has no such place."""
    rig = Rig(plant, c.rig.drives, c.rig.columns)
    same = [
        x
        for x in candidates(rig, {c.effect.name: c.effect})
        if (x.key, x.variant, x.label) == (c.key, c.variant, c.label)
    ]
    if not same:
        raise LookupError(f"{c.effect.name} has no place {c.place.where} any more")
    return same[0]
