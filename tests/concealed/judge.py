"""How large is an effect? By the signal left after an honest refit, in the metric of the sensors' noise.

All signals are whitened by the known noise spectrum in the DCT domain. With J the whitened derivatives of the outputs
by the plant's parameters and start values (scaled by a quarter of their ranges, which enter as a ridge of 1) and d the
whitened difference an effect makes,

    left over:  r = d - J (J'J + I)^-1 J'd,     SNR = |r|

so white noise of sd s on N samples gives SNR = rms(r) sqrt(N) / s, and the SNR is the expected value of an ideal
single-effect test statistic in standard deviations. This straight line chooses a size; what an effect of that size leaves
is then measured by a refit that follows the curve and respects the ranges (`generate.Bench.refit`): it can swallow four
fifths of what the line says (a hidden thermal mass, 24.7 to 5.1 sigmas), or leave more, where a range is a wall.
Bands: small 3-6, middle 6-15, large above 15. Two
explanations are `nearly the same` when less than 3.5 of the true one's signal is left after the other, too, is fitted.

A test that does not know the noise has to learn its spectrum S from the same record, and noise of another spectrum
S' imitates a part of the signal R. With the likelihood of Whittle (1953), over all bins and with the best S' of the
sensors' family in each channel, it is left with

    SNR^2 = sum  log S'/S + (S + R^2) / S' - 1,      which is sum R^2 / S for S' = S.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dct
from scipy.optimize import minimize

from tests.concealed.sensors import Noise

BANDS = {"small": (3.0, 6.0), "middle": (6.0, 15.0), "large": (15.0, 60.0)}
TELL_APART = 3.5
COLOURS = 0.3, 0.9, 0.99  # lag-one correlations from which the noise of a test that has to learn it starts


class Judge:
    """Whitening and projection for one rig: `spectra[run][channel]` (N,) per-bin noise variances."""

    def __init__(self, spectra: list[np.ndarray]):
        self.spectra = spectra
        self.scale = [1 / np.sqrt(s) for s in spectra]

    def whiten(self, runs: list[np.ndarray]) -> np.ndarray:
        """Signals of all runs, each (m, N, ny), to whitened rows (m, sum N*ny)."""
        rows = [
            (dct(y, axis=1, norm="ortho") * s).reshape(len(y), y.shape[1] * y.shape[2])
            for y, s in zip(runs, self.scale, strict=True)
        ]
        return np.concatenate(rows, axis=1)

    def set_parameters(self, derivatives: np.ndarray) -> None:
        """Whitened derivatives (np, M), each already times a quarter of the parameter's range."""
        padded = np.concatenate([derivatives, np.eye(len(derivatives))], axis=1)
        _, r = np.linalg.qr(padded.T)
        self.basis = np.linalg.solve(r.T, derivatives)
        self.solve = r

    def left_over(self, d: np.ndarray) -> np.ndarray:
        """What a refit leaves of the whitened signals d (m, M), in coordinates (m, M + np) that carry the ridge."""
        c = d @ self.basis.T
        inner = np.linalg.solve(self.solve, c.T).T
        return np.concatenate([d - c @ self.basis, -inner], axis=1)

    def _squares(self, left: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Squares of one left-over signal (M + np,) by run (N, ny), and the part that carries the ridge (np,)."""
        *runs, ridge = np.split(left, np.cumsum([s.size for s in self.spectra]))
        return [r.reshape(s.shape) ** 2 for r, s in zip(runs, self.spectra, strict=True)], ridge

    def errors(self, left: np.ndarray) -> np.ndarray:
        """Rms over the noise (ny,) of one left-over signal (M + np,)."""
        return np.sqrt(np.concatenate(self._squares(left)[0]).mean(axis=0))

    def learnt(self, left: np.ndarray) -> float:
        """SNR of one left-over signal (M + np,) for a test that has to learn the noise of each channel."""
        parts, ridge = self._squares(left)
        channels = range(self.spectra[0].shape[1])
        square = sum(_learnt([s[:, j] for s in self.spectra], [p[:, j] for p in parts]) for j in channels)
        return float(np.sqrt(square + ridge @ ridge))


def _learnt(spectra: list[np.ndarray], parts: list[np.ndarray]) -> float:
    """SNR^2 of one channel: its spectrum in each run (N,), and the squares of the whitened signal there."""
    size = float(np.mean(spectra[0]))
    true, seen = (
        np.concatenate(spectra),
        np.concatenate([s * (1 + p) for s, p in zip(spectra, parts, strict=True)]),
    )

    def apart(x: np.ndarray) -> float:
        white, ar, flicker = np.sqrt(size * np.exp(x[:3]))
        noise = Noise(white, ar, x[3], flicker)
        other = np.concatenate([noise.spectrum(len(s)) for s in spectra])
        return float(np.sum(np.log(other / true) + seen / other - 1))

    found = [
        minimize(apart, [-0.5, -1.5, -4.0, rho], method="L-BFGS-B", bounds=[(-9, 6)] * 3 + [(0, 0.999)]).fun
        for rho in COLOURS
    ]
    return max(0.0, min(float(np.sum(parts)), *found))


def snr(left: np.ndarray) -> np.ndarray:
    """Norms of left-over rows."""
    return np.linalg.norm(left, axis=-1)


def apart(left: np.ndarray, rival: np.ndarray) -> np.ndarray:
    """One signal (M,) without what the rival's rows (k, M) explain of it."""
    q, _ = np.linalg.qr(rival[snr(rival) > 1e-9].T)
    return left - q @ (q.T @ left)


def beyond(left: np.ndarray, rival: np.ndarray) -> float:
    """What is left of one signal (M,) after the rival's rows (k, M) are fitted to it as well."""
    return float(np.linalg.norm(apart(left, rival)))


def size_for(curve: tuple, target: float) -> float | None:
    """The size at which the left-over SNR is `target`; None where the effect cannot be that visible."""
    suspect, sizes, left = curve
    s = snr(left)
    if not np.all(np.isfinite(s)) or s.max() < target:
        return None
    k = int(np.argmax(s >= target))
    if k == 0:
        return float(sizes[0] * target / s[0]) if suspect.top > 1 else float(sizes[0])
    x = np.interp(np.log(target), np.log(s[k - 1 : k + 1] + 1e-12), np.log(sizes[k - 1 : k + 1]))
    return float(np.exp(x))
