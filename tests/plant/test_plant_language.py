"""The parser: a wrong file of each kind gives its one error; nothing crashes, hangs, runs code or eats memory."""

import contextlib
import time
import tracemalloc

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant import from_plain, loads

GOOD = {
    "format": "thermoctl-plant/1",
    "title": "block",
    "inputs": {"P": {"unit": "W"}, "air": {"unit": "degC", "between_samples": "linear"}},
    "parameters": {
        "C": {"value": 46.0, "unit": "J/K", "range": [20, 90]},
        "G": {"value": 0.31, "unit": "W/K"},
    },
    "nodes": {"T": {"unit": "degC", "storage": "C", "initial": "air"}},
    "flows": {
        "heat": {"into": "T", "rate": "P", "unit": "W"},
        "loss": {"from": "T", "rate": "G * (T - air)", "unit": "W"},
    },
    "outputs": {"y": {"value": "T", "unit": "degC", "noise": 0.1}},
}


def changed(path, value):
    data = yaml.safe_load(yaml.safe_dump(GOOD))
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return yaml.safe_dump(data, sort_keys=False)


def test_good_file_survives_a_round_trip():
    plant = loads(yaml.safe_dump(GOOD))
    assert from_plain(plant.plain()).plain() == plant.plain()


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("format",), "thermoctl-plant/9", "thermoctl-plant/1"),
        (("outputs",), None, "outputs"),
        (("outputs",), {}, "outputs"),
        (("inputs", "P", "unti"), "W", "unit"),  # unknown key, with a suggestion
        (("inputs", "P", "between_samples"), "spline", "hold"),
        (("inputs", "spare"), {"unit": "V"}, "nothing reads it"),
        (("parameters", "spare"), {"value": 1}, "nothing uses it"),
        (("parameters", "C", "value"), "many", "value"),
        (("parameters", "C", "range"), [90, 20], "range"),
        (("parameters", "C", "range"), [50, 90], "range"),  # the belief outside
        (("parameters", "C", "value"), None, "value"),
        (("nodes", "lonely"), {"storage": 1, "initial": 0}, "no flow touches it"),
        (("nodes", "T", "initial_sigma"), -1, "initial_sigma"),
        (("flows", "loss", "from"), "U", "'U'"),
        (("flows", "loss"), {"rate": "G * (T - air)"}, "neither"),
        (("flows", "loss"), {"from": "T", "into": "T", "rate": "G * (T - air)"}, "itself"),
        (("flows", "loss", "rate"), "G * (T - iar)", "air"),  # did you mean
        (("flows", "loss", "rate"), "G * (T - air", ")"),
        (("flows", "loss", "rate"), "", ""),
        (("flows", "loss", "rate"), "G * delay(T, 3)", "delay"),
        (("outputs", "y", "value"), "delay(T, -3)", "reach -3; 0 at least"),
        (("outputs", "y", "value"), "delay(T - air, -3)", "more than recorded inputs"),
        (("outputs", "y", "value"), "delay(T, C - 50)", "reach -30; 0 at least"),  # at the lower bound of C
        (("flows", "loss", "rate"), "G * first(air)", "first"),
        (("flows", "loss", "rate"), "__import__('os').system('true')", "'"),
        (("flows", "loss", "rate"), "T.__class__", "."),
        (("flows", "loss", "rate"), "eval(T)", "eval"),
        (("flows", "loss", "rate"), "[T for T in G]", ""),
        (("flows", "loss", "rate"), "lambda: G", ""),
        (("flows", "loss", "rate"), "G if T else air", ""),
        (("flows", "loss", "rate"), "table(T, [0, 1], [0])", "table"),
        (("flows", "loss", "rate"), "table(T, [1, 0], [0, 1])", "increase"),
        (("flows", "loss", "rate"), "G * 1e999", "large"),
        (("flows", "loss", "unit"), "J", "W"),
        (("flows", "T"), {"from": "T", "rate": "G * (T - air)"}, "T"),  # a name used twice
        (("nodes", "sin"), {"storage": 1, "initial": 0}, "sin"),
        (("nodes", "2x"), {"storage": 1, "initial": 0}, "name"),
        (("nodes", "T", "storage"), "t * C", "storage"),
        (("nodes", "T", "initial"), "T", "initial"),
        (("outputs", "y", "noise"), "some", "noise"),
        (("flows",), [1, 2], "flows"),
    ],
)
def test_wrong_file_gives_its_one_error(path, value, words):
    with pytest.raises(InputError) as e:
        loads(changed(path, value), "bad.yaml")
    message = str(e.value)
    assert message.startswith("bad.yaml:") and "\n" not in message and len(message) < 1000
    assert words in message, message


