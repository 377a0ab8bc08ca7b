"""Results of a test of the position loop: whether its ticks came in time, and the margins of the loop.

The loop is measured, not fitted (Ljung, System Identification, 2nd ed., chapter 6). T = Phi_yr / Phi_rr, with
the recorded reference r and the averaged position y that the law used. Noise does not reach r. S = 1 - T,
L = T/S, with all that acts in the loop: command periods, dead times, late ticks. Bands of frequencies are
averaged with the weight of a prediction T0:

    T(f) = T0(f) sum Y (T0 R)* / sum |T0 R|^2

So a right prediction is confirmed without bias, however fast the phase turns within a band.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.identify.tuning import (
    WANTED_DEG,
    WANTED_GAIN,
    Gains,
    SecondOrder,
    controller_at,
    margins,
    plant_at,
)
from thermoctl.rig.signals import AT

# Share of the ticks that may be skipped, late by more than half a period, or lost. At 1 % the mean dead time
# grows by a hundredth of a period; at 9 % a loop was proposed that diverged in 0.16 s.
SLIPS = 0.01
WIDTH = 0.12  # standard deviation of a band's weight, in ln of frequency
BANDS = 48
UNCLEAR = 0.5  # relative standard error of the loop's size from which on a band counts as not measured
SURE_DEG, SURE_GAIN = 5.0, 0.15  # largest standard error of a measured phase, and relative one of a gain


@dataclass(frozen=True)
class Timing:
    """The ticks of a test: due, skipped, late by more than half a period, lost on the way to this program.

    spread_s: 95 % of the ticks are at most this much later than the median one."""

    due: int
    skipped: int
    late: int
    lost: int
    spread_s: float

    @classmethod
    def of(cls, rows: np.ndarray, period_s: float) -> Timing:
        """Take it from consecutive record rows (N, signals). Raises InputError for fewer than 20."""
        if len(rows) < 20:
            raise InputError(f"the test gave {len(rows)} ticks; at least 20 are needed")
        late_s = 1e-6 * rows[:, AT["lateness_us"]]
        made = int(rows[-1, AT["tick"]] - rows[0, AT["tick"]]) + 1
        gaps = np.round((rows[1:, AT["dt_s"]] - np.diff(late_s)) / period_s) - 1
        skipped = int(max(rows[-1, AT["slips"]] - rows[0, AT["slips"]], np.maximum(gaps, 0).sum()))
        return cls(
            made + skipped,
            skipped,
            int((late_s > 0.5 * period_s).sum()),
            made - len(rows),
            float(np.quantile(late_s, 0.95) - np.median(late_s)),
        )

    @property
    def bad(self) -> float:
        """Return the share of the ticks that were skipped, late or lost."""
        return (self.skipped + self.late + self.lost) / self.due

    def check(self) -> None:
        """Raise InputError where the ticks make the test worthless."""
        if self.bad > SLIPS:
            raise InputError(
                f"no gains from this test: of {self.due} ticks {self.skipped} were skipped, {self.late} late by more than half "
                f"a period and {self.lost} lost, {100 * self.bad:.2g} %; at most {100 * SLIPS:g} % were expected, because skipped "
                "ticks act as dead time that comes and goes. Set loop.priority (80), load the machine less or raise "
                "loop.period_s; `thermoctl latency` shows the ticks (docs/how-to/real-time.md)"
            )

    def delay_s(self, period_s: float, command_s: float) -> float:
        """Return the dead time by which a command may exceed the mean one of the test.

        Half of what a command's period is longer than a tick, and the spread of the ticks."""
        return max(0.0, 0.5 * (command_s - period_s)) + self.spread_s


@dataclass(frozen=True)
class Measured:
    """Margins of a measured loop with their standard errors; NaN where it was not measured."""

    phase_deg: float
    phase_error_deg: float
    gain: float
    gain_error: float

    @property
    def is_sure(self) -> bool:
        """Whether both margins are known well enough, or surely above the wanted ones."""
        phase = self.phase_deg - 2.0 * self.phase_error_deg >= WANTED_DEG or self.phase_error_deg <= SURE_DEG
        # The relative error of the loop's gain, too.
        error = 0.0 if math.isinf(self.gain) else self.gain_error / self.gain
        gain = self.gain / (1.0 + 2.0 * error) >= WANTED_GAIN or error <= SURE_GAIN
        return phase and gain

    def __str__(self) -> str:
        """Write the margins for people."""
        if math.isnan(self.phase_deg):
            return "no margins measured"
        gain = f"{self.gain:.2f} +- {self.gain_error:.2f}" if math.isfinite(self.gain) else "above 2"
        return f"gain margin {gain}, phase margin {self.phase_deg:.0f} +- {self.phase_error_deg:.0f} deg"


NOTHING = Measured(math.nan, math.inf, math.nan, math.inf)


