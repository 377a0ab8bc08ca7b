"""Combined deterministic-stochastic subspace identification: the paper's (7) to (26), and improvements.

Block Hankel matrices Up, Uf, Yp, Yf of i block rows (10); Wp = [Up; Yp] (12).

    oblique projection        O_i = Yf /_Uf Wp                                             (9), (18)
    weighted SVD              W1 O_i W2 = U S V', Gamma_i = W1^-1 U1 S1^1/2                (19), (20)
      n4sid (`paper`)         W1 = I, W2 = I
      moesp                   W1 = I, W2 = projector onto the complement of Uf
      cva                     W1 = (Yf/Uf_perp Yf/Uf_perp')^-1/2, W2 the same projector
    shift invariance          C = first block of Gamma, A = Gamma(without last)+ Gamma(without first)
    the paper's B (`paper`)   Z_i = Yf / [Wp; Uf], Z_{i+1} = Yf- / [Wp+; Uf-]                        (21)
                              [Gamma_{i-1}+ Z_{i+1}; Y_i] = [A; C] Gamma_i+ Z_i + K Uf + [Rw; Rv]    (24)
                              K = N [D; B] by least squares, D = 0                             (25), (26)
    our B and x(0)            least squares on y(n) = C A^n x0 + sum C A^(n-1-k) B u(k), linear in B and x0.
                              In modal form its normal matrix is (C'C) o (S'S), S the modal states: no
                              simulation for each unknown.

The Hankel matrix H is never formed. Only its Gram matrix H H' of lag correlations is needed. Each block
follows from its upper left neighbour: G[s+1, t+1] = G[s, t] + z(s+N) z(t+N)' - z(s) z(t)'. One pass over the
data accumulates them in bounded memory. In H = L Q, L is the Cholesky factor. If that fails (noise-free
data), a blocked QR gives L and keeps only the triangle.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from thermoctl.identify import kernels
from thermoctl.identify.statespace import StateSpace, _c, _ridge
from thermoctl.yamlfile import InputError

WEIGHTINGS = ("paper", "n4sid", "moesp", "cva")
_ROWS = 10  # samples per row of the blocked correlation: a wide product runs at full speed


@dataclass(frozen=True)
class Correlations:
    """Gram matrix of the block Hankel matrix.

    Its rows are [z(n); ...; z(n+2i-1)], z = [u; y] of m + l entries."""

    gram: np.ndarray
    i: int
    m: int
    l: int  # noqa: E741
    samples: int
    period_s: float
    qr: np.ndarray | None = None  # triangle from the blocked QR, if requested


def correlate(
    chunks: Iterable[tuple[np.ndarray, np.ndarray]] | tuple[np.ndarray, np.ndarray],
    period_s: float,
    i: int = 20,
    qr: bool = False,
) -> Correlations:
    """Accumulate the correlations in one pass over (u (N, m), y (N, l)) or pieces of it.

    `qr` keeps the triangle of a blocked QR instead (40 times the work, for data without noise). Raises
    InputError for a missing sample or fewer than 4i samples.
    """
    if isinstance(chunks, tuple):
        chunks = [chunks]
    lags = 2 * i
    sums: np.ndarray | None = None
    triangle: np.ndarray | None = None
    head = tail = np.empty((0, 0))
    total = m = w = 0
    for cu, cy in chunks:
        cu, cy = np.atleast_2d(cu.T).T, np.atleast_2d(cy.T).T
        step = len(cu) if len(cu) <= 20_000 else 10_000
        for k in range(0, len(cu), step):
            z = np.hstack([cu[k : k + step], cy[k : k + step]])
            if not np.isfinite(z).all():
                row = total + int(np.flatnonzero(~np.isfinite(z).all(1))[0])
                raise InputError(
                    f"sample {row} is missing; subspace identification needs every sample (method 'modal' does not)"
                )
            m, w = cu.shape[1], z.shape[1]
            if sums is None:
                tail, sums, head = np.empty((0, w)), np.zeros((lags, w, w)), np.empty((0, w))
            total += len(z)
            if len(head) < lags:
                head = np.vstack([head, z[: lags - len(head)]])
            z = np.vstack([tail, z])
            # every start n whose window z(n..n+lags-1) lies in z; the start rows are taken _ROWS at a time
            starts = len(z) - lags + 1
            if starts <= 0:
                tail = z
                continue
            if qr:
                triangle = _append_qr(triangle, z, lags)
            else:
                _add_lags(sums, z, starts)
            tail = z[starts:]
    if sums is None or total < 2 * lags:
        raise InputError(f"{total} samples; subspace identification with i = {i} needs at least {2 * lags}")
    columns = total - lags + 1
    if triangle is not None:
        return Correlations(triangle.T @ triangle, i, m, w - m, columns, period_s, triangle)
    return Correlations(_gram(sums, head, tail, columns), i, m, w - m, columns, period_s)


def _add_lags(sums: np.ndarray, z: np.ndarray, starts: int) -> None:
    """Add to sums[t] the sum over n < starts of z(n) z(n+t)'."""
    lags, w = len(sums), z.shape[1]
    blocks = starts // _ROWS
    if blocks:
        first = z[: blocks * _ROWS].reshape(blocks, _ROWS * w)
        wide = lags + _ROWS - 1
        products = np.empty((_ROWS * w, wide * w))
        for s in range(0, wide, _ROWS):
            n = min(_ROWS, wide - s)
            if s + blocks * _ROWS <= len(z) and n == _ROWS:
                other = z[s : s + blocks * _ROWS].reshape(blocks, _ROWS * w)
            else:
                other = np.lib.stride_tricks.sliding_window_view(z[s:].ravel(), n * w)[:: _ROWS * w][:blocks]
            products[:, s * w : (s + n) * w] = first.T @ other
        for r in range(_ROWS):
            part = products[r * w : (r + 1) * w, r * w : (r + lags) * w]
            sums += part.reshape(w, lags, w).transpose(1, 0, 2)
    rest = z[blocks * _ROWS :]
    n = starts - blocks * _ROWS
    if n:
        for t in range(lags):
            sums[t] += rest[:n].T @ rest[t : t + n]


