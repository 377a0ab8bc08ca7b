"""PID tuning: fit the response of position to drive to a recording of the closed loop, and propose gains.

PID, velocity form (41): D(s) = Kp (1 + 1/(Ti s) + Td s)

Response: K0 e^(-s theta)/((t1 s + 1)(t2 s + 1)), by output-error least squares from recorded drive to
recorded position. This is the direct method of closed-loop identification (Ljung, System Identification, 2nd
ed., section 13.5). The loop answers the noise of a sample one period later at the earliest. So white noise of
the encoder does not bias the fit.

Lambda / IMC (Rivera, Morari, Skogestad), with the half rule for faster lags than theta:

    series form     Kc = t1/(K0 (lambda + theta)), tI = t1, tD = t2
    parallel form   Kp = Kc (1 + tD/tI), Ti = tI + tD, Td = tI tD/(tI + tD)

A loop without derivative stays without: PI by the half rule, t1 + t2/2 and theta + t2/2.

Margins are those of the sampled loop L(e^jw) = D(z) G(z). G has a zero-order hold, the dead time and the
moving average. A recording cannot tell a short lag from dead time, but a faster loop is less stable with dead
time. So a proposal has its margins on two models, the fitted one and `pessimist`, whose short lag is replaced
by dead time. Half a command period, the ticks' jitter and the phase's uncertainty are added as dead time.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy import optimize, signal

from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.option import LIVE_STEP, TRIAL_FACTOR

# No gains are proposed when the phase near the crossover has a larger standard error. A smaller one counts as
# dead time.
UNCERTAIN_DEG = 40.0
ANSWERS = 10.0  # least gain of the response over its standard error; a fit to noise alone reaches 5
WANTED_DEG, WANTED_GAIN = 45.0, 2.0  # least phase margin and gain margin of a proposal
TURNS = 3.0  # a loop's phase passes 180 deg at about this multiple of its crossover
SHORTEST_S = 1e-6  # lag that stands for no lag
BLOCK_S = 1.0  # length of a block of residuals; the blocks count as independent


@dataclass(frozen=True)
class SecondOrder:
    """K0 e^(-s theta) / ((t1 s + 1)(t2 s + 1)), or oscillating: `t1`, `t2` are then complex conjugate.

    Gain in um per unit of drive. Of a fit: residual um, and uncertain_s, the standard error of the phase near
    the crossover, as a dead time."""

    gain: float
    t1: complex
    t2: complex
    theta_s: float
    residual: float = 0.0
    uncertain_s: float = 0.0

    def step(self, t: np.ndarray) -> np.ndarray:
        """Return the response to a unit step at t = 0."""
        s = np.maximum(np.asarray(t, float) - self.theta_s, 0.0)
        t1, t2 = complex(self.t1), complex(self.t2)
        if abs(t1 - t2) < 1e-9 * abs(t1):
            t2 = t1 * (1 + 1e-6)
        y = 1 - (t1 * np.exp(-s / t1) - t2 * np.exp(-s / t2)) / (t1 - t2)
        return self.gain * np.real(y)

    def response(self, drive: np.ndarray, period_s: float) -> np.ndarray:
        """Return positions (N,) from rest; each drive (N,) is written after its position and held."""
        impulse = np.diff(self.step(np.arange(len(drive) + 1) * period_s))
        return np.concatenate(([0.0], signal.fftconvolve(drive, impulse)[: len(drive) - 1]))

    def frequency(self, w: np.ndarray) -> np.ndarray:
        """G(jw)."""
        s = 1j * w
        return self.gain * np.exp(-s * self.theta_s) / ((self.t1 * s + 1) * (self.t2 * s + 1))


@dataclass(frozen=True)
class Gains:
    """Kp (drive per um), Ti s, Td s, and the method that gave them."""

    kp: float
    ti_s: float
    td_s: float
    how: str
    figures: dict[str, float] = field(default_factory=dict)


def fit_response(
    t_s: np.ndarray,
    drive: np.ndarray,
    y_um: np.ndarray,
    period_s: float,
    least_s: float = 0.0,
    present: Gains | None = None,
) -> SecondOrder:
    """Fit the second order with dead time that gives positions y_um (N,) from drives (N,) at times t_s (N,).

    Row k holds the position read and the drive written in the same tick of `period_s`; a missing tick kept
    the drive before it. least_s: the dead time is at least this. present: the fastest loop
    that matters has TRIAL_FACTOR times these gains; None: any. Raises InputError when the recording does not
    determine the response."""
    ticks = np.round((np.asarray(t_s) - t_s[0]) / period_s).astype(int)
    n = int(ticks[-1]) + 1
    if len(ticks) < 20:
        raise InputError(f"{len(ticks)} samples; at least 20 are needed to fit the position's response")
    u = np.asarray(drive, float)[np.searchsorted(ticks, np.arange(n), side="right") - 1]
    u, y = u - u[0], np.asarray(y_um, float) - np.mean(y_um)

    def model(p: np.ndarray, gain: float = 1.0) -> SecondOrder:
        """Return the response of p: ln of natural frequency (1/s), damping ratio and dead time (s)."""
        wn, zeta = np.exp(p[0]), np.exp(p[1])
        root = np.sqrt(complex(zeta**2 - 1))
        return SecondOrder(gain, 1 / (wn * (zeta - root)), 1 / (wn * (zeta + root)), float(np.exp(p[2])))

    def unit_response(p: np.ndarray) -> np.ndarray:
        """Return the positions (N,) at gain 1, um, about their mean."""
        x = model(p).response(u, period_s)[ticks]
        return x - x.mean()

    def residual(p: np.ndarray) -> np.ndarray:
        """Return fitted minus measured position (N,), um, with the gain of least squares."""
        x = unit_response(p)
        return (x @ y) / max(x @ x, 1e-300) * x - y

    starts = ((300.0, 0.3), (300.0, 1.5), (100.0, 3.0))  # (1/s, damping)
    least = np.log(max(0.02 * period_s, least_s))
    bounds = ([0.0, -4.0, least], [12.0, 4.0, np.log(200 * period_s + least_s)])
    tries = [
        optimize.least_squares(
            residual,
            [np.log(wn), np.log(zeta), max(np.log(period_s), least + 0.1)],
            bounds=bounds,
            max_nfev=60,
        )
        for wn, zeta in starts
    ]
    best = min(tries, key=lambda r: r.cost)
    x = unit_response(best.x)
    rms = float(np.sqrt(2 * best.cost / len(y)))
    covariance = _covariance(best.jac, best.fun, round(BLOCK_S / period_s))
    w = np.geomspace(0.1, 1 / period_s, 400)
    phases = np.unwrap(np.angle(model(best.x).frequency(w)))
    k = min(int(np.searchsorted(-phases, np.pi * 2 / 3)), len(w) - 1)
    w = w[k : k + 1]  # the crossover with 60 degrees left
    if present is not None:
        fitted = model(best.x, float(x @ y / max(x @ x, 1e-300)))
        w = np.minimum(w, TURNS * _crossover(fitted, replace(present, kp=TRIAL_FACTOR * present.kp)))
    slope = [
        np.angle(model(best.x + d).frequency(w) / model(best.x - d).frequency(w))[0] / 2e-3
        for d in 1e-3 * np.eye(3)
    ]
    uncertain = float(np.sqrt(slope @ covariance @ slope))
    uncertain_deg = np.degrees(uncertain)
    size = float(np.sqrt(x @ x))
    if not size or abs(x @ y) / size < ANSWERS * rms or uncertain_deg > UNCERTAIN_DEG:
        raise InputError(
            f"the position moved by {np.ptp(y):.3g} um with {rms:.2g} um of noise: its phase at {w[0] / (2 * np.pi):.3g} Hz is "
            f"known to {uncertain_deg:.2g} deg only, {UNCERTAIN_DEG:g} were expected; raise control.setpoint_rate_um_s"
        )
    gain = float(x @ y / (x @ x))
    return replace(model(best.x, gain), residual=rms, uncertain_s=uncertain / float(w[0]))


def _crossover(model: SecondOrder, gains: Gains) -> float:
    """Return the largest frequency, 1/s, at which the loop's gain is 1, in continuous time."""
    w = np.geomspace(1e-2, 1e5, 2000)
    d = gains.kp * (1 + 1 / (1j * w * gains.ti_s) + 1j * w * gains.td_s)
    over = np.flatnonzero(np.abs(d * model.frequency(w)) >= 1)
    return float(w[over[-1]]) if len(over) else float(w[0])


