"""Thermal models with real poles, from data of any length: reduce first, then separable least squares.

A passive heat network (RC) has real poles, so its response to heat u is

    y(n) = sum_k R_k s_k(n) + sum_k W_k p_k^n,   s_k(n+1) = p_k s_k(n) + u(n)

For given poles the residues R, W are linear: only the poles are searched. All models are stable by
construction.

1. Reduce. One pass over the samples makes blocks of q samples. Kept are the mean of each output and the first
r moments of each input in discrete orthogonal (Gram) polynomials. A pole moves p^q over a block. Its end
state and its mean depend on the inputs with weights p^(q-1-i) and (1 - p^(q-1-i))/(1 - p). Three moments
represent both to 1e-4 of the smallest effect of a block. So averaging 10 000 samples of 1 ms into one of
10 s loses no slow dynamics.

2. Search. Variable projection (Golub and Pereyra 1973) with Kaufman's simplification over x_k = ln(time
constant):

    J'J = (dF' P dF) o (T T'),  J'r = -diag(dF' r T')
    F (J, K) block responses, T the residues, P the projector off F

3. Select the order with the least BIC.

4. Whiten. The chamber, the bench and unmeasured heat move temperatures for hours, so the residual is
coloured. Plain least squares then fits the slowest, most disturbed part of the recording hardest. With
`drift_s` = (td, tc) the residual is white noise plus a first-order drift of time constant td. The drift
exceeds the noise below 1/(2 pi tc). Outputs and responses first pass the whitening filter (generalised least
squares)

    (1 - exp(-T/td) z^-1) / (1 - exp(-T/tc) z^-1)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize, signal

from thermoctl.files.yamlfile import InputError
from thermoctl.identify.statespace import StateSpace, modal

MOMENTS = 3


@dataclass(frozen=True)
class Blocks:
    """Recordings reduced to J blocks of `q` samples.

    - `u` (J, m, r): input moments; `basis` (r, q): their polynomials
    - `y` (J, l): output means (NaN: no sample); `weight` (J, l): share of samples in each mean
    - `period_s`: of the samples"""

    u: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    q: int
    period_s: float
    basis: np.ndarray


def gram_polynomials(q: int) -> np.ndarray:
    """Return orthonormal discrete polynomials (r, q) of degree 0..r-1 on q points; r: MOMENTS, at most q."""
    r = min(MOMENTS, q)
    vander = np.polynomial.legendre.legvander(np.linspace(-1, 1, q) if q > 1 else np.zeros(1), r - 1)
    return np.ascontiguousarray(np.linalg.qr(vander)[0].T)


def reduce(
    chunks: Iterable[tuple[np.ndarray, np.ndarray]] | tuple[np.ndarray, np.ndarray],
    period_s: float,
    block_s: float = 10.0,
) -> Blocks:
    """One pass over samples: `chunks` is (u (N, m), y (N, l)) or an iterable of such pieces.

    Memory does not grow with N beyond the blocks. A block without any sample of an output gives NaN there; a
    last, incomplete block is dropped. Raises InputError when an input is missing or the data are shorter than
    20 blocks."""
    q = max(1, round(block_s / period_s))
    basis = gram_polynomials(q)
    if isinstance(chunks, tuple):
        chunks = [chunks]
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # moments, sums and counts of the outputs
    samples = 0
    left: np.ndarray | None = None
    for cu, cy in chunks:
        cu, cy = np.atleast_2d(cu.T).T, np.atleast_2d(cy.T).T
        for k in range(0, len(cu), 100_000):  # small pieces: bounded memory whatever the caller's chunks are
            u, y = cu[k : k + 100_000], cy[k : k + 100_000]
            if not np.isfinite(u).all():
                row = samples + int(np.flatnonzero(~np.isfinite(u).all(1))[0])
                raise InputError(
                    f"an input is missing at sample {row}; identification needs every sample of the inputs"
                )
            samples += len(u)
            z = np.hstack([u, y]) if left is None else np.vstack([left, np.hstack([u, y])])
            whole = z[: len(z) // q * q].reshape(-1, q, z.shape[1])
            left, m = z[len(z) // q * q :], u.shape[1]
            moments = np.einsum("jqm,rq->jmr", whole[..., :m], basis)
            parts.append((moments, np.nansum(whole[..., m:], 1), np.isfinite(whole[..., m:]).sum(1)))
    if samples < 20 * q:
        raise InputError(
            f"{samples} samples of {period_s:g} s are {samples // q} blocks of {q * period_s:g} s; at least 20 are needed"
        )
    moments, sums, count = (np.concatenate(v) for v in zip(*parts, strict=True))
    with np.errstate(invalid="ignore"):
        return Blocks(moments, sums / count, count / q, q, period_s, basis)


def _responses(
    records: list[Blocks], tau: np.ndarray, rest: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stack `_response` of several recordings: common poles and residues, separate initial states."""
    parts = [_response(b, tau, rest) for b in records]
    return np.vstack([f for f, _, _ in parts]), np.vstack([d for _, d, _ in parts]), parts[0][2]