def measure(
    rows: np.ndarray, model: SecondOrder, gains: Gains, period_s: float, moving_average: int = 1
) -> Measured:
    """Measure the margins of the loop that rows (N, signals) of consecutive ticks show.

    model, gains: the prediction whose weight the bands have; the loop ran with these gains."""
    t = rows[:, AT["t_s"]]
    ticks = np.round((t - t[0]) / period_s).astype(int)
    n = int(ticks[-1]) + 1
    held = np.searchsorted(ticks, np.arange(n), side="right") - 1
    r, y = (rows[held, AT[name]] for name in ("reference_um", "compensated_um"))
    w = 2 * np.pi * np.arange(1, n // 2) / (n * period_s)
    R, Y = np.fft.rfft(r - r[0])[1 : n // 2], np.fft.rfft(y - y.mean())[1 : n // 2]
    loop = controller_at(w, gains, period_s) * plant_at(w, model, period_s, moving_average)
    predicted = loop / (1 + loop)
    below, turned = np.flatnonzero(np.abs(loop) < 1), np.flatnonzero(np.unwrap(np.angle(loop)) < -np.pi)
    if not len(below) or not np.any(R):
        return NOTHING
    top = w[turned[0]] if len(turned) else np.inf
    f = np.geomspace(w[below[0]] / 3, min(2.0 * max(top, w[below[0]]), 0.9 * np.pi / period_s), BANDS)
    expected = predicted * R
    size, both = np.abs(expected) ** 2, Y * expected.conj()
    found, error = np.zeros(BANDS, complex), np.zeros(BANDS)
    for k, centre in enumerate(f):
        weight = np.exp(-0.5 * (np.log(w / centre) / WIDTH) ** 2)
        energy = weight @ size
        share = (weight @ both) / energy
        left = (weight @ np.abs(Y - share * expected) ** 2) / weight.sum()
        closed = share * np.interp(centre, w, predicted)
        found[k] = closed / (1 - closed)
        error[k] = math.sqrt(0.5 * left * (weight**2 @ size)) / energy / abs(share * (1 - closed))
    return _margins(found, error)


def _margins(loop: np.ndarray, error: np.ndarray) -> Measured:
    """Return the margins of a measured loop at rising frequencies (K,); error: its relative error (K,)."""
    size, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    cross = np.flatnonzero((size[:-1] >= 0) & (size[1:] < 0))
    if not len(cross):
        return NOTHING
    least, k = min((_between(size, phase, k, 0.0), k) for k in cross.tolist())
    phase_error = error[k] * _lever(size, phase, k)
    clear = error <= UNCLEAR  # the others are noise; a large response would show above it
    turn = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi) & clear[:-1] & clear[1:])
    top = size[np.flatnonzero(clear)[-1]] if clear.any() else 0.0
    if len(turn):
        gain, j = min((math.exp(-_between(phase, size, j, -np.pi)), j) for j in turn.tolist())
        gain_error = gain * error[j] * _lever(phase, size, j)
    else:
        gain, gain_error = (math.inf, 0.0) if top < -math.log(WANTED_GAIN) else (math.nan, math.inf)
    return Measured(180 + math.degrees(least), math.degrees(phase_error), gain, float(gain_error))


def _lever(x: np.ndarray, y: np.ndarray, k: int) -> float:
    """Return the error of y at the point where x passes a value, if x and y have errors of 1."""
    return math.hypot(1.0, (y[k + 1] - y[k]) / (x[k + 1] - x[k]))


def _between(x: np.ndarray, y: np.ndarray, k: int, at: float) -> float:
    """Return y where x passes `at` between the points k and k + 1."""
    return float(y[k] + (x[k] - at) / (x[k] - x[k + 1]) * (y[k + 1] - y[k]))


def disagreement(
    measured: Measured, models: tuple[SecondOrder, SecondOrder], gains: Gains, period_s: float, average: int
) -> str:
    """Return how a measured loop contradicts its prediction; '' if it does not.

    models: the fitted one and its pessimist. A margin contradicts them if it is below that of the worse
    model by more than its standard error. So does a margin that is not known well enough. A gain margin of
    twice the wanted one always agrees."""
    if not measured.is_sure:
        return (
            f"the margins are not known well enough ({measured}): at most +- {SURE_DEG:g} deg and +- {100 * SURE_GAIN:g} % were "
            "expected; raise control.setpoint_rate_um_s"
        )
    both = [margins(m, gains, period_s, average) for m in models]
    phase, gain = min(m.phase_deg for m in both), min(*(m.gain for m in both), 2.0 * WANTED_GAIN)
    if measured.phase_deg + measured.phase_error_deg < phase or measured.gain + measured.gain_error < gain:
        return f"{measured} measured, at least {gain:.2f} and {phase:.0f} deg predicted"
    return ""
