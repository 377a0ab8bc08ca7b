"""The experiment that decides between the remaining hypotheses, the best for an hour of rig time.

Two fitted hypotheses a, b predict readings y_a, y_b (N,) of an experiment. Their difference is compared with
the noise and with the uncertainty of their parameters (Buzzi-Ferraris & Forzatti, Chem. Eng. Sci. 38 (1983)
225). R is the noise's covariance, J = dy/dz, P = cov z:

    D_ab = (y_a - y_b)' (R + J_a P_a J_a' + J_b P_b J_b')^-1 (y_a - y_b)          (1)

The experiment's information on which hypothesis is true, in bits (lower bound of Kolchinsky & Tracey, Entropy
19 (2017) 361):

    I = -sum_a w_a log2 sum_b w_b exp(-D_ab / 8)                                  (2)

The choice is the largest I per hour among the candidates that reach ENOUGH of the best I. Every hypothesis
must predict every reading inside its recorded range, unless limits are given. If no candidate meets that, the
inputs' excursions are made smaller (SHARES)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, with_residuals
from thermoctl.diagnosis.experiment.design import NONE, Excitation, Lever, Ranges, family, levers, recorded
from thermoctl.diagnosis.experiment.file import FILES
from thermoctl.diagnosis.hypothesis.candidates import spoken
from thermoctl.diagnosis.law.result import described
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.residuals import Scale
from thermoctl.plant.simulation.simulate import Model, SimulationError, compile_plant
from thermoctl.recording.table import Table
from thermoctl.units import readable_time

MOST = 5  # largest number of hypotheses that are compared
LIKELY = 0.02  # a hypothesis below this share of the likeliest one is not worth rig time
# Largest number of samples and of readings of a simulated experiment. A sample that stands for several
# recorded ones has a smaller noise.
POINTS, READINGS = 700, 4000
FEWEST_POINTS = 150  # least number of samples of a simulated experiment with many outputs
TRIALS, FEWEST_TRIALS = 150, 40  # number of candidates that are simulated: at most, and for large plants
NUMBERS = 2e8  # largest number of slopes that all trials compute: a plant of many bodies gets fewer trials
ENOUGH = 0.8  # share of the best experiment's bits that a shorter one must reach
# Shares of the inputs' recorded excursion from rest, tried until the readings stay inside their range.
SHARES = (1.0, 0.7, 0.5, 0.3)
DECIDES = 20.0  # least D that decides between two hypotheses: mean odds of e^(D/2)
# Variance of a parameter that is new in every recording: anything within its range (z from 0 to 1).
IN_RANGE = 0.09
LEAST_BITS = 0.06  # an experiment that tells less is not worth rig time
WORTH_A_SENSOR = 0.1  # least information in bits that a further sensor must add to be proposed

Standing = tuple[Fitted, float, str]  # a fitted hypothesis, its probability, its name
Prediction = tuple[np.ndarray, np.ndarray]  # readings (N, ny), and their uncertainty (N, ny, z)


@dataclass
class _Predictor:
    """A fitted hypothesis ready to predict, with the root of its parameters' covariance."""

    label: str
    weight: float
    model: Model
    root: np.ndarray  # (z, z), P = root root'
    slopes: np.ndarray  # (z,) dq / dz of each uncertain unknown, else 0

    def predict(self, table: Table, states: bool = False) -> Prediction | None:
        """Simulate an experiment; None where that fails. `states`: append them as columns."""
        try:
            run = self.model.run(self.model.excitation(table), sensitivities=True, rtol=1e-5, states=states)
        except (SimulationError, InputError):
            return None
        y, slopes = run.y, run.sensitivities
        if states and run.dx is not None:
            y, slopes = np.concatenate([y, run.x], axis=1), np.concatenate([slopes, run.dx], axis=1)
        slopes = slopes * self.slopes @ self.root
        return (y, slopes) if np.all(np.isfinite(y)) and np.all(np.isfinite(slopes)) else None


def _predictor(f: Fitted, weight: float, label: str) -> _Predictor:
    model = compile_plant(f.plant)
    covariance = np.linalg.pinv(f.curvature, hermitian=True)
    place = {q: k for k, q in enumerate(q for q, r in f.fit.unknowns if r is None)}
    nq = len(model.unknowns)
    scaled, slopes = np.eye(nq), np.zeros(nq)
    for c, q in enumerate(model.unknowns):
        p = model.plant.parameters.get(q)
        if c < len(model.active) and p is not None and p.range:
            slopes[c] = Scale(p).slope(p.value)
            scaled[c, c] = IN_RANGE
        elif c >= len(model.active):
            slopes[c] = model.plant.nodes[model.uncertain[c - len(model.active)]].initial_sigma or 0.0
    determined = [c for c, q in enumerate(model.unknowns) if q in place and slopes[c]]
    index = [place[model.unknowns[c]] for c in determined]
    scaled[np.ix_(determined, determined)] = covariance[np.ix_(index, index)]
    # no parameter is more uncertain than its range
    scaled[np.diag_indices(nq)] = np.minimum(np.diag(scaled), 1.0)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return _Predictor(label, weight, model, root, slopes)


