"""PID tuning: proposals, never written by themselves.

PID, velocity form (41): D(s) = Kp (1 + 1/(Ti s) + Td s) Ziegler-Nichols from the open-loop step (Table I): Kp
= 1.2 tau_c/(K0 tau_d), Ti = 2 tau_d, Td = 0.5 tau_d, with the tangent at the steepest point of the response.
The tangent is drawn on a fitted second-order response with dead time, not on the samples: the steepest
difference of noisy samples is too steep (0.15 um of noise: Kp 21 % low; fitted: 0.1 %).
Relay (Astrom and Hagglund): Ku = 4 d/(pi sqrt(a^2 - e^2)), Kp = 0.6 Ku, Ti = 0.5 Tu, Td = 0.125 Tu Lambda /
IMC (Rivera, Morari, Skogestad) for K0 e^(-s theta)/((t1 s + 1)(t2 s + 1)): series form Kc = t1/(K0 (lambda +
theta)), tI = t1, tD = t2 (half rule for what is faster than theta); parallel form Kp = Kc (1 + tD/tI), Ti =
tI + tD, Td = tI tD/(tI + tD) Margins: of the sampled loop L(e^jw) = D(z) G(z), G with a zero-order hold and
the dead time, moving average included.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from thermoctl.yamlfile import InputError


@dataclass(frozen=True)
class SecondOrder:
    """K0 e^(-s theta) / ((t1 s + 1)(t2 s + 1)), or oscillating: `t1`, `t2` are then complex conjugate.

    Gain in um per unit of drive."""

    gain: float
    t1: complex
    t2: complex
    theta_s: float
    residual: float = 0.0

    def step(self, t: np.ndarray) -> np.ndarray:
        """Response to a unit step at t = 0."""
        s = np.maximum(np.asarray(t, float) - self.theta_s, 0.0)
        t1, t2 = complex(self.t1), complex(self.t2)
        if abs(t1 - t2) < 1e-9 * abs(t1):
            t2 = t1 * (1 + 1e-6)
        y = 1 - (t1 * np.exp(-s / t1) - t2 * np.exp(-s / t2)) / (t1 - t2)
        return self.gain * np.real(y)

    def frequency(self, w: np.ndarray) -> np.ndarray:
        """G(jw)."""
        s = 1j * w
        return self.gain * np.exp(-s * self.theta_s) / ((self.t1 * s + 1) * (self.t2 * s + 1))


@dataclass(frozen=True)
class Gains:
    """Kp (drive per um), Ti s, Td s, and how they came about."""

    kp: float
    ti_s: float
    td_s: float
    how: str
    figures: dict[str, float] = field(default_factory=dict)


def fit_step(t_s: np.ndarray, y_um: np.ndarray, drive: float, at_s: float = 0.0) -> SecondOrder:
    """Second order with dead time fitted to a step response by least squares.

    t_s (N,), y_um (N,), step of `drive` at `at_s`.

    Raises InputError when there is no response to be seen."""
    t, y = np.asarray(t_s, float) - at_s, np.asarray(y_um, float)
    before = y[t < 0]
    y = y - (before.mean() if len(before) else y[0])
    t, y = t[t >= 0], y[t >= 0]
    if len(t) < 20:
        raise InputError(f"{len(t)} samples after the step; at least 20 are needed")
    final = y[-max(5, len(y) // 5) :].mean()
    noise = np.std(np.diff(y[-max(10, len(y) // 5) :])) / np.sqrt(2)
    if abs(final) < 5 * noise + 1e-12:
        raise InputError(
            f"the step moved the output by {final:.3g} um, its noise is {noise:.3g} um; give a larger step"
        )
    reach = t[np.argmax(np.abs(y) >= 0.632 * abs(final))] + (t[1] - t[0])

    def model(p: np.ndarray) -> SecondOrder:
        wn, zeta = np.exp(p[1]), np.exp(p[2])
        root = np.sqrt(complex(zeta**2 - 1))
        return SecondOrder(p[0] / drive, 1 / (wn * (zeta - root)), 1 / (wn * (zeta + root)), np.exp(p[3]))

    best: Any = None
    for zeta in (0.3, 1.01, 2.0):
        for dead in (0.02, 0.2, 0.5):
            start = [final, np.log(2 * max(zeta, 0.5) / reach), np.log(zeta), np.log(dead * reach)]
            r = optimize.least_squares(
                lambda p: model(p).step(t) * drive - y,
                start,
                max_nfev=100,
                bounds=([-np.inf, -30, -4, np.log(1e-3 * reach)], [np.inf, 30, 4, np.log(reach * 1.5)]),
            )
            if best is None or r.cost < best.cost:
                best = r
    m = model(best.x)
    return SecondOrder(float(m.gain), m.t1, m.t2, float(m.theta_s), float(np.sqrt(2 * best.cost / len(y))))


def tangent(model: SecondOrder) -> tuple[float, float, float]:
    """Return (K0, tau_d, tau_c) of the step response's steepest tangent.

    It cuts 0 at tau_d and K0 at tau_d + tau_c."""
    span = model.theta_s + 12 * max(abs(model.t1), abs(model.t2))
    t = np.linspace(0, span, 200_001)
    y = model.step(t) / model.gain
    slope = np.gradient(y, t)
    k = int(np.argmax(slope))
    return model.gain, float(t[k] - y[k] / slope[k]), float(1 / slope[k])


def ziegler_nichols(model: SecondOrder) -> Gains:
    """Table I from the fitted step response."""
    k0, tau_d, tau_c = tangent(model)
    return Gains(
        1.2 * tau_c / (k0 * tau_d),
        2 * tau_d,
        0.5 * tau_d,
        "Ziegler-Nichols, step (Table I)",
        {"K0": k0, "tau_d_s": tau_d, "tau_c_s": tau_c},
    )


def relay(t_s: np.ndarray, y_um: np.ndarray, amplitude: float, hysteresis_um: float = 0.0) -> Gains:
    """From a relay test's oscillation: `amplitude` d of the drive.

    Raises InputError when it did not oscillate steadily."""
    y = y_um - y_um.mean()
    tail = slice(len(y) // 3, None)
    t, y = np.asarray(t_s)[tail], y[tail]
    up = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    if len(up) < 4:
        raise InputError(
            f"{max(len(up) - 1, 0)} whole oscillations in the last two thirds of the relay test; at least 3 are needed"
        )
    crossing = t[up] - y[up] * (t[up + 1] - t[up]) / (y[up + 1] - y[up])
    periods = np.diff(crossing)
    if periods.std() > 0.1 * periods.mean():
        raise InputError("the relay's oscillation is not steady (its period varies by more than 10 %)")
    a = np.median([np.ptp(y[i:j]) / 2 for i, j in zip(up[:-1], up[1:], strict=True)])
    ku = 4 * amplitude / (np.pi * np.sqrt(max(a * a - hysteresis_um**2, 1e-300)))
    tu = float(periods.mean())
    return Gains(0.6 * ku, 0.5 * tu, 0.125 * tu, "relay", {"Ku": ku, "Tu_s": tu})


def imc(model: SecondOrder, lambda_s: float | None = None) -> Gains:
    """Lambda tuning; `lambda_s` (closed-loop time constant) defaults to the dead time, Skogestad's choice."""
    theta = model.theta_s
    if abs(complex(model.t1).imag) > 1e-12:
        wn2 = 1 / np.real(model.t1 * model.t2)
        two_zeta_wn = np.real(model.t1 + model.t2) * wn2
        ti, td = two_zeta_wn / wn2, 1 / two_zeta_wn
        lam = theta if lambda_s is None else lambda_s
        return Gains(ti / (model.gain * (lam + theta)), ti, td, "IMC, oscillating plant", {"lambda_s": lam})
    t1, t2 = sorted((float(np.real(model.t1)), float(np.real(model.t2))), reverse=True)
    lam = theta if lambda_s is None else lambda_s
    ti = min(t1, 4 * (lam + theta))
    kc, td = t1 / (model.gain * (lam + theta)), t2
    return Gains(kc * (1 + td / ti), ti + td, ti * td / (ti + td), "lambda / IMC", {"lambda_s": lam})


