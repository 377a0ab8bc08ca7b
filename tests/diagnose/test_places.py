"""Which places and shapes the catalogue offers on a plant."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.plants import FREE_CARRIAGE
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.search.gains import Direction
from thermoctl.diagnosis.search.refits import free_starts, ranges_of
from thermoctl.diagnosis.search.shapes import shape_grid
from thermoctl.plant import loads
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

MOTOR = """format: thermoctl-plant/1
title: A motor on a frame that grows
inputs: {current: {unit: A}, speed: {unit: rad/s}, air: {unit: degC, between_samples: linear}}
parameters:
  C_winding: {value: 60, unit: J/K, range: [20, 200]}
  C_housing: {value: 300, unit: J/K, range: [100, 900]}
  G: {value: 1.2, unit: W/K, range: [0.3, 4]}
  H: {value: 0.8, unit: W/K, range: [0.2, 3]}
  fan: {value: 0.001, unit: W/K/(rad/s)}
  R: {value: 1.2, unit: ohm, range: [0.6, 2.4]}
  growth: {value: 2.0, unit: um/K, range: [0.5, 8]}
nodes: {winding: {unit: degC, storage: C_winding, initial: air}, housing: {unit: degC, storage: C_housing, initial: air}}
flows:
  joule: {into: winding, rate: R * current**2 * (1 + 0.00393 * (winding - 20)), unit: W}
  link: {from: winding, into: housing, rate: G * (winding - housing), unit: W}
  draught: {into: housing, rate: (H + fan * abs(speed)) * (air - housing), unit: W}
outputs:
  winding_c: {value: winding, unit: degC, noise: 0.1}
  housing_c: {value: housing, unit: degC, noise: 0.1}
  error: {value: growth * (housing - 20), unit: um, noise: 0.05}
