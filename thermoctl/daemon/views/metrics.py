"""The daemon's numbers in Prometheus' text format (version 0.0.4).

Every number of the newest row becomes `thermoctl_<signal>`, in the signal's unit; temperatures have the point
as a label. An invalid number is NaN; `thermoctl_reading_ok` and `thermoctl_reading_age_seconds` give state
and age by role. Lateness and busy time are histograms in seconds, faults are 0 or 1 each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from thermoctl.control import arming, faults
from thermoctl.daemon.answers.readings import readings, valid_signals
from thermoctl.daemon.tick.shared import RECORDER_LOST, RECORDER_ROWS, UNSAVED, Shared
from thermoctl.daemon.unsaved import unsaved
from thermoctl.rig.signals import AT, Row, fault_word

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS_US = (10, 20, 50, 100, 200, 500, 1000, 2000, 4096)
HISTOGRAMS = {
    "lateness": "wake-up after the tick's deadline",
    "busy": "wake-up until the amplifier was written",
    "reference": "lateness of the idle loop beside it",
}
_COUNTERS = {"tick": "thermoctl_ticks_total", "slips": "thermoctl_slips_total"}
_ELSEWHERE = {"t_s", "wall_s", "lateness_us", "busy_us", "state", "command", "command_value"}


Family = tuple[str, str, str, list[tuple[str, float]]]
"""Name, type, help, and samples as (labels, value)."""


def metrics(shared: Shared | None) -> str:
    """Return the page of this moment; without a daemon only `thermoctl_up 0`."""
    row = None if shared is None else shared.ring.newest()
    families: list[Family] = [
        ("thermoctl_up", "gauge", "1 while the daemon runs", [("", float(row is not None))])
    ]
    if shared is None or row is None:
        return "\n".join(_lines(families)) + "\n"
    by_role = readings(shared, row)
    valid, layout = valid_signals(shared.channels, by_role), shared.row
    row = np.array([v if valid.get(n, True) else math.nan for n, v in zip(layout.names, row, strict=True)])
    families += [
        *_state_families(row, by_role, layout),
        *_signal_families(row, layout),
        *_recorder_families(shared),
    ]
    lines = list(_lines(families))
    for name, meaning in HISTOGRAMS.items():
        lines += _histogram(f"thermoctl_{name}_seconds", meaning, shared.areas[name])
    return "\n".join(lines) + "\n"


def _lines(families: Iterable[Family]) -> Iterator[str]:
    for name, kind, help, samples in families:
        yield f"# HELP {name} {help}"
        yield f"# TYPE {name} {kind}"
        yield from (f"{name}{labels} {_number(value)}" for labels, value in samples)


def _state_families(row: np.ndarray, found: Mapping[str, Mapping[str, Any]], layout: Row) -> Iterator[Family]:
    """Yield state, faults, readings and temperatures."""
    state, bits = int(row[AT["state"]]), fault_word(row)
    states = [(f'{{state="{name}"}}', float(k == state)) for k, name in enumerate(arming.STATES)]
    yield "thermoctl_state", "gauge", "1 for the state the daemon is in", states
    active = [
        (f'{{name="{f.name}",severity="{f.severity}"}}', float(bits >> f.bit & 1)) for f in faults.FAULTS
    ]
    yield "thermoctl_fault", "gauge", "1 while the fault is active", active
    fitted = {role: r for role, r in found.items() if r["state"] != "ABSENT"}
    good = [(f'{{role="{role}"}}', float(r["state"] == "OK")) for role, r in fitted.items()]
    yield "thermoctl_reading_ok", "gauge", "1 while the role's reading is valid", good
    ages = [(f'{{role="{role}"}}', r["age_s"]) for role, r in fitted.items()]
    yield "thermoctl_reading_age_seconds", "gauge", "time since the role's newest reading", ages
    temperatures = [
        (f'{{point="{p}",kind="{kind}"}}', row[layout.index[f"{p}{end}"]])
        for p in layout.channels.point_names
        for kind, end in (("measured", "_c"), ("estimated", "_est_c"))
    ]
    yield "thermoctl_temperature_celsius", "gauge", "temperature of a point", temperatures


def _signal_families(row: np.ndarray, layout: Row) -> Iterator[Family]:
    """Yield the start time, and every signal that no other family holds."""
    start_s = row[AT["wall_s"]] - row[AT["t_s"]]
    began = "when the daemon started, seconds since 1970"
    yield "thermoctl_start_time_seconds", "gauge", began, [("", start_s)]
    temperatures = {f"{p}{end}" for p in layout.channels.point_names for end in ("_c", "_est_c")}
    for s in layout.signals:
        if s.name in _COUNTERS:
            yield _COUNTERS[s.name], "counter", s.meaning, [("", row[layout.index[s.name]])]
        elif s.name not in _ELSEWHERE | layout.bit_words | temperatures:
            yield f"thermoctl_{s.name}", "gauge", s.meaning, [("", row[layout.index[s.name]])]


def _recorder_families(shared: Shared) -> Iterator[Family]:
    for name, help, place in (
        ("rows", "ticks written to the recording", RECORDER_ROWS),
        ("lost", "ticks that the recorder lost: it fell behind, or could not write", RECORDER_LOST),
    ):
        yield f"thermoctl_recorder_{name}_total", "counter", help, [("", shared.counters[place])]
    now = {u["what"] for u in unsaved(shared)}
    help = "1 while the disk cannot be written: `thermoctl status` says why"
    yield "thermoctl_unsaved", "gauge", help, [(f'{{what="{n}"}}', float(n in now)) for n in UNSAVED]


def _histogram(name: str, help: str, counts: np.ndarray) -> list[str]:
    """Return a cumulative histogram of whole microseconds; the sum takes the middle of each bin."""
    counts = counts.astype(np.float64)
    return [
        f"# HELP {name} {help}",
        f"# TYPE {name} histogram",
        *(f'{name}_bucket{{le="{us * 1e-6:.6g}"}} {_number(counts[:us].sum())}' for us in BUCKETS_US),
        f'{name}_bucket{{le="+Inf"}} {_number(counts.sum())}',
        f"{name}_sum {_number((np.arange(len(counts)) + 0.5) @ counts * 1e-6)}",
        f"{name}_count {_number(counts.sum())}",
    ]


def _number(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    return repr(float(value)) if math.isfinite(value) else f"{'+' if value > 0 else '-'}Inf"