@dataclass(frozen=True)
class Margins:
    """Margins of the sampled loop: gain (factor), phase deg, delay s; `stable`: of the closed loop."""

    gain: float
    phase_deg: float
    delay_s: float
    stable: bool
    peak_sensitivity: float


def margins(model: SecondOrder, gains: Gains, period_s: float, moving_average: int = 1) -> Margins:
    """Margins of PID (41) at `period_s` on the model with a zero-order hold.

    The moving average of `moving_average` samples counted."""
    w = np.geomspace(1e-2, np.pi / period_s, 40_000)
    z = np.exp(1j * w * period_s)
    k, ti, td, ts = gains.kp, gains.ti_s, gains.td_s, period_s
    d = k * ((1 + ts / ti + td / ts) - (1 + 2 * td / ts) / z + td / ts / z**2) / (1 - 1 / z)
    average = (
        np.ones_like(z) if moving_average == 1 else (1 - z**-moving_average) / (1 - 1 / z) / moving_average
    )
    loop = d * average * np.array(_held(model, w, ts))
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
    return Margins(gm, pm, delay, gm > 1 and pm > 0, float(1 / np.abs(1 + loop).min()))


def _held(model: SecondOrder, w: np.ndarray, period_s: float) -> np.ndarray:
    """G(z) with a zero-order hold on |z| = 1, from the step response's samples: G = (1 - 1/z) Z{step}."""
    slowest = max(abs(model.t1), abs(model.t2))
    n = int(min(20_000, np.ceil((model.theta_s + 16 * slowest) / period_s) + 2))
    impulse = np.diff(model.step(np.arange(n + 1) * period_s))
    out = np.zeros(len(w), complex)
    z = np.exp(-1j * w * period_s)
    for h in impulse[::-1]:
        out = (out + h) * z
    return out


