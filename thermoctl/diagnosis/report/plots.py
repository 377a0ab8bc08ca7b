"""The figures of a report: measured and simulated curves, and the remaining error."""

from __future__ import annotations

import numpy as np

from thermoctl.diagnosis.curves import Curve
from thermoctl.diagnosis.report.figures import COLUMNS, WIDE, percent
from thermoctl.report.page import BLUE, FAINT, GREY, ORANGE, THIRD, panel, panels, unit
from thermoctl.report.residuals import draw_autocorrelation, draw_periodogram, titled

POINTS = 200  # number of buckets of a curve, each drawn by its smallest and its largest value
DOTS = 300  # largest number of measured values that are drawn
ROOM = 0.15  # margin above and below the readings, over their range; simulations outside are cut off
GAP = 8.0  # a step of time this many times the usual one is a gap in the curve
FEWEST = 16  # least number of values for an autocorrelation
SHADES = {"before": GREY, "refit_only": ORANGE, "after": BLUE}
# (least span in s, unit in s, unit).
SCALES = ((2 * 86400.0, 86400.0, "days"), (7200.0, 3600.0, "h"), (0.0, 1.0, "s"))


def compared(c: Curve, caption: str) -> str:
    """Return the figure of a measured output with its simulations, and of their errors."""
    curves, errors = panel(), panel()
    t, label = _times(c)
    dots = np.flatnonzero(np.isfinite(c.y))
    dots = dots[:: max(1, -(-len(dots) // DOTS))]
    curves.plot(
        *_dots(t[dots], c.y[dots]),
        lw=3,
        color=GREY,
        alpha=0.55,
        solid_capstyle="round",
        label="measured",
        zorder=1,
    )
    for k, e in c.errors.items():
        fit = c.fit_percent(k)
        name = COLUMNS[k] if fit is None else f"{COLUMNS[k]}: {percent(fit)} %"
        style = {"lw": 0.9, "ls": "--"} if k == "before" else {"lw": 1.5}
        curves.plot(*_thin(t, c.y - e), color=SHADES[k], label=name, **style)
        if k != "before":
            errors.plot(*_thin(t, e), color=SHADES[k], lw=0.9)
    room = max(ROOM * float(np.ptp(c.y[dots])), 1e-12)
    curves.set_ylim(c.y[dots].min() - room, c.y[dots].max() + room)
    titled(curves, "", label, _with_unit(c.output, unit(c.unit)))
    titled(errors, "", label, _with_unit("error", _difference(c.unit)))
    errors.set_xlim(curves.get_xlim())
    return panels((curves, errors), caption)


def remaining(c: Curve, key: str, noise: float, caption: str) -> str:
    """Return the figure of an error in its own scale, with its autocorrelation and cumulated periodogram."""
    e = c.errors[key]
    seen = e[np.isfinite(e)]
    axes, (t, label) = panel(THIRD), _times(c)
    axes.axhspan(-WIDE * noise, WIDE * noise, color=FAINT, lw=0, alpha=0.6)
    axes.plot(*_thin(t, e), color=BLUE, lw=0.7)
    titled(axes, "error, and 95 % of the noise", label, _with_unit(c.output, _difference(c.unit)))
    drawn = [axes]
    if len(seen) >= FEWEST and float(np.ptp(seen)) > 0:
        drawn += [panel(THIRD), panel(THIRD)]
        draw_autocorrelation(drawn[1], seen)
        draw_periodogram(drawn[2], seen)
    return panels(drawn, caption)


def _times(c: Curve) -> tuple[np.ndarray, str]:
    """Return the times (N,) since the begin in a unit that suits them, and the axis' label."""
    scale, word = next((s, w) for least, s, w in SCALES if np.ptp(c.t) >= least)
    return (c.t - c.t[0]) / scale, f"time ({word})"


def _dots(t: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return each point (N,) as a short line and a gap. In SVG this takes a tenth of the size of markers."""
    ends = ((t, t + 1e-4 * np.ptp(t)), (v, v))
    return tuple(np.column_stack([a, b, np.full(len(a), np.nan)]).ravel() for a, b in ends)


def _thin(t: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each of POINTS buckets, with NaN in gaps."""
    index = np.flatnonzero(np.isfinite(v))
    if len(index) > 2 * POINTS:
        parts = np.array_split(index, POINTS)
        index = np.unique([q for part in parts for q in (part[v[part].argmin()], part[v[part].argmax()])])
    steps = np.diff(t[index])
    gap = np.flatnonzero(steps > GAP * np.median(steps)) if len(steps) else np.zeros(0, int)
    return np.insert(t[index], gap + 1, np.nan), np.insert(v[index], gap + 1, np.nan)


def _with_unit(text: str, its_unit: str) -> str:
    return f"{text} ({its_unit})" if its_unit else text


def _difference(its_unit: str | None) -> str:
    """Return the unit of a difference of readings."""
    return "K" if its_unit == "degC" else unit(its_unit)
