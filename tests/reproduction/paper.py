"""The paper's method, as printed: N4SID of order 12 with (26), the modified Kalman filter, recursion (5).

It is here to be compared with the product's method; `thermoctl identify` uses the better one.

Block Hankel matrices Up, Uf, Yp, Yf of i block rows (10); Wp = [Up; Yp] (12).

    oblique projection   O_i = Yf /_Uf Wp                                                       (9), (18)
    SVD                  O_i = U S V', Gamma_i = U1 S1^1/2                                      (19), (20)
    shift invariance     C = first block of Gamma, A = Gamma(without last)+ Gamma(without first)
    B                    Z_i = Yf / [Wp; Uf], Z_{i+1} = Yf- / [Wp+; Uf-]                        (21)
                         [Gamma_{i-1}+ Z_{i+1}; Y_i] = [A; C] Gamma_i+ Z_i + K Uf + [Rw; Rv]    (24)
                         K = N [D; B] by least squares, D = 0                                   (25), (26)
    MKF                  output form (33), scalar gain of the coil's row (34), (35), mapped to the other points by
                         zeta = [1, sigma_2/sigma_1 ...], sigma_j = cov(e_1, e_j)               (36), (37)
    expansion            block least squares with the measured output in the regressor: with lambda = 1 this is
                         what recursion (5) ends at

The Hankel matrix H is never formed, only its Gram matrix H H': each block follows from its upper left neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from thermoctl.calibration import chain
from thermoctl.calibration.chain import (
    AIR_FILTER_S,
    NOISE_K,
    STEP_K,
    fit_expansion,
    rises,
    run_kalman,
    smooth_air,
)
from thermoctl.calibration.recorded import Recorded, filled
from thermoctl.control.model import CompensatorModel
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import filter
from thermoctl.identify.expansion import Expansion
from thermoctl.identify.statespace import StateSpace

ORDER = 12
LONGEST_S = 36000.0  # no expansion takes longer than ten hours
FASTEST = 0.05  # smallest real pole of a sampled heat network; smaller ones are fits of noise
Q0 = 1e6  # Q(0) of recursion (5), times the identity
# Sampling periods, s, and the block rows i tried with each
ROWS = {1: (30, 40, 50), 2: (15, 20, 30, 40), 3: (15, 20, 30), 4: (15, 20, 30, 40), 6: (15, 20), 8: (15, 20)}
CHOICES = [(period_s, i) for period_s, rows in ROWS.items() for i in rows]
ESTIMATORS = ("siso", "paper", "better", "twelve")


def block_mean(v: np.ndarray, q: int) -> np.ndarray:
    """Average over blocks of q rows; drop an incomplete last block."""
    return v[: len(v) // q * q].reshape(len(v) // q, q, -1).mean(1)


def factor(u: np.ndarray, y: np.ndarray, i: int) -> np.ndarray:
    """Return the lower triangular L of H = L Q / sqrt(N) of u (N, m), y (N, l), rows ordered [Uf; Up; Yp; Yf].

    Raises InputError for too few samples, and where H is singular."""
    z, m, lags = np.hstack([u, y]), u.shape[1], 2 * i
    if len(z) < 2 * lags:
        raise InputError(f"{len(z)} samples; subspace identification with i = {i} needs at least {2 * lags}")
    columns, w = len(z) - lags + 1, z.shape[1]
    g = np.empty((lags, w, lags, w))
    g[0] = np.stack([z[:columns].T @ z[t : t + columns] for t in range(lags)], axis=1)
    head, tail = z[: lags - 1], z[columns:]
    for s in range(1, lags):
        a = np.einsum("a,tb->atb", tail[s - 1], tail[s - 1 :])
        b = np.einsum("a,tb->atb", head[s - 1], head[s - 1 :])
        g[s][:, s:] = g[s - 1][:, s - 1 : -1] + a - b
        for t in range(s):
            g[s][:, t] = g[t][:, s].T
    index = np.arange(lags * w).reshape(lags, w)
    parts = (index[i:, :m], index[:i, :m], index[:i, m:], index[i:, m:])
    order = np.concatenate([p.ravel() for p in parts])
    try:
        return linalg.cholesky(g.reshape(lags * w, -1)[np.ix_(order, order)] / columns, lower=True)
    except linalg.LinAlgError:
        raise InputError("the data's correlation matrix is singular: an input that does not move") from None


def n4sid(u: np.ndarray, y: np.ndarray, period_s: float, n: int = ORDER, i: int = 20) -> StateSpace:
    """Identify a model of order n from u (N, m), y (N, l) by (7) to (26); it may be unstable."""
    L, m, l = factor(u, y, i), u.shape[1], y.shape[1]  # noqa: E741
    nu, past = i * m, i * (2 * m + l)
    oblique = (
        linalg.solve_triangular(L[nu:past, nu:past], L[past:, nu:past].T, lower=True, trans="T").T
        @ L[nu:past, :past]
    )
    values, vectors = linalg.eigh(oblique @ oblique.T, driver="evd")
    s = np.sqrt(np.maximum(values[::-1], 0))
    gamma = vectors[:, ::-1][:, :n] * np.sqrt(s[:n])
    a, c = _pinv_solve(gamma[:-l], gamma[l:]), gamma[:l].copy()
    info = {"method": "N4SID", "i": i, "period_s": period_s, "singular_values": s[: 3 * n].tolist()}
    return StateSpace(a, _input_matrix(L, gamma, a, c, i, m), c, period_s, np.zeros(n), info)


def _pinv_solve(f: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Solve least squares by the normal equations, each column scaled to one."""
    g = f.T @ f
    d = np.sqrt(np.maximum(np.diag(g), 1e-300))
    return linalg.solve(g / d / d[:, None], (f.T @ y) / d[:, None], assume_a="pos") / d[:, None]


