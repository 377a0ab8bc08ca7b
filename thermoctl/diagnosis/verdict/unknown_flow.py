"""Is a flow missing that no single reading shows?

Each reading's noise may hide a slow error, but a flow into one node reaches several readings together. An
unknown flow into a node, or along a flow from node to node, is a hypothesis like any other. It is piecewise
linear between KNOTS knots in each recording. Their values w are independent and normal, with the share eta
of the typical flow there as sd. X holds the responses to them, without the part that the plant's own
parameters absorb. r is the residual. By Laplace's method, at the likeliest w,

    log p(D | flow) = log p(r - X w) - 1/2 w'w - 1/2 log |1 + X' V^-1 X|.

Noise and remainder are averaged as always. 1/V is their mean for r - X w, because part of the noise may be
the flow. eta is log-uniform over SHARES. Coarsely rounded readings have errors that depend on the signal, so
they do not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.special import expit, logsumexp

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.evidence.levels import rounded
from thermoctl.diagnosis.evidence.where import typical_flow, typical_rate
from thermoctl.diagnosis.law.smooth import flow_rows, hat_functions
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.plant.language import Plant

# Knots of a recording, at most and at least, and about how many in all recordings together.
KNOTS, FEWEST, TOGETHER = 24, 6, 240
# Iterations of flow and noise in turn, at most; they end where the evidence changes by fewer nats.
ROUNDS, SETTLED = 4, 0.1
FAR = 50.0  # nats below no flow, from which a share of the typical flow cannot win
SHARES = 10.0 ** np.arange(-4.5, 0.6, 0.5)  # eta


@dataclass(frozen=True)
class Missing:
    """The probability that something unknown is missing, the node where it most likely is, and a sentence."""

    probability: float = 0.0
    node: str | None = None
    sentence: str = ""

    def doubt(self, verdict: str, limits: Thresholds) -> str:
        """Return the sentence if the flow is certain, or possible and the verdict ambiguous; else ''."""
        if self.probability >= limits.name:
            return self.sentence
        if verdict == "ambiguous" and self.probability > 1 - limits.set:
            return f"or {self.sentence} (probability {self.probability:.2f})"
        return ""


def flow_missing(case: Case, f: Fitted, nodes: Sequence[str]) -> Missing:
    """Return the probability that an unknown flow into or between nodes is missing in a fitted hypothesis.

    Its prior odds are `missing` (any physics) times `rare` (a function of time), shared among its places."""
    try:
        gains = flow_gains(case, f, nodes)
    except FAILS:
        return Missing()
    if not gains:
        return Missing()
    limits = case.limits
    odds = np.log(limits.missing / (1 - limits.missing)) + np.log(limits.rare) - np.log(len(gains))
    p = float(expit(logsumexp(list(gains.values())) + odds))
    best = max(gains, key=lambda where: gains[where])
    along = f.plant.flows.get(best)
    where = f"along {best}" if along else f"into {best}"
    sentence = (
        f"a flow {where} is missing that no effect explains: readings that hide it one by one "
        "show it together"
    )
    return Missing(p, along.source if along else best, sentence)


def flow_gains(case: Case, f: Fitted, nodes: Sequence[str]) -> dict[str, float]:
    """Return the log Bayes factor of an unknown flow into each node and along each flow between two of them.

    Raises SimulationError."""
    metric = Metric(Plain(case, f.fit), f.average, True)
    knots = int(np.clip(TOGETHER // len(metric.runs), FEWEST, KNOTS))
    knots = min(knots, *(len(d.t) for d in metric.drives))
    hats = [hat_functions(d.t, knots) for d in metric.drives]
    coarse = {g.output for g, is_coarse in zip(case.grids, rounded(case), strict=True) if is_coarse}
    fine = [o not in coarse for o in case.null.model.outputs]
    counts = np.concatenate([np.full(c.rows, fine[c.output]) for c in metric.plain.coordinates.channels])
    _, weight = metric.weighed(metric.residual)
    responses = {n: block_diag(*flow_rows(metric, n, hats)) for n in nodes}
    out = {}
    for where, response, size in _ways(metric.model.plant, responses, metric.signals):
        x = metric.project(size * response) * counts[:, None]
        scores = [evidence(metric, x * share, weight) for share in SHARES]
        gain = float(logsumexp(scores) - np.log(len(SHARES)))
        if np.isfinite(gain):
            out[where] = gain
    return out


def _ways(
    plant: Plant, responses: Mapping[str, np.ndarray], runs: Sequence[Mapping[str, np.ndarray | float]]
) -> Iterator[tuple[str, np.ndarray, float]]:
    """Yield where a flow may be missing, its unit response and its typical size.

    It comes from outside into a node, or it goes along a flow of the plant, from node to node."""
    for n, response in responses.items():
        size = typical_flow(plant, n, runs)
        if size > 0:
            yield n, response, size
    for f in plant.flows.values():
        if f.source and f.target and {f.source, f.target} <= responses.keys():
            size = typical_rate(f, runs)
            if size > 0:
                yield f.name, responses[f.target] - responses[f.source], size


def evidence(metric: Metric, x: np.ndarray, weight: np.ndarray) -> float:
    """Return the log evidence of flows with whitened responses x (rows, knots) by Laplace's method.

    `weight` (rows,): of the noise without them; it rises where they explain part of that noise."""
    score = 0.0  # that of no flow
    for _ in range(ROUNDS):
        inside = x * weight[:, None]
        curvature = np.eye(x.shape[1]) + inside.T @ inside
        w = np.linalg.solve(curvature, inside.T @ (metric.residual * weight))
        likelihood, weight = metric.weighed(metric.residual - x @ w)
        before, score = score, likelihood - 0.5 * float(w @ w + np.linalg.slogdet(curvature)[1])
        if abs(score - before) < SETTLED or score < -FAR:
            break
    return score