def _gram(sums: np.ndarray, head: np.ndarray, tail: np.ndarray, columns: int) -> np.ndarray:
    """Return the whole Gram matrix from its first block row.

    `tail` are the lags - 1 samples after the last start."""
    lags, w, _ = sums.shape
    g = np.empty((lags, w, lags, w))
    g[0] = sums.transpose(1, 0, 2)
    tail = tail[-(lags - 1) :]  # samples z(columns) to z(columns + lags - 2)
    for s in range(1, lags):
        a = np.einsum("a,tb->atb", tail[s - 1], tail[s - 1 :])
        b = np.einsum("a,tb->atb", head[s - 1], head[s - 1 : lags - 1])
        g[s][:, s:] = g[s - 1][:, s - 1 : -1] + a - b
        for t in range(s):
            g[s][:, t] = g[t][:, s].T
    return g.reshape(lags * w, lags * w)


def _append_qr(triangle: np.ndarray | None, z: np.ndarray, lags: int) -> np.ndarray:
    rows = (
        np.lib.stride_tricks.sliding_window_view(z, lags, axis=0)
        .transpose(0, 2, 1)
        .reshape(len(z) - lags + 1, -1)
    )
    stack = rows if triangle is None else np.vstack([triangle, rows])
    return linalg.qr(stack, mode="r", check_finite=False)[0][: stack.shape[1]]


def _factor(c: Correlations) -> np.ndarray:
    """Return the lower triangular L of H = L Q / sqrt(N), rows ordered [Uf; Up; Yp; Yf]."""
    i, m, w = c.i, c.m, c.m + c.l
    index = np.arange(2 * i * w).reshape(2 * i, w)
    order = np.concatenate(
        [index[i:, :m].ravel(), index[:i, :m].ravel(), index[:i, m:].ravel(), index[i:, m:].ravel()]
    )
    if c.qr is not None:
        triangle = linalg.qr(c.qr[:, order], mode="r")[0].T / np.sqrt(c.samples)
        return triangle * np.where(np.diag(triangle) < 0, -1, 1)
    g = c.gram[np.ix_(order, order)] / c.samples
    try:
        return linalg.cholesky(g, lower=True, check_finite=False)
    except linalg.LinAlgError:
        raise InputError(
            "the data's correlation matrix is singular (no noise, or an input that does not move); "
            "use correlate(..., qr=True) or a richer input"
        ) from None


@dataclass(frozen=True)
class Subspace:
    """Result of the projection: singular values (descending), unweighted left vectors, factor."""

    singular_values: np.ndarray
    left: np.ndarray
    l_factor: np.ndarray
    correlations: Correlations
    weighting: str