def _input_matrix(
    L: np.ndarray, gamma: np.ndarray, a: np.ndarray, c: np.ndarray, i: int, m: int
) -> np.ndarray:
    """Return B by (21) to (26) with D = 0, the inaccurate step of the method."""
    n, l = len(a), len(c)  # noqa: E741
    nu, past = i * m, i * (2 * m + l)
    z_i = L[past:, :past]  # Z_i Q': Yf on [Uf; Up; Yp] is exact in L
    pin_i, pin_less = np.linalg.pinv(gamma), np.linalg.pinv(gamma[:-l])
    # Z_{i+1}: Yf- on [Wp+; Uf-]; all of it in the coordinates of the rows of Q (columns of L)
    uf, up, yp, yf = L[:nu], L[nu : 2 * nu], L[2 * nu : past], L[past:]
    q, _ = linalg.qr(np.vstack([up, uf[:m], yp, yf[:l], uf[m:]]).T, mode="economic")
    z_next = (yf[l:] @ q) @ q.T
    state = np.hstack([pin_i @ z_i, np.zeros((n, L.shape[1] - past))])
    left = np.vstack([pin_less @ z_next, yf[:l]]) - np.vstack([a, c]) @ state
    # (24) to (26) in one least-squares problem: min |left - N(B) Uf|, linear in B. To solve for K first, then for
    # B without weights, is equal without noise and far worse with it: Uf of long pulses is nearly singular.
    target = left[:, :nu]  # left, projected on Uf
    lag, lcg = a @ pin_i, c @ pin_i  # (n, i l), (l, i l)
    steps = np.empty((i, n + l, n))
    for j in range(i):
        # H_i's block column j holds [0...0; D; CB; CAB; ...]: C A^r B = gamma block r times B
        h_i = np.vstack([np.zeros(((j + 1) * l, n)), gamma[: (i - j - 1) * l]])
        h_less = np.vstack([np.zeros((j * l, n)), gamma[: (i - 1 - j) * l]])
        steps[j, :n] = (np.eye(n) if j == 0 else pin_less @ h_less) - lag @ h_i
        steps[j, n:] = -lcg @ h_i
    matrix = np.einsum("jpa,jbr->prab", steps, uf[:, :nu].reshape(i, m, nu)).reshape(target.size, n * m)
    return linalg.lstsq(matrix, target.ravel())[0].reshape(n, m)