"""


@pytest.fixture(scope="module")
def motor() -> tuple[Plant, Table]:
    plant = loads(MOTOR)
    t = np.arange(0.0, 3000.0, 10.0)
    columns = {
        "current": 3.0 * (np.sin(t / 200) > 0),
        "speed": 50 + 50 * np.cos(t / 150),
        "air": 21 + np.sin(t / 700),
    }
    return plant, compile_plant(plant).measure(Table("run", "run", t, columns))


def entries(*names: str) -> dict:
    return {n: catalogue()[n] for n in names}


def offered(plant: Plant, table: Table, name: str) -> dict:
    rig = Rig(plant, [compile_plant(plant).excitation(table)], [table.columns])
    return {c.place.where: c for c in candidates(rig, entries(name))}


def test_heat_that_copper_makes_may_go_elsewhere_and_what_a_draught_carries_off_may_not(motor):
    assert set(offered(*motor, "heat_split")) == {"winding-housing"}


def test_a_member_whose_growth_a_displacement_has_with_a_free_size_is_not_missing(motor):
    """A gauge that is zeroed anew between two recordings was one, above 0.99: its memory of the start is an offset."""
    assert set(offered(*motor, "missing_member")) == {"winding", "air"}
    plant = loads(MOTOR.replace(", range: [0.5, 8]", ""))
    assert set(offered(plant, motor[1], "missing_member")) == {"winding", "air", "housing"}


def test_a_reading_of_growth_may_follow_the_air_as_a_temperature_does(motor):
    assert set(offered(*motor, "cold_junction_drift")) == {"winding_c", "housing_c", "error"}


def test_an_effect_that_the_plant_file_holds_already_comes_a_second_time_under_names_of_its_own(motor):
    plant, table = motor
    extended = offered(plant, table, "heat_split")["winding-housing"].extend({"A": 0.1})
    again = offered(extended, table, "heat_split")["winding-housing"]
    assert not again.own_in(extended)
    twice = again.extend({"A": 0.2})
    assert extended.parameters.items() <= twice.parameters.items()
    assert len(twice.flows) - len(extended.flows) == len(extended.flows) - len(plant.flows) > 0


def test_a_period_that_has_not_come_twice_is_not_offered():
    plant = loads(FREE_CARRIAGE)
    t = np.arange(4000) * 0.002
    force = np.interp(t, np.arange(0, 9, 0.4), np.random.default_rng(1).uniform(-8, 8, 23))
    table = compile_plant(plant).measure(Table("r", "r", t, {"force": force, "encoder": np.zeros(len(t))}))
    model = compile_plant(plant)
    drive = model.excitation(table)
    runs = [model.run(drive)]
    travel = np.ptp(runs[0].x[:, model.states.index("position")])
    (found, *_) = candidates(Rig(plant, [drive], [table.columns]), entries("cogging"))
    grid = shape_grid("periods", found, runs)
    periods = [s["period"] for s in grid]
    assert max(periods) == pytest.approx(travel / 2) and min(periods) < travel / 50
    start = {p.name: p.null for p in found.effect.parameters}
    for shape in grid:
        direction = Direction(found, shape, 1.0, 2, {**start, "P": shape["period"]})
        ranges = ranges_of(direction)
        assert ranges["P"][1] <= 1.001 * travel / 2
        assert np.ptp(ranges["PHI"]) == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("zero", [0.0, 273.15])
def test_the_prior_of_a_limit_depends_on_what_the_signal_visits_and_not_on_the_zero_of_its_unit(motor, zero):
    """It was three times the level: a limit of a temperature in K had 2.3 nats less than the same in degC."""
    plant, table = motor
    plant = loads(MOTOR.replace("value: winding, unit: degC", f"value: winding + {zero}, unit: degC"))
    model = compile_plant(plant)
    (found, *_) = candidates(
        Rig(plant, [drive := model.excitation(table)], [table.columns]), entries("sensor_saturation")
    )
    runs = [model.run(drive)]
    spans = {
        ranges_of(Direction(found, shape, 1.0, 1, {"YMAX": shape["level"]}))["YMAX"]
        for shape in shape_grid("end_levels", found, runs)
    }
    y = runs[0].y[:, 0] - zero
    ((low, high),) = spans
    assert (low - zero, high - zero) == pytest.approx(
        (y.min() - np.ptp(y) / 2, y.max() + np.ptp(y) / 2), rel=1e-3
    )


def jumping(motor, column: str) -> tuple[Plant, Table]:
    plant, table = motor
    columns = {**table.columns, column: table.columns[column] + 3.0 * (table.t > 1000)}
    return plant, Table("run", "run", table.t, columns)


@pytest.mark.parametrize("column", ["winding_c", "air"])
def test_an_offset_step_is_no_larger_than_the_largest_jump_of_its_reading(motor, column):
    """A step of 299 K at an extruder whose reading rose by 12 K within three samples had been named."""
    plant, table = jumping(motor, column)
    c = offered(plant, table, "sensor_offset_step")[column]
    p = next(p for p in c.effect.parameters if p.name == "A")
    low, high = c.bounds(p)
    v = table.columns[column]
    assert high == -low == max(np.abs(v[k:] - v[:-k]).max() for k in (1, 2, 3))
    assert high > 3.0


@pytest.mark.parametrize(
    ("electronics", "values"),
    [("sensor_offset_step", {"A": 3.0, "T0": 1000.0}), ("sensor_saturation", {"YMAX": 24.0})],
)
@pytest.mark.parametrize("slow", ["sensor_lag", "expansion_lag"])
def test_a_slow_part_of_a_reading_comes_before_its_electronics_in_whichever_order_it_is_found(
    motor, electronics, values, slow
):
    """A step that a lag smoothed had taken the shape of a heated probe's drift, with its full size."""
    output = "error" if slow == "expansion_lag" else "winding_c"
    plant, table = jumping(motor, output)
    given = {electronics: values, slow: {"TAU": 60.0}}
    readings = []
    for order in ((slow, electronics), (electronics, slow), (slow,)):
        extended = plant
        for effect in order:
            extended = offered(extended, table, effect)[output].extend(given[effect])
        model = compile_plant(extended)
        readings.append(model.run(model.excitation(table)).y[:, model.outputs.index(output)])
    np.testing.assert_allclose(readings[0], readings[1], rtol=1e-9, atol=1e-9)
    error = readings[0] - readings[2]
    if electronics == "sensor_offset_step":
        assert np.abs(error[3:] - error[:-3]).max() > 2.5  # a lag would leave 1.2


def test_a_reading_of_the_start_is_no_body_whose_start_nobody_measured(motor):
    """Ten times the spread let a member's growth trade with it: 18 sigmas of growth were called not significant."""
    _, table = motor
    plant = loads(MOTOR.replace("initial: air}", "initial: air, initial_sigma: 0.2}"))
    extended = free_starts(plant, offered(plant, table, "missing_member")["winding"].extend({"A": 0.1}))
    (memory,) = extended.nodes.keys() - plant.nodes.keys()
    assert extended.nodes[memory].initial_sigma == pytest.approx(0.2)
    hidden = offered(plant, table, "hidden_thermal_mass")["winding"].extend({"C": 30.0, "G": 1.0})
    (body,) = hidden.nodes.keys() - plant.nodes.keys()
    widened = free_starts(plant, hidden).nodes[body].initial_sigma
    assert widened == pytest.approx(10 * hidden.nodes[body].initial_sigma)


