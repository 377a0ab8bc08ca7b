"""Damaged and mislabelled recordings are found before any refit; sound ones, also with missing physics, are not."""

import dataclasses
import io
import re

import numpy as np
import pytest

from tests.checks.rigs import PLANTS, rig
from thermoctl.checks import checks
from thermoctl.checks.commands import report
from thermoctl.checks.file import file_findings
from thermoctl.cli import main
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def column(name, change):
    return lambda table: dataclasses.replace(
        table, columns=table.columns | {name: change(table.columns[name])}
    )


def both(*names, change):
    def done(table):
        for n in names:
            table = column(n, change)(table)
        return table

    return done


def swap(a, b):
    return lambda t: dataclasses.replace(t, columns=t.columns | {a: t.columns[b], b: t.columns[a]})


def timed(factor):
    return lambda table: dataclasses.replace(table, t=table.t * factor)


def rows(keep):
    def done(table):
        index = keep(len(table))
        return dataclasses.replace(
            table, t=table.t[index], columns={n: v[index] for n, v in table.columns.items()}
        )

    return done


def stretched(table, pick):
    """Every fourth sample only, and the three between made up."""
    index = np.arange(len(table)) // 4 * 4
    made = {n: pick(table.t, table.t[::4], v[::4], v[index]) for n, v in table.columns.items() if "temp" in n}
    return dataclasses.replace(table, columns=table.columns | made)


def twice(table):
    """The first 300 rows, and again from row 100 on under later times."""
    index = np.concatenate([np.arange(300), np.arange(100, 600)])
    return dataclasses.replace(table, columns={n: v[index] for n, v in table.columns.items()})


def frozen(a, b):
    def change(v):
        v = v.copy()
        v[a:b] = v[a]
        return v

    return change


def overflowing(share, bits):
    """Return readings of a counter of `bits` that spans a share of the travel, scaled to the unit."""

    def change(v):
        step = share * np.ptp(v) / 2**bits
        return v.min() + step * ((np.round((v - v.min()) / step) + 2 ** (bits - 2)) % 2**bits)

    return change


def fahrenheit(v):
    return 1.8 * v + 32


