"""Does an effect predict data that it was not fitted to?

Each recording is cut into BLOCKS parts. A hypothesis h and one without the effect are linearised at their
refits. For each part k their parameters are fitted to the other parts. E is the mean square of an output's
errors over its noise.

    d_k = sum over outputs of ln(E_k(without) + FLOOR) - ln(E_k(h) + FLOOR)

The effect is confirmed with the probability that Wilcoxon's signed-rank statistic of d is smaller by
chance. A wrong effect helps in the one part whose misfit it imitates, a right one in most parts. So no score
within the fitted data replaces this test. With recordings set aside, the parts are those of these recordings,
each simulated with the refits, and nothing is fitted to them.

Rows of a smooth error are not independent. An output counts as its number of equivalent draws, the
participation ratio 3 (sum R^2)^2 / sum R^4 of its DCT rows R."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.data.coordinates import FEWEST
from thermoctl.diagnosis.evidence.fit import UNIFORM, Fitted, as_refitted
from thermoctl.diagnosis.evidence.held_out import errors_aside
from thermoctl.diagnosis.evidence.posterior import Posterior, gaussian
from thermoctl.diagnosis.hypothesis.candidates import Candidate, Key, Keys
from thermoctl.diagnosis.verdict.decide import Probabilities
from thermoctl.plant.fitting.climb import bounded_step
from thermoctl.plant.simulation.simulate import SimulationError
from thermoctl.recording.table import Table

BLOCKS = 8  # parts of each recording
FLOOR = 0.1  # added to mean squares over the noise: differences between errors far below it are chance
DRAWS = 3.0  # n independent normal rows have the participation ratio n / 3
UNTOLD = 0.5  # probability of an event beside a misfit that no other recording can tell from it
ACROSS = 2  # least number of recordings to predict one from the others
ENDS, BRIEF = ("start", "end"), 2  # shapes of a window in time; number of rows in which a brief one is over
SWEEPS = 2  # solutions; after each, the outputs' weights are computed again
TINY = 1e-9


class Blocks:
    """A hypothesis linearised at a refit: sums of [slopes, residual] in each part of each recording.

    `sums` (recordings, BLOCKS, outputs, k + 1, k + 1), `count` (recordings, BLOCKS, outputs), of k unknowns.
    Raises SimulationError."""

    def __init__(self, case: Case, f: Fitted):
        log = Posterior(case, f.plant, f.hypothesis.effects)
        problem, self.z = log.problem, f.fit.z
        values, dx0 = problem.unpack(self.z)
        sigma = np.array([n.sigma for n in case.noise])
        k, outputs, recordings = len(self.z), len(sigma), len(problem.excitations)
        self.sums = np.zeros((recordings, BLOCKS, outputs, k + 1, k + 1))
        self.count = np.zeros((recordings, BLOCKS, outputs))
        draws = np.zeros(outputs)
        for r, d in enumerate(problem.excitations):
            unknowns, y, slopes = problem.jacobian(r, values[r], dx0[r])
            x = np.concatenate([slopes, (d.y - y)[:, :, None]], axis=2)
            x /= sigma[:, None]
            good = np.isfinite(d.y)
            if not np.isfinite(x[good]).all():
                raise SimulationError("the simulation gives values that are not numbers")
            x[~good] = 0.0
            draws += [_draws(x[good[:, j], j, -1]) for j in range(outputs)]
            entries = np.ix_([*unknowns, k], [*unknowns, k])
            for b, (own, seen) in enumerate(
                zip(np.array_split(x, BLOCKS), np.array_split(good, BLOCKS), strict=True)
            ):
                for j in range(outputs):
                    self.sums[r, b, j][entries] = own[:, j].T @ own[:, j]
                self.count[r, b] = seen.sum(axis=0)
        self.recording = np.array([-1 if r is None else r for _, r in problem.unknowns])
        self.low, self.high = (np.array(bound) for bound in log.bounds)
        self.prior, self.pull = self._prior(log, values)
        rows = self.count.sum(axis=(0, 1))
        self.share = np.minimum(draws, rows) / np.maximum(rows, 1.0)

    def _prior(self, log: Posterior, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return precision (k, k) and gradient at z (k,) of the prior, as one Gaussian.

        An effect's size may vanish where the other parts do not need it: its bounds hold its null value."""
        problem, z = log.problem, self.z
        _, push, bend = problem.prior_terms(values, True)
        precision, step = log.precision.copy(), log.mean - z
        for k, (_, p) in log.sizes.items():
            name, r = problem.unknowns[k]
            value = float(values[r or 0, log.model.parameters.index(name)])
            none = z[k] + (p.null - value) / problem.scales[name].slope(value)
            self.low[k], self.high[k] = min(self.low[k], none), max(self.high[k], none)
        for k in set(range(len(z))) - {*gaussian(log), *log.believed, *log.sizes}:
            precision[k, :] = precision[:, k] = 0.0
            precision[k, k], step[k] = UNIFORM, 0.5 - z[k]
        return precision + bend, precision @ step - push

    def _solved(self, sums: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the step of the unknowns (k,) from z that fits sums (outputs, k + 1, k + 1) best."""
        total, k = np.tensordot(weight, sums, axes=1), len(self.z)
        gradient, matrix = total[:k, k] + self.pull, total[:k, :k] + self.prior
        return bounded_step(self.z, gradient, matrix, 0.0, (self.low, self.high))[0]

    def _own(self, r: int, step: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the step with the unknowns of recording r (its initial states) refitted to all of r."""
        own = np.flatnonzero(self.recording == r)
        if not len(own):
            return step
        k = len(self.z)
        total = np.tensordot(weight, self.sums[r].sum(axis=0), axes=1)
        matrix = total[:k, :k] + self.prior
        gradient = total[:k, k] + self.pull - matrix @ step
        here = matrix[np.ix_(own, own)]
        out = step.copy()
        change = np.linalg.solve(here + TINY * np.diag(np.diag(here)), gradient[own])
        out[own] = np.clip(step[own] + change, self.low[own] - self.z[own], self.high[own] - self.z[own])
        return out

    def predicted(self, across: bool) -> np.ndarray:
        """Return the mean squares over the noise (recordings, BLOCKS, outputs) of parts, fitted to others.

        `across`: fitted to the other recordings alone. NaN where an output was not measured."""
        whole, rows = self.sums.sum(axis=(0, 1)), np.maximum(self.count.sum(axis=(0, 1)), 1.0)
        energy = whole[:, -1, -1] / rows
        for _ in range(SWEEPS):
            weight = self.share / np.maximum(energy, TINY)
            energy = _squares(whole, self._solved(whole, weight)) / rows
        weight = self.share / np.maximum(energy, TINY)
        out = np.full(self.count.shape, np.nan)
        for r, b in np.ndindex(*self.count.shape[:2]):
            left = self.sums[r, b]
            others = whole - (self.sums[r].sum(axis=0) if across else left)
            step = self._own(r, self._solved(others, weight), weight)
            seen = self.count[r, b] > 0
            out[r, b, seen] = _squares(left, step)[seen] / self.count[r, b, seen]
        return out


def timed(f: Fitted, key: Key) -> Candidate | None:
    """Return an effect if it depends on the time itself."""
    mine = (e.candidate for e in f.hypothesis.effects if e.key == key)
    return next((c for c in mine if c.effect.timed), None)


def brief(f: Fitted, key: Key) -> bool:
    """Return whether an effect may be over within BRIEF rows: so is the error of a switch logged early.

    Its size and its length may replace each other: so the least length counts, by two standard errors."""
    for e in (e for e in f.hypothesis.effects if e.key == key):
        ends = [e.own[p.name] for p in e.candidate.effect.parameters if p.shape in ENDS]
        times = [f.plant.parameters[q].value for q in ends]
        unsure = 2 * sum(f.sd.get(q, 0.0) for q in ends)
        return len(times) == len(ENDS) and times[1] - times[0] - unsure <= BRIEF * e.candidate.rig.sample
    return False


def _squares(sums: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the sums of squares (outputs,) after a step of the unknowns."""
    x = np.append(-step, 1.0)
    return np.maximum(np.einsum("oij,i,j->o", sums, x, x), 0.0)


def _draws(error: np.ndarray) -> float:
    """Return the number of equivalent independent draws of an error (N,)."""
    if len(error) < FEWEST:
        return 0.0
    power = dct(error, norm="ortho") ** 2
    return DRAWS * float(power.sum() ** 2 / max(float(power @ power), TINY**9))


@dataclass
class Confirm:
    """The test of the effects of one diagnosis. Each hypothesis is linearised once.

    `tried`: the hypotheses; `reserve`: recordings that took no part in any choice; `misfit`: does one stay
    that an event may imitate?"""

    case: Case
    tried: Mapping[Keys, Fitted]
    reserve: Sequence[Table]
    misfit: bool

    def __post_init__(self) -> None:
        self._known: dict[tuple[Keys, bool], np.ndarray | None] = {}

    def probability(self, home: Keys, key: Key) -> float:
        """Return the probability that an effect helps a hypothesis to predict.

        An event has a course in time, as a misfit has. Parts of one recording cannot tell them apart, only
        another recording can that the event is in, too."""
        event = None if self.reserve or not self.misfit else timed(self.tried[home], key)
        if event and (len(self.case.tables) < ACROSS or not event.shared):
            return UNTOLD
        mine = self._log_energies(home, event is not None)
        parts = [
            self._log_energies(keys, event is not None)
            for keys in self.tried
            if keys < home and key not in keys
        ]
        others = [part for part in parts if part is not None]
        if mine is None or not others:
            return 0.0 if mine is None else 1.0
        without = min(others, key=lambda part: float(np.nansum(part)))
        return signed_rank(np.nansum(without - mine, axis=1)[np.isfinite(mine).any(axis=1)])

    def _log_energies(self, keys: Keys, across: bool) -> np.ndarray | None:
        """Return ln(E + FLOOR) (parts, outputs); None where a simulation fails."""
        if (keys, across) not in self._known:
            try:
                energy = self._aside(keys) if self.reserve else self._left_out(keys, across)
            except FAILS:
                energy = None
            self._known[keys, across] = None if energy is None else np.log(energy + FLOOR)
        return self._known[keys, across]

    def _left_out(self, keys: Keys, across: bool) -> np.ndarray | None:
        """Return the mean squares of parts that were left out, of one recording after another if `across`.

        A hypothesis has two refits (`as_refitted`). The one that fits better is used."""
        f = self.tried[keys]
        both = [Blocks(self.case, f), Blocks(self.case, as_refitted(self.case, f))]
        best = min(both, key=lambda b: float(np.sum(np.log(_fitted(b)))))
        predicted = best.predicted(across)
        return predicted.reshape(-1, predicted.shape[-1])

    def _aside(self, keys: Keys) -> np.ndarray | None:
        """Return the mean squares in the parts of the recordings set aside."""
        sigma = np.array([n.sigma for n in self.case.noise])
        squares = []
        for table in self.reserve:
            error = errors_aside(self.case, self.tried[keys].plant, table) / sigma
            for part in np.array_split(error, BLOCKS):
                seen = np.isfinite(part)
                square = np.where(seen, part, 0.0) ** 2
                squares.append(
                    np.where(seen.any(axis=0), square.sum(axis=0) / np.maximum(seen.sum(axis=0), 1), np.nan)
                )
        out = np.array(squares)
        return out if np.isfinite(out).any() else None


def signed_rank(d: np.ndarray) -> float:
    """Return the probability of a smaller sum of the ranks of |d| (n,) with d > 0, if signs are chance.

    Wilcoxon (1945), exact: 2^-n times the number of subsets of 1..n with a smaller sum."""
    ways = np.ones(1)
    for k in range(1, len(d) + 1):
        ways = np.convolve(ways, np.eye(1, k + 1, k)[0] + np.eye(1, k + 1)[0]) / 2
    rank = np.argsort(np.argsort(np.abs(d))) + 1
    return float(ways[: int(rank[d > 0].sum())].sum())


def _fitted(b: Blocks) -> np.ndarray:
    """Return the mean squares over the noise of the outputs that were measured, at the refit."""
    rows = b.count.sum(axis=(0, 1))
    return np.asarray(np.maximum(b.sums.sum(axis=(0, 1))[rows > 0, -1, -1] / rows[rows > 0], TINY))


def confirmed(
    posterior: Probabilities, best: Keys, test: Confirm, name: float
) -> tuple[Keys, Probabilities, dict[Key, float]]:
    """Return the confirmed effects of a hypothesis, the posterior, and each tested effect's probability.

    Where an effect that would be named is not confirmed, the weakest of all is removed. Then the others are
    tested again: beside a wrong effect a right one may not help."""
    asked: dict[Key, float] = {}
    keys = best
    while True:
        own = {k: test.probability(keys, k) for k in keys if posterior.effects[k] >= name}
        asked |= own
        if min(own.values(), default=1.0) >= name:
            break
        own |= {k: test.probability(keys, k) for k in keys - own.keys()}
        weakest = min(own, key=lambda k: own[k])
        if keys - {weakest} not in test.tried:
            break
        keys = keys - {weakest}
    effects = {k: min(p, asked.get(k, 1.0)) for k, p in posterior.effects.items()}
    return keys, replace(posterior, effects=effects), asked
