"""Experiments: setpoint, or inputs of any rig, over time, read from a file.

An experiment has `parts`, which build a setpoint, or `inputs`: corners for each column of a recording. If the
only input is setpoint_um, it is a schedule and runs on the daemon's tick. For another rig, a person runs it
from the CSV beside it, or a plant file simulates it.

A schedule is a list of (seconds, um) corners, joined by straight lines; the law's rate limiter makes the
ramps. It runs under all protections and gives a recording. A fault ends it, nothing recorded is lost, and it
can be resumed where it stopped.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from pathlib import Path

import numpy as np

from thermoctl.files.yamlfile import InputError, Node, Section, load

FORMAT = "thermoctl-experiments/1"
MAX_CORNERS = 100_000  # largest number of corners of a schedule: no person wrote more
SETPOINT = "setpoint_um"


@dataclass(frozen=True)
class Schedule:
    """Corners t_s (K,) and setpoint_um (K,), ends at duration_s."""

    name: str
    title: str
    t_s: np.ndarray
    setpoint_um: np.ndarray
    duration_s: float

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """Return the setpoint at times; the rate limiter makes the ramps."""
        return np.interp(t_s, self.t_s, self.setpoint_um)

    def commands(self) -> list[tuple[float, str, float]]:
        """Return (time s, 'setpoint', um) for the daemon: the target of every ramp at the ramp's start."""
        out, now = [], None
        for k in range(len(self.t_s) - 1):
            target = float(self.setpoint_um[k + 1])
            if target != now:
                out.append((float(self.t_s[k]), "setpoint", target))
                now = target
        return out