def project(c: Correlations, weighting: str = "cva") -> Subspace:
    """Compute oblique projection and weighted SVD, (18) to (20). InputError: unknown weighting."""
    if weighting not in WEIGHTINGS:
        raise InputError(f"weighting '{weighting}' is not known; {', '.join(WEIGHTINGS)} are")
    L = _factor(c)
    nu, np_ = c.i * c.m, c.i * (2 * c.m + c.l)
    past = L[nu:np_, :np_]
    lff = L[np_:, nu:np_]  # Yf on Wp, after Uf
    if weighting in ("paper", "n4sid"):
        lww = past[:, nu:]
        if c.qr is None:
            steer = linalg.solve_triangular(lww, lff.T, lower=True, trans="T", check_finite=False).T
        else:
            steer = lff @ np.linalg.pinv(lww, rcond=1e-11)
        oblique = steer @ past  # O_i Q'
        scale = None
    else:
        oblique = lff
        scale = None
        if weighting == "cva":
            scale = linalg.cholesky(
                lff @ lff.T + L[np_:, np_:] @ L[np_:, np_:].T, lower=True, check_finite=False
            )
            oblique = linalg.solve_triangular(scale, lff, lower=True, check_finite=False)
    if c.qr is None:
        values, vectors = linalg.eigh(oblique @ oblique.T, check_finite=False, driver="evd")
        s, left = np.sqrt(np.maximum(values[::-1], 0)), vectors[:, ::-1]
    else:
        left, s, _ = np.linalg.svd(oblique)
    if scale is not None:
        left = scale @ left
    return Subspace(s, left, L, c, weighting)


def choose_order(s: np.ndarray, largest: int = 12) -> int:
    """Choose the order: the largest drop on a log scale among the first `largest` + 1 singular values."""
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(s[: largest + 1], 1e-300 + s[0] * 1e-14))
    return int(np.argmax(logs[:-1] - logs[1:])) + 1


def identify(
    u: np.ndarray,
    y: np.ndarray,
    period_s: float,
    order: int | None = 12,
    i: int = 20,
    weighting: str = "cva",
    rest: bool = True,
) -> StateSpace:
    """Identify a model of `order` (None: by the singular values) from u (N, m), y (N, l).

    weighting `paper`: A, C from W1 = W2 = I and B from (26), as printed; it may be unstable. Else A is made
    stable, and B, x(0) come from simulation least squares (`rest`: with x(0) = 0).
    """
    u, y = np.atleast_2d(u.T).T, np.atleast_2d(y.T).T
    c = correlate((u, y), period_s, i)
    sub = project(c, weighting)
    n = order or choose_order(sub.singular_values)
    a, cc = shift(sub, n)
    info = {
        "method": "subspace",
        "weighting": weighting,
        "i": i,
        "singular_values": sub.singular_values[: 3 * n].tolist(),
    }
    if weighting == "paper":
        return StateSpace(a, paper_b(sub, a, cc, n), cc, period_s, np.zeros(n), info)
    a = stabilise(a)
    b, x0 = input_matrix(a, cc, u, y, rest)
    return StateSpace(a, b, cc, period_s, x0, info)