def robust(
    model: SecondOrder, period_s: float, moving_average: int = 1, phase_deg: float = 45.0, gain: float = 2.0
) -> Gains:
    """Return the fastest lambda tuning with at least these margins.

    Raises InputError when none up to 1000 dead times has them."""
    for factor in np.geomspace(0.3, 1000, 60):
        g = imc(model, factor * max(model.theta_s, period_s))
        m = margins(model, g, period_s, moving_average)
        if m.stable and m.phase_deg >= phase_deg and m.gain >= gain:
            return Gains(
                g.kp,
                g.ti_s,
                g.td_s,
                f"lambda / IMC with at least {phase_deg:g} deg and factor {gain:g}",
                {**g.figures, "gain_margin": m.gain, "phase_margin_deg": m.phase_deg},
            )
    raise InputError("no lambda tuning reaches the wanted margins on this model")


def difference(present: Gains, proposed: Gains) -> str:
    """Return the change as lines of text, for people; nothing is written."""
    rows = [
        ("kp", present.kp, proposed.kp),
        ("ti_s", present.ti_s, proposed.ti_s),
        ("td_s", present.td_s, proposed.td_s),
    ]
    return "\n".join(
        f"  {n:5s} {a:10.4g} -> {b:10.4g}   ({100 * (b / a - 1) if a else float('inf'):+.0f} %)"
        for n, a, b in rows
    )


def write(config: Path, proposed: Gains) -> None:
    """Write kp, ti_s, td_s into the control section of a configuration, other lines untouched.

    On request only.

    Raises InputError when the section does not name all three on lines of their own."""
    text = config.read_text(encoding="utf-8")
    section = re.search(r"^control:.*\n((?:[ \t]+.*\n|\s*\n|#.*\n)*)", text, re.MULTILINE)
    if section is None:
        raise InputError(
            f"{config}: no section 'control' with lines of its own; write kp, ti_s, td_s by hand"
        )
    body = section.group(1)
    for name, value in (("kp", proposed.kp), ("ti_s", proposed.ti_s), ("td_s", proposed.td_s)):
        body, n = re.subn(
            rf"^([ \t]+{name}:[ \t]*)[^#\n]*?([ \t]*(?:#.*)?)$",
            rf"\g<1>{value:.6g}\g<2>",
            body,
            flags=re.MULTILINE,
        )
        if n != 1:
            raise InputError(
                f"{config}: control.{name} does not stand on a line of its own; write it by hand: {value:.6g}"
            )
    temporary = config.with_name(f".{config.name}.writing")
    temporary.write_text(text[: section.start(1)] + body + text[section.end(1) :], encoding="utf-8")
    os.replace(temporary, config)