@dataclass(frozen=True)
class Inputs:
    """An experiment that drives inputs of a rig.

    `corners`: column to (K, 2) of seconds and value, joined by straight lines up to duration_s and sampled
    every sample_s. `assumed`: values of the columns that are not driven. `predicted`: lowest and highest
    value of each reading by the diagnosis."""

    name: str
    title: str
    corners: dict[str, np.ndarray]
    assumed: dict[str, float]
    sample_s: float
    duration_s: float
    predicted: dict[str, tuple[float, float]]

    def schedule(self) -> Schedule:
        """Return it as a schedule for the daemon. Raises InputError if it drives more than the setpoint."""
        if set(self.corners) != {SETPOINT}:
            raise InputError(
                f"experiment '{self.name}' drives {', '.join(self.corners)}; the daemon commands {SETPOINT} only. Run it "
                "by hand from the CSV beside it, or give a plant file in the rig's place (--plant)"
            )
        t, v = self.corners[SETPOINT].T
        return Schedule(self.name, self.title, t, v, self.duration_s)

    def columns(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return times (N,) every sample_s, and each column over them."""
        t = np.arange(int(np.floor(self.duration_s / self.sample_s + 1e-9)) + 1) * self.sample_s
        return t, {
            **{n: np.full(len(t), v) for n, v in self.assumed.items()},
            **{n: np.interp(t, c[:, 0], c[:, 1]) for n, c in self.corners.items()},
        }


def load_inputs(path: str | Path) -> dict[str, Inputs]:
    """Return the experiments of a file that list inputs. Raises InputError with the line of a wrong entry."""
    return {
        n: _inputs(n, node)
        for n, node in _head(load(path)).items()
        if isinstance(node.value, dict) and "inputs" in node.value
    }


def _head(root: Node) -> dict[str, Node]:
    """Return the file's experiments, its keys and format checked."""
    top = _keys(root, "the file", {"format", "experiments"}, {"rate_um_s"})
    if top["format"].value != FORMAT:
        raise top["format"].error(f"'{FORMAT}' was expected")
    if not isinstance(top["experiments"].value, dict) or not top["experiments"].value:
        raise top["experiments"].error("a mapping of experiments by name was expected")
    return top["experiments"].value


def _inputs(name: str, node: Node) -> Inputs:
    e = _keys(node, f"experiment '{name}'", {"title", "inputs", "sample_s"}, {"assumed", "predicted"})
    if not isinstance(e["inputs"].value, dict) or not e["inputs"].value:
        raise e["inputs"].error("a mapping of columns with `corners` each was expected")
    corners = {}
    for column, entry in e["inputs"].value.items():
        points = _keys(entry, f"input '{column}'", {"corners"}, {"unit"})["corners"]
        pairs = points.value if isinstance(points.value, list) else []
        if len(pairs) < 2 or any(not isinstance(q.value, list) or len(q.value) != 2 for q in pairs):
            raise points.error(f"input '{column}': two or more corners [seconds, value] were expected")
        made = np.array([[_number(q.value[0], 0, 1e9), _number(q.value[1], -1e12, 1e12)] for q in pairs])
        late = int(np.argmax(np.diff(made[:, 0]) <= 0)) + 1
        if made[0, 0] != 0 or np.any(np.diff(made[:, 0]) <= 0):
            raise pairs[late if made[0, 0] == 0 else 0].error(
                f"input '{column}': times must begin at 0 and increase"
            )
        corners[column] = made
    ends = {c: float(made[-1, 0]) for c, made in corners.items()}
    if max(ends.values()) - min(ends.values()) > 1e-9 * max(ends.values()):
        raise e["inputs"].error(
            "all inputs must end at the same time; they end at "
            + ", ".join(f"{c} {t:g} s" for c, t in ends.items())
        )
    assumed = e["assumed"].value if "assumed" in e else {}
    if not isinstance(assumed, dict):
        raise e["assumed"].error("a mapping of columns to numbers was expected")
    predicted = {}
    for column, entry in Section(e["predicted"], "predicted").node.value.items() if "predicted" in e else ():
        if not isinstance(entry.value, list) or len(entry.value) != 2:
            raise entry.error(f"predicted '{column}': [lowest, highest] was expected")
        low, high = (_number(v, -1e12, 1e12) for v in entry.value)
        predicted[column] = (low, high)
    duration = max(ends.values())
    return Inputs(
        name,
        str(e["title"].value),
        corners,
        {c: _number(v, -1e12, 1e12) for c, v in assumed.items()},
        _number(e["sample_s"], duration * 1e-7, duration),
        duration,
        predicted,
    )


def load_experiments(path: str | Path) -> dict[str, Schedule]:
    """Read the schedules of an experiment file by name.

    Raises InputError with the line of a wrong entry."""
    root = load(path)
    entries = _head(root)
    out = {}
    for name, node in entries.items():
        if isinstance(node.value, dict) and "inputs" in node.value:
            out[name] = _inputs(name, node).schedule()
            continue
        e = _keys(node, f"experiment '{name}'", {"title", "parts"})
        if "rate_um_s" not in root.value:
            raise root.error("the file: 'rate_um_s' is missing, the rate at which parts are joined")
        rate = _number(root.value["rate_um_s"], 0.01, 1e5)
        corners = [(0.0, 0.0)]
        _parts(e["parts"], rate, corners)
        t, v = np.array(corners).T
        out[name] = Schedule(name, str(e["title"].value), t, v, float(t[-1]))
    return out


def _parts(node: Node, rate: float, corners: list[tuple[float, float]]) -> None:
    if not isinstance(node.value, list) or not node.value:
        raise node.error("a list of parts was expected: hold, trapezoid, pulses or repeat")
    for part in node.value:
        kind = next((k for k in _PARTS if k in (part.value if isinstance(part.value, dict) else {})), None)
        if kind is None:
            raise part.error(f"a part is one of {', '.join(_PARTS)}")
        _PARTS[kind](part, rate, corners)
        if len(corners) > MAX_CORNERS:
            raise part.error(f"more than {MAX_CORNERS} corners up to here: fewer repetitions were expected")


def _repeat(part: Node, rate: float, corners: list[tuple[float, float]]) -> None:
    p = _keys(part, "a repeated part", {"repeat", "parts"})
    for _ in range(int(_number(p["repeat"], 1, 1000))):
        _parts(p["parts"], rate, corners)


def _holds(part: Node, rate: float, corners: list[tuple[float, float]]) -> None:
    _keys(part, "a part", {"hold"})
    for pair in Section(part, "a part").list("hold"):
        if not isinstance(pair.value, list) or len(pair.value) != 2:
            raise pair.error("[seconds, um] was expected")
        _hold(corners, _number(pair.value[0], 0, 1e6), _number(pair.value[1], -1e6, 1e6), rate)


def _trapezoid(part: Node, rate: float, corners: list[tuple[float, float]]) -> None:
    z = _keys(part.value["trapezoid"], "trapezoid", {"low_um", "high_um", "hold_s", "duration_s"})
    low, high, duration = (_number(z[k], -1e6, 1e6) for k in ("low_um", "high_um", "duration_s"))
    holds = [_number(h, 0, 1e6) for h in Section(part.value["trapezoid"], "trapezoid").list("hold_s")]
    once = 2 * sum(holds) + 2 * len(holds) * abs(high - low) / rate
    if once * MAX_CORNERS < duration:
        raise z["hold_s"].error(
            f"hold_s: seconds were expected that fill duration_s within {MAX_CORNERS} turns"
        )
    end = corners[-1][0] + duration
    for hold in cycle(holds):
        if corners[-1][0] + 2 * hold + 2 * abs(high - low) / rate > end + 1e-9:
            break
        _hold(corners, hold + abs(high - corners[-1][1]) / rate, high, rate)
        _hold(corners, hold + abs(low - corners[-1][1]) / rate, low, rate)
    if corners[-1][0] < end:
        _hold(corners, end - corners[-1][0], low, rate)


def _pulses(part: Node, rate: float, corners: list[tuple[float, float]]) -> None:
    z = _keys(part.value["pulses"], "pulses", {"count", "high_um", "active_s", "cutoff_hz", "least_s"})
    widths, gaps = design_pulses(
        int(_number(z["count"], 1, 6)),
        _number(z["active_s"], 10, 1e6),
        _number(z["cutoff_hz"], 1e-6, 10),
        _number(z["least_s"], 1, 1e6),
    )
    for width, gap in zip(widths, gaps, strict=True):
        _hold(corners, width, _number(z["high_um"], -1e6, 1e6), rate)
        _hold(corners, gap, 0.0, rate)


_PARTS = {"hold": _holds, "trapezoid": _trapezoid, "pulses": _pulses, "repeat": _repeat}
"""A part of a schedule by its key; each appends its corners (s, um)."""


def _hold(corners: list[tuple[float, float]], seconds: float, value: float, rate: float) -> None:
    """Go to `value` at the rate limit, then stay until `seconds` have passed."""
    t, now = corners[-1]
    ramp = min(abs(value - now) / rate, seconds)
    if ramp > 0:
        corners.append((t + ramp, value))
    if seconds > ramp:
        corners.append((t + seconds, value))


def design_pulses(
    count: int, active_s: float, cutoff_hz: float, least_s: float
) -> tuple[list[float], list[float]]:
    """Return widths and gaps of `count` power pulses that fill `active_s`, none shorter than `least_s`.

    They maximise the geometric mean of the alternating power in four bands below `cutoff_hz`. Raises
    InputError when they do not fit."""
    unit = active_s / (4 * count)
    lengths = [v for v in (0.5 * unit, unit, 1.5 * unit, 2 * unit, 3 * unit, 4 * unit) if v >= least_s]
    best, pulses = -np.inf, None
    for parts in product(lengths, repeat=2 * count):
        if abs(sum(parts) - active_s) > 1e-6 * active_s:
            continue
        power = _pulse_power(parts[::2], parts[1::2], np.geomspace(cutoff_hz / 10, cutoff_hz, 24))
        above = _pulse_power(
            parts[::2], parts[1::2], np.geomspace(cutoff_hz * 1.05, cutoff_hz * 5, 24)
        ).mean()
        score = np.log(power.reshape(4, 6).mean(1)).mean() - 0.5 * np.log(above)
        if score > best + 1e-12:
            best, pulses = score, parts
    if pulses is None:
        raise InputError(f"{count} pulses of at least {least_s:g} s with gaps do not fit into {active_s:g} s")
    return list(pulses[::2]), list(pulses[1::2])


def _pulse_power(widths: Sequence[float], gaps: Sequence[float], f: np.ndarray) -> np.ndarray:
    """Return |Fourier transform|^2 of rectangular pulses of height 1 at frequencies f."""
    total, t = np.zeros(len(f), complex), 0.0
    for w, g in zip(widths, gaps, strict=True):
        total += (np.exp(-2j * np.pi * f * t) - np.exp(-2j * np.pi * f * (t + w))) / (2j * np.pi * f)
        t += w + g
    return np.abs(total) ** 2


def spectrum(t_s: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the one-sided power spectrum (f Hz, density) of an equidistant signal.

    The mean is removed and the signal padded fourfold."""
    n, dt = len(power), t_s[1] - t_s[0]
    x = np.fft.rfft(power - power.mean(), 4 * n)
    return np.fft.rfftfreq(4 * n, dt), np.abs(x) ** 2 * dt / n * 2


def share_below(t_s: np.ndarray, power: np.ndarray, cutoff_hz: float) -> float:
    """Return the share of the alternating power below `cutoff_hz`."""
    f, s = spectrum(t_s, power)
    return float(s[f <= cutoff_hz].sum() / s.sum())


@dataclass
class Progress:
    """Progress of a run: seconds done of duration, wall seconds used, and an estimate of the rest."""

    done_s: float
    duration_s: float
    used_s: float

    @property
    def percent(self) -> float:
        """Completed share of the duration, %."""
        return 100 * self.done_s / self.duration_s

    @property
    def eta_s(self) -> float:
        """Estimated wall seconds left."""
        return self.used_s * (self.duration_s - self.done_s) / max(self.done_s, 1e-9)


class Aborted(Exception):
    """The run ended early for `reason` after `done_s` seconds; the recording is kept."""

    def __init__(self, reason: str, done_s: float):
        super().__init__(reason)
        self.reason, self.done_s = reason, done_s


def _keys(node: Node, what: str, needed: set[str], optional: Collection[str] = ()) -> dict[str, Node]:
    s = Section(node, what)
    s.asked.update(needed, optional)
    s.end()
    for key in sorted(needed):
        s.get(key)
    return dict(node.value)


def _number(node: Node, low: float, high: float) -> float:
    v = node.value
    if isinstance(v, bool) or not isinstance(v, int | float) or not low <= v <= high:
        raise node.error(f"{v!r}: a number from {low:g} to {high:g} was expected")
    return float(v)
