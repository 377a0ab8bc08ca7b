"""What a loop of tests/tune/rig.py is really like: stability, margins and speed, without the product's law, fit or margins.

The PID (41) and the plant are computed here anew, in sampled time with the true dead time, command period, skipped and late ticks.
The loop is linear, so it is stable when a disturbance's trace dies away. Its gain margin is the factor on kp, its delay margin the
extra dead time, at which it no longer does.
"""

import math

import numpy as np

from tests.tune.rig import late_ticks

LONGEST_S = 3.0  # of a trace
FACTORS = np.concatenate(([1.0], np.geomspace(1.02, 8.0, 60)))


def trace(truth, kp, ti_s, td_s, delay_s=0.0, seconds=LONGEST_S, load=0.0, seed=0):
    """Positions (ticks, V) of V loops with gains kp (V,), without noise, after a kick or under a constant load on the drive."""
    kp = np.atleast_1d(np.asarray(kp, float))
    x1, x2, u, v, e1, d1 = (np.zeros_like(kp) for _ in range(6))
    if not load:
        x1[:] = x2[:] = 1.0 / truth.gain
    waiting, now, sent, before = [], 0.0, -math.inf, 0.0
    dead = truth.dead_s + delay_s
    out, times = [], []
    for at, _, _ in late_ticks(truth, np.random.default_rng([seed, 77])):
        if at > seconds:
            break
        while waiting and waiting[0][0] <= at:
            when, new = waiting.pop(0)
            x1, x2 = _moved(truth, x1, x2, u + load, when - now)
            now, u = when, new
        x1, x2 = _moved(truth, x1, x2, u + load, at - now)
        now = at
        y = truth.gain * x2
        dt, before = at - before, at
        e = -y
        d = (e - e1) / dt
        v = v + kp * ((e - e1) + dt / ti_s * e + td_s * (d - d1))
        e1, d1 = e, d
        if at >= sent + 1.0 / truth.command_hz:
            sent = at
            waiting.append((at + dead, v))
        out.append(y)
        times.append(at)
        if np.abs(y).min() > 1e9:  # all of them diverge
            break
    return np.array(times), np.array(out)


def _moved(truth, x1, x2, u, dt):
    if dt <= 0.0:
        return x1, x2
    t1, t2 = truth.t1_s, truth.t2_s
    a, b = math.exp(-dt / t1), math.exp(-dt / t2)
    d1 = x1 - u
    return u + d1 * a, u + (x2 - u) * b + d1 * t1 / (t1 - t2) * (a - b)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def stable(truth, kp, ti_s, td_s, delay_s=0.0):
    """Of each loop (V,), whether its trace dies away: the last third has less energy than the second."""
    t, y = trace(truth, kp, ti_s, td_s, delay_s)
    if t[-1] < 0.9 * LONGEST_S:
        return np.zeros(y.shape[1], bool)
    part = [
        np.sqrt((y[(t > a * LONGEST_S) & (t <= b * LONGEST_S)] ** 2).mean(0))
        for a, b in ((0, 0.05), (1 / 3, 2 / 3), (2 / 3, 1))
    ]
    return np.isfinite(part[2]) & ((part[2] < part[1]) | (part[2] < 1e-6 * part[0]))


def margins(truth, kp, ti_s, td_s):
    """(gain margin, delay margin s: infinite from 0.1 on) of the true loop; (0, 0) when it is unstable."""
    ok = stable(truth, kp * FACTORS, ti_s, td_s)
    if not ok[0]:
        return 0.0, 0.0
    gain = FACTORS[int(np.argmin(ok)) - 1] if not ok.all() else FACTORS[-1]
    low, high = 0.0, 0.1
    for _ in range(10):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(truth, [kp], ti_s, td_s, middle)[0] else (low, middle)
    return float(gain), low if high < 0.1 else math.inf


def phase_deg(truth, kp, ti_s, td_s, delay_s):
    """The phase margin that a delay margin is: 360 f delay, f the largest frequency with |L| = 1, by the continuous plant."""
    w = np.geomspace(0.1, math.pi / truth.period_s, 20000)
    s = 1j * w
    size = np.abs(
        kp * (1 + 1 / (ti_s * s) + td_s * s) * truth.gain / ((truth.t1_s * s + 1) * (truth.t2_s * s + 1))
    )
    over = np.flatnonzero(size >= 1)
    return math.degrees(w[over[-1]] * delay_s) if len(over) else math.inf


def load_error(truth, kp, ti_s, td_s):
    """Integral of |position| over 1 s under a constant load of one drive unit, um s: how fast the loop is."""
    t, y = trace(truth, [kp], ti_s, td_s, seconds=1.0, load=1.0)
    return float(np.sum(np.abs(y[:-1, 0]) * np.diff(t)))
