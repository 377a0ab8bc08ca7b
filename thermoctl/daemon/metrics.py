"""The daemon's numbers in Prometheus' text format (version 0.0.4).

Every number of the newest row becomes `thermoctl_<signal>` with the signal's own unit as its ending; the temperatures
carry the point as a label.
What is not valid is NaN; `thermoctl_reading_ok` and `thermoctl_reading_age_seconds` say so by role.
Lateness and busy time are histograms in seconds, faults are 0 or 1 each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from thermoctl.control import arming, faults
from thermoctl.daemon.readings import readings, valid
from thermoctl.daemon.shared import RECORDER_LOST, RECORDER_ROWS, Shared
from thermoctl.signals import INDEX, POINTS, SIGNALS

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS_US = (10, 20, 50, 100, 200, 500, 1000, 2000, 4096)
_COUNTERS = {"tick": "thermoctl_ticks_total", "slips": "thermoctl_slips_total"}
_ELSEWHERE = {
    "t_s",
    "wall_s",
    "lateness_us",
    "busy_us",
    "state",
    "fault_bits",
    "fresh_bits",
    "status_bits",
    "command",
    "command_value",
    "external_bits",
    *(f"{p}{end}" for p in POINTS for end in ("_c", "_est_c")),
}


def metrics(shared: Shared | None) -> str:
    """Return the page of this moment; without a daemon only `thermoctl_up 0`."""
    row = None if shared is None else shared.ring.newest()
    lines: list[str] = []

    def family(name: str, kind: str, help: str, samples: Iterable[tuple[str, float]]) -> None:
        lines.append(f"# HELP {name} {help}")
        lines.append(f"# TYPE {name} {kind}")
        lines.extend(f"{name}{labels} {_number(value)}" for labels, value in samples)

    family("thermoctl_up", "gauge", "1 while the daemon runs", [("", float(row is not None))])
    if shared is None or row is None:
        return "\n".join(lines) + "\n"
    found = readings(shared, row)
    row = np.array([v if valid(n, found) else math.nan for n, v in zip(INDEX, row, strict=True)])
    state, bits = int(row[INDEX["state"]]), int(row[INDEX["fault_bits"]])
    family(
        "thermoctl_state",
        "gauge",
        "1 for the state the daemon is in",
        [(f'{{state="{name}"}}', float(k == state)) for k, name in enumerate(arming.STATES)],
    )
    family(
        "thermoctl_fault",
        "gauge",
        "1 while the fault stands",
        [(f'{{name="{f.name}",severity="{f.severity}"}}', float(bits >> f.bit & 1)) for f in faults.FAULTS],
    )
    fitted = {role: r for role, r in found.items() if r["state"] != "ABSENT"}
    family(
        "thermoctl_reading_ok",
        "gauge",
        "1 while the role's reading is valid",
        [(f'{{role="{role}"}}', float(r["state"] == "OK")) for role, r in fitted.items()],
    )
    family(
        "thermoctl_reading_age_seconds",
        "gauge",
        "time since the role's newest reading",
        [(f'{{role="{role}"}}', r["age_s"]) for role, r in fitted.items()],
    )
    family(
        "thermoctl_temperature_celsius",
        "gauge",
        "temperature of a point",
        [
            (f'{{point="{p}",kind="{kind}"}}', row[INDEX[f"{p}{end}"]])
            for p in POINTS
            for kind, end in (("measured", "_c"), ("estimated", "_est_c"))
        ],
    )
    family(
        "thermoctl_start_time_seconds",
        "gauge",
        "when the daemon started, seconds since 1970",
        [("", row[INDEX["wall_s"]] - row[INDEX["t_s"]])],
    )
    for s in SIGNALS:
        if s.name in _COUNTERS:
            family(_COUNTERS[s.name], "counter", s.meaning, [("", row[INDEX[s.name]])])
        elif s.name not in _ELSEWHERE:
            family(f"thermoctl_{s.name}", "gauge", s.meaning, [("", row[INDEX[s.name]])])
    family(
        "thermoctl_recorder_rows_total",
        "counter",
        "ticks written to the recording",
        [("", shared.counters[RECORDER_ROWS])],
    )
    family(
        "thermoctl_recorder_lost_total",
        "counter",
        "ticks that the recorder lost",
        [("", shared.counters[RECORDER_LOST])],
    )
    for name, meaning in (
        ("lateness", "wake-up after the tick's deadline"),
        ("busy", "wake-up until the amplifier was written"),
        ("reference", "lateness of the idle loop beside it"),
    ):
        _histogram(lines, f"thermoctl_{name}_seconds", meaning, shared.areas[name])
    return "\n".join(lines) + "\n"


def _histogram(lines: list[str], name: str, help: str, counts: np.ndarray) -> None:
    """Append a cumulative histogram of whole microseconds; the sum takes the middle of each bin."""
    counts = counts.astype(np.float64)
    lines += [f"# HELP {name} {help}", f"# TYPE {name} histogram"]
    lines += [f'{name}_bucket{{le="{us * 1e-6:.6g}"}} {_number(counts[:us].sum())}' for us in BUCKETS_US]
    lines += [
        f'{name}_bucket{{le="+Inf"}} {_number(counts.sum())}',
        f"{name}_sum {_number((np.arange(len(counts)) + 0.5) @ counts * 1e-6)}",
        f"{name}_count {_number(counts.sum())}",
    ]


def _number(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    return repr(float(value)) if math.isfinite(value) else f"{'+' if value > 0 else '-'}Inf"
