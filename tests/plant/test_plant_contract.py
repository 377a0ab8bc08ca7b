"""The statements of the plant file's format one by one: what is read, what it means, what is refused and where."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.plants import ONE_BLOCK, SPRING_STAGE, TWO_BLOCKS
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, loads, save
from thermoctl.plant.fitting.estimate import updated
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import FLICKER_DECADES, ROLES, SensorNoise
from thermoctl.plant.simulation.sensor import error
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl_hal.simulated.rig import PlantRig

BLOCK = """\
format: thermoctl-plant/1
inputs:
  heat: {unit: W}
  air:
    unit: degC
    column: air_temperature
parameters: {C: {value: 46, unit: J/K}, G: {value: 0.3, unit: W/K}}
nodes:
  T:
    unit: degC
    storage: C
    initial: air
flows:
  power: {into: T, rate: heat, unit: W}
  loss: {from: T, rate: G * (T - air), unit: W}
outputs:
  y:
    value: T
    unit: degC
"""


def block(section, line):
    """BLOCK with a line more below the last of `section`: air, T or y."""
    after = {
        "air": "    column: air_temperature\n",
        "T": "    initial: air\n",
        "y": "    value: T\n    unit: degC\n",
    }
    return loads(BLOCK.replace(after[section], f"{after[section]}    {line}\n"), "p.yaml")


def refusal(section, line):
    with pytest.raises(InputError) as e:
        block(section, line)
    return str(e.value)


def table(n=40, **columns):
    t = np.arange(n, dtype=float)
    columns = {"heat": np.full(n, 5.0), "air_temperature": 20 + 0.1 * t} | columns
    return Table("r", "r.csv", t, {k: np.asarray(v, float) for k, v in columns.items()})


def outputs(plant, recording):
    return dict(zip(plant.outputs, compile_plant(plant).simulate(recording).y.T, strict=True))


# ---------------------------------------------------------------------------------------------------- role


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("section", ["air", "T", "y"])
def test_an_input_a_node_and_an_output_may_have_a_role(section, role):
    plant = block(section, f"role: {role}")
    where = {"air": plant.inputs, "T": plant.nodes, "y": plant.outputs}[section]
    assert where[section].role == role
    assert loads(BLOCK).inputs["air"].role is None, "it is optional"


@pytest.mark.parametrize(("section", "line"), [("air", 7), ("T", 13), ("y", 20)])
def test_another_role_is_refused_with_those_that_exist(section, line):
    message = refusal(section, "role: ambeint")
    assert message.startswith(f"p.yaml:{line}:11: role of '{section}': 'ambeint' is not one of ")
    assert all(role in message for role in ROLES) and "did you mean 'ambient'" in message


@pytest.mark.parametrize("section", ["parameters", "flows"])
def test_a_parameter_and_a_flow_have_no_role(section):
    old = {"parameters": "unit: J/K}", "flows": "rate: heat,"}[section]
    with pytest.raises(InputError, match="unknown key 'role'"):
        loads(BLOCK.replace(old, f"role: level, {old}"))


# --------------------------------------------------------------------------------------------------- noise


@pytest.mark.parametrize(
    ("text", "noise", "sd"),
    [
        ("0.05", 0.05, 0.05),
        ("{white: 0.03, drift: 0.04, time: 300}", SensorNoise(0.03, 0.04, 300), 0.05),
        ("{white: 0.03, drift: 0.04, time: 300, sd: 0.3}", SensorNoise(0.03, 0.04, 300, sd=0.3), 0.05),
        (
            "{white: 0.03, flicker: 0.01}",
            SensorNoise(0.03, flicker=0.01),
            np.hypot(0.03, 0.01 * FLICKER_DECADES**0.5),
        ),
        ("{white: 0, flicker: 0.01, sd: 0.5}", SensorNoise(0, flicker=0.01, sd=0.5), 0.02),
    ],
)
def test_noise_is_a_number_or_a_mapping(text, noise, sd):
    plant = block("y", f"noise: {text}")
    assert plant.outputs["y"].noise == noise
    assert plant.outputs["y"].noise_sd == pytest.approx(sd)
    assert default_noise(plant)[0].sigma == pytest.approx(sd), "a fit takes the whole as white"
    assert loads(BLOCK).outputs["y"].noise_sd == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{drift: 0.02, time: 300}", "'white' is missing"),
        ("{white: 0.05, drift: 0.02}", "'time' is missing"),
        ("{white: 0.05, time: 300}", "'drift' is missing"),
        ("{white: 0.05, drift: 0.02, time: 0}", "above 0 s"),
        ("{white: -1, flicker: 0.02}", "outside 0"),
        ("{white: 0.05, flicker: 0.02, time: 3}", "unknown key 'time'"),
        ("{white: 0.05, pink: 0.02}", "unknown key 'pink'"),
        ("{white: 0.05, flicker: much}", "a number was expected"),
        ("[0.05]", "a number was expected"),
    ],
)
def test_wrong_noise_is_refused_in_its_place(text, words):
    message = refusal("y", f"noise: {text}")
    assert message.startswith("p.yaml:20:") and "noise of" in message and words in message


def test_a_simulated_sensor_has_the_slow_parts_that_are_stated():
    plant = block("y", "noise: {white: 0.05, drift: 0.5, time: 30}")
    recording = table(20_000, air_temperature=np.full(20_000, 20.0))
    read = compile_plant(plant).measure(recording, seed=3).columns["y"]
    e = read - outputs(plant, recording)["y"]
    assert np.std(e) == pytest.approx(np.hypot(0.05, 0.5), rel=0.1)
    neighbours = np.mean(e[1:] * e[:-1])
    assert neighbours == pytest.approx(0.5**2 * np.exp(-1 / 30), rel=0.2)
    white = block("y", "noise: 0.5")
    e = compile_plant(white).measure(recording, seed=3).columns["y"] - outputs(white, recording)["y"]
    assert abs(np.mean(e[1:] * e[:-1])) < 0.01, "a plain number says nothing of slow parts"


def test_flicker_has_its_variance_in_every_decade():
    n, rng = 2**15, np.random.default_rng(5)
    t = np.arange(n, dtype=float)
    power = np.mean(
        [np.abs(np.fft.rfft(error(SensorNoise(0.0, flicker=0.2), t, rng))) ** 2 for _ in range(8)], axis=0
    )
    f = np.fft.rfftfreq(n)
    for low in (1e-3, 1e-2):
        band = (f >= low) & (f < 10 * low)
        assert 2 * power[band].sum() / n**2 == pytest.approx(0.2**2, rel=0.15)


def test_slow_noise_follows_the_times_of_unequal_samples():
    rng = np.random.default_rng(1)
    t = np.cumsum(np.where(np.arange(40_000) % 2, 1.0, 100.0))
    e = error(SensorNoise(0.0, 1.0, 50.0), t, rng)
    near, far = np.mean(e[1::2] * e[:-1:2]), np.mean(e[2::2] * e[1:-1:2])
    assert near == pytest.approx(np.exp(-1 / 50), abs=0.05) and far == pytest.approx(np.exp(-2), abs=0.05)


def test_the_simulated_rig_has_the_slow_parts_too(tmp_path):
    (tmp_path / "rig.yaml").write_text(
        "format: thermoctl-plant/1\ninputs: {u: {}}\nnodes: {x: {storage: 1, initial: 0}}\n"
        "flows: {f: {into: x, rate: u - x}}\n"
        "outputs: {position_um: {value: x, noise: {white: 0, drift: 0.5, time: 0.02}}}\n"
    )

    def readings():
        rig = PlantRig(tmp_path / "rig.yaml", 1e-3, "u", {}, {}, seed=3)
        found = []
        for _ in range(20_000):
            rig.step(0.0)
            found.append(rig.sense("position_um"))
        assert rig.true("position_um") == 0 and rig.sense("position_um") == found[-1], "one error an instant"
        return np.array(found)

    e = readings()
    assert np.std(e) == pytest.approx(0.5, rel=0.15)
    assert np.mean(e[1:] * e[:-1]) == pytest.approx(0.25 * np.exp(-0.05), rel=0.25)
    assert np.array_equal(e, readings()), "the same seed gives the same bits"


# -------------------------------------------------------------------------------------------- inputs and time


def test_a_column_is_the_inputs_own_name_unless_it_is_given():
    plant = loads(BLOCK)
    assert (plant.inputs["heat"].column, plant.inputs["air"].column) == ("heat", "air_temperature")
    assert plant.outputs["y"].column == "y"


def test_an_input_holds_unless_it_is_linear():
    n = 3
    text = "format: thermoctl-plant/1\ninputs: {u: {%s}}\nnodes: {x: {storage: 1, initial: 0}}\n"
    text += "flows: {f: {into: x, rate: u}}\noutputs: {y: {value: x}}\n"
    steps = table(n, u=[0, 2, 4])
    assert outputs(loads(text % ""), steps)["y"][-1] == pytest.approx(2)
    assert outputs(loads(text % "between_samples: hold"), steps)["y"][-1] == pytest.approx(2)
    assert outputs(loads(text % "between_samples: linear"), steps)["y"][-1] == pytest.approx(4)


def test_an_output_without_a_column_in_the_recording_is_not_measured():
    assert np.isnan(compile_plant(loads(BLOCK)).excitation(table()).y).all()


def test_t_is_seconds_since_the_first_sample():
    plant = loads("format: thermoctl-plant/1\noutputs: {y: {value: t}}")
    moved = dataclasses.replace(table(5), t=np.arange(5) + 1000.0)
    assert outputs(plant, moved)["y"] == pytest.approx(np.arange(5))


# ---------------------------------------------------------------------------------- storage, initial, absent


def test_storage_may_read_an_input():
    """A payload that is recorded: dv/dt = 1 N / mass(t)."""
    text = """\