def test_a_slow_sensor_measures_where_it_starts_itself(motor):
    """Ten times the spread cost a lag 2.3 nats a recording against the delay that fits as well."""
    _, table = motor
    plant = loads(MOTOR.replace("initial: air}", "initial: air, initial_sigma: 0.2}"))
    place, lag = next(iter(offered(plant, table, "sensor_lag").items()))
    slow = lag.extend({"TAU": 5.0})
    (sensor,) = slow.nodes.keys() - plant.nodes.keys()
    assert free_starts(plant, slow).nodes[sensor].initial_sigma == pytest.approx(0.2), place


TANK = """format: thermoctl-plant/1
title: A tank that drains
inputs: {inflow: {unit: m^3/s}}
parameters: {k: {value: 1e-3, range: [1e-4, 1e-2]}}
nodes: {level: {unit: m, storage: 0.1, initial: 0.3}}
flows:
  fill: {into: level, rate: inflow, unit: m^3/s}
  outflow: {from: level, rate: "RATE", unit: m^3/s}
outputs: {gauge: {value: level, unit: m, noise: 0.001}}
"""
EMPTY = Table("run", "run", np.arange(200.0), {"inflow": np.zeros(200), "gauge": np.zeros(200)})


@pytest.mark.parametrize(
    ("rate", "exponent"),
    [
        ("k * max(level - 0.02, 0)", 1.0),
        ("k * level / 2", 1.0),
        ("k * sqrt(max(level, 0))", 0.5),
        ("k * max(level, 0)**0.8", 0.8),
        ("k * max(level, 0)**1.5", 1.5),
    ],
)
def test_an_outlet_has_the_exponent_of_its_file_until_another_is_found(rate, exponent):
    plant = loads(TANK.replace("RATE", rate))
    c = offered(plant, EMPTY, "orifice_exponent")["outflow"]
    (n,) = c.effect.parameters
    assert n.null == exponent

    def level(p: Plant) -> np.ndarray:
        model = compile_plant(p)
        return model.run(model.excitation(EMPTY)).x[:, 0]

    assert np.allclose(level(c.extend({})), level(plant), rtol=1e-6)

    def fall(_: float, h: np.ndarray) -> np.ndarray:
        head = h - 0.02 if "0.02" in rate else h
        return -1e-3 * np.maximum(head, 0) ** 0.7 * (0.5 if "/ 2" in rate else 1) / 0.1

    known = solve_ivp(fall, (0, EMPTY.t[-1]), [0.3], t_eval=EMPTY.t, rtol=1e-9, atol=1e-12).y[0]
    assert np.allclose(level(c.extend({"N": 0.7})), known, rtol=1e-5, atol=1e-6)


def test_a_vessel_may_overflow_beside_the_exponent_of_its_outlet():
    """A level in volts: only the power of it in the outflow tells a vessel."""
    text = (
        TANK.replace("RATE", "k * sqrt(max(level, 0))")
        .replace("m^3/s", "V/s")
        .replace("unit: m,", "unit: V,")
    )
    plant = loads(text)
    assert set(offered(plant, EMPTY, "overflow")) == {"level"}
    found = offered(plant, EMPTY, "orifice_exponent")["outflow"]
    assert set(offered(found.extend({"N": 0.6}), EMPTY, "overflow")) == {"level"}


def test_only_a_level_has_an_outlet_and_only_of_its_own_head(motor):
    assert offered(*motor, "orifice_exponent") == {}
    drains = "  drain: {from: level, into: lower, rate: k * (level - lower)}"
    two = TANK.replace("RATE", "k").replace("0.3}}", "0.3}, lower: {unit: m, storage: 1, initial: 0}}")
    plant = loads(two.replace("outputs:", f"{drains}\noutputs:"))
    assert offered(plant, EMPTY, "orifice_exponent") == {}
    steep = loads(TANK.replace("RATE", "k * max(level, 0)**3"))  # neither an orifice nor a weir
    assert offered(steep, EMPTY, "orifice_exponent") == {}