TWO, STAGE = "two blocks", "stage"
DAMAGES = {
    # name: rig, damage, kind of the finding, words in it
    "temperatures swapped": (TWO, swap("temperature_1", "temperature_2"), "swapped", "temperature_1", True),
    "heat and air swapped": (TWO, swap("heat", "air_temperature"), "swapped", "air_temperature", True),
    "air and sensor swapped": ("one block", swap("air", "temperature"), "swapped", "'air'", True),
    "heat in mW": (TWO, column("heat", lambda v: 1e3 * v), "unit", "1000 times too large", True),
    "heat in kW": (TWO, column("heat", lambda v: 1e-3 * v), "unit", "1000 times too small", True),
    "heat of the other sign": (TWO, column("heat", lambda v: -v), "sign", "'heat'", True),
    "one sensor in degF": (TWO, column("temperature_1", fahrenheit), "unit", "degF", True),
    "both sensors in degF": (TWO, both("temperature_1", "temperature_2", change=fahrenheit), "unit", "degF", True),
    "one sensor in K": (TWO, column("temperature_2", lambda v: v + 273.15), "unit", "in K", True),
    "both sensors in K": (TWO, both("temperature_1", "temperature_2", change=lambda v: v + 273.15), "unit", "in K", True),
    "air in degF": (TWO, column("air_temperature", fahrenheit), "unit", "degF", True),
    "air in K": (TWO, column("air_temperature", lambda v: v + 273.15), "unit", "in K", True),
    "sensor in millidegrees": (TWO, column("temperature_1", lambda v: 1e3 * v), "unit", "1000 times", True),
    "sensor in tenths": ("one block", column("temperature", lambda v: 10 * v), "unit", "tenths", True),
    "clock in ms": (TWO, timed(1e3), "clock", "ms", True),
    "clock in us": ("one block", timed(1e6), "clock", "us", True),
    "clock in minutes": ("one block", timed(1 / 60), "clock", "in min", True),
    "clock of a stage in ms": (STAGE, timed(1e3), "clock", "ms", True),
    "force of the other sign": (STAGE, column("force", lambda v: -v), "sign", "", True),
    "position in mm": (STAGE, column("encoder", lambda v: 1e3 * v), "unit", "1000 times", True),
    "position in um": ("carriage", column("encoder", lambda v: 1e6 * v), "unit", "1e+06 times", True),
    "force in kN": ("carriage", column("force", lambda v: 1e-3 * v), "unit", "1000 times", True),
    "angle in deg": ("pendulum", column("encoder", np.degrees), "unit", "deg instead of rad", True),
    "pump in litres": ("tank", column("pump", lambda v: 1e3 * v), "unit", "1000 times too large", True),
    "level in mm": ("tank", column("gauge", lambda v: 1e3 * v), "unit", "1000 times too large", True),
    "first sample far from initial": ("tank", rows(lambda n: np.arange(260, n)), "start", "gauge", False),
    "dead sensor": (TWO, column("temperature_2", lambda v: 0 * v + 21.5), "still", "temperature_2", True),
    "dead input": (TWO, column("heat", lambda v: 0 * v), "still", "no input moves", True),
    "sensor that hangs": (TWO, column("temperature_1", frozen(420, 540)), "stuck", "temperature_1", True),
    "gap": (TWO, rows(lambda n: np.r_[0:300, 420:n]), "gap", "t = 598 to 840 s; they are 2 s apart elsewhere; 'heat' changed", True),
    "gap at rest": (TWO, rows(lambda n: np.r_[0:310, 390:n]), "gap", "t = 618 to 780", False),
    "copied twice": (TWO, twice, "repeated", "digit for digit", True),
    "held": (TWO, lambda t: stretched(t, lambda now, at, v, last: last), "resampled", "held between every 4th", False),
    "interpolated": (
        TWO,
        lambda t: stretched(t, lambda now, at, v, last: np.round(np.interp(now, at, v), 4)),
        "resampled",
        "interpolated between every 4th",
        True,
    ),
    "sensor converted twice": (TWO, column("temperature_1", lambda v: (v - 32) / 1.8), "unit", "converted from degF twice", True),
    "counter of 8 bits": (STAGE, column("encoder", overflowing(0.6, 8)), "wrapped", "numpy.unwrap", True),
    "counter of 16 bits": ("carriage", column("encoder", overflowing(0.9, 16)), "wrapped", "period=0.1355", True),
    "counter of 32 bits": (STAGE, column("encoder", overflowing(0.3, 32)), "wrapped", "against its motion", True),
    "sampled too slowly": ("carriage", rows(lambda n: np.arange(0, n, 1000 // 4)), "sampling", "miss", False),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_recording_is_found(case):
    name, damage, kind, words, severe = case
    plant, table = rig(name)
    found = checks(plant, [damage(table)])
    assert [f for f in found if f.kind == kind and words in f.what + f.suggestion and f.severe == severe], [
        str(f) for f in found
    ]
    assert all(f.suggestion for f in found)


def test_thirty_damages_are_tried():
    assert len(DAMAGES) >= 30


WRONG = {
    "loss of the wrong sign": ("rate: G_1 * (one - air)", "rate: G_1 * (air - one)", "unstable", "'loss_1'"),
    "other loss of the wrong sign": ("rate: G_2 * (two - air)", "rate: G_2 * (air - two)", "unstable", "'loss_2'"),
    "negative storage": ("storage: C_1", "storage: -C_1", "storage", "'one' is -6"),
    "storage of zero": ("storage: C_2", "storage: C_2 - 6", "storage", "A node without storage cannot be"),
    "storages in kJ/K": ("C_1: {value: 6, unit: J/K, range: [2, 14]}", "C_1: {value: 6e-6, unit: J/K}", "sampling", "miss"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG.values(), ids=WRONG)
def test_a_wrong_plant_is_found(case):
    old, new, kind, words = case
    _, table = rig(TWO)
    assert old in PLANTS[TWO]
    found = checks(loads(PLANTS[TWO].replace(old, new)), [table])
    assert [f for f in found if f.kind == kind and words in f.what + f.suggestion], [str(f) for f in found]


def test_a_plant_without_units_is_found():
    import re

    _, table = rig("one block")
    bare = re.sub(r",? ?unit: [^,}]+", "", PLANTS["one block"]).replace("{,", "{").replace("{ ", "{")
    assert [f.kind for f in checks(loads(bare), [table])] == ["no units"]


CART = """\
format: thermoctl-plant/1
title: A cart on a spring, pulled by a coil
inputs: {i: {unit: A}}
parameters:
  m: {value: 0.2, unit: kg, range: [0.1, 0.5]}
  k: {value: 600, unit: N/m, range: [200, 2000]}
  d: {value: 4, unit: N*s/m, range: [0.1, 20]}
  Kf: {value: 8, unit: N/A}
  R: {value: 2, unit: ohm}
nodes: {v: {unit: m/s, storage: m, initial: 0}, p: {unit: m, storage: 1, initial: 0}}
flows:
  force: {into: v, rate: Kf * i, unit: N}
  spring: {from: v, rate: k * p, unit: N}
  damper: {from: v, rate: d * v, unit: N}
  motion: {into: p, rate: v, unit: m/s}
outputs:
  u: {value: R * i + Kf * v, unit: V, noise: 0.01}
  x: {value: 1000 * p, unit: mm, noise: 0.01}
"""


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ("value: 1000 * p,", "value: p,", "the value of 'x' is stated in mm, but 'p' has a unit of 1000 mm"),
        (
            "rate: Kf * i, unit: N",
            "rate: Kf * i, unit: kN",
            "'force' is stated in kN, but 'Kf * i' has a unit of 0.001 kN",
        ),
        (
            "rate: k * p, unit: N",
            "rate: k * p, unit: mN",
            "'spring' is stated in mN, but 'k * p' has a unit of 1000 mN",
        ),
    ],
)
def test_an_expression_that_nothing_converts(right, wrong, words, tmp_path, capsys):
    """Units are checked by dimension, so m fits in place of mm: what no number converts is told, and data prove it."""
    sound, _ = loads(CART), loads(CART.replace(right, wrong))
    t = np.arange(1500) / 500
    u = np.repeat(np.random.default_rng(0).normal(size=30), 50)
    y = compile_plant(sound).simulate(Table("r", "r.csv", t, {"i": u})).y
    noisy = y + np.random.default_rng(1).normal(0, 0.01, y.shape)
    table = Table("r", "r.csv", t, {"i": u, "u": noisy[:, 0], "x": noisy[:, 1]})
    assert not checks(sound, [table])
    (tmp_path / "plant.yaml").write_text(CART.replace(right, wrong))
    assert main(["plant", "check", str(tmp_path / "plant.yaml")]) == 0
    told = capsys.readouterr().out
    assert words in told and "warning" in told and "plant.yaml:" in told
    found = checks(loads(CART.replace(right, wrong)), [table])
    stated = [f for f in found if words in f.what]
    assert len(stated) == 1 and stated[0].severe == (wrong == "value: p,")


@pytest.mark.parametrize("power", [3.0, 8.0])
def test_watts_that_are_kilowatts_beside_missing_physics(power):
    """An unknown source hid the mistake that the plant file shows: it was diagnosed, and two laws were named."""
    source = f"  sun: {{into: two, rate: {power} * step(t - 500), unit: W}}\noutputs:"
    _, table = rig(TWO, text=PLANTS[TWO].replace("outputs:", source))
    table = column("heat", lambda v: 1e-3 * v)(table)
    found = checks(loads(PLANTS[TWO].replace("heat: {unit: W}", "heat: {unit: kW}")), [table])
    assert [f.kind for f in found if f.severe] == ["unit"]
    assert "nothing converts it" in found[0].what


FLIES = """\
format: thermoctl-plant/1
title: Flies in a bottle
inputs: {fed: {unit: 1/day}}
parameters: {r: {value: 0.3, unit: 1/day}}
nodes:
  flies: {unit: "1", storage: 1, initial: 10}
flows:
  death: {from: flies, rate: r * flies}
  arrival: {into: flies, rate: fed}
outputs:
  count: {value: flies, unit: "1", noise: 1}
"""


@pytest.mark.parametrize("stated", ["", ", unit: 1/day"])
def test_rates_for_a_day_are_told_where_the_node_counts_seconds(stated):
    """They were taken for rates in 1/s, and the file was good."""

    def told(text):
        return [f.what for f in file_findings(loads(text)) if f.kind == "unit"]

    text = FLIES.replace("* flies}", f"* flies{stated}}}").replace("rate: fed}", f"rate: fed{stated}}}")
    assert ["storage times node per second" in what for what in told(text)] == [True, True]
    assert not told(text.replace("1/day", "1/s"))
    assert not told(FLIES.replace("r * flies", "r * flies / 86400").replace("rate: fed", "rate: fed / 86400"))


RADIATION = (
    "  radiation: {from: one, rate: 2e-10 * ((one + 273.15)**4 - (air + 273.15)**4), unit: W}\noutputs:"
)
SOURCE = "  sun: {into: two, rate: 0.3 * step(t - 500), unit: W}\noutputs:"
SOUND = {
    "nothing missing": (TWO, None),
    "nothing missing, one block": ("one block", None),
    "nothing missing, stage": (STAGE, None),
    "nothing missing, carriage": ("carriage", None),
    "nothing missing, pendulum": ("pendulum", None),
    "nothing missing, tank": ("tank", None),
    "radiation": (TWO, PLANTS[TWO].replace("outputs:", RADIATION)),
    "heat source": (TWO, PLANTS[TWO].replace("outputs:", SOURCE)),
    "sensor lag": ("one block", PLANTS["one block"].replace("value: block,", "value: 'delay(block, 8)',")),
    "Coulomb friction": (
        "carriage",
        PLANTS["carriage"].replace("outputs:", "  dry: {from: velocity, rate: 6 * sign(velocity), unit: N}\noutputs:"),
    ),
    "cubic spring": (
        STAGE,
        PLANTS[STAGE].replace("outputs:", "  cubic: {from: velocity, rate: 4e5 * position**3, unit: N}\noutputs:"),
    ),
    "quadratic drag": (
        "pendulum",
        PLANTS["pendulum"].replace(
            "outputs:", "  drag: {from: speed, rate: 0.004 * speed * abs(speed), unit: N*m}\noutputs:"
        ).replace("0.004 *", "drag_c *").replace("nodes:", "  drag_c: {value: 0.004}\nnodes:"),
    ),
    "overflow": (
        "tank",
        PLANTS["tank"].replace("outputs:", "  spill: {from: level, rate: \"1e-3 * max(level - 0.12, 0)\"}\noutputs:"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("case", SOUND.values(), ids=SOUND)
def test_a_sound_recording_gives_no_finding(case, seed):
    name, text = case
    plant, table = rig(name, seed, text)
    assert [str(f) for f in checks(plant, [table])] == []


def test_slow_sensors_and_irregular_samples_are_sound():
    plant, table = rig(TWO)
    rng = np.random.default_rng(3)
    slow = table.columns["temperature_2"].copy()
    slow[np.arange(len(slow)) % 5 != 0] = np.nan
    table = dataclasses.replace(table, columns=table.columns | {"temperature_2": slow})
    table = rows(lambda n: np.flatnonzero(rng.random(n) < 0.4))(table)
    assert [str(f) for f in checks(plant, [table])] == []


def test_a_saturated_sensor_is_physics():
    plant, table = rig(TWO)
    clipped = column("temperature_1", lambda v: np.minimum(v, np.quantile(v, 0.8)))(table)
    assert not [f for f in checks(plant, [clipped]) if f.severe]


def test_an_ambient_in_fahrenheit_beside_sensors_in_fahrenheit():
    """Nothing but the climate tells it: the plant follows in any linear scale of temperature."""
    _, table = rig("one block")
    plant = loads(PLANTS["one block"].replace("air: {unit: degC,", "air: {unit: degC, role: ambient,"))
    found = checks(plant, [both("air", "temperature", change=fahrenheit)(table)])
    assert [(f.kind, f.severe) for f in found] == [("unit", False)] and "if it is in degF" in found[0].what


def test_an_input_that_only_sets_the_start_is_no_drive():
    """Found on recordings of a free pendulum and of a temperature laboratory."""
    text = PLANTS["pendulum"].replace(
        "angle: {unit: rad, storage: 1, initial: 0}", "angle: {unit: rad, storage: 1, initial: start}"
    )
    plant = loads(text.replace("torque: {unit: N*m}}", "torque: {unit: N*m}, start: {unit: rad}}"))
    table = rig("pendulum")[1]
    table = dataclasses.replace(table, columns=table.columns | {"start": np.full(len(table), 0.0)})
    assert [str(f) for f in checks(plant, [table])] == []


def swing(dry, seconds, step=1e-4):
    """The pendulum released at 0.5 rad: time and angle (N,) under dry friction of `dry` N*m, read in steps (rad)."""
    dt, angle, speed = 1e-3, 0.5, 0.0
    angles = []
    for _ in range(int(seconds / dt)):
        angles.append(angle)
        speed += (-0.6 * np.sin(angle) - 0.01 * speed) / 0.02 * dt
        speed = np.sign(speed) * max(abs(speed) - dry / 0.02 * dt, 0.0)  # rest is held up to the friction
        angle += speed * dt
    t = np.arange(len(angles)) * dt
    return t[::10], step * np.round(np.array(angles[::10]) / step)


def released(dry, seconds):
    text = PLANTS["pendulum"].replace(
        "storage: 1, initial: 0", "storage: 1, initial: 0.5, initial_sigma: 0.02"
    )
    t, angle = swing(dry, seconds)
    return loads(text), Table("swing", "swing.csv", t, {"torque": np.zeros(len(t)), "encoder": angle})


def test_a_body_at_rest_by_dry_friction_is_no_hung_sensor():
    """Found on a propeller's pendulum: it stood for seconds, and the plant without friction swung on."""
    plant, table = released(dry=0.012, seconds=15.0)
    y = table.columns["encoder"]
    assert np.ptp(y[-500:]) == 0 and np.ptp(y[:200]) > 0.5
    assert [f.kind for f in checks(plant, [table]) if f.severe] == []
    hung = column("encoder", frozen(90, 150))(table)
    assert [f.kind for f in checks(plant, [hung]) if f.severe] == ["stuck"]


def test_each_stretch_that_hangs_is_told():
    """One was told at a time: who emptied its cells met the next one in the next run."""
    plant, table = rig(TWO)
    hung = column("temperature_1", lambda v: frozen(100, 200)(frozen(420, 540)(v)))(table)
    told = [f.what for f in checks(plant, [hung]) if f.severe]
    assert len(told) == 2 and all("'temperature_1' stands at" in what for what in told)


def test_a_free_swing_needs_no_input_that_moves():
    """Found on a flexible link that rings after its release; a swing that nothing in the plant explains needs one."""
    plant, table = released(dry=0.0, seconds=6.0)
    assert [f.kind for f in checks(plant, [table]) if f.severe] == []
    pushed = column("encoder", lambda v: v + 0.3 * np.sign(np.sin(table.t)))(table)
    assert "still" in [f.kind for f in checks(plant, [pushed])]


def test_two_recordings_share_a_finding():
    plant, one = rig(TWO, 1)
    _, two = rig(TWO, 1)
    two = dataclasses.replace(two, name="run_2", path="run_2.csv")
    wrong: list[Table] = [swap("temperature_1", "temperature_2")(t) for t in (one, two)]
    found = checks(plant, wrong)
    assert [f.kind for f in found] == ["swapped"] and "and 1 more" in found[0].where


RAMPS = """\
format: thermoctl-plant/1
inputs: {power: {unit: W}}
nodes: {block: {unit: degC, storage: 5, initial: 20}}
flows:
  heating: {into: block, rate: power, unit: W}
  loss: {from: block, rate: 0.2 * (block - 20), unit: W}
outputs: {block_c: {value: block, unit: degC, noise: 0.02}}
"""


def ramps(said):
    """A measured power that ramps between 0 and 20 W in a minute, sampled every second."""
    t = np.arange(600.0)
    plant = loads(RAMPS.replace("power: {unit: W}", f"power: {{unit: W, {said}}}"))
    truth = loads(RAMPS.replace("power: {unit: W}", "power: {unit: W, between_samples: linear}"))
    table = Table(
        "ramps", "ramps.csv", t, {"power": 20 * np.abs((t / 60) % 2 - 1), "block_c": np.full(len(t), 20.0)}
    )
    model = compile_plant(truth)
    y = model.run(model.excitation(table)).y[:, 0] + 0.02 * np.random.default_rng(1).standard_normal(len(t))
    return plant, dataclasses.replace(table, columns=table.columns | {"block_c": y})


def test_a_measured_ramp_that_the_plant_holds_by_default():
    """Found on a rig at the wire: a sure second effect beside the right one."""
    plant, table = ramps("column: power")
    (found,) = checks(plant, [table])
    assert (found.kind, found.severe) == ("between", False) and "'power'" in found.what
    assert "between_samples" in found.suggestion


def test_a_word_that_the_plant_file_lacks_is_asked_for_once():
    """The movement differs in each recording, the line to write does not."""
    plant, table = ramps("column: power")
    faster = dataclasses.replace(
        table, path="faster.csv", columns=table.columns | {"power": table.columns["power"] ** 2}
    )
    report(checks(plant, [table, faster]), out := io.StringIO())
    (line,) = [x for x in out.getvalue().splitlines() if "between_samples" in x]
    assert "times their noise (in 2 recordings)" in line


def test_a_delay_of_an_input_is_checked_as_any_plant():
    """A finding of actuator_delay writes such a plant, and its own check ended in a traceback."""
    plant, table = ramps("column: power")
    delayed = loads(RAMPS.replace("rate: power", "rate: 'delay(power, 2)'"))
    assert [f.kind for f in checks(delayed, [table])] == [f.kind for f in checks(plant, [table])]


@pytest.mark.parametrize("said", ["between_samples: linear", "between_samples: hold"])
def test_what_the_plant_file_says_of_a_ramp_is_not_doubted(said):
    plant, table = ramps(said)
    assert not [f for f in checks(plant, [table]) if f.kind == "between"]


def test_fine_readings_that_move_in_each_row_are_not_interpolated():
    """Found on a clean recording of a slow block: its least step from row to row was a slope, no resolution."""
    text = """
    format: thermoctl-plant/1
    inputs: {heat: {unit: W}, air: {unit: degC, between_samples: linear}}
    parameters: {C: {value: 100, unit: J/K}, G: {value: 0.2, unit: W/K}}
    nodes: {one: {unit: degC, storage: C, initial: air, initial_sigma: 1000}}
    flows: {power: {into: one, rate: heat, unit: W}, loss: {from: one, rate: G * (one - air), unit: W}}
    outputs: {T: {value: one, unit: degC}}
    """
    t = 5.0 * np.arange(500)
    heat = np.where(np.arange(500) // 60 % 2, 10.0, 0.0)
    block = np.empty(500)
    block[0] = 60.0
    for k in range(499):
        end = 20 + heat[k] / 0.2
        block[k + 1] = end + (block[k] - end) * np.exp(-0.2 / 100 * 5)
    noisy = np.round(block + 0.01 * np.random.default_rng(0).standard_normal(500), 3)
    columns = {"heat": heat, "air": np.full(500, 20.0), "T": noisy}
    assert np.abs(np.diff(noisy)).min() > 0.1
    assert [str(f) for f in checks(loads(text), [Table("run", "run.csv", t, columns)])] == []


def test_a_siphon_that_empties_is_no_counter():
    """A level that falls at once and rises again leaps one way, by no power of two of the gauge's step."""
    text = """
    format: thermoctl-plant/1
    inputs: {pump: {unit: m^3/s}}
    parameters: {A: {value: 0.01, unit: m^2}}
    nodes: {level: {unit: m, storage: A, initial: first(gauge)}}
    flows: {feed: {into: level, rate: pump, unit: m^3/s}}
    outputs: {gauge: {value: level, unit: m, noise: 0.001}}
    """
    t = np.arange(400.0)
    level = np.round(0.02 + (0.0011 * t + 0.01) % 0.0811, 4)
    columns = {"pump": np.where(t > 100, 1.1e-5, 1.0e-5), "gauge": level}
    assert "wrapped" not in {f.kind for f in checks(loads(text), [Table("run", "run.csv", t, columns)])}


def test_a_single_wild_reading_is_no_counter():
    """Down at the top of a swing and up again were two leaps of 1.5 times their size: a severe finding."""
    plant, table = rig("one block")
    wild = table.columns["temperature"].copy()
    step = np.diff(wild)
    top = next(k for k in range(300, 700) if step[k - 2] > 0 > step[k + 1])
    wild[top] -= 4 * np.ptp(wild)
    found = checks(plant, [column("temperature", lambda v: wild)(table)])
    assert "wrapped" not in {f.kind for f in found}


@pytest.mark.parametrize("empty", [0, 60])
def test_the_time_of_a_leap_counts_rows_with_empty_cells(empty):
    plant, table = rig(STAGE)
    table = column("encoder", overflowing(0.6, 8))(table)
    y = table.columns["encoder"].copy()
    leaps = table.t[:-1][np.abs(np.diff(y)) > 0.5 * np.ptp(y)]
    y[:empty] = np.nan
    (told,) = (f for f in checks(plant, [column("encoder", lambda v: y)(table)]) if f.kind == "wrapped")
    first = float(re.search(r"first after t = ([\d.]+) s", told.what)[1])
    assert np.abs(leaps - first).min() < 1e-6


@pytest.mark.parametrize("seed", range(8))
def test_noise_at_rest_is_no_counter(seed):
    """Its largest leaps reach from end to end, as those of a counter do: 29 of 400 rows had been a severe finding."""
    plant, table = rig("one block")
    noise = np.random.default_rng(seed).normal(0, 0.1, len(table))
    rest = {**table.columns, "temperature": 21.5 + noise, "heat": np.zeros(len(table))}
    assert "wrapped" not in {f.kind for f in checks(plant, [dataclasses.replace(table, columns=rest)])}


BELT = """\
format: thermoctl-plant/1
inputs: {u: {unit: N}}
parameters: {b: {value: 60, unit: N*s/m, range: [20, 200]}, m: {value: 40, unit: kg}, F: {value: 20, unit: N}}
nodes: {v: {unit: m/s, storage: m, initial: first(y), initial_sigma: 0.02}}
flows:
  force: {into: v, rate: u, unit: N}
  drag: {from: v, rate: b * v, unit: N}
  deck: {from: v, rate: F * tanh(v / 0.01), unit: N}
outputs: {y: {value: v, unit: m/s, noise: 0.01}}
"""


def test_friction_at_rest_is_not_the_slowest_time_constant():
    """At rest, friction holds the belt within 20 ms. Moving, its time constant is 0.7 s."""
    plant, t = loads(BELT), np.arange(0.0, 40.0, 0.1)
    u = 80.0 * (t % 20 > 2)
    table = Table("run", "run", t, {"u": u, "y": np.zeros(len(t))})
    table = dataclasses.replace(
        table, columns={"u": u, "y": compile_plant(plant, ()).simulate(table).y[:, 0]}
    )
    (found,) = [f for f in checks(plant, [table]) if f.kind == "sampling"]
    assert "slowest" not in found.what and "time in another unit" not in found.suggestion
