"""Estimate the noise of each sensor from a fit's residuals: a first-order part beside the sensor's steps.

    e_k = a_k + w_k,   a_k = phi a_(k-1) + n_k,   var w = r = resolution^2 / 12 (known)
    as ARMA(1,1):  e_k = phi e_(k-1) + i_k - theta i_(k-1),   theta = b - sqrt(b^2 - 1),
                   b = (s^2 (1 - phi^2) + r (1 + phi^2)) / (2 phi r),   s^2 = var a,   var i = phi r / theta

phi is estimated channel by channel by restricted maximum likelihood (Patterson & Thompson 1971). The fit has
absorbed a part of the slow noise; the plain correlation of the residuals would miss it and make intervals too
narrow.

    minimise  n log v + RSS / v + log |M|,   M = sum over channels of J' V^-1 J,
              RSS after the parameters' answer -J M^-1 J' V^-1 e
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.fitting.whitening import Noise
from thermoctl.plant.simulation.simulate import Excitation

CLIP = 6.0  # residuals are clipped to this many robust standard deviations
# limits of the correlation of neighbouring samples; below the first: white noise
MIN_CORRELATION, MAX_CORRELATION = 1e-3, 0.995
MIN_SAMPLES = 20  # fewest samples of a channel for an estimate of its noise


def innovations(phi: float, white: float, total: float) -> Noise:
    """Return AR(1) noise with correlation phi and an uncorrelated part, as Noise.

    `white` is the variance of the uncorrelated part, `total` that of the whole."""
    coloured = max(total - white, 0.02 * total)
    if phi < MIN_CORRELATION:
        return Noise(float(np.sqrt(total)))
    if white < 1e-6 * total:
        return Noise(float(np.sqrt(total)), phi)
    b = (coloured * (1 - phi**2) + white * (1 + phi**2)) / (2 * phi * white)
    theta = b - np.sqrt(b * b - 1)
    return Noise(float(np.sqrt(phi * white / theta)), ar=(1.0, -phi), ma=(1.0, -float(theta)))


@dataclass(frozen=True)
class _Moments:
    """One channel's share of the restricted likelihood.

    J' V^-1 J (k, k), J' V^-1 e (k,), e' V^-1 e and log |V|."""

    gram: np.ndarray
    gradient: np.ndarray
    square: float
    log_size: float


class _Restricted:
    """The restricted likelihood of each output's noise, at a fit to `excitations`."""

    def __init__(self, found: Fit, excitations: Sequence[Excitation]):
        self.found = found
        self.problem = Problem(found.model, excitations, found.noise)
        values, dx0 = self.problem.unpack(found.z)
        self.slopes = [self.problem.jacobian(r, values[r], dx0[r]) for r in range(len(excitations))]
        self.prior = np.diag(self.problem.prior())
        self.moments = [self.moments_of(j, n) for j, n in enumerate(found.noise)]

    def moments_of(self, j: int, candidate: Noise) -> _Moments:
        """Return channel j's moments under a noise; residuals beyond CLIP robust sigmas are clipped."""
        own = self.problem.with_noise(j, candidate)
        gram, gradient, square, log_size = np.zeros_like(self.prior), np.zeros(len(self.prior)), 0.0, 0.0
        for r, (columns, _, dy) in enumerate(self.slopes):
            e = self.found.residuals[r][:, j]
            spread = 1.4826 * np.nanmedian(np.abs(e)) if np.isfinite(e).any() else 1.0
            e = np.clip(e, -CLIP * spread, CLIP * spread) if spread > 0 else e
            w, jac = own.whitening[r][j].whiten(e), own.whitening[r][j].whiten(dy[:, j])
            gram[np.ix_(columns, columns)] += jac.T @ jac
            gradient[columns] += jac.T @ w
            square += float(w @ w)
            log_size += 2 * (
                float(np.log(own.whitening[r][j].scale).sum())
                if len(candidate.ar) == 1
                else len(w) * np.log(candidate.sigma)
            )
        return _Moments(gram, gradient, square, log_size)

    def choose(self, j: int) -> Noise:
        """Return channel j's noise of the greatest restricted likelihood; the others' noise is held."""
        from scipy.optimize import minimize_scalar  # slow to load, and only coloured noise needs it

        old = self.found.noise[j]
        best = minimize_scalar(
            lambda phi: self._score(j, phi)[0],
            bounds=(0.0, MAX_CORRELATION),
            method="bounded",
            options={"xatol": 0.004},
        )
        white_score, white = self._score(j, 0.0)
        noise = self._score(j, float(best.x))[1] if best.fun < white_score - 2 else white
        noise = dataclasses.replace(noise, sigma=max(noise.sigma, 1e-3 * old.sigma))
        self.moments[j] = self.moments_of(j, noise)
        return noise

    def samples(self, j: int) -> int:
        """Return the number of measured samples of channel j."""
        return sum(len(outputs[j].index) for outputs in self.problem.whitening)

    def _score(self, j: int, phi: float) -> tuple[float, Noise]:
        """Return -2 log restricted likelihood of channel j at a correlation phi, and its noise.

        Three iterations determine the standard deviation."""
        output = list(self.found.model.plant.outputs.values())[j]
        white = (output.resolution or 0.0) ** 2 / 12
        residuals = np.concatenate([r[np.isfinite(r[:, j]), j] for r in self.found.residuals])
        total, count = max(float(np.mean(residuals**2)), 1e-24), self.samples(j)
        others = [m for k, m in enumerate(self.moments) if k != j]
        rest = self.prior + sum(m.gram for m in others)
        pull = sum((m.gradient for m in others), np.zeros(len(self.prior)))
        for _ in range(3):
            candidate = innovations(phi, min(white, 0.9 * total), total)
            own = self.moments_of(j, candidate)
            matrix = rest + own.gram
            answer = np.linalg.solve(matrix, pull + own.gradient)
            left = own.square - 2 * own.gradient @ answer + answer @ own.gram @ answer
            taken = min(float(np.trace(np.linalg.solve(matrix, own.gram))), 0.5 * count)
            total *= max(left, 1e-12) / (count - taken)
        return left + own.log_size + float(np.linalg.slogdet(matrix)[1]), candidate


def coloured(found: Fit, excitations: Sequence[Excitation]) -> list[Noise]:
    """Estimate each output's noise as AR(1) beside its quantisation, from the residuals of a fit.

    A channel of fewer than MIN_SAMPLES keeps its noise."""
    likelihood = _Restricted(found, excitations)
    return [
        likelihood.choose(j) if likelihood.samples(j) >= MIN_SAMPLES else n for j, n in enumerate(found.noise)
    ]
