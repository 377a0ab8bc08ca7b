"""Checks of one recording by itself: gaps, repeated and resampled data, columns that do not move.

If an input changes in most rows, the plant file should state whether it is held or linear between rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import gcd, log

import numpy as np

from thermoctl.checks.finding import Finding
from thermoctl.checks.hung import ALARM, FEW, quantum
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting import refit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Input
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

SIGMAS = 6.0
FREE = 12  # iterations of the refit that tests whether the plant moves like this without its inputs
JOINED = 0.45  # largest other step of a counter that overflows, over its period: from 0.5 on nothing joins it
TURNS = 0.7  # share of overflows with motion on both sides; at the others it turns round or stands
SLOWS = 0.25  # a body comes to rest if its last steps are below this share of its mean step


def data_findings(model: Model, table: Table, excitation: Excitation) -> list[Finding]:
    """Check the columns that the plant reads."""
    if len(table.t) < FEW:
        rows = f"{len(table.t)} row{'s' * (len(table.t) != 1)}"
        what, advice = f"{rows}, of which nothing is checked", f"Give {FEW} or more."
        return [Finding("few", table.path, what, advice, severe=False)]
    findings = _gaps(model, table, excitation)
    read = [i for i in model.plant.readings() if i.column in table.columns]
    for item in read:
        there = np.isfinite(table.columns[item.column])
        values = table.columns[item.column][there]
        if not there.any():
            what = f"column '{item.column}' has no value at all"
            advice = f"Check how '{item.name}' was logged."
            findings.append(Finding("empty", table.path, what, advice, severe=False))
        elif len(values) >= FEW and item.name in model.plant.outputs:
            # A periodic input repeats by itself; measured noise does not.
            findings += _copies(table, item.column, values, table.t[there])
            findings += _resampled(table, item.column, values)
    try:
        simulated = model.run(excitation).y
    except SimulationError:
        return findings
    return (
        findings + _between(model, table, excitation, simulated) + _dead(model, table, excitation, simulated)
    )


def _gaps(model: Model, table: Table, excitation: Excitation) -> list[Finding]:
    """Report intervals without samples, beyond the longest of as many random (exponential) ones.

    Of n such intervals with median m, one is longer than m log2(n / ALARM) with probability ALARM. Intervals
    that a logger leaves on purpose (more than one in a hundred) are its sampling. A gap in which a held input
    changed is severe: the wrong time of the change would be taken for physics."""
    steps = np.diff(table.t)
    if len(steps) < FEW:
        return []
    limit = float(np.median(steps)) * log(len(steps) / ALARM) / log(2)
    long = np.flatnonzero(steps > limit)
    if not 0 < len(long) <= max(1, len(steps) // 100):
        return []
    k = long[np.argmax(steps[long])]
    u = dict(zip(model.inputs, excitation.u.T, strict=False))
    held = [i for i in driving_inputs(model.plant) if not i.linear]
    changed = [i.column for i in held if np.any(u[i.name][long] != u[i.name][long + 1])]
    unknown = f"; {', '.join(map(repr, changed))} changed meanwhile" if changed else ""
    more = f" and {len(long) - 1} more" if len(long) > 1 else ""
    what = (
        f"no samples from t = {table.t[k]:.6g} to {table.t[k + 1]:.6g} s{more}; they are "
        f"{np.median(steps):.3g} s apart elsewhere{unknown}"
    )
    advice = "The inputs are unknown there: cut the recording at the gap and give both parts."
    return [Finding("gap", table.path, what, advice, severe=bool(changed))]


def _between(model: Model, table: Table, excitation: Excitation, held: np.ndarray) -> list[Finding]:
    """Find inputs that change in most rows, if the plant file does not say whether they are held or linear.

    Linear interpolation would change the simulated readings. Half the energy of this change, in the noise, is
    the largest possible gain in log likelihood. It has to exceed -log(ALARM)."""
    moving = {n for n, u in zip(model.inputs, excitation.u.T, strict=False) if np.mean(np.diff(u) != 0) > 0.5}
    loose = [i for i in driving_inputs(model.plant) if i.name in moving and not i.stated]
    if not loose:
        return []
    straight = {i.name: replace(i, linear=True) for i in loose}
    lines = compile_plant(replace(model.plant, inputs={**model.plant.inputs, **straight}))
    try:
        moved = lines.run(lines.excitation(table)).y - held
    except SimulationError:
        return []
    moved = moved / [n.sigma for n in default_noise(model.plant, [excitation])]
    moved = moved[np.isfinite(excitation.y)]
    if 0.5 * float(np.sum(moved**2)) <= -log(ALARM):
        return []
    names = ", ".join(f"'{i.name}'" for i in loose)
    what = (
        f"no word on how an input goes on between rows, where it changes in most of them: {names}. It is held; straight "
        f"lines would move the readings by up to {np.abs(moved).max():.2g} times their noise"
    )
    advice = (
        "State between_samples in the plant file: linear for what is measured, hold for what a drive holds."
    )
    return [Finding("between", table.path, what, advice, severe=False)]


def _resampled(table: Table, column: str, values: np.ndarray) -> list[Finding]:
    """Find readings that change at every k-th sample only, or on straight lines between them.

    Straight lines between readings are severe: no sensor makes them. Changes at free instants are all
    multiples of k apart with probability k^(1 - changes)."""
    step = quantum(values)
    if not np.isfinite(step):
        return []
    for difference, tolerance, how in ((1, 0.0, "held"), (2, 2.001 * step, "interpolated")):
        jumps = np.flatnonzero(np.abs(np.diff(values, difference)) > tolerance)
        if len(jumps) < FEW or (difference == 2 and np.ptp(values) < 100 * step):
            continue
        every = gcd(*np.diff(jumps).tolist())
        if every > 1 and (len(jumps) - 1) * log(every) > -log(ALARM):
            what = (
                f"'{column}' is {how} between every {every}th sample: its {len(values)} values hold "
                f"{len(values) // every} readings"
            )
            advice = "Leave the cells between two readings empty; else their errors count several times."
            return [Finding("resampled", table.path, what, advice, severe=difference > 1)]
    return []


def _copies(table: Table, column: str, values: np.ndarray, t: np.ndarray) -> list[Finding]:
    """Find a stretch of noisy readings that occurs twice.

    Two independent second differences of noise agree with the probability of their commonest value. Smooth
    or coarse readings repeat by themselves and are left out."""
    second = np.round(np.diff(values, 2) / max(quantum(values), 1e-300))
    if not np.isfinite(second).all() or len(second) < FEW:
        return []
    _, counts = np.unique(second, return_counts=True)
    likeliest = float(counts.max()) / len(second)
    moving = np.abs(second) > 2
    if likeliest > 0.2 or moving.mean() < 0.5:
        return []
    length = max(FEW, int(np.ceil((2 * log(len(second)) - log(ALARM)) / -log(likeliest))))
    seen: dict[bytes, int] = {}
    still = np.concatenate([[0], np.cumsum(np.diff(values) == 0)])
    for k in range(len(second) - length + 1):
        if still[k + length + 1] > still[k]:  # a reading at its limit repeats by itself
            continue
        key = np.ascontiguousarray(values[k : k + length + 2]).tobytes()
        first = seen.setdefault(key, k)
        if k - first >= length:
            what = f"'{column}' from t = {t[k]:.6g} s on repeats its readings from {t[first]:.6g} s, digit for digit"
            advice = "Part of the file was copied twice: cut it out."
            return [Finding("repeated", table.path, what, advice)]
    return []


def _dead(model: Model, table: Table, excitation: Excitation, run: np.ndarray) -> list[Finding]:
    """Find readings that stand still while the plant moves, and inputs that never move."""
    findings = []
    noises = default_noise(model.plant, [excitation])
    sds = [float(np.hypot(o.noise_sd, (o.resolution or 0.0) / 12**0.5)) for o in model.plant.outputs.values()]
    for j, (o, noise) in enumerate(zip(model.plant.outputs.values(), noises, strict=True)):
        there = np.isfinite(excitation.y[:, j])
        y, simulated = excitation.y[there, j], run[there, j]
        if len(y) < FEW or not np.isfinite(simulated).all():
            continue
        sd = sds[j]
        if np.ptp(y) == 0 and np.ptp(simulated) > SIGMAS * max(sd, 1e-3 * np.ptp(simulated)):
            what = (
                f"'{o.column}' stands at {y[0]:.6g} throughout; the plant moves it by {np.ptp(simulated):.3g}"
            )
            advice = "Is the sensor connected, and is it this column?"
            findings.append(Finding("still", table.path, what, advice))
            continue
        findings += _stuck(table, o.column, y, simulated, table.t[there], max(sd, noise.sigma))
        findings += _wrapped(table, o.column, y, simulated, table.t[there], o.unit or "")
    scales = [max(sd, noise.sigma) for sd, noise in zip(sds, noises, strict=True)]
    driving = [
        i
        for i in driving_inputs(model.plant)
        if i.role != "ambient" and not (i.role is None and i.unit in ("degC", "K", "degF"))
    ]
    dead = driving and not any(moves(table, i.column) for i in driving)
    if dead and not _follows(excitation.y, run, scales) and not _by_itself(model, excitation, scales):
        names = ", ".join(f"'{i.column}'" for i in driving)
        what = f"no input moves ({names}), but the readings do, far beyond the plant"
        advice = "Was the right column logged? Without the inputs any effect could be named."
        findings.append(Finding("still", table.path, what, advice))
    return findings


def _follows(y: np.ndarray, run: np.ndarray, scales: Sequence[float]) -> bool:
    """Return whether a run (N, outputs) explains half of the variance of readings that move."""
    explained = total = 0.0
    for j, scale in enumerate(scales):
        there = np.isfinite(y[:, j])
        if (
            there.sum() >= FEW
            and np.isfinite(run[there, j]).all()
            and np.ptp(y[there, j]) > 2 * SIGMAS * scale
        ):
            total += float(np.var(y[there, j])) / scale**2
            explained += float(np.var(y[there, j]) - np.var(y[there, j] - run[there, j])) / scale**2
    return explained >= 0.5 * total


def _by_itself(model: Model, excitation: Excitation, scales: Sequence[float]) -> bool:
    """Return whether the plant moves like this without its inputs, by ringing or cooling from its start."""
    try:
        fitted = refit.fit(model, [excitation], iterations=FREE)
    except (SimulationError, InputError):
        return False
    return _follows(excitation.y, excitation.y - fitted.residuals[0], scales)


def driving_inputs(plant: Plant) -> list[Input]:
    """Return the inputs that a flow, an output or a storage reads; others only set initial states."""
    read = [f.rate for f in plant.flows.values()] + [o.value for o in plant.outputs.values()]
    names = set().union(*(ex.names(e) for e in [*read, *(n.storage for n in plant.nodes.values())]))
    return [i for i in plant.inputs.values() if i.name in names]


def moves(table: Table, column: str) -> bool:
    """Return whether a column has two different values."""
    return bool(np.nanmax(table.columns[column]) > np.nanmin(table.columns[column]))


def _wrapped(
    table: Table, column: str, y: np.ndarray, simulated: np.ndarray, t: np.ndarray, unit: str
) -> list[Finding]:
    """Find a counter that overflows, or an angle that begins again: leaps by a period against the motion.

    Noise alone leaps as far as it reaches: the other steps have to be far below the period. Stick-slip and
    siphons leap, too. So the period has to be a turn or a power of two of the readings' step, or the leaps go
    both ways. A leap that is taken back at once is a bad reading."""
    steps = np.diff(y)
    far = np.flatnonzero(np.abs(steps) > 0.5 * np.ptp(y))
    far = far[(far > 0) & (far < len(steps) - 1) & ~np.isin(far - 1, far) & ~np.isin(far + 1, far)]
    if not 0 < len(far) <= len(steps) // FEW or np.abs(np.diff(simulated)).max() > 0.5 * np.ptp(y):
        return []
    before, after, leaps = steps[far - 1], steps[far + 1], steps[far]
    periods = np.abs(leaps - (before + after) / 2)
    error = float(np.abs(np.delete(steps, far)).max(initial=0.0))
    against = np.sign(before) == np.sign(after)
    against &= np.sign(before) == -np.sign(leaps)
    period = float(np.median(periods))
    if against.mean() < TURNS or np.ptp(periods) > 2 * error or not error <= JOINED * period:
        return []
    if period < np.ptp(y) - error:
        return []
    bits = quantum(y) * 2.0 ** round(log(period / quantum(y), 2))
    turn = {"deg": 360.0, "rad": 2 * np.pi}.get(unit, np.inf)
    both = leaps.min() < 0 < leaps.max()
    sure = [size for size in (bits, turn) if abs(period - size) <= min(error, 0.01 * size)]
    if not (sure or both):
        return []
    period = sure[0] if sure else period
    what = f"'{column}' leaps {len(far)} times by {period:.6g} against its motion, first after t = {t[far[0]]:.6g} s"
    advice = f"A counter that overflows? Join it: numpy.unwrap(values, period={period:.6g})."
    return [Finding("wrapped", table.path, what, advice)]


def _stuck(
    table: Table, column: str, y: np.ndarray, simulated: np.ndarray, t: np.ndarray, sd: float
) -> list[Finding]:
    """Find runs of one value, the longest first, that are too long for chance while the plant moves.

    At the end of the readings' range it is a sensor at its limit, which is physics. So is a body at rest: it
    comes to rest slowly, and leaves without a jump."""
    if len(y) <= FEW:
        return []
    edges = np.flatnonzero(np.diff(y) != 0)
    begins, ends = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(y) - 1]])
    k = int(np.argmax(ends - begins))
    a, b = int(begins[k]), int(ends[k])
    length = b - a
    steps = np.abs(np.diff(y))
    if b == len(y) - 1:
        before = y[max(a - 1 - length, 0) : a]
        slows = np.mean(steps[max(a - FEW, 0) : a]) <= SLOWS * np.mean(steps[:a])
        if slows or np.ptp(before) <= 2 * SIGMAS * sd:
            return _stuck(table, column, y[:a], simulated[:a], t[:a], sd) if a > FEW else []
    rest = max(len(y) - 1 - length, 1)
    same = max((len(y) - 1 - len(edges) - length) / rest, 1 / (len(y) + 1))
    # Two readings of a body at rest agree with probability q / (2 sqrt(pi) sd), q the step of the readings.
    resting = 1.4826 * float(np.median(np.abs(np.diff(y, 2)))) / 6**0.5
    same = max(same, quantum(y) / (2 * np.pi**0.5 * max(min(sd, resting), 1e-300)))
    if same > 0.5 or length < FEW or y[a] in (y.min(), y.max()):
        return []
    if length * -log(same) < log(len(y) / ALARM) or np.ptp(simulated[a : b + 1]) < 2 * SIGMAS * sd:
        return []
    others = np.concatenate([[0.0], steps[: max(a - 1, 0)], steps[b + 1 :]])
    if b < len(y) - 1 and steps[b] <= max(2 * SIGMAS * sd, np.quantile(others, 0.99)):
        return []
    what = f"'{column}' stands at {y[a]:.6g} from t = {t[a]:.6g} to {t[b]:.6g} s while the plant moves"
    advice = "The sensor or its bus hung: empty those cells, or cut the recording."
    others = np.delete(np.arange(len(y)), np.s_[a : b + 1])
    more = _stuck(table, column, y[others], simulated[others], t[others], sd)
    return [Finding("stuck", table.path, what, advice), *more]
