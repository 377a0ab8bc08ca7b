"""A linear thermal model: resampling, simulation.

    x(n+1) = A x(n) + B u(n),   y(n) = C x(n)                                     (31), (32) with D = 0

Resampling: [[A, B], [0, I]] at one period T is the exponential of [[F, G], [0, 0]] T. Its logarithm gives any
other period.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import linalg

from thermoctl.files.yamlfile import InputError
from thermoctl.identify import kernels


@dataclass(frozen=True)
class StateSpace:
    """a (n, n), b (n, m), c (l, n), period_s, x0 (n,) at the first sample of the identification data; D = 0.

    `info` holds figures of the estimate (method, singular values, residuals) for reports."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    period_s: float
    x0: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of A, largest magnitude first."""
        p = np.linalg.eigvals(self.a)
        return p[np.argsort(-np.abs(p))]

    @property
    def stable(self) -> bool:
        """Return whether every eigenvalue of A lies inside the unit circle."""
        return bool(np.abs(self.poles).max() < 1)

    @property
    def time_constants_s(self) -> np.ndarray:
        """-T/ln|pole|, longest first."""
        with np.errstate(divide="ignore"):
            return -self.period_s / np.log(np.abs(self.poles))

    def simulate(self, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Free run: outputs (N, l) for inputs u (N, m), from x0 (default: rest)."""
        x0 = np.zeros(self.order) if x0 is None else x0
        return kernels.simulate(_c(self.a), _c(self.b), _c(self.c), _c(x0), _c(np.atleast_2d(u.T).T))

    def resample(self, period_s: float) -> StateSpace:
        """Return the same continuous system, inputs held, at another period.

        Exact (2e-15 in A - I from 10 s to 1 ms); a linear scaling of A - I would be 25 % off. Identification
        itself runs at 1 to 10 s. At 1 ms a pole of 4000 s lies 2.5e-7 from 1, closer than noise can resolve.
        Raises InputError when no real logarithm exists."""
        if period_s == self.period_s:
            return self
        bad = [p for p in self.poles if abs(p.imag) < 1e-12 and p.real <= 1e-12]
        if bad:
            raise InputError(
                f"the model has a pole at {bad[0].real:.4g} (period {self.period_s:g} s): a real system sampled at "
                f"that period has none at or below zero, so it cannot be resampled to {period_s:g} s; it is a noise "
                "mode: lower the order or identify with real poles (method 'modal')"
            )
        n, m = self.b.shape
        big = np.zeros((n + m, n + m))
        big[:n, :n], big[:n, n:], big[n:, n:] = self.a, self.b, np.eye(m)
        rate = linalg.logm(big) * (period_s / self.period_s)
        if np.abs(np.imag(rate)).max() > 1e-9 * np.abs(rate).max():
            raise InputError(
                f"the model at {self.period_s:g} s has no real logarithm (a repeated pole below zero); lower the order"
            )
        new = linalg.expm(np.real(rate))
        return replace(self, a=new[:n, :n], b=new[:n, n:], period_s=period_s)

    def minus_identity(self, period_s: float) -> np.ndarray:
        """Return A - I at a (short) period by the series of exp(F T) - I.

        The subtraction from 1 would lose digits."""
        if self.poles.real.min() <= 0:
            self.resample(period_s)  # raises an error that names the pole
        f = np.real(linalg.logm(self.a)) * (period_s / self.period_s)
        total = term = f
        for k in range(2, 30):
            term = term @ f / k
            total = total + term
        return total


def modal(
    poles: np.ndarray, residues: np.ndarray, free: np.ndarray, period_s: float, info: dict[str, Any]
) -> StateSpace:
    """Return the smallest state space with these real poles (K,), residues and free decay.

    residues (K, l, m): y = sum R_k s_k, s(n+1) = p s + u; `free` (K, l): amplitudes of the initial state's
    decay. A pole whose residue has rank r gets r states."""
    a, b, c, x0 = [], [], [], []
    scale = max(np.abs(residues).max(), 1e-300)
    for p, r, w in zip(poles, residues, free, strict=True):
        left, s, right = np.linalg.svd(
            np.column_stack([r * 1.0, w])[:, : r.shape[1] + bool(np.any(w))], full_matrices=False
        )
        keep = s > 1e-12 * scale
        for k in np.flatnonzero(keep):
            a.append(p)
            c.append(left[:, k] * s[k])
            b.append(right[k, : r.shape[1]])
            x0.append(right[k, -1] if np.any(w) else 0.0)
    return StateSpace(np.diag(a), np.array(b), np.array(c).T, period_s, np.array(x0), info)


def _c(v: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(v, dtype=float)