def _whitened(rows: np.ndarray, records: list[Blocks], drift_s: tuple[float, float] | None) -> np.ndarray:
    """Filter stacked rows (J, columns) by the drift's whitening filter, each recording separately.

    Without `drift_s` they are unchanged."""
    if drift_s is None:
        return rows
    forgotten, corner = (np.exp(-records[0].q * records[0].period_s / t) for t in drift_s)
    ends = np.cumsum([len(b.u) for b in records])[:-1]
    return np.vstack(
        [signal.lfilter([1, -forgotten], [1, -corner], part, axis=0) for part in np.split(rows, ends)]
    )


def _response(blocks: Blocks, tau: np.ndarray, rest: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return block-mean responses F (J, columns), their derivative by ln tau, and each column's pole index.

    Columns by pole: one per input, then (unless `rest`) the free decay."""
    q, basis, J = blocks.q, blocks.basis, len(blocks.u)
    i = np.arange(q)
    F, D, owner = [], [], []
    p = np.exp(-blocks.period_s / tau)  # per sample
    dp = p * blocks.period_s / tau  # dp/d ln tau
    pq, dpq = p**q, q * p ** (q - 1) * dp
    for k in range(len(tau)):
        powers = p[k] ** (q - 1 - i)  # p^(q-1-i)
        dpowers = (q - 1 - i) * powers / p[k] * dp[k]
        held = -np.expm1((q - 1 - i) * np.log(p[k])) / -np.expm1(np.log(p[k]))  # (1 - p^(q-1-i)) / (1 - p)
        dheld = (-dpowers + held * dp[k]) / (1 - p[k])
        first = -np.expm1(q * np.log(p[k])) / (1 - p[k]) / q  # mean of p^i over the block
        dfirst = (-dpq[k] / q + first * dp[k]) / (1 - p[k])
        # the block's input as moments: its effect on the block's end state and on the block's mean
        end, dend = blocks.u @ (basis @ powers), blocks.u @ (basis @ dpowers)  # (J, m)
        mean, dmean = blocks.u @ (basis @ held) / q, blocks.u @ (basis @ dheld) / q
        states = signal.lfilter([0, 1], [1, -pq[k]], end, axis=0)  # s(j+1) = p^q s(j) + end(j)
        dstates = signal.lfilter([0, 1], [1, -pq[k]], states * dpq[k] + dend, axis=0)
        # scaled by (1 - p), so that every column has the size of the input for any time constant
        f = first * states + mean
        df = dfirst * states + first * dstates + dmean
        F += list(((1 - p[k]) * f).T)
        D += list(((1 - p[k]) * df - dp[k] * f).T)
        owner += end.shape[1] * [k]
        if not rest:
            n = np.arange(J)
            decay = pq[k] ** n
            F.append(first * decay)
            D.append(dfirst * decay + first * n * pq[k] ** np.maximum(n - 1, 0) * dpq[k] * (n > 0))
            owner.append(k)
    return np.array(F).T, np.array(D).T, np.array(owner)


@dataclass(frozen=True)
class _Fit:
    tau: np.ndarray
    theta: np.ndarray  # (columns, l)
    cost: float
    iterations: int


def _project(F: np.ndarray, Y: np.ndarray, ridge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Q of F, the residue matrix and the residual.

    A ridge of `ridge` times each column's norm keeps nearly equal poles harmless."""
    n = F.shape[1]
    norm = np.linalg.norm(F, axis=0)
    norm[norm == 0] = 1
    Q, R = linalg.qr(np.vstack([F / norm, ridge * np.eye(n)]), mode="economic", check_finite=False)
    theta = linalg.solve_triangular(R, Q[: len(F)].T @ Y, check_finite=False) / norm[:, None]
    return Q[: len(F)], theta, Y - F @ theta


def _fit(
    blocks: list[Blocks],
    Y: np.ndarray,
    weight: np.ndarray,
    tau: np.ndarray,
    rest: bool,
    iterations: int,
    bounds: tuple[float, float],
    ridge: float,
    drift_s: tuple[float, float] | None,
) -> _Fit:
    """Fit ln tau within its bounds. `Y` (J, l) is scaled by noise, `weight` (J,) is by row."""
    Y = _whitened(Y, blocks, drift_s) * weight[:, None]
    latest: dict[bytes, tuple[np.ndarray, ...]] = {}

    def parts(x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return Q, residues, residual (J, l), D and owner at x = ln tau; the last point is kept.

        D: derivatives of the responses by ln tau; owner: the time constant of each column."""
        if x.tobytes() not in latest:
            F, D, owner = _responses(blocks, np.exp(x), rest)
            F, D = (_whitened(v, blocks, drift_s) * weight[:, None] for v in (F, D))
            latest.clear()
            latest[x.tobytes()] = (*_project(F, Y, ridge), D, owner)
        return latest[x.tobytes()]

    def slopes(x: np.ndarray) -> np.ndarray:
        """Return the derivatives (J l, K) of the residual by Kaufman's simplification."""
        Q, theta, _, D, owner = parts(x)
        off = D - Q @ (Q.T @ D)
        return np.stack([-(off[:, owner == k] @ theta[owner == k]).ravel() for k in range(len(x))], axis=1)

    solution = optimize.least_squares(
        lambda x: parts(x)[2].ravel(),
        np.log(tau),
        slopes,
        bounds=tuple(np.log(bounds)),
        ftol=1e-7,
        max_nfev=iterations,
    )
    x = np.sort(solution.x)
    return _Fit(np.exp(x), parts(x)[1], 2 * solution.cost, solution.nfev)


def identify(
    records: Blocks | list[Blocks],
    order: int | None = 8,
    rest: bool = True,
    iterations: int = 30,
    tau_range_s: tuple[float, float] | None = None,
    ridge: float = 1e-7,
    drift_s: tuple[float, float] | None = None,
) -> StateSpace:
    """Identify a model with `order` real poles per input from reduced data, at the blocks' sample period.

    `order` None: the least BIC of 1..10. Several recordings of one block length are fitted together; they
    must begin at `rest`, in thermal equilibrium. Without `rest` the free decay of every output is estimated,
    too. `ridge` (of a column's norm) keeps residues small that the data hardly determine: for short records
    of a network that is not quite linear. `drift_s`: see 4. above. Missing outputs are filled by two
    iterations of the model's own output. Raises InputError when an output was never measured."""
    records = [records] if isinstance(records, Blocks) else records
    blocks = replace(
        records[0],
        y=np.vstack([b.y for b in records]),
        weight=np.vstack([b.weight for b in records]),
        u=np.concatenate([b.u for b in records]),
    )
    if len(records) > 1 and not rest or len({(b.q, b.period_s) for b in records}) > 1:
        raise InputError(
            "recordings that are fitted together must begin at rest and have blocks of one length"
        )
    block_s = blocks.q * blocks.period_s
    span = max(len(b.u) for b in records) * block_s
    bounds = tau_range_s or (0.7 * block_s, 2.5 * span)
    missing = ~np.isfinite(blocks.y)
    if missing.all(0).any():
        raise InputError(f"output {int(np.flatnonzero(missing.all(0))[0]) + 1} has no sample; leave it out")
    if order is None:
        fits = [identify(records, k, rest, iterations, bounds, ridge, drift_s) for k in range(1, 11)]
        return min(fits, key=lambda m: m.info["bic"])
    weight = np.sqrt(np.where(missing, 1, blocks.weight).mean(1))
    y = blocks.y.copy()
    gaps = missing.any()
    if gaps:
        t = np.arange(len(y))
        for j in np.flatnonzero(missing.any(0)):
            y[missing[:, j], j] = np.interp(t[missing[:, j]], t[~missing[:, j]], y[~missing[:, j], j])
    noise = np.maximum(np.std(np.diff(y, 2, axis=0), axis=0) / np.sqrt(6), 1e-9 * (np.abs(y).max() + 1e-300))
    noise = np.maximum(noise, 1e-2 * np.median(noise))
    tau = np.geomspace(max(1.5 * block_s, bounds[0]), min(0.5 * span, bounds[1]), order)
    for _ in range(3 if gaps else 1):
        fit = _fit(records, y / noise, weight, tau, rest, iterations, bounds, ridge, drift_s)
        if gaps:
            F, _, _ = _responses(records, fit.tau, rest)
            y[missing] = (F @ fit.theta * noise)[missing]
            tau = fit.tau
    m = blocks.u.shape[1]
    p = np.exp(-blocks.period_s / fit.tau)
    theta = (fit.theta * noise).reshape(order, m + (not rest), -1)
    residues = np.moveaxis(theta[:, :m], 1, 2) * (1 - p)[:, None, None]
    free = theta[:, m] if not rest else np.zeros((order, theta.shape[2]))
    count = int((~missing).sum())
    parameters = order * (1 + theta.shape[1] * theta.shape[2])
    F, _, _ = _responses(records, fit.tau, rest)
    residual = np.where(missing, np.nan, blocks.y - F @ fit.theta * noise)
    info = {
        "method": "modal",
        "time_constants_s": fit.tau[::-1].tolist(),
        "iterations": fit.iterations,
        "bic": count * np.log(fit.cost / count) + parameters * np.log(count),
        "residual_rms": np.sqrt(np.nanmean(residual**2, 0)).tolist(),
        "block_s": block_s,
    }
    return modal(p, residues, free, blocks.period_s, info)
