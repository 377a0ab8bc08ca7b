"""Every sensor x (open, short, frozen, jump, drift, NaN, stale, swapped, late, duplicated), armed and driving."""

import math

import pytest

from tests.hazards.harness import say
from thermoctl.rig.channels import TEMPERATURES

OTHERS = TEMPERATURES[1:]
SENSORS = ("position_um", "output_reference_um", "voltage_v", "current_a", "air_c", *TEMPERATURES)
SHOWS = {
    "position_um": "position",
    "output_reference_um": "monitored",
    "voltage_v": "voltage",
    "current_a": "current",
    "air_c": "air",
    "coil_c": "coil",
}


THERMAL = (
    *SENSORS[:7],
    *(
        pytest.param(r, marks=() if r in ("shaft_1_c", "bracket_2_c") else pytest.mark.slow)
        for r in OTHERS[1:]
    ),
)
"""For hazards that take seconds of simulated time: of the eleven watched temperatures three in `make test`, all in
`make hazards`."""


def group(role):
    return SHOWS.get(role, "monitored")


@pytest.mark.parametrize("role", SENSORS)
def test_open(rig, role):
    """A broken lead: the converter says so (sentinel, no signal)."""
    rig.ready_to_be_spoiled()
    rig.inject("error", role)
    ticks, found, way = rig.detect({f"{group(role)}_error"}, 1)
    finish(rig, role, "open", 1, ticks, found, way)


@pytest.mark.parametrize("role", SENSORS)
def test_nan(rig, role):
    limit = 100 if role.endswith("_c") else 1
    rig.ready_to_be_spoiled()
    rig.inject("nan", role)
    ticks, found, way = rig.detect({f"{group(role)}_range"}, limit)
    finish(rig, role, "NaN", limit, ticks, found, way)


STALE_TICKS = {"position_um": 12, "output_reference_um": 12, "voltage_v": 52, "current_a": 52, "air_c": 2002}


@pytest.mark.parametrize("role", SENSORS)
def test_stale(rig, role):
    """No reading comes any more; the driver's own limit or the law's, whichever is shorter."""
    limit = min(STALE_TICKS.get(role, 1002), 152)
    rig.ready_to_be_spoiled()
    rig.inject("drop", role)
    ticks, found, way = rig.detect({f"{group(role)}_stale"}, limit)
    finish(rig, role, "stale", limit, ticks, found, way)


@pytest.mark.parametrize("role", SENSORS)
def test_late(rig, role):
    """Readings come late by three times the limit of their age and look new when they come."""
    limit = STALE_TICKS.get(role, 1002) + 100 * role.endswith("_c")
    rig.ready_to_be_spoiled()
    rig.inject("delay", role, by=3e-3 * limit)
    ticks, found, way = rig.detect({f"{group(role)}_stale"}, limit)
    finish(rig, role, "late", limit, ticks, found, way)


# What a reading shows that is shorted, and in how many ticks that is found.
SHORT = {
    "position_um": (0.0, 102, {"position_frozen", "position_disagrees", "following_error"}),
    "output_reference_um": (0.0, 102, {"monitored_frozen", "monitored_disagrees"}),
    "voltage_v": (0.0, 102, {"voltage_frozen", "electrical_disagrees"}),
    "current_a": (0.0, 102, {"current_frozen", "electrical_disagrees", "amplifier_not_following"}),
    "air_c": (-242.0, 100, {"air_range"}),
    "coil_c": (22.0, 13000, {"electrical_disagrees", "coil_disagrees"}),
}


@pytest.mark.parametrize("role", THERMAL)
def test_short(rig, role):
    """Encoder and meters read 0, the Pt100 its lower end, a thermocouple the temperature of its terminals, which is the
    chamber's: a believable number."""
    value, limit, expected = SHORT.get(
        role, (22.0, 19000, {"monitored_frozen", "monitored_disagrees", "monitored_rate"})
    )
    rig.ready_to_be_spoiled(250.0 if role.endswith("_c") else 20.0)
    rig.inject("set", role, by=value)
    ticks, found, way = rig.detect(expected, limit)
    finish(rig, role, "short", limit, ticks, found, way)


FROZEN = {"position_um": 103, "output_reference_um": 103, "voltage_v": 103, "current_a": 103, "air_c": 10200}


