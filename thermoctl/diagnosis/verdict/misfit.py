"""Is an effect physics, or the shape of a misfit that nobody will name?

Every plant is also wrong in small ways, and these misfits have the shapes of effects. Their energy stays in
the residuals of every hypothesis. Along each parameter of an effect, such a misfit has a normal distribution.
Its variance is the share `alike` of that energy. One cause may act on all m readings with a misfit, so these
count as one. A loud misfit of one does not hide an effect in another. The noise of its n rows limits a
reading, too. The size of a true effect is log-uniform. With r, the effect's size in standard
deviations of all readings together,

    r^2 = sum over readings (energy that the effect removes) / (share m (energy that stays) + 1 / n)
    share = 1 - (1 - alike)^parameters,   odds of physics = sqrt(2 pi) exp(r^2 / 2) / (r DECADES ln 10)

Energies are mean squares of an output's residuals over its sensor's noise.

The standard deviations of a refit are those of the noise. With z, the effect's size in these, noise and
misfit together give standard deviations that are sqrt(1 + z^2 / r^2) times as large (`deviations`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import DECADES, Fitted, as_refitted, significance
from thermoctl.diagnosis.evidence.levels import rounded
from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.search.beam import Searched

MISFIT = 0.5  # probability of being physics; an effect below it is taken for a misfit
SURE = 200.0  # r^2 beyond which the probability is 1 in any case


@dataclasses.dataclass(frozen=True)
class Energy:
    """By output: mean square of the residuals over the noise, its part above the noise, number of rows."""

    squares: tuple[float, ...]
    misfit: tuple[float, ...]
    rows: tuple[float, ...]

    @property
    def all(self) -> float:
        """Sum over outputs."""
        return sum(self.squares)


def standing(
    energy: Mapping[Keys, Energy], dims: Mapping[Key, int], contains: Mapping[str, str], limits: Thresholds
) -> dict[Keys, dict[Key, float]]:
    """Return the probability that each effect of a hypothesis is physics, by hypothesis.

    Hypotheses with effects are left out if no effect of theirs stands out of the misfit. An effect is
    compared with the best tried hypothesis whose effects are a subset of the others. Effects that do not
    stand out are part of the misfit. The others then have the larger of their probabilities beside them and
    without them. A hypothesis is left out, too, if an effect in it does not stand out against the simpler
    entry that it contains. `dims`: number of parameters of each effect; `contains`: by entry, the simpler
    one."""
    probabilities: dict[Keys, dict[Key, float]] = {}
    simpler = set()
    for home in sorted(energy, key=len):
        mine, own = energy[home], {}
        for key in home:
            own[key] = physics(_without(energy, home, key), mine, _share(dims[key], limits))
        stand = standouts(own)
        if stand in simpler or any(_is_simpler(home, key, energy, dims, contains, limits) for key in home):
            simpler.add(home)
            continue
        for key, p in probabilities.get(stand, {}).items() if stand < home else ():
            own[key] = max(own[key], p)
        probabilities[home] = own
    return {home: own for home, own in probabilities.items() if not home or standouts(own)}


def _is_simpler(
    home: Keys,
    key: Key,
    energy: Mapping[Keys, Energy],
    dims: Mapping[Key, int],
    contains: Mapping[str, str],
    limits: Thresholds,
) -> bool:
    """Return whether an effect of a hypothesis adds only a misfit to the simpler entry that it contains."""
    effect, where = key
    simple = (contains.get(effect, ""), where)
    other = energy.get(home - {key} | {simple})
    if other is None or simple in home:
        return False
    more = max(dims[key] - dims[simple], 1)
    return physics(other, energy[home], _share(more, limits)) <= MISFIT


def _share(dims: int, limits: Thresholds) -> float:
    """Return the share of the energy that stays along `dims` parameters."""
    return 1 - (1 - limits.alike) ** dims


def _without(energy: Mapping[Keys, Energy], home: Keys, key: Key) -> Energy:
    """Return the energy of the best tried hypothesis without an effect, whose effects are a subset."""
    return min((e for keys, e in energy.items() if keys < home and key not in keys), key=lambda e: e.all)


def standouts(of: Mapping[Key, float]) -> Keys:
    """Return the effects that are more probably physics than a misfit."""
    return frozenset(key for key, p in of.items() if p > MISFIT)


def supported(likeliest: Keys, probabilities: Mapping[Keys, Mapping[Key, float]]) -> Keys:
    """Return the effects of a hypothesis without those that are more probably a misfit.

    The weakest is left out first. Of two effects of the same shape, neither stands out beside the other. The
    stronger one stands out once the weaker one is left out. `probabilities`: the result of `standing`."""
    keys = likeliest
    while own := probabilities.get(keys, {}):
        weakest = min(own, key=lambda key: own[key])
        if own[weakest] > MISFIT:
            return keys
        keys = keys - {weakest}
    return standouts(probabilities[likeliest])


def physics(without: Energy, beside: Energy, share: float) -> float:
    """Return the probability that an effect is physics, from the energies without it and beside it."""
    square = float(np.clip(_square(without, beside, share), 0.0, SURE))
    r = max(np.sqrt(square), 1.0)
    odds = np.sqrt(2 * np.pi) * np.exp(0.5 * square) / (r * DECADES * np.log(10.0))
    return float(odds / (1 + odds))


def _square(without: Energy, beside: Energy, share: float) -> float:
    """Return r^2; infinite where no misfit stays."""
    removed, left = np.subtract(without.squares, beside.squares), np.array(beside.misfit)
    if not left.any():
        return np.inf
    variance = share * np.count_nonzero(left) * left + 1 / np.array(beside.rows)
    return float((removed / variance).sum())


def deviations(f: Fitted, energy: Mapping[Keys, Energy], limits: Thresholds) -> Mapping[str, float]:
    """Return the standard deviations of the effects' parameters, noise and misfit together."""
    home, sd = f.hypothesis.keys, dict(f.sd)
    for e in f.hypothesis.effects:
        square = _square(_without(energy, home, e.key), energy[home], _share(len(e.own), limits))
        stretch = np.sqrt(1 + significance(f, e) / max(square, 1.0))
        sd |= {n: sd[n] * stretch for n in e.own.values() if n in sd}
    return sd


