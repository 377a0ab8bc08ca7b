"""The notes of a diagnosis: assumptions and cautions, as sentences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.evidence.levels import late
from thermoctl.diagnosis.hypothesis.candidates import spoken
from thermoctl.diagnosis.law.refit import PlacedLaw
from thermoctl.diagnosis.law.result import wrong_ends
from thermoctl.diagnosis.report.figures import chance
from thermoctl.diagnosis.report.words import listed
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.diagnosis.verdict.confirm import BRIEF, brief
from thermoctl.plant.fitting.refit import Fit

MOVES = 6.0  # an output moves if its spread is this many standard deviations of its noise
# Largest residual variance over the output's, if the plant is of this rig and lacks some physics.
FOLLOWS = 0.3
MATTERS = 0.1  # nats by which a refit is below its maximum, from which a probability changes


def notes(d: Diagnosis) -> list[str]:
    """Return the assumptions and the cautions, as sentences."""
    unnamed = [e.key for e in d.final.hypothesis.effects if e not in d.shown and not isinstance(e, PlacedLaw)]
    return [
        *d.case.notes,
        *doubts(d.case, d.final.fit, d.before.noise),
        *late(d.case, d.final),
        *unfinished(d.null, d.final),
        *_at_bounds(d),
        *_differ(d),
        *(note for law in d.laws for note in wrong_ends(d.case, law)),
        *(
            []
            if d.plant is d.final.plant
            else ["units of what was added to the plant do not fit it: left out"]
        ),
        *filter(None, [d.unknown]),
        *(
            f"{effect} at {where} may be over within {BRIEF} rows: a switch that is logged early or late looks the same"
            for effect, where in sorted(d.refused)
            if any(brief(w.fitted, (effect, where)) for w in d.searched.tried)
        ),
        *(
            f"{effect} at {where} is in the extended plant, but is no finding (probability "
            f"{chance(d.posterior.effects.get((effect, where), 0.0))})"
            for effect, where in unnamed
        ),
        *(e.candidate.effect.caution for e in d.shown if e.candidate.effect.caution),
    ]


def _differ(d: Diagnosis) -> list[str]:
    """Return a sentence where recordings set aside are not followed, though the others are."""
    over = d.worth.not_followed
    if d.decision.verdict != "consistent" or not over:
        return []
    worst = max(over, key=lambda o: over[o])
    names = d.worth.names
    differ = "differ" if names[1:] else "differs"
    return [
        f"the error of {worst} is {over[worst]:.2g} times the noise in {listed(names)}, set aside, which {differ} from the others"
    ]


def _at_bounds(d: Diagnosis) -> list[str]:
    """Return a sentence where values end at bounds that the plant file may have set too narrow.

    A bound of zero is physics: a flow that is not there. A law may take a flow's place below its bound."""
    known, now = d.case.plant.parameters, d.final.plant.parameters
    ranges = {q: now[q].range or (0.0, 0.0) for q in known if q in now}
    bounds = {q: ranges[q][side == "high"] for q, side in d.final.fit.at_bound.items() if q in ranges}
    ends = [f"{q} ({bound:g})" for q, bound in bounds.items() if bound]
    below = [f"{q} ({now[q].value:.3g})" for q in ranges if ranges[q] < (known[q].range or (0.0, 0.0))]
    beyond = f"at a bound of the range in the plant file: {listed(ends)}; the truth may lie beyond, and what was found may stand for that"
    instead = f"below the range in the plant file: {listed(below)}; the law takes the place of the flow in proportion to it"
    return [*([beyond] if ends else []), *([instead] if below else [])]


def unfinished(*fits: Fitted) -> list[str]:
    """Return a sentence for each fit that the limit of steps ended below its maximum."""
    names = {
        ", ".join(spoken(f.hypothesis.keys)) or "the plant without effects": f.fit
        for f in fits
        if not f.fit.converged
    }
    return [
        f"the refit of {name} ended after {fit.iterations} steps below its maximum; another promised {0.5 * fit.left:.2g} nats: "
        f"{'its probability may be too small' if 0.5 * fit.left > MATTERS else 'too few to change a probability'}"
        for name, fit in names.items()
    ]


def doubts(case: Case, fit: Fit, noise: Mapping[str, float]) -> list[str]:
    """Return sentences that doubt the recordings: nothing moves, or they do not suit the plant."""
    model = fit.model
    drives = case.drives(model)
    recorded = np.concatenate([x.y for x in drives])
    seen = {o: y[np.isfinite(y)] for o, y in zip(model.outputs, recorded.T, strict=True)}
    spread = {o: float(np.ptp(np.quantile(y, (0.02, 0.98)))) for o, y in seen.items() if len(y)}
    moves = any(spread[o] > MOVES * s for o, s in noise.items())
    if not moves and not any(np.ptp(x.u, axis=0).any() for x in drives):
        return [
            "no input changes and no output moves: almost nothing is excited, so almost nothing could be seen; "
            "record a run with changing inputs"
        ]
    swing = {o: float(np.std(seen[o])) for o in spread}
    return [
        f"the plant follows {o} only roughly (error {error:.3g}, standard deviation of the reading {swing[o]:.3g}): "
        "check that the recording is of this rig, in the plant's units, on one clock"
        for o, error in fit.rms().items()
        if o in spread and spread[o] > MOVES * noise[o] and error**2 > FOLLOWS * swing[o] ** 2
    ]
