"""What an explanation leaves of the recordings unexplained, and whether that can be noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from math import log10

from thermoctl.diagnose import locate
from thermoctl.diagnose.effects import Rig
from thermoctl.diagnose.evidence import Colour, possible
from thermoctl.diagnose.explain import Case, Explanation, noise_of
from thermoctl.diagnose.screen import Metric

REMAINS = -9.0  # log10 p of an unknown input, in the residual's own colour, from which something is left over
WHITE = -3.5  # the same where every residual is white, so that the chance is what it should be
RHYTHM = (
    -5.0
)  # the same of a period, whose chance in noise of any colour is what it should be (tests/diagnose)
TOGETHER = -5.0  # the same of what two sensors share, whose chance is known, too
UNLIKE_COLOUR, MOST = (
    -30.0,
    0.12,
)  # the same in white noise's metric, and its share of the residual's energy beyond white noise


def metric_of(case: Case, e: Explanation, colours: Sequence[Colour] | None) -> Metric:
    """Return the residual's rows of a fitted hypothesis, weighted by a noise model a channel, or as white noise."""
    drives = [e.fit.model.excitation(t) for t in case.tables]
    for r, d in enumerate(drives):
        e.fit.model.prepare(d, e.fit.values[r])
    return Metric(dataclasses.replace(e.fit, noise=noise_of(colours)) if colours else e.fit, drives)


def energy(case: Case, e: Explanation) -> float:
    """Residual energy beyond the sensors' noise, summed over outputs."""
    return sum(max(x * x - 1.0, 0.0) for x in case.excess(e).values())


def smooth(case: Case, e: Explanation, coloured: bool = False) -> float:
    """log10 p of the best smooth unknown input at one node or on one sensor; 0 where there is none."""
    found = locate.suspects(metric_of(case, e, e.colours if coloured else None))
    return found[0].log_p if found else 0.0


def remains(case: Case, e: Explanation) -> locate.Suspect | None:
    """An unknown input in time, an unknown function of the state, or a rhythm, that still explains more of the residual than noise of any colour
    that the residual may have would let it; or, in white noise's metric, a good part of what is there beyond white noise: a sensor's
    colour spreads over many frequencies and follows nothing. There an error of the sensor alone says nothing: it may be its colour.
    Or what two sensors share. Kept by the case: search and verdict ask for the same ones."""
    if id(e) not in case.left:
        case.left[id(e)] = (e, _remains(case, e))
    return case.left[id(e)][1]


def _remains(case: Case, e: Explanation) -> locate.Suspect | None:
    def strongest(colours: Sequence[Colour] | None) -> tuple[locate.Suspect | None, float]:
        metric = metric_of(case, e, colours)
        rig = Rig(e.plant, metric.drives, [t.columns for t in case.tables])
        looks = [*locate.patterns(metric, rig), *locate.suspects(metric)]
        limit = WHITE - log10(max(len(looks), 1)) if e.white else REMAINS if colours else UNLIKE_COLOUR
        found = [
            s for s in looks if s.log_p < (2 * limit if s.kind == "output" else limit)
        ]  # sensors wander by themselves
        if (
            not found and colours
        ):  # what follows a signal may ring: a rhythm of its own is said where nothing else explains it
            found = [s for s in locate.rhythms(metric)[:1] if s.log_p < RHYTHM]
        return min(found, key=lambda s: s.log_p, default=None), float(
            metric.residual @ metric.residual
        ) - len(metric.residual)

    tinted = [strongest(c)[0] for c in possible(e.fit.residuals, [n.sigma for n in case.noise])]
    if all(tinted):
        return tinted[0]
    if not e.white:
        plain, beyond = strongest(None)
        if plain and plain.kind != "output" and plain.gain > MOST * beyond:
            return plain
    return next(
        (s for s in locate.together(e.fit.residuals, e.colours, e.plant)[:1] if s.log_p < TOGETHER), None
    )