FILE = """\
format: thermoctl-plant/1
inputs: {P: {unti: W}}
parameters: {C: {value: many}, G: {valeu: 1}}
nodes: {T: {storage: C, initial: 0, initial_sigma: -1}}
flows: {heat: {into: U, rate: P}}
outputs: {y: {value: T, column: 3}}
"""


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("inputs", "p.yaml:2:20: input 'P': unknown key 'unti' (did you mean 'unit'?); known here: "),
        ("parameters", "p.yaml:3:25: value of 'C': a number was expected, found 'many'"),
        ("parameters: G", "p.yaml:3:35: parameter 'G': 'value' is missing; is 'valeu' meant to be it?"),
        ("nodes", "p.yaml:4:52: initial_sigma of 'T': -1 is outside 0 .. inf"),
        ("flows", "p.yaml:5:22: flow 'heat': 'U' is not a node; nodes are T"),
        ("outputs", "p.yaml:6:33: column of 'y': a column's name was expected, found 3"),
    ],
)
def test_an_error_names_file_line_and_column(section, message):
    """The wrong entry of `section` is kept, those of the others are put right."""
    text = FILE
    right = {
        "inputs": ("unti", "unit"),
        "parameters": ("many", "1.00"),
        "parameters: G": ("valeu", "value"),
        "nodes": ("-1", "1"),
        "flows": ("U,", "T,"),
        "outputs": ("column: 3", "column: z"),
    }
    for name, (old, new) in right.items():
        text = text if name == section else text.replace(old, new)
    with pytest.raises(InputError) as e:
        loads(text, "p.yaml")
    assert str(e.value).startswith(message)


def test_initial_is_missing_and_initial_sigma_is_not_taken_for_it():
    with pytest.raises(InputError) as e:
        loads(
            FILE.replace("unti", "unit")
            .replace("many", "1")
            .replace("valeu", "value")
            .replace("initial: 0, ", ""),
            "p.yaml",
        )
    assert str(e.value).endswith("node 'T': 'initial' is missing")


def test_a_power_with_a_caret_is_answered_by_its_operator():
    with pytest.raises(
        ex.ExpressionError, match=r"'\^2' is not part of the language; a power is written \*\*;"
    ):
        ex.parse("a^2")


NAMES = st.sampled_from(["T", "air", "P", "C", "G", "t", "pi"])


def joined(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "<", ">="]), inner).map(
            lambda q: f"({q[0]} {q[1]} {q[2]})"
        ),
        st.tuples(st.sampled_from(["abs", "sign", "tanh", "sin", "cos", "step"]), inner).map(
            lambda q: f"{q[0]}({q[1]})"
        ),
        st.tuples(inner, inner).map(lambda q: f"max({q[0]}, min({q[1]}, 2))"),
        inner.map(lambda q: f"-{q}"),
    )


EXPRESSIONS = st.recursive(
    st.one_of(NAMES, st.floats(0.1, 9).map(lambda q: f"{q:.3g}")), joined, max_leaves=12
)


@given(EXPRESSIONS)
def test_an_expression_means_what_python_means_by_it(text):
    values = {"T": 1.7, "air": -0.4, "P": 2.3, "C": 0.9, "G": 3.1, "t": 0.6}
    functions = {
        "abs": abs,
        "sign": lambda q: float(np.sign(float(q))),
        "tanh": lambda q: float(np.tanh(float(q))),
        "sin": lambda q: float(np.sin(float(q))),
        "cos": lambda q: float(np.cos(float(q))),
        "max": max,
        "min": min,
        "step": lambda q: float(q >= 0),
        "pi": np.pi,
    }
    try:
        expected = float(eval(text, {"__builtins__": {}}, functions | values))
    except ZeroDivisionError:
        return
    if np.isfinite(expected) and abs(expected) < 1e12:
        with np.errstate(all="ignore"):
            assert float(ex.evaluate(ex.parse(text), values)) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(EXPRESSIONS)
def test_an_expression_survives_writing_and_reading(text):
    read = ex.parse(text)
    values = {"T": 1.7, "air": -0.4, "P": 2.3, "C": 0.9, "G": 3.1, "t": 0.6}
    with np.errstate(all="ignore"):
        a, b = float(ex.evaluate(read, values)), float(ex.evaluate(ex.parse(str(read)), values))
    assert a == pytest.approx(b, rel=1e-12, abs=1e-12, nan_ok=True)


@given(st.text(alphabet="TG()[]+-*/,.<>=1e9 _'\"\\:;{}@!$", max_size=60))
@settings(max_examples=400)
def test_any_text_is_an_expression_or_one_error(text):
    try:
        ex.parse(text)
    except ex.ExpressionError as e:
        assert str(e)


@given(
    st.dictionaries(
        st.text(max_size=6),
        st.recursive(
            st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8)),
            lambda inner: st.one_of(
                st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=6), inner, max_size=3)
            ),
            max_leaves=8,
        ),
        max_size=5,
    ),
    st.sampled_from(["inputs", "parameters", "nodes", "flows", "outputs", "title"]),
)
@settings(max_examples=40, deadline=None)
def test_any_yaml_in_any_section_is_a_plant_or_one_error(data, section):
    try:
        loads(yaml.safe_dump(GOOD | {section: data}), "fuzz.yaml")
    except InputError as e:
        assert "\n" not in str(e)


@pytest.mark.parametrize(
    "text",
    [
        "(" * 50_000 + "T" + ")" * 50_000,
        "-" * 100_000 + "T",
        "T" + "+T" * 100_000,
        "T**" * 3000 + "T",
        "9**9**9**9**9",
        "abs(" * 500 + "T" + ")" * 500,
        "1" * 30_000,
        "T" * 30_000,
    ],
)
def test_monsters_are_refused_or_read_quickly_in_bounded_memory(text):
    tracemalloc.start()
    begin = time.process_time()
    with contextlib.suppress(ex.ExpressionError, KeyError, OverflowError):
        ex.evaluate(ex.parse(text), {"T": 1.0})
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - begin < 5 and used < 100e6
