"""The unit check: what pint says, what the spec forgives, what is refused with the line and both dimensions."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import loads
from thermoctl.units import SYMBOLS, dimension, readable_time, without_brackets

PLANT = """format: thermoctl-plant/1
inputs: {{P: {{unit: W}}, air: {{unit: degC}}, v: {{unit: m/s}}}}
parameters:
  C: {{value: 40, unit: J/K}}
  G: {{value: 0.3, unit: {G}}}
nodes:
  T: {{unit: degC, storage: C, initial: air}}
flows:
  heat: {{into: T, rate: P, unit: {heat}}}
  loss: {{from: T, rate: "{loss}", unit: W}}
outputs:
  y: {{value: "{y}", unit: {y_unit}}}
  speed: {{value: v, unit: m/s}}
"""
GOOD = {"G": "W/K", "heat": "W", "loss": "G * (T - air)", "y": "T", "y_unit": "degC"}


def plant(**change):
    return loads(PLANT.format(**(GOOD | change)), "p.yaml")


@pytest.mark.parametrize(
    "change",
    [
        {"y": "T * 1e6 + v * 2", "y_unit": "um"},  # bare numbers take any dimension
        {"loss": "G * (T + 273.15 - air)"},
        {"loss": "G * (T - air) * tanh(v / 2e-4)"},
        {"loss": "G * (T - air) * tanh(v / 1.0)"},
        {"loss": "G * (T - air) * (v > 0.1)"},
        {"G": "kW/K", "heat": "mW"},  # prefixes are alike
        {"G": "J/s/K"},
        {"G": "kg*m**2/s^3/K"},
        {"G": "V*A/degC"},
        {"y": "delay(T, 3)", "y_unit": "K"},
        {"y": "table(v, [0, 1], [2, 3])", "y_unit": "bar", "loss": "G * (T - air)"},
        {"loss": "G * (T - air) * abs(v)**0.5 * 2", "G": "W/K"},
    ],
)
def test_accepts(change):
    plant(**change)


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        ({"heat": "J"}, 9, ("heat", "J = kg m2 s-2", "W = kg m2 s-3")),
        ({"G": "W"}, 10, ("loss", "K")),
        ({"loss": "G * T * v"}, 10, ("loss",)),
        ({"loss": "G * (T - v)"}, 10, ("K", "m s-1", "alike")),
        ({"loss": "G * (T - air) * exp(v)"}, 10, ("exp", "dimensionless")),
        ({"loss": "G * (T - air) * 2**v"}, 10, ("exponent",)),
        ({"y": "T", "y_unit": "um"}, 12, ("y", "K", "m")),
        ({"y": "delay(T, v)"}, 12, ()),
        ({"G": "W/Kelv1n"}, 5, ("pint knows no unit",)),
        ({"G": "W//K"}, 5, ("not a unit",)),
        ({"loss": "G * min(T, v)"}, 10, ("alike",)),
    ],
)
def test_refuses_with_line_and_dimensions(change, line, words):
    with pytest.raises(InputError) as e:
        plant(**({"loss": GOOD["loss"]} | change))
    message = str(e.value)
    assert message.startswith(f"p.yaml:{line}") and "\n" not in message
    for word in words:
        assert word in message, message


def test_pure_integrator_takes_its_dimension_from_its_flows():
    text = """format: thermoctl-plant/1
inputs: {a: {unit: m/s}, b: {unit: %s}}
nodes: {x: {unit: m, storage: 1, initial: 0}}
flows: {f: {into: x, rate: a, unit: m/s}, g: {into: x, rate: b, unit: %s}}
outputs: {y: {value: x, unit: um}}
"""
    loads(text % ("mm/s", "mm/s"))
    with pytest.raises(InputError, match="other flows of node 'x'"):
        loads(text % ("N", "N"))


@pytest.mark.parametrize("symbol", sorted(set(SYMBOLS) - {"1", "%", "dimensionless", "var", "kvar"}))
def test_table_of_common_units_is_pints(symbol):
    pint = pytest.importorskip("pint")
    registry = _registry(pint)
    bases = {"[length]": "m", "[mass]": "kg", "[time]": "s", "[current]": "A", "[temperature]": "K"}
    assert {bases[k]: float(v) for k, v in registry.get_dimensionality(symbol).items()} == {
        k: float(v) for k, v in dimension(symbol)
    }


def _registry(pint, kept=[]):  # noqa: B006 one registry for all cases: half a second each
    if not kept:
        kept.append(pint.UnitRegistry())
    return kept[0]


@settings(deadline=None)
@given(st.text(alphabet="WKms/*^()12.-+ %°²JNVx", max_size=24))
def test_any_text_is_a_dimension_or_one_error(text):
    try:
        dimension(text)
    except ValueError as e:
        assert "\n" not in str(e)


@pytest.mark.parametrize(
    "seconds, text",
    [
        (0.004, "0.004 s"),
        (90, "90 s"),
        (750, "12.5 min"),
        (7560, "2.1 h"),
        (259200, "3 days"),
        (1.2623e9, "40 years"),
    ],
)
def test_a_time_is_written_in_a_readable_unit(seconds, text):
    assert readable_time(seconds) == text


@pytest.mark.parametrize(
    "unit, plain",
    [
        ("(V) * s / (A)", "V*s/A"),
        ("(K)/s", "K/s"),
        ("(K)/K", "1"),
        ("1/(mm)**2", "1/mm**2"),
        ("(V)/(rad/s)", "V*s/rad"),
        ("(N*m) * s / (rad/s)", "N*m*s**2/rad"),
        ("W/K/m^2", "W/K/m^2"),  # without brackets: as it came
        ("(10 V)/s", "(10 V)/s"),
        ("(m**0.5)/s", "m**0.5/s"),
    ],
)
def test_a_unit_is_written_without_brackets(unit, plain):
    assert without_brackets(unit) == plain
    assert dimension(plain) == dimension(unit)