def distances(
    predictions: Sequence[Prediction], columns: Sequence[Sequence[int]], sigma: np.ndarray
) -> np.ndarray:
    """Compute D of (1) for each pair of predictions over their columns, by Woodbury's identity.

    `sigma`: noise of each column. The products of one prediction are computed once for all its pairs."""
    y, load = (
        [
            np.concatenate([p[part][:, j] / s for j, s in zip(own, sigma, strict=True)])
            for p, own in zip(predictions, columns, strict=True)
        ]
        for part in (0, 1)
    )
    own = [np.eye(x.shape[1]) + x.T @ x for x in load]
    squared = np.zeros((len(y), len(y)))
    for a in range(len(y)):
        for b in range(a):
            difference = y[a] - y[b]
            inner = np.concatenate([load[a].T @ difference, load[b].T @ difference])
            cross = load[a].T @ load[b]
            taken = np.linalg.solve(np.block([[own[a], cross], [cross.T, own[b]]]), inner)
            squared[a, b] = squared[b, a] = float(max(difference @ difference - inner @ taken, 0.0))
    return squared


def bits(squared: np.ndarray, weights: np.ndarray) -> float:
    """Compute I of (2) from D of (1), `squared` (n, n), and the hypotheses' weights (n,)."""
    return float(-weights @ np.log2(np.exp(-squared / 8) @ weights))


def noise_of(case: Case, f: Fitted) -> np.ndarray:
    """Return the standard deviation (ny,) of one reading of each output, for comparing hypotheses.

    It is the rms residual of the likeliest hypothesis, at least the sensor's noise. It is larger if
    neighbouring residuals correlate, because their mean is less precise than that of independent ones."""
    out = []
    for o, n in zip(case.null.model.outputs, case.noise, strict=True):
        j = f.fit.model.outputs.index(o)
        r = [q[np.isfinite(q[:, j]), j] for q in f.fit.residuals]
        r = [q for q in r if len(q) > 8]
        square, lag = n.sigma**2, 0.0
        if r:
            square = max(square, float(np.concatenate([q**2 for q in r]).mean()))
            products, squares = np.sum([(np.sum(q[1:] * q[:-1]), np.sum(q**2)) for q in r], axis=0)
            lag = float(np.clip(products / max(squares, 1e-300), 0.0, 0.98))
        out.append(np.sqrt(square * (1 + lag) / (1 - lag)))
    return np.array(out)


def survivors(diagnosis: Diagnosis) -> list[Standing]:
    """Return the hypotheses, or laws, that are not ruled out, the likeliest first; none if all is decided.

    Each has its probability and its name. Unless the verdict is ambiguous, the plant without effects is one
    of them. If other data confirmed no effect, its probability is at least that of this doubt."""
    verdict = diagnosis.decision.verdict
    if verdict in ("ambiguous", "unexplained") or (
        verdict == "consistent" and diagnosis.posterior.something > 0.5
    ):
        hypotheses = {k: p for k, p in diagnosis.posterior.hypotheses.items() if k or verdict != "ambiguous"}
        if verdict == "unexplained":
            doubt = 1.0 - min(diagnosis.asked.values(), default=1.0)
            hypotheses[frozenset()] = max(hypotheses.get(frozenset(), 0.0), doubt)
        fits = {w.fitted.hypothesis.keys: w.fitted for w in diagnosis.searched.tried}
        likely = [
            (fits[k], p, " and ".join(spoken(k)) or "the plant as it is") for k, p in hypotheses.items()
        ]
    elif law := diagnosis.law:
        likely = [(law.fitted, law.share, f"the law found at {law.proposal.place.where}")]
        likely += [(f, share, described(p, f)) for p, f, share in law.rivals]
    else:
        return []
    likely.sort(key=lambda x: -x[1])
    return [x for x in likely if x[1] >= LIKELY * likely[0][1] and x[1] > 0][:MOST]


@dataclass(frozen=True)
class _Trial:
    """A simulated candidate: its information, the distances D (n, n), and each hypothesis's prediction."""

    excitation: Excitation
    bits: float
    distances: np.ndarray
    predictions: list[np.ndarray]  # readings (N, ny)