def shift(sub: Subspace, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a (n, n) and C (l, n) from the extended observability matrix (13), (20).

    Raises InputError when n is too large."""
    l, i = sub.correlations.l, sub.correlations.i  # noqa: E741
    if n >= (i - 1) * l or n > len(sub.singular_values):
        raise InputError(f"order {n} with i = {i} and {l} outputs; at most {(i - 1) * l - 1} is possible")
    gamma = sub.left[:, :n] * np.sqrt(sub.singular_values[:n])
    return _ridge(gamma[:-l], gamma[l:], 0.0), gamma[:l].copy()


def stabilise(a: np.ndarray, margin: float = 1e-6) -> np.ndarray:
    """Return A with its unstable eigenvalues reflected into the unit circle (1/conj).

    None is left nearer to the circle than `margin`."""
    values, vectors = np.linalg.eig(a)
    size = np.abs(values)
    if size.max() < 1 - margin:
        return a
    new = np.where(size > 1, values / size**2, values)
    size = np.maximum(np.abs(new), 1e-300)
    new = new * np.minimum(1, (1 - margin) / size)
    return np.real(vectors @ np.diag(new) @ np.linalg.inv(vectors))


def input_matrix(
    a: np.ndarray, c: np.ndarray, u: np.ndarray, y: np.ndarray, rest: bool = False, ridge: float = 1e-11
) -> tuple[np.ndarray, np.ndarray]:
    """Return B (n, m) and x0 (n,) by simulation least squares in modal coordinates (rest: x0 = 0)."""
    values, vectors = np.linalg.eig(a)
    values = np.ascontiguousarray(values, dtype=complex)
    cm = c @ vectors
    n, m, N = len(a), u.shape[1], len(u)
    s = np.empty((n * (m + (not rest)), N), dtype=complex)
    for k in range(m):
        s[k * n : (k + 1) * n] = kernels.modal_states(values, _c(u[:, k]))
    if not rest:
        impulse = np.zeros(N)
        impulse[0] = 1
        s[m * n :] = kernels.modal_states(values, impulse)
        s[m * n :, 0] = 1.0
        s[m * n :, 1:] *= values[:, None]
    cols = np.tile(np.arange(n), m + (not rest))
    small = np.empty((2 * len(s), N))
    small[::2], small[1::2] = s.real, s.imag
    gram = small @ small.T
    gram = (gram[::2, ::2] + gram[1::2, 1::2]) + 1j * (gram[::2, 1::2] - gram[1::2, ::2])  # conj(S) S'
    normal = (cm.conj().T @ cm)[np.ix_(cols, cols)] * gram
    cross = small @ y
    right = ((cross[::2] - 1j * cross[1::2]) * cm.conj().T[cols]).sum(1)
    d = np.sqrt(np.real(np.diag(normal)))
    d[d == 0] = 1
    unknown = np.linalg.solve(normal / d / d[:, None] + ridge * np.eye(len(d)), right / d) / d
    parts = unknown.reshape(-1, n)
    b = np.real(vectors @ parts[:m].T)
    x0 = np.zeros(n) if rest else np.real(vectors @ parts[m])
    return b, x0


def paper_b(sub: Subspace, a: np.ndarray, c: np.ndarray, n: int) -> np.ndarray:
    """Return B by the paper's (21) to (26) with D = 0, as printed: the inaccurate step of the method."""
    k, L = sub.correlations, sub.l_factor
    i, m, l = k.i, k.m, k.l  # noqa: E741
    nu, np_ = i * m, i * (2 * m + l)
    gamma = sub.left[:, :n] * np.sqrt(sub.singular_values[:n])
    z_i = L[np_:, :np_]  # Z_i Q': Yf on [Uf; Up; Yp] is exact in L
    pin_i, pin_less = np.linalg.pinv(gamma), np.linalg.pinv(gamma[:-l])
    # Z_{i+1}: Yf- on [Wp+; Uf-]; all of it in the coordinates of the rows of Q (columns of L)
    uf, up, yp, yf = L[:nu], L[nu : 2 * nu], L[2 * nu : np_], L[np_:]
    seen = np.vstack([up, uf[:m], yp, yf[:l], uf[m:]])
    target = yf[l:]
    q, _ = linalg.qr(seen.T, mode="economic")
    z_next = (target @ q) @ q.T
    state = np.hstack([pin_i @ z_i, np.zeros((n, L.shape[1] - np_))])
    left = np.vstack([pin_less @ z_next, yf[:l]]) - np.vstack([a, c]) @ state
    # Solve (24) to (26) in one least-squares problem: min |left - N(B) Uf|, linear in B (D = 0). The other
    # way is to solve for K first, then for B without weights. Without noise the results are equal. With noise
    # the other way is far worse, because Uf of long pulses is nearly singular.
    nu_factor = uf[:, :nu]
    target = left[:, :nu]  # left, projected on Uf
    lag, lcg = a @ pin_i, c @ pin_i  # (n, i l), (l, i l)
    steps = np.empty((i, n + l, n))
    for j in range(i):
        # H_i's block column j holds [0...0; D; CB; CAB; ...]: C A^r B = gamma block r times B
        h_i = np.vstack([np.zeros(((j + 1) * l, n)), gamma[: (i - j - 1) * l]])
        h_less = np.vstack([np.zeros((j * l, n)), gamma[: (i - 1 - j) * l]])
        steps[j, :n] = (np.eye(n) if j == 0 else pin_less @ h_less) - lag @ h_i
        steps[j, n:] = -lcg @ h_i
    matrix = np.einsum("jpa,jbr->prab", steps, nu_factor.reshape(i, m, nu)).reshape(target.size, n * m)
    return linalg.lstsq(matrix, target.ravel())[0].reshape(n, m)


def innovations(model: StateSpace, u: np.ndarray, y: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return one-step prediction errors (N, l) of (6), with K = `gain` (n, l).

    x(n+1) = A x + B u + K e, e = y - C x
    """
    closed = model.a - gain @ model.c
    predicted = kernels.simulate(
        _c(closed), _c(np.hstack([model.b, gain])), _c(model.c), _c(model.x0), _c(np.hstack([u, y]))
    )
    return y - predicted


def prediction_gain(model: StateSpace, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Estimate a start for K (n, l) of (6).

    Process noise comes from the slow part of the residual, sensor noise from its differences."""
    e = y - model.simulate(u, model.x0)
    white = np.diff(e, 2, axis=0)
    r = white.T @ white / len(white) / 6
    r += 1e-9 * np.trace(r) / len(r) * np.eye(len(r)) + 1e-18 * np.eye(len(r))
    slow = np.linalg.pinv(model.c, rcond=1e-6) @ (e[8:] + e[:-8]).T / 2
    w = slow[:, 1:] - model.a @ slow[:, :-1]
    q = w @ w.T / w.shape[1] * 0.01
    q += 1e-12 * (np.trace(q) + 1e-18) * np.eye(len(q))
    p = linalg.solve_discrete_are(model.a.T, model.c.T, q, r)
    return model.a @ p @ model.c.T @ np.linalg.inv(model.c @ p @ model.c.T + r)


def refine_prediction_error(
    model: StateSpace, u: np.ndarray, y: np.ndarray, iterations: int = 6
) -> tuple[StateSpace, np.ndarray]:
    """Refine C, B, K and the (real) poles by prediction errors (Gauss-Newton); return (model, K (n, l)).

    The model must be diagonal (from `modal`). Minimises the whitened innovations' sum of
    squares; a step that would leave the stable region or raise the cost is halved. Returns the start
    unchanged if nothing improves.
    """
    if np.abs(model.a - np.diag(np.diag(model.a))).max() > 1e-12:
        raise InputError("prediction-error refinement starts from a model with real poles (diagonal A)")
    n, m = model.b.shape
    l = len(model.c)  # noqa: E741
    gain = prediction_gain(model, u, y)
    e = innovations(model, u, y, gain)
    root = np.linalg.inv(linalg.cholesky(np.cov(e.T).reshape(l, l) + 1e-18 * np.eye(l), lower=True))
    uy = _c(np.hstack([u, y]))

    def cost(mod: StateSpace, k: np.ndarray) -> float:
        """Return the sum of squares of whitened innovations; inf if unstable or a pole is not positive."""
        if (
            not (np.diag(mod.a) > 0).all()
            or np.abs(np.linalg.eigvals(mod.a - k @ mod.c)).max() >= 1
            or not mod.stable
        ):
            return np.inf
        return float(((innovations(mod, u, y, k) @ root.T) ** 2).sum())

    best = cost(model, gain)
    for _ in range(iterations):
        closed = model.a - gain @ model.c
        x = kernels.simulate(_c(closed), _c(np.hstack([model.b, gain])), np.eye(n), _c(model.x0), uy)
        e = y - x @ model.c.T
        # de = -(dC x + C dx), dx(n+1) = (A - K C) dx + dA x + dB u + dK e - K dC x: one run for each unknown
        columns = []
        for k in range(n):
            columns.append(("a", k, k, x[:, k]))
            columns += [("b", k, j, u[:, j]) for j in range(m)] + [("k", k, j, e[:, j]) for j in range(l)]
        jac = np.empty((len(columns) + n * l, len(u) * l))
        basis = np.eye(n)
        kernel_c = _c(model.c)
        for r, (_, k, _, drive) in enumerate(columns):
            jac[r] = -(
                kernels.simulate(
                    _c(closed), _c(basis[:, k : k + 1]), kernel_c, np.zeros(n), _c(drive[:, None])
                )
                @ root.T
            ).ravel()
        for j in range(l):
            for k in range(n):
                d = -kernels.simulate(
                    _c(closed), _c(-gain[:, j : j + 1]), kernel_c, np.zeros(n), _c(x[:, k : k + 1])
                )
                d[:, j] -= x[:, k]
                jac[len(columns) + j * n + k] = (d @ root.T).ravel()
        h = jac @ jac.T
        d = np.sqrt(np.maximum(np.diag(h), 1e-300))
        g = jac @ (e @ root.T).ravel()
        step = -np.linalg.solve(h / d / d[:, None] + 1e-6 * np.eye(len(d)), g / d) / d
        size = 1.0
        while size > 1e-3:
            a, b, k2 = np.diag(model.a).copy(), model.b.copy(), gain.copy()
            for (kind, k, j, _), v in zip(columns, size * step, strict=False):
                if kind == "a":
                    a[k] += v
                elif kind == "b":
                    b[k, j] += v
                else:
                    k2[k, j] += v
            c2 = model.c + size * step[len(columns) :].reshape(l, n)
            trial = replace(model, a=np.diag(a), b=b, c=c2)
            value = cost(trial, k2)
            if value < best:
                break
            size /= 2
        else:
            break
        done = best - value < 1e-6 * best
        model, gain, best = trial, k2, value
        if done:
            break
    return replace(model, info={**model.info, "prediction_error": best / y.size}), gain
