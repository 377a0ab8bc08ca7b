"""Answers made from shared memory: `status` and `latency`. Reading them never costs the loop a tick."""

from __future__ import annotations

from typing import Any

import numpy as np

from thermoctl.control import arming
from thermoctl.daemon.answers import readings
from thermoctl.daemon.answers.display import EXPECTED, FREE, MEASURED, NO_ESTIMATE, UNKNOWN
from thermoctl.daemon.tick.shared import NO_MODEL, RECORDER_LOST, RECORDER_ROWS, TUNING, Shared, percentiles
from thermoctl.daemon.unsaved import unsaved
from thermoctl.rig.channels import STATUS_NAMES
from thermoctl.rig.signals import AT, Row

_NUMBERS = """
setpoint_um reference_um position_um compensated_um compensation_um expansion_um output_reference_um
control_v drive enable voltage_v current_a power_w air_c innovation_c kalman_gain position_age_s coil_age_s
supply_v amplifier_state amplifier_fault
"""
NUMBERS = tuple(_NUMBERS.split())
"""Signals that a status answer contains under their own names."""


def status(shared: Shared) -> dict[str, Any]:
    """Return the newest row as `thermoctl status --json` prints it.

    A number whose reading is invalid is null; `readings` has its state, age and message. Without a model
    the estimates are null, too. `output_is` says whether the output is measured by a second encoder or only
    expected by the model. Faults have the cause first."""
    row = shared.ring.newest()
    if row is None:
        return {
            "state": "OFF",
            "ticks": 0,
            "slips": 0,
            "faults": [],
            "setpoint_um": None,
            "position_um": None,
            "compensation_um": None,
        }
    by_role = readings.readings(shared, row)
    valid, coil = readings.valid_signals(shared.channels, by_role), shared.channels.coil
    number = {
        name: readings.finite(row[i]) if valid.get(name, True) else None
        for name, i in shared.row.index.items()
    }
    estimated = not shared.counters[NO_MODEL]
    if not estimated:
        number |= dict.fromkeys(("expansion_um", *(f"{p}_est_c" for p in shared.channels.point_names)))
    measured = by_role["output_reference_um"]["state"] != "ABSENT"
    busy = percentiles(shared.areas["busy"])
    return {
        "state": arming.STATES[int(row[AT["state"]])],
        "ticks": int(row[AT["tick"]]),
        "slips": int(row[AT["slips"]]),
        "generation": int(row[AT["generation"]]),
        "uptime_s": number["t_s"],
        **{name: number[name] for name in NUMBERS},
        "channels": {role: r["state"] for role, r in by_role.items()},
        "readings": by_role,
        "output_is": MEASURED if measured else EXPECTED if estimated else UNKNOWN,
        "estimates_state": NO_ESTIMATE if not estimated else "OK" if by_role[coil]["state"] == "OK" else FREE,
        "coil": coil,
        "labels": shared.channels.labels,
        "drive_code": readings.drive_code(shared, row),
        "temperatures_c": {p: number[f"{p}_c"] for p in shared.channels.point_names},
        "estimates_c": {p: number[f"{p}_est_c"] for p in shared.channels.point_names},
        "lateness_us": number["lateness_us"],
        "busy_us": number["busy_us"],
        "busy_p50_us": readings.finite(busy[0]),
        "tuning_percent": float(shared.counters[TUNING]) - 1.0 if shared.counters[TUNING] else None,
        "recorder": {
            "rows": int(shared.counters[RECORDER_ROWS]),
            "lost": int(shared.counters[RECORDER_LOST]),
        },
        "unsaved": unsaved(shared),
        "wall_s": number["wall_s"],
        "faults": readings.standing_faults(shared, row, by_role),
    }


def channel_states(row: np.ndarray, layout: Row) -> dict[str, str]:
    """Return each channel's state in a record row: OK, STALE, ERROR or ABSENT."""
    return {
        name: STATUS_NAMES[state]
        for name, state in zip(layout.channels.names, layout.states(row)[0], strict=True)
    }


def latency(shared: Shared, period_s: float) -> dict[str, Any]:
    """Return histograms and percentiles of lateness, busy time and the idle loop's lateness, us."""
    row = shared.ring.newest()
    answer: dict[str, Any] = {
        "period_us": period_s * 1e6,
        "ticks": 0 if row is None else int(row[AT["tick"]]),
        "slips": 0 if row is None else int(row[AT["slips"]]),
    }
    for k, name in enumerate(("lateness", "busy", "reference")):
        counts = shared.areas[name].copy()  # the loop continues to count
        p50, p99, p999 = percentiles(counts)
        answer[name] = {
            "count": int(counts.sum()),
            "p50_us": readings.finite(p50),
            "p99_us": readings.finite(p99),
            "p999_us": readings.finite(p999),
            "largest_us": float(shared.areas["largest"][k]),
            "bins_us": [[int(i), int(counts[i])] for i in counts.nonzero()[0]],
        }
    return answer