format: thermoctl-plant/1
inputs: {payload: {unit: kg}, force: {unit: N}}
parameters: {m: {value: 1, unit: kg, range: [0.5, 2]}}
nodes: {v: {unit: m/s, storage: m + payload, initial: 0}}
flows: {push: {into: v, rate: force, unit: N}}
outputs: {speed: {value: v, unit: m/s}}
"""
    payload = np.repeat([0.0, 3.0], 10)
    y = outputs(loads(text), table(20, payload=payload, force=np.ones(20)))["speed"]
    assert y == pytest.approx(np.concatenate([[0], np.cumsum(1 / (1 + payload[:-1]))]))
    model = compile_plant(loads(text))
    run = model.run(model.excitation(table(20, payload=payload, force=np.ones(20))), None, None, True)
    slope = np.concatenate([[0], np.cumsum(-1 / (1 + payload[:-1]) ** 2)])
    assert run.dy[:, 0, 0] == pytest.approx(slope, rel=1e-5, abs=1e-9)
    with pytest.raises(InputError, match="storage times node per second"):
        loads(text.replace("m + payload", "m * payload"))


def test_storage_may_not_read_the_time_or_the_past():
    for wrong, words in (("C + t", "'t' may not stand there"), ("C * delay(heat, 2)", "delay")):
        with pytest.raises(InputError, match=words) as e:
            loads(BLOCK.replace("storage: C", f"storage: {wrong}"), "p.yaml")
        assert str(e.value).startswith("p.yaml:11:14: storage of 'T'")


@pytest.mark.parametrize(
    ("initial", "value"),
    [
        ("3", 3),
        ("air", 20),
        ("air + 2 * dT", 24),
        ("first(y)", 55),
        ("first(air)", 20),
        ("(first(y) + first(air)) / 2", 37.5),
        ("max(air, first(y) - dT)", 53),
    ],
)
def test_initial_forms(initial, value):
    text = BLOCK.replace("initial: air", f"initial: {initial}")
    if "dT" in initial:
        text = text.replace("parameters: {", "parameters: {dT: {value: 2, unit: K}, ")
    plant = loads(text)
    y = np.full(40, np.nan)
    y[3:] = 55.0  # the first recorded value of a slow sensor comes late
    assert outputs(plant, table(y=y))["y"][0] == pytest.approx(value)


@pytest.mark.parametrize(
    ("initial", "words"),
    [
        ("T", "'T' may not stand there"),
        ("t", "'t' may not stand there"),
        ("first(z)", "neither input nor output"),
        ("first(C)", "neither input nor output"),
        ("first(3)", "takes the name of an input or an output"),
        ("heat", "degC"),
        ("first(heat)", "degC"),
    ],
)
def test_wrong_initial_is_refused(initial, words):
    with pytest.raises(InputError) as e:
        loads(BLOCK.replace("initial: air", f"initial: {initial}"), "p.yaml")
    assert str(e.value).startswith("p.yaml:1") and words in str(e.value)


@pytest.mark.parametrize("old, new", [("initial: air", "initial: first(P)"), ("rate: heat", "rate: P")])
def test_the_name_of_a_column_in_a_plant_names_its_reader(old, new):
    text = BLOCK.replace("heat: {", "heat: {column: P, ", 1)
    assert old in text and "column: P" in text
    with pytest.raises(InputError, match="it is the column of 'heat': write 'heat'"):
        loads(text.replace(old, new))


def test_first_of_an_output_without_a_reading_is_an_error():
    plant = loads(BLOCK.replace("initial: air", "initial: first(y)"))
    with pytest.raises(InputError, match=r"first\(y\)"):
        compile_plant(plant).simulate(table())


@pytest.mark.parametrize("more", ["", "nodes: {}\nflows: {}\n", "nodes:\nflows:\n"])
def test_a_static_plant_has_neither_nodes_nor_flows(more):
    text = f"format: thermoctl-plant/1\ninputs: {{u: {{}}}}\nparameters: {{k: {{value: 3, range: [1, 9]}}}}\n{more}"
    plant = loads(text + "outputs: {y: {value: k * u, noise: 0.1}}\n")
    recording = table(5, u=np.arange(5))
    assert outputs(plant, recording)["y"] == pytest.approx(3 * np.arange(5))
    assert set(compile_plant(plant).measure(recording).columns) == {"u", "y"}
    assert "nodes" not in plant.plain() and "flows" not in plant.plain()


def test_what_leaves_one_node_arrives_in_the_other():
    text = "format: thermoctl-plant/1\nnodes: {a: {storage: 2, initial: 9}, b: {storage: 5, initial: 1}}\n"
    text += "flows: {f: {from: a, into: b, rate: 0.3 * (a - b)}}\noutputs: {stored: {value: 2 * a + 5 * b}}\n"
    assert outputs(loads(text), table())["stored"] == pytest.approx(23)


def test_a_recording_has_its_own_value_of_a_parameter():
    text = BLOCK.replace("G: {value: 0.3,", "G: {value: 0.3, per_recording: true, values: {r: 0, other: 9},")
    cooled, own = outputs(loads(BLOCK), table())["y"], outputs(loads(text), table())["y"]
    assert own[-1] == pytest.approx(20 + 39 * 5 / 46) and cooled[-1] < own[-1]
    unnamed = outputs(loads(text), dataclasses.replace(table(), name="third"))["y"]
    assert unnamed == pytest.approx(cooled), "`value` stands for any other recording"
    with pytest.raises(InputError, match="per_recording: true"):
        loads(text.replace("per_recording: true, ", ""))


def test_a_refit_finds_a_value_for_each_recording_and_their_mean_inside_the_range_only():
    plant = loads(
        "format: thermoctl-plant/1\ninputs: {u: {}}\n"
        "parameters: {b: {value: 1, range: [-5, 5], per_recording: true}, k: {value: 2}}\n"
        "outputs: {y: {value: k * u + b, noise: 0.01}}\n"
    )
    u = np.arange(40) / 40
    tables = [table(u=u, y=3 * u + b) for b in (0.5, 1.5, 9.0)]  # k is known, and b = 9 is not physical
    tables = [dataclasses.replace(t, name=n) for t, n in zip(tables, "abc", strict=True)]
    model = compile_plant(plant)
    excitations = [model.excitation(t) for t in tables]
    fitted = updated(plant, fit(model, excitations), excitations).parameters
    assert fitted["k"].value == 2, "a parameter without a range is known"
    middle = np.mean(u)  # b takes the mean error of k
    values = fitted["b"].values
    assert values == pytest.approx({"a": 0.5 + middle, "b": 1.5 + middle, "c": 5.0}, abs=0.02)
    assert fitted["b"].value == pytest.approx(np.mean(list(values.values())))


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("delay(u, 2)", 1),  # of an input, in an output
        ("delay(u, 2) + 0 * t", 1),
        ("step(u - 3)", 1),
        ("step(u - 3.1)", 0),
        ("(u >= 3) + (u > 3) + (u == 3) * 4 + (u != 3) * 8 + (u < 3) * 16 + (u <= 3) * 32", 37),
        ("table(u, [0, 1, 2], [5, 6, 8])", 8),
        ("-u**2", -9),
        ("min(u, 1, 2) + max(u, 1)", 4),
        ("cos(pi) * u", -3),
    ],
)
def test_expressions_in_an_output(expression, value):
    plant = loads(
        f"format: thermoctl-plant/1\ninputs: {{u: {{}}}}\noutputs: {{y: {{value: '{expression}'}}}}\n"
    )
    assert outputs(plant, table(4, u=np.arange(4)))["y"][-1] == pytest.approx(value)


def test_a_number_that_is_too_large_is_refused_also_as_a_product():
    for text in ("1e300 * 1e300", "1e200 + 9 * 1e308", "1e999", ".inf", ".nan", "9" * 400):
        with pytest.raises(InputError, match="too large"):
            loads(f"format: thermoctl-plant/1\noutputs: {{y: {{value: {text}}}}}\n")


def test_a_title_is_text():
    with pytest.raises(InputError, match=r"^p.yaml:2:8: title: text was expected"):
        loads("format: thermoctl-plant/1\ntitle: [a]\noutputs: {y: {value: 1}}", "p.yaml")


def test_a_wrong_unit_is_named_with_line_and_column():
    with pytest.raises(InputError, match=r"^p.yaml:15:9: rate of 'loss'"):
        loads(BLOCK.replace("G * (T - air)", "G * T * air"), "p.yaml")


# ---------------------------------------------------------------------------------------------- saved is read

NUMBERS = st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) > 1e-9)
LARGE = st.floats(1e-9, 1e6)
NAMES = st.sampled_from(["u", "w", "x", "k", "t", "pi"])


def _joined(inner):
    two = st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "**", "<", ">=", "=="]), inner)
    return st.one_of(
        two.map(lambda q: f"({q[0]}) {q[1]} ({q[2]})"),
        st.tuples(st.sampled_from(["abs", "sqrt", "tanh", "step", "-"]), inner).map(
            lambda q: f"{q[0]}({q[1]})"
        ),
        st.tuples(inner, inner, inner).map(lambda q: f"max({', '.join(q)})"),
        st.tuples(inner, NUMBERS).map(lambda q: f"table({q[0]}, [-1, 2.5], [{q[1]!r}, 4])"),
    )


EXPRESSIONS = st.recursive(st.one_of(NAMES, LARGE.map(repr)), _joined, max_leaves=8)
NOISES = st.one_of(
    LARGE,
    st.fixed_dictionaries({"white": LARGE, "drift": LARGE, "time": LARGE}, optional={"sd": LARGE}),
    st.fixed_dictionaries({"white": LARGE, "flicker": LARGE}, optional={"sd": LARGE}),
)
ROLE = st.sampled_from(ROLES)
TEXT = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)
UNIT = st.sampled_from(["K", "W/K", "%", "1", 1, "m/s**2"])


@st.composite
def plant_files(draw):
    def some(required, **optional):
        return draw(st.fixed_dictionaries({k: st.just(v) for k, v in required.items()}, optional=optional))

    def units(*items):  # a unit of no consequence: the generated expressions fit no dimension
        return dict.fromkeys(items, UNIT) if draw(st.integers(0, 9)) == 0 else {}

    used = "u + w + x + k"
    recorded = {"column": TEXT, "role": ROLE, "between_samples": st.sampled_from(["hold", "linear"])}
    value = draw(NUMBERS)
    spread = draw(st.floats(0.1, 10))
    k = some({"value": value}, range=st.just([value - spread * (1 + abs(value)), value + spread]))
    if draw(st.booleans()):
        k |= {"per_recording": True, "values": draw(st.dictionaries(TEXT, NUMBERS, max_size=3))}
    initial = st.sampled_from(["u", "first(y)", "k * first(w)", "2"])
    node = {"storage": draw(st.sampled_from(["1", "k", "k + w", "x * k"])), "initial": draw(initial)}
    output = {"column": TEXT, "noise": NOISES, "resolution": LARGE, "role": ROLE}
    return {
        "format": "thermoctl-plant/1",
        "title": draw(TEXT),
        "inputs": {"u": some({}, **recorded), "w": some({}, **recorded)},
        "parameters": {"k": k},
        "nodes": {"x": some(node, initial_sigma=LARGE, role=ROLE)},
        "flows": {
            "f": {draw(st.sampled_from(["from", "into"])): "x", "rate": f"{used} + {draw(EXPRESSIONS)}"}
        },
        "outputs": {"y": some({"value": draw(EXPRESSIONS)}, **output, **units("unit"))},
    }


@given(plant_files())
@settings(max_examples=150, deadline=None)
def test_a_saved_plant_is_read_back_equal(tmp_path_factory, data):
    try:
        plant = loads(yamlfile.dumps(data))
    except InputError as e:
        assert any(said in str(e) for said in ("dimension", "too large", "the exponent", "[")), e
        return
    path = tmp_path_factory.mktemp("saved") / "plant.yaml"
    save(plant, path, "a note\nof two lines")
    assert load(path) == plant


@pytest.mark.parametrize("text", [ONE_BLOCK, TWO_BLOCKS, SPRING_STAGE, BLOCK])
def test_a_known_plant_is_read_back_equal(text, tmp_path):
    save(loads(text), tmp_path / "p.yaml")
    assert load(tmp_path / "p.yaml") == loads(text)