def _covariance(slopes: np.ndarray, residuals: np.ndarray, block: int) -> np.ndarray:
    """Return the covariance (p, p) of fitted parameters from slopes (N, p) and residuals (N,).

    Residuals of one block may depend on each other, those of two do not: the sandwich of clustered data."""
    p = slopes.shape[1]
    normal = slopes.T @ slopes
    bread = np.linalg.inv(normal + 1e-12 * (np.trace(normal) + 1e-12) * np.eye(p))
    starts = np.arange(0, len(residuals), max(1, min(block, len(residuals) // 8)))
    scores = np.add.reduceat(slopes * residuals[:, None], starts)
    few = len(starts) / max(len(starts) - p, 1)
    return bread @ (scores.T @ scores) @ bread * few


def pessimist(model: SecondOrder, delay_s: float) -> SecondOrder:
    """Return the slowest response that the recording allows, for loops faster than the recorded one.

    A short lag becomes dead time; twice the standard error and delay_s are added."""
    more = delay_s + 2.0 * model.uncertain_s
    if abs(complex(model.t1).imag) > 1e-12:
        return replace(model, theta_s=model.theta_s + more)
    t2, t1 = sorted((float(np.real(model.t1)), float(np.real(model.t2))))
    return replace(model, t1=t1, t2=min(SHORTEST_S, t2), theta_s=model.theta_s + t2 + more)


def tangent(model: SecondOrder) -> tuple[float, float, float]:
    """Return (K0, tau_d, tau_c) of the step response's steepest tangent.

    It cuts 0 at tau_d and K0 at tau_d + tau_c."""
    span = model.theta_s + 12 * max(abs(model.t1), abs(model.t2))
    t = np.linspace(0, span, 200_001)
    y = model.step(t) / model.gain
    slope = np.gradient(y, t)
    k = int(np.argmax(slope))
    return model.gain, float(t[k] - y[k] / slope[k]), float(1 / slope[k])


def imc(model: SecondOrder, lambda_s: float | None = None, derivative: bool = True) -> Gains:
    """Lambda tuning; `lambda_s` (closed-loop time constant) defaults to the dead time, Skogestad's choice."""
    theta = model.theta_s
    oscillates = abs(complex(model.t1).imag) > 1e-12
    t1, t2 = sorted((float(np.real(model.t1)), float(np.real(model.t2))), reverse=True)
    if not derivative:
        t1, t2, theta = t1 + t2 / 2, 0.0, theta + t2 / 2
    lam = theta if lambda_s is None else lambda_s
    if oscillates and derivative:
        wn2 = 1 / np.real(model.t1 * model.t2)
        two_zeta_wn = np.real(model.t1 + model.t2) * wn2
        ti, td = two_zeta_wn / wn2, 1 / two_zeta_wn
        return Gains(ti / (model.gain * (lam + theta)), ti, td, "IMC, oscillating plant", {"lambda_s": lam})
    ti = min(t1, 4 * (lam + theta))
    kc, td = t1 / (model.gain * (lam + theta)), t2
    return Gains(kc * (1 + td / ti), ti + td, ti * td / (ti + td), "IMC", {"lambda_s": lam})


@dataclass(frozen=True)
class Margins:
    """Margins of the sampled loop: gain (factor), phase deg, delay s; `stable`: of the closed loop."""

    gain: float
    phase_deg: float
    delay_s: float
    stable: bool


@functools.lru_cache(maxsize=16)
def _plant(model: SecondOrder, period_s: float, moving_average: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies w (K,), 1/s, up to half the sampling rate, and G(z) with the moving average (K,)."""
    w = np.geomspace(1e-2, np.pi / period_s, 8000)
    return w, plant_at(w, model, period_s, moving_average)


def plant_at(w: np.ndarray, model: SecondOrder, period_s: float, moving_average: int) -> np.ndarray:
    """Return G(z) with a zero-order hold and the moving average at frequencies w (K,), 1/s."""
    z = np.exp(1j * w * period_s)
    average = (
        np.ones_like(z) if moving_average == 1 else (1 - z**-moving_average) / (1 - 1 / z) / moving_average
    )
    return average * _held(model, w, period_s)


def controller_at(w: np.ndarray, gains: Gains, period_s: float) -> np.ndarray:
    """Return D(z) of PID (41) at frequencies w (K,), 1/s."""
    z = np.exp(1j * w * period_s)
    k, ti, td, ts = gains.kp, gains.ti_s, gains.td_s, period_s
    return k * ((1 + ts / ti + td / ts) - (1 + 2 * td / ts) / z + td / ts / z**2) / (1 - 1 / z)


def margins(model: SecondOrder, gains: Gains, period_s: float, moving_average: int = 1) -> Margins:
    """Return the margins of PID (41) at `period_s` on the model with a zero-order hold.

    The moving average of `moving_average` samples is included."""
    w, plant = _plant(model, period_s, moving_average)
    loop = controller_at(w, gains, period_s) * plant
    size, phase = np.abs(loop), np.unwrap(np.angle(loop))
    phase -= 2 * np.pi * np.round((phase[0] + np.pi / 2) / (2 * np.pi))
    cross = np.flatnonzero((size[:-1] >= 1) & (size[1:] < 1))
    if len(cross):
        pms = 180 + np.degrees(phase[cross])
        i = int(np.argmin(pms))
        pm, delay = float(pms[i]), float(np.radians(pms[i]) / w[cross[i]])
    else:
        pm, delay = np.inf, np.inf
    turn = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi))
    gm = float(1 / size[turn].max()) if len(turn) else np.inf
    return Margins(gm, pm, delay, gm > 1 and pm > 0)


def _held(model: SecondOrder, w: np.ndarray, period_s: float) -> np.ndarray:
    """Return G(z) with a zero-order hold on |z| = 1: G = (1 - 1/z) Z{step}, from the step's samples."""
    slowest = max(abs(model.t1), abs(model.t2))
    n = int(min(20_000, np.ceil((model.theta_s + 16 * slowest) / period_s) + 2))
    impulse = np.diff(model.step(np.arange(n + 1) * period_s))
    out = np.zeros(len(w), complex)
    z = np.exp(-1j * w * period_s)
    for h in impulse[::-1]:
        out = (out + h) * z
    return out


def share_of_margins(
    models: Sequence[SecondOrder], gains: Gains, period_s: float, moving_average: int
) -> float:
    """Return the smallest margin on any model as a share of the wanted one: 1 or more is good, 0 unstable."""
    by_model = [margins(m, gains, period_s, moving_average) for m in models]
    return min(min(m.phase_deg / WANTED_DEG, m.gain / WANTED_GAIN) if m.stable else 0.0 for m in by_model)


def robust(
    models: Sequence[SecondOrder], period_s: float, moving_average: int, derivative: bool = True
) -> Gains:
    """Return the fastest lambda tuning of the first model with the wanted margins on all of them.

    Raises InputError when none up to 1000 dead times has them."""
    for factor in np.geomspace(0.3, 1000, 60):
        g = imc(models[0], factor * max(models[-1].theta_s, period_s), derivative)
        if share_of_margins(models, g, period_s, moving_average) >= 1.0:
            return replace(
                g, how=f"IMC; at least {WANTED_DEG:g} deg phase and factor {WANTED_GAIN:g} gain margin"
            )
    raise InputError("no lambda tuning reaches the wanted margins on this model")


def within_factor(present: Gains, wanted: Gains) -> Gains:
    """Return the wanted gains, each within a factor of TRIAL_FACTOR of the present one."""
    kp, ti, td = (
        min(max(b, a / TRIAL_FACTOR), a * TRIAL_FACTOR) if a > 0.0 else b
        for a, b in zip(_three(present), _three(wanted), strict=True)
    )
    return replace(wanted, kp=kp, ti_s=ti, td_s=td)


def way(present: Gains, proposed: Gains) -> list[Gains]:
    """Return the gains of each step from the present to the proposed ones, the last included.

    No gain changes by more than LIVE_STEP in one step; a gain that is 0 stays 0."""
    a, b = np.array(_three(present)), np.array(_three(proposed))
    ratio = np.where((a > 0.0) & (b > 0.0), b / np.where(a > 0.0, a, 1.0), 1.0)
    n = max(1, int(np.ceil(np.abs(np.log(ratio)).max() / np.log(LIVE_STEP) - 1e-9)))
    steps = [a * ratio ** (k / n) for k in range(1, n)]
    return [
        *(replace(proposed, kp=kp, ti_s=ti, td_s=td) for kp, ti, td in map(np.ndarray.tolist, steps)),
        proposed,
    ]


def propose(
    models: Sequence[SecondOrder], present: Gains, wanted: Gains, period_s: float, moving_average: int = 1
) -> list[Gains]:
    """Return the steps from the present gains towards the wanted ones; the last is the proposal.

    No gain leaves TRIAL_FACTOR. Each step has the wanted margins on all models, or no smaller ones than
    the present gains; its kp is lowered where it must be. Raises InputError where that does not help."""
    least = min(1.0, share_of_margins(models, present, period_s, moving_average))
    target = _slower(models, present, within_factor(present, wanted), 1.0, period_s, moving_average)
    return [
        *(
            _slower(models, present, g, 0.99 * least, period_s, moving_average)
            for g in way(present, target)[:-1]
        ),
        target,
    ]


def _slower(
    models: Sequence[SecondOrder], present: Gains, gains: Gains, least: float, period_s: float, average: int
) -> Gains:
    """Lower kp, at most by TRIAL_FACTOR, until the share of the margins is `least`."""
    while share_of_margins(models, gains, period_s, average) < least:
        gains = replace(gains, kp=0.95 * gains.kp)
        if gains.kp < present.kp / TRIAL_FACTOR:
            raise InputError(
                f"no gains within a factor of {TRIAL_FACTOR:g} of the present ones have {WANTED_DEG:g} deg and a factor of "
                f"{WANTED_GAIN:g} of margin on this response: lower kp by hand, `thermoctl reload`, and run it again"
            )
    return gains


def _three(g: Gains) -> tuple[float, float, float]:
    return g.kp, g.ti_s, g.td_s


def difference(present: Gains, proposed: Gains) -> str:
    """Return the change as lines of text; nothing is written."""
    names = ("kp", "ti_s", "td_s")
    rows = zip(names, _three(present), _three(proposed), strict=True)
    return "\n".join(
        f"  {n:5s} {a:10.4g} -> {b:10.4g}   ({f'{100 * (b / a - 1):+.0f} %' if a else 'new' if b else 'stays'})"
        for n, a, b in rows
    )


def write(config: Path, proposed: Gains, axis: str = "") -> None:
    """Write kp, ti_s, td_s into a configuration. Raises InputError as `write_values`."""
    numbers = {"kp": proposed.kp, "ti_s": proposed.ti_s, "td_s": proposed.td_s}
    write_values(config, "control", {n: f"{v:.6g}" for n, v in numbers.items()}, axis)


def write_values(config: Path, section: str, values: dict[str, str], axis: str = "") -> None:
    """Write values into a section of a configuration; other lines and the comments stay.

    A value with a comment of its own, 'VALUE  # COMMENT', also replaces the old comment.
    axis: into the section of this axis; section and keys are added where the axis has none of its own.
    Raises InputError when the place has no lines of its own, or without an axis names no such key."""
    text = config.read_text(encoding="utf-8")
    place = ["axes", axis, section] if axis else [section]
    by_hand = ", ".join(f"{n}: {v}" for n, v in values.items())
    span = _body(text, place)
    if span is None and axis and (above := _body(text, place[:-1])) is not None:
        begin, _, indent = above
        if not re.search(rf"^{indent}{section}:", text[slice(*above[:2])], re.MULTILINE):
            head = f"{indent}{section}:\n"
            text = text[:begin] + head + text[begin:]
            span = begin + len(head), begin + len(head), indent + "  "
    if span is None:
        raise InputError(
            f"{config}: no section '{'.'.join(place)}' with lines of its own; write by hand: {by_hand}"
        )
    begin, end, indent = span
    body = text[begin:end]
    for name, value in reversed(values.items()):  # a new line goes before those that are there
        line = re.compile(rf"^({indent}{name}:[ \t]*)[^#\n]*?([ \t]*(?:#.*)?)$", re.MULTILINE)
        body, n = line.subn(rf"\g<1>{value}" + ("" if " #" in value else r"\g<2>"), body)
        if n == 0 and axis:
            body = f"{indent}{name}: {value}\n{body}"
        elif n != 1:
            raise InputError(
                f"{config}: {section}.{name} does not stand on a line of its own; write by hand: {by_hand}"
            )
    write_text(config, text[:begin] + body + text[end:])


def _body(text: str, place: Sequence[str]) -> tuple[int, int, str] | None:
    """Find the lines below a key of a YAML file: begin, end, their indent. None without such lines."""
    begin, end, indent = 0, len(text), ""
    for key in place:
        below = rf"^{indent}{key}:[ \t]*(?:#.*)?\n((?:{indent}[ \t]+.*\n|\s*\n|[ \t]*#.*\n)*)"
        match = re.compile(below, re.MULTILINE).search(text, begin, end)
        inner = match and re.search(r"^([ \t]+)[^\s#]", match[1], re.MULTILINE)
        if not (match and inner):
            return None
        begin, end, indent = match.start(1), match.end(1), inner[1]
    return begin, end, indent