class _Comparison:
    """The hypotheses of an undecided diagnosis, and the information of an experiment about them."""

    def __init__(self, case: Case, standing: Sequence[Standing], limits: Ranges):
        self.case, self.limits = case, limits
        self.predictors = [_predictor(f, p, label) for f, p, label in standing]
        weights = np.array([b.weight for b in self.predictors])
        self.weights = weights / weights.sum()
        self.step = float(np.median(np.concatenate([np.diff(t.t) for t in case.tables])))
        self.sigma = noise_of(case, with_residuals(case, standing[0][0]))
        self.outputs = list(case.null.model.outputs)
        self.seen = [j for j, _ in enumerate(self.outputs) if len(_recorded(case, j))]
        self.points = min(POINTS, max(READINGS // len(self.outputs), FEWEST_POINTS))
        unknowns = sum(len(b.model.unknowns) for b in self.predictors)
        numbers = self.points * len(self.outputs) * unknowns
        self.trials = int(np.clip(NUMBERS / numbers, FEWEST_TRIALS, TRIALS))

    def grid(self, x: Excitation) -> float:
        """Return the time step of a simulated experiment, s."""
        return max(self.step, x.duration_s / self.points)

    def trial(self, x: Excitation) -> _Trial | None:
        """Simulate a candidate; None if a simulation fails, or a reading leaves its limits."""
        table = x.table(self.case.plant, self.grid(x))
        predictions = [p for b in self.predictors if (p := b.predict(table)) is not None]
        if len(predictions) < len(self.predictors) or self._leaves_limits(predictions):
            return None
        distances = self.distances(predictions, self.sigma[self.seen] * np.sqrt(self.step / self.grid(x)))
        return _Trial(x, bits(distances, self.weights), distances, [y for y, _ in predictions])

    def distances(
        self, predictions: Sequence[Prediction], sigma: np.ndarray, state: str | None = None
    ) -> np.ndarray:
        """Compute D of every two hypotheses over the recorded outputs.

        `state`: name of a state that is assumed to have a sensor, too; `sigma`: noise of each column."""
        columns = []
        for b in self.predictors:
            recorded = [b.model.outputs.index(self.outputs[j]) for j in self.seen]
            columns.append(recorded + ([len(b.model.outputs) + b.model.states.index(state)] if state else []))
        return distances(predictions, columns, sigma)

    def _leaves_limits(self, predictions: Sequence[Prediction]) -> bool:
        """Return whether any hypothesis predicts a reading outside its limits.

        Without limits, the recorded range counts, widened to include the experiment's initial value."""
        for j, o in enumerate(self.outputs):
            y = _recorded(self.case, j)
            for p, _ in predictions if len(y) or o in self.limits else ():
                if o in self.limits:
                    low, high = self.limits[o]
                else:
                    low, high = min(y.min(), p[0, j]), max(y.max(), p[0, j])
                if p[:, j].min() < low or p[:, j].max() > high:
                    return True
        return False


def propose(
    diagnosis: Diagnosis,
    drivable: Sequence[str] = (),
    limits: Ranges = NONE,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, Any], Excitation] | None:
    """Choose the next experiment of an undecided diagnosis: the result's entry, and its excitation.

    None if all is decided (`survivors`), no input can be driven, or no experiment tells forms of a law apart.
    `limits`: {input or output: (low, high)} of the rig. Raises InputError for a name that is neither."""
    case = diagnosis.case
    for n in limits:
        if n not in case.plant.inputs and n not in case.plant.outputs:
            raise InputError(
                f"a limit of '{n}': no such input or output of {case.plant.file}; there are "
                + ", ".join((*case.plant.inputs, *case.plant.outputs))
            )
    standing = survivors(diagnosis)
    if len(standing) < 2:
        return None
    drive = levers(case.plant, case.tables, drivable, limits)
    if not drive:
        return None
    if progress:
        progress("looking for the experiment that tells them apart")
    comparison = _Comparison(case, standing, limits)
    for share in SHARES:
        smaller = [_smaller(lever, share) for lever in drive]
        candidates = family(case.plant, case.tables, smaller, comparison.step)
        candidates = candidates[:: -(-len(candidates) // comparison.trials)]
        with ThreadPoolExecutor(max_workers=2) as pool:
            trials = [t for t in pool.map(comparison.trial, candidates) if t is not None]
        if trials:
            most = max(t.bits for t in trials)
            enough = (t for t in trials if t.bits >= ENOUGH * most)
            best = max(enough, key=lambda t: t.bits / t.excitation.duration_s)
            if best.bits < LEAST_BITS and diagnosis.law:
                return None  # no experiment tells these forms of one law apart
            return _entry(comparison, best, len(trials)), best.excitation
    return None


def _entry(comparison: _Comparison, best: _Trial, candidates: int) -> dict[str, Any]:
    """Return the proposal as `next_experiment` of diagnosis.json."""
    x, (first, *others) = best.excitation, comparison.predictors
    hours = x.duration_s / 3600
    sigmas = np.sqrt(best.distances[0, 1:])
    none = "No experiment that was tried tells them apart: the best sets"
    does = "It would set" if best.bits >= LEAST_BITS else none
    inputs = {n: c.tolist() for n, c in x.corners.items()} | {
        n: [[0.0, v]] for n, v in x.starts.items() if n in comparison.case.plant.inputs
    }
    return {
        "profile": x.title,
        "why": f"{does} {first.label} apart from {others[int(np.argmin(sigmas))].label} by {sigmas.min():.1f} "
        f"standard errors, after what their parameters are still uncertain by ({best.bits:.2f} bits in {readable_time(x.duration_s)}; "
        f"best per hour of {candidates} candidates).",
        "also_helpful": None if np.all(sigmas**2 >= DECIDES) else _sensor(comparison, best),
        "duration_s": x.duration_s,
        "sample_s": comparison.step,
        "hours": hours,
        "bits": best.bits,
        "bits_per_hour": best.bits / hours,
        "candidates": candidates,
        "separates": [
            {"hypothesis": b.label, "from": first.label, "sigmas": float(q)}
            for b, q in zip(others, sigmas, strict=True)
        ],
        "inputs": inputs,
        "predicted": _predicted(comparison, best.predictions),
        "limits": {n: list(span) for n, span in comparison.limits.items()},
        "file": FILES[0],
    }


def _smaller(lever: Lever, share: float) -> Lever:
    """Return the lever with the excursions from rest multiplied by `share`."""
    return dataclasses.replace(
        lever,
        low=lever.rest + share * (lever.low - lever.rest),
        high=lever.rest + share * (lever.high - lever.rest),
    )


def _recorded(case: Case, j: int) -> np.ndarray:
    """Return all finite readings of output j, of all recordings."""
    parts = recorded(case.tables, list(case.plant.outputs.values())[j].column)
    return np.concatenate([p[np.isfinite(p)] for p in parts]) if parts else np.zeros(0)


def _predicted(comparison: _Comparison, predictions: Sequence[np.ndarray]) -> dict[str, dict[str, Any]]:
    """List each output's unit, predicted range over all hypotheses, and recorded range."""
    out = {}
    for j, o in enumerate(comparison.outputs):
        y = _recorded(comparison.case, j)
        out[o] = {
            "unit": comparison.case.plant.outputs[o].unit,
            "column": comparison.case.plant.outputs[o].column,
            "low": float(min(p[:, j].min() for p in predictions)),
            "high": float(max(p[:, j].max() for p in predictions)),
            "recorded": [float(y.min()), float(y.max())] if len(y) else None,
        }
    return out


def _sensor(comparison: _Comparison, best: _Trial) -> str:
    """Return a sentence on the sensor that would add most to an experiment that does not decide."""
    plant, sigma, seen = comparison.case.plant, comparison.sigma, comparison.seen
    grid = comparison.grid(best.excitation)
    share = np.sqrt(comparison.step / grid)
    table = best.excitation.table(plant, grid)
    predictions = [p for b in comparison.predictors if (p := b.predict(table, True)) is not None]
    shown = [plant.outputs[comparison.outputs[j]] for j in seen]
    most, where = bits(best.distances, comparison.weights), ""
    for node in plant.nodes.values():
        same_unit = [sigma[j] for j, o in zip(seen, shown, strict=True) if o.unit == node.unit]
        measured = any(o.value.op == "name" and o.value.value == node.name for o in shown)
        known = all(node.name in b.model.states for b in comparison.predictors)
        if measured or not same_unit or not known:
            continue
        noise = np.append(sigma[seen], np.median(same_unit)) * share
        with_sensor = bits(comparison.distances(predictions, noise, node.name), comparison.weights)
        if with_sensor > most + WORTH_A_SENSOR:
            most, where = with_sensor, node.name
    if where:
        return f"A sensor of its own at {where} would tell more ({most:.2f} bits with the same experiment)."
    return (
        f"None of the experiments that were tried decides for sure between {comparison.predictors[0].label} and the others inside the "
        "recorded limits; a larger range of the inputs or another sensor would be needed."
    )