@pytest.mark.parametrize("kind", ["frozen", "duplicated"])
@pytest.mark.parametrize("role", THERMAL)
def test_frozen_and_duplicated(rig, role, kind):
    """The converter hangs and goes on sending; or a gateway gives its last reading as new in every tick."""
    limit = FROZEN.get(role, 18500)
    expected = {
        f"{group(role)}_frozen",
        *(("coil_disagrees", "electrical_disagrees") if role == "coil_c" else ("monitored_disagrees",)),
    }
    rig.ready_to_be_spoiled(250.0 if role.endswith("_c") else 20.0)
    rig.inject("freeze", role)
    if kind == "duplicated":
        rig.inject("duplicate", role)
    ticks, found, way = rig.detect(expected, limit)
    finish(rig, role, kind, limit, ticks, found, way)


JUMP = {
    "position_um": (100.0, 1, {"position_rate"}),
    "output_reference_um": (100.0, 1, {"monitored_rate"}),
    "voltage_v": (2.0, 50, {"electrical_disagrees"}),
    "current_a": (0.5, 50, {"amplifier_not_following", "electrical_disagrees"}),
    "air_c": (
        5.0,
        200,
        {"air_rate"},
    ),  # two readings in a row, 100 ticks apart: one proves no jump of a temperature
    "coil_c": (5.0, 200, {"coil_rate"}),
}


@pytest.mark.parametrize("role", SENSORS)
def test_jump(rig, role):
    """A loose contact, a missed reference mark."""
    by, limit, expected = JUMP.get(role, (5.0, 200, {"monitored_rate"}))
    rig.ready_to_be_spoiled()
    rig.inject("step", role, by=by)
    ticks, found, way = rig.detect(expected, limit)
    finish(rig, role, f"jump of {by:g}", limit, ticks, found, way)


# Drift a second, and by how much the reading may be wrong when it is found: the limit in ticks follows.
DRIFT = {
    "position_um": (1.0, 4.5, {"position_disagrees"}),
    "output_reference_um": (1.0, 3.0, {"monitored_disagrees"}),
    "voltage_v": (0.05, 0.05, {"electrical_disagrees"}),
    "current_a": (0.01, 0.01, {"amplifier_not_following", "electrical_disagrees"}),
    "air_c": (0.5, 8.0, {"monitored_disagrees", "coil_disagrees", "electrical_disagrees"}),
    "coil_c": (0.5, 4.5, {"coil_disagrees", "electrical_disagrees"}),
}


@pytest.mark.parametrize("role", THERMAL)
def test_drift(rig, role):
    """A reading creeps away between all its limits."""
    by, wrong, expected = DRIFT.get(role, (1.0, 3.5, {"monitored_disagrees"}))
    limit = math.ceil(wrong / by * 1000)
    rig.ready_to_be_spoiled()
    rig.inject("drift", role, by=by)
    ticks, found, way = rig.detect(expected, limit)
    finish(rig, role, f"drift of {by:g} a second", limit, ticks, found, way)


# Plugs exchanged before the rig is switched on, then a move that heats the coil by 10 K.
SWAPS = [
    ("position_um", "output_reference_um", 10000, {"monitored_disagrees"}),
    ("voltage_v", "current_a", 200, {"electrical_disagrees"}),
    ("air_c", "coil_c", 18000, {"monitored_disagrees", "coil_disagrees", "electrical_disagrees"}),
    ("shaft_1_c", "outer_magnet_c", 18000, {"monitored_disagrees"}),
    *(
        pytest.param(
            "coil_c",
            m,
            18000,
            {"monitored_disagrees", "coil_disagrees", "electrical_disagrees"},
            marks=() if m in ("bobbin_c", "bobbin_connector_c", "bracket_1_c") else pytest.mark.slow,
        )
        for m in OTHERS
    ),
]


@pytest.mark.parametrize("one,other,limit,expected", SWAPS)
def test_swapped(rig, one, other, limit, expected):
    rig.inject("swap", one, other)
    rig.arm()
    rig.command("setpoint", 250.0)
    ticks, found, way = rig.detect(expected, limit)
    rig.mend()
    rig.command("disarm")
    rig.tick()
    say("Sensors", f"{one}: swapped with {other}", limit, ticks, found, way, None)


def finish(rig, role, hazard, limit, ticks, found, way):
    """Back without a jump, and the row; the eleven watched temperatures share one row a hazard: the slowest."""
    warned = rig.state == "ARMED"
    if warned:
        rig.mend()
        rig.command("disarm")
        rig.tick()
    jump = rig.comes_back(60.0)
    say("Sensors", f"{role}: {hazard}", limit, ticks, found, way, jump)