def energies(case: Case, searched: Searched) -> Mapping[Keys, Energy]:
    """Return the energies of all hypotheses.

    Up to `clean` times its noise a residual is no misfit, unless a remainder is certain there. The
    noise is the estimate of the leading hypothesis: a stated noise that is too large would hide the misfit. A
    hypothesis has two refits (`as_refitted`). The one with less energy is used."""
    own = searched.tried[0].fitted.average.sensor
    noise = list(zip(own, rounded(case), strict=True))
    out = {}
    for w in searched.tried:
        both = [_energy(case, f, noise) for f in (w.fitted, as_refitted(case, w.fitted))]
        out[w.fitted.hypothesis.keys] = min(both, key=lambda e: e.all)
    return out


def _energy(case: Case, f: Fitted, noise: Sequence[tuple[float, bool]]) -> Energy:
    """Return the energies of a refit.

    `noise`: by output the noise's variance, and whether the reading is coarsely rounded."""
    parts = []
    for g, (own, coarse), p in zip(case.grids, noise, f.average.remainder, strict=True):
        power = sum(float(f.powers[k].sum()) for k in g.channels) + f.past.squares.get(g.output, 0.0)
        rows = float(g.count.sum()) + f.past.counts.get(g.output, 0.0)
        square = power / (rows * own)
        noisy = 1.0 if p >= case.limits.name and not coarse else case.limits.clean**2
        parts.append((square, max(square - noisy, 0.0), rows))
    return Energy(*zip(*parts, strict=True))
