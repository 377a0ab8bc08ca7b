"""The noise of each sensor measured on a fit's residuals: a first-order coloured part beside the steps of the sensor.

    e_k = a_k + w_k,   a_k = phi a_(k-1) + n_k,   var w = r = resolution^2 / 12 (known)
    as ARMA(1,1):  e_k = phi e_(k-1) + i_k - theta i_(k-1),   theta = b - sqrt(b^2 - 1),
                   b = (s^2 (1 - phi^2) + r (1 + phi^2)) / (2 phi r),   s^2 = var a,   var i = phi r / theta

phi is found channel by channel by restricted maximum likelihood (Patterson & Thompson 1971): the fitted parameters have taken a
part of the slow noise with them, which the residuals' plain correlation would miss, and intervals would come out too narrow:

    minimise  n log v + RSS / v + log |M|,   M = sum over channels of J' V^-1 J,   RSS after the parameters' answer -J M^-1 J' V^-1 e
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from thermoctl.plant.refit import Fit, Noise, Problem
from thermoctl.plant.simulate import Excitation

CLIP = 6.0  # residuals beyond this many robust sigmas count as so many
MOST = 0.995  # largest correlation of neighbours


def innovations(phi: float, white: float, total: float) -> Noise:
    """AR(1) with correlation phi of which `white` (a variance) of `total` is uncorrelated, as Noise."""
    coloured = max(total - white, 0.02 * total)
    if phi < 1e-3:
        return Noise(float(np.sqrt(total)))
    if white < 1e-6 * total:
        return Noise(float(np.sqrt(total)), phi)
    b = (coloured * (1 - phi**2) + white * (1 + phi**2)) / (2 * phi * white)
    theta = b - np.sqrt(b * b - 1)
    return Noise(float(np.sqrt(phi * white / theta)), ar=(1.0, -phi), ma=(1.0, -float(theta)))


def coloured(found: Fit, drives: Sequence[Excitation]) -> list[Noise]:
    """Each output's noise as AR(1) beside its quantisation, from the residuals of a fit to `drives`; channels of fewer than
    20 samples keep theirs."""
    problem = Problem(found.model, drives, found.noise)
    slopes = [problem.jacobian(found.z, r) for r in range(len(drives))]
    outputs = list(found.model.plant.outputs.values())
    noise = list(found.noise)
    prior = np.diag(problem.prior())

    def parts(j: int, candidate: Noise) -> tuple[np.ndarray, np.ndarray, float, float]:
        """J' V^-1 J, J' V^-1 e, e' V^-1 e and log |V| of channel j under a noise."""
        own = problem.heard(j, candidate)
        gram, gradient, square, size = np.zeros_like(prior), np.zeros(len(prior)), 0.0, 0.0
        for r, (columns, dy) in enumerate(slopes):
            e = found.residuals[r][:, j]
            spread = 1.4826 * np.nanmedian(np.abs(e)) if np.isfinite(e).any() else 1.0
            e = np.clip(e, -CLIP * spread, CLIP * spread) if spread > 0 else e
            w, jac = own.whiten(r, j, e), own.whiten(r, j, dy[:, j])
            gram[np.ix_(columns, columns)] += jac.T @ jac
            gradient[columns] += jac.T @ w
            square += float(w @ w)
            size += 2 * (
                float(np.log(own.rows[r][j][2]).sum())
                if len(candidate.ar) == 1
                else len(w) * np.log(candidate.sigma)
            )
        return gram, gradient, square, size

    now = [parts(j, n) for j, n in enumerate(noise)]
    for j, o in enumerate(outputs):
        count = sum(len(rows[j][0]) for rows in problem.rows)
        if count < 20:
            continue
        rest = prior + sum(now[k][0] for k in range(len(noise)) if k != j)
        pull = sum((now[k][1] for k in range(len(noise)) if k != j), np.zeros(len(prior)))
        white = (o.resolution or 0.0) ** 2 / 12
        plain = max(
            float(np.mean(np.concatenate([r[np.isfinite(r[:, j]), j] for r in found.residuals]) ** 2)), 1e-24
        )

        def judged(
            phi: float, j=j, rest=rest, pull=pull, white=white, plain=plain, count=count
        ) -> tuple[float, Noise]:
            """-2 log restricted likelihood of channel j, and its noise, the size found by two rounds."""
            total = plain
            for _ in range(3):
                candidate = innovations(phi, min(white, 0.9 * total), total)
                gram, gradient, square, size = parts(j, candidate)
                matrix = rest + gram
                answer = np.linalg.solve(matrix, pull + gradient)
                left = square - 2 * gradient @ answer + answer @ gram @ answer
                taken = min(float(np.trace(np.linalg.solve(matrix, gram))), 0.5 * count)
                total *= max(left, 1e-12) / (count - taken)
            return left + size + float(np.linalg.slogdet(matrix)[1]), candidate

        best = minimize_scalar(
            lambda phi: judged(phi)[0], bounds=(0.0, MOST), method="bounded", options={"xatol": 0.004}
        )
        flat, white_only = judged(0.0)
        noise[j] = judged(float(best.x))[1] if best.fun < flat - 2 else white_only
        noise[j] = dataclasses.replace(noise[j], sigma=max(noise[j].sigma, 1e-3 * found.noise[j].sigma))
        now[j] = parts(j, noise[j])
    return noise
