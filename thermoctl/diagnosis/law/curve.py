"""The missing flow as a free function of a signal, to be drawn beside the law that was found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoctl.diagnosis.law.free import PIECES, pieces
from thermoctl.diagnosis.law.propose import Proposal
from thermoctl.diagnosis.law.signals import Signal
from thermoctl.diagnosis.law.smooth import Tracked
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant

SEEN = 0.01  # least singular value of a direction of the free function that is drawn, over the largest one


@dataclass(frozen=True)
class Curve:
    """The missing flow as a free function of a signal, its sd, and the law, at visited values `at` (k,)."""

    signal: Signal
    at: np.ndarray
    flow: np.ndarray
    sd: np.ndarray
    law: np.ndarray


def curve(linear: Tracked, p: Proposal, rate: ex.Expr, plant: Plant) -> Curve | None:
    """Return the flow at the law's place as a free function of its first signal, and the law there.

    None for a law with a memory or of a storage. None, too, if the plant without it lacks one of its signals:
    a lag of a sensor that was found beside it makes such signals. The free function is the law plus a fit to
    its residual."""
    signals = [s for t in p.terms for s in t.signals]
    if not signals or p.place.part != "flow" or any(t.form.memory for t in p.terms):
        return None
    s = signals[0]
    parameters = {q: v.value for q, v in plant.parameters.items()}
    if not ex.names(rate) <= {*linear.metric.signals[0], *parameters, "t"}:
        return None
    values = linear.along(s.along)
    flows = linear.along(lambda run, t: ex.series(rate, {**run, **parameters}, t))
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, PIECES + 4)))
    parts = [pieces(v, knots) for v in values]
    whole = np.concatenate(parts)
    line = np.linalg.lstsq(whole, np.concatenate(flows), rcond=None)[0]
    rest = linear.target - linear.columns(p.place, [q[:, None] for q in flows])[:, 0]
    u, w, v = np.linalg.svd(linear.columns(p.place, parts), full_matrices=False)
    seen = w > SEEN * w[0]  # the plant's own parameters absorb the others
    noise = max(float(np.mean(rest**2)), 1.0)
    extra = v[seen].T @ ((u.T @ rest)[seen] / w[seen])
    sd = np.sqrt(noise * ((v[seen].T / w[seen]) ** 2).sum(axis=1))
    return Curve(s, knots, line + extra, sd, line)