@dataclass(frozen=True)
class Mkf:
    """alpha (M, M), beta (M,), zeta (M,), R_w and R_v in K^2, at `period_s`."""

    alpha: np.ndarray
    beta: np.ndarray
    zeta: np.ndarray
    r_w: float
    r_v: float
    period_s: float

    def run(self, power_w: np.ndarray, coil_k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return filtered rises (N, M) and gains (N,) from rest, for power (N,) and coil rises (N,), NaN: no reading."""
        out, gains = np.empty((len(coil_k), len(self.zeta))), np.zeros(len(coil_k))
        x, p, a1 = np.zeros(len(self.zeta)), self.r_w, float(self.alpha[0] @ self.alpha[0])
        for k, (w, coil) in enumerate(zip(power_w, coil_k, strict=True)):
            if np.isfinite(coil):
                gains[k] = p / (p + self.r_v)
                p *= 1 - gains[k]
                x = x + gains[k] * (coil - x[0]) * self.zeta
            out[k] = x
            x = self.alpha @ x + self.beta * w
            p = a1 * p + self.r_w
        return out, gains


def output_form(model: StateSpace, tolerance: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha (l, l), beta (l, m) of (33), y(n+1) = alpha y + beta u.

    The inverse of C omits singular values below `tolerance` of the largest: order 12 always has noise modes, with
    cond(C) to 3e5, and the plain inverse amplifies them."""
    return model.c @ model.a @ np.linalg.pinv(model.c, rcond=tolerance), model.c @ model.b


def mkf(model: StateSpace, u: np.ndarray, y: np.ndarray, r_v: float) -> Mkf:
    """Identify the filter from a test, u (N, 1) W and y (N, M) K at the model's period.

    R_w is the squared rms error of the coil in that test, plus R_v, as in the paper (its 0.46 degC)."""
    e = y - model.simulate(u, model.x0)
    e = e[np.isfinite(e).all(1)]
    centred = e - e.mean(0)
    sigma = (centred[:, :1].T @ centred)[0] / len(e)
    alpha, beta = output_form(model)
    r_w = float((e[:, 0] ** 2).mean() + r_v)
    return Mkf(alpha, beta[:, 0], sigma / sigma[0], r_w, r_v, model.period_s)


def recursion(x: np.ndarray, y: np.ndarray, period_s: float) -> Expansion:
    """Fit the expansion on rises x (N, M) by what recursion (5) with lambda = 1 and Q(0) = Q0 I ends at."""
    m = x.shape[1]
    past = np.vstack([x[:1], x[:-1]])
    phi = np.hstack([past, x, y[:, None]])[:-1]
    rows = np.vstack([phi, np.eye(2 * m + 1) / np.sqrt(Q0)])
    theta = linalg.lstsq(rows, np.append(y[1:], np.zeros(2 * m + 1)))[0]
    return Expansion(float(theta[-1]), theta[:m], theta[m : 2 * m], period_s)


@dataclass(frozen=True)
class Calibration:
    """Estimators of one rig, and their position errors in um: the paper's, the coil alone, ours, ours with 12 sensors."""

    paper_model: StateSpace
    mkf: Mkf
    paper_um: Expansion
    siso_um: Expansion
    kalman: filter.Kalman
    better_um: Expansion
    twelve: filter.Kalman
    twelve_um: Expansion
    variances: np.ndarray


def calibrate(test_2: Recorded, test_3: Recorded, test_4a: Recorded) -> Calibration:
    """Calibrate all estimators from the three calibration tests at 1 s."""
    r_v = filter.sensor_variance(STEP_K, NOISE_K)
    paper_model, of_paper = identify(test_2, test_4a)
    y4, q = test_4a.error_um, round(of_paper.period_s)
    paper_um = recursion(mkf_steps(of_paper, test_4a), block_mean(y4[:, None], q)[:, 0], of_paper.period_s)
    # unstable at the model's period: use the fastest measured period, as the paper advises
    if paper_um.f1 >= 1:
        paper_um = recursion(estimate(of_paper, test_4a), y4, 1.0)
    paper_um = replace(paper_um, f1=min(paper_um.f1, float(np.exp(-paper_um.period_s / LONGEST_S))))
    siso_um = recursion(filled(rises(test_4a)[:, :1]), y4, 1.0)
    tests = [test_2, test_3, test_4a]
    _, kalman, variances, better_um = chain.calibrate(tests)
    twelve = filter.steady(kalman.model, variances, r_v, tuple(range(len(kalman.model.c))))
    return Calibration(
        paper_model,
        of_paper,
        paper_um,
        siso_um,
        kalman,
        better_um,
        twelve,
        fit_expansion(twelve, tests),
        variances,
    )


def identify(test_2: Recorded, check: Recorded) -> tuple[StateSpace, Mkf]:
    """Identify the paper's model and its MKF, both from test 2.

    The paper leaves sampling period and block rows i open. Of CHOICES this takes those whose stable model's filter
    follows the thermometers best over `check`, another test. Raises InputError for a test that is too short."""
    r_v = filter.sensor_variance(STEP_K, NOISE_K)
    y2, measured = filled(rises(test_2)), filled(rises(check))
    best: tuple[StateSpace, Mkf] | None = None
    least = np.inf
    for period_s, i in CHOICES:
        u, y = block_mean(test_2.power_w[:, None], period_s), block_mean(y2, period_s)
        try:
            model = n4sid(u, y, float(period_s), i=i)
        except InputError:  # too few samples for this number of rows
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            trial = mkf(model, u, y, r_v)
            left = float(np.sqrt(np.mean((estimate(trial, check) - measured) ** 2)))
        if left < least and (model.stable or best is None):
            least, best = left, (model, trial)
    if best is None:
        raise InputError(
            "no choice of sampling and block rows gives a model of order 12; the test is too short"
        )
    return best


def estimate(f: Mkf, r: Recorded) -> np.ndarray:
    """Run the MKF over a 1 s recording; return rises (N, points), held between the MKF's steps."""
    return held(mkf_steps(f, r), round(f.period_s), len(r.power_w))


def mkf_steps(f: Mkf, r: Recorded) -> np.ndarray:
    """Run the MKF; rises (K, points), one row for each of its periods."""
    q = round(f.period_s)
    return f.run(block_mean(r.power_w[:, None], q)[:, 0], block_mean(filled(rises(r)[:, :1]), q)[:, 0])[0]


def held(v: np.ndarray, q: int, n: int) -> np.ndarray:
    """Hold each row of v for q samples, n in all; the last one to the end."""
    return np.repeat(v, q, axis=0)[np.minimum(np.arange(n), len(v) * q - 1)]


def estimates(c: Calibration, r: Recorded, starts_anew: bool = False) -> dict[str, np.ndarray]:
    """Estimate the position error (N,) um by each estimator over a test that starts with test 4A.

    `starts_anew`: over another recording, from zero."""
    air, q, n = smooth_air(r.air_c), round(c.mkf.period_s), len(r.power_w)
    same = c.paper_um.period_s == c.mkf.period_s
    paper = c.paper_um.predict(mkf_steps(c.mkf, r) if same else estimate(c.mkf, r))
    out = {
        "siso": c.siso_um.predict(filled(rises(r)[:, :1])),
        "paper": held(paper[:, None], q, n)[:, 0] if same else paper,
    }
    for name, k, um in (("better", c.kalman, c.better_um), ("twelve", c.twelve, c.twelve_um)):
        out[name] = um.predict(run_kalman(k, r), air, 0.0 if starts_anew else um.info["start_um"])
    return out


def compensator(c: Calibration, kind: str) -> CompensatorModel:
    """Build the daemon's compensator model at 1 ms: 'paper' (MKF and recursion (5)) or 'better'."""
    if kind == "better":
        return chain.compensator(c.kalman, c.better_um)
    alpha, beta = output_form(c.paper_model)
    values, vectors = np.linalg.eig(alpha)  # poles that no sampled heat network has are moved to FASTEST
    keep = np.where((np.abs(values.imag) < 1e-12) & (values.real <= FASTEST), FASTEST, values)
    alpha = np.real(vectors @ np.diag(keep) @ np.linalg.inv(vectors))
    n, period_s, um = len(alpha), 0.001, c.paper_um
    reduced = StateSpace(alpha, beta, np.eye(n), c.paper_model.period_s, np.zeros(n))
    return CompensatorModel(
        "mkf",
        period_s,
        reduced.minus_identity(period_s),
        np.column_stack([reduced.resample(period_s).b[:, 0], np.zeros(n)]),
        np.eye(n),
        c.mkf.zeta,
        c.mkf.r_w * period_s / c.mkf.period_s,
        c.mkf.r_v,
        um.f1,
        um.b1,
        um.b2,
        um.period_s,
        air_filter_s=AIR_FILTER_S,
    )
