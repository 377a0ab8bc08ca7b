"""`Section`, the one typed reader of mappings: values come out typed, each mistake with its place and what was expected."""

import math
import re

import pytest

from thermoctl.files.yamlfile import InputError, Section, loads

TEXT = """\
name: pump
mode: fast
gain: 2.5
count: 0x10
on: true
span: [1, 4]
items: [a, b]
inner: {depth: 3}
empty:
"""


def section(text: str = TEXT) -> Section:
    return Section(loads(text, "f.yaml"), "a pump")


def test_values_are_typed():
    s = section()
    assert (s.text("name"), s.text("mode", choices=("slow", "fast")), s.text("other", "x")) == (
        "pump",
        "fast",
        "x",
    )
    assert (s.number("gain"), s.number("absent", 1.0), s.optional_number("empty")) == (2.5, 1.0, None)
    assert (s.integer("count"), s.flag("on", False), s.flag("off", True)) == (16, True, True)
    assert s.interval("span") == (1.0, 4.0) and s.interval("none") == (-math.inf, math.inf)
    assert [n.value for n in s.list("items")] == ["a", "b"] and s.list("nothing", False) == []
    assert s.section("inner").number("depth") == 3.0 and s.section("absent", False) is None
    assert s.given("empty") is None
    s.end()


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda s: s.text("gain"), "f.yaml:3:7: gain: text was expected, found 2.5"),
        (
            lambda s: s.text("mode", choices=("slow", "fats")),
            "f.yaml:2:7: mode: 'fast' is not one of slow, fats (did",
        ),
        (lambda s: s.number("name"), "f.yaml:1:7: name: a number was expected, found 'pump'"),
        (lambda s: s.number("on"), "f.yaml:5:5: on: a number was expected, found True"),
        (lambda s: s.number("gain", high=2), "f.yaml:3:7: gain: 2.5 is outside -inf .. 2"),
        (lambda s: s.integer("gain"), "f.yaml:3:7: gain: a whole number was expected, found 2.5"),
        (lambda s: s.flag("gain", True), "f.yaml:3:7: gain: true or false was expected, found 2.5"),
        (lambda s: s.interval("items"), "f.yaml:7:9: items: a number was expected, found 'a'"),
        (lambda s: s.list("gain"), "f.yaml:3:7: gain: a list was expected, found 2.5"),
        (lambda s: s.section("gain"), "f.yaml:3:7: gain: a mapping (key: value) was expected, found 2.5"),
        (lambda s: s.get("nmae"), "f.yaml:1:1: a pump: 'nmae' is missing; is 'name' meant to be it?"),
        (lambda s: s.get("zzz"), "f.yaml:1:1: a pump: 'zzz' is missing"),
        (lambda s: (s.text("name"), s.end()), "f.yaml:2:7: a pump: unknown key 'mode'; known here: name"),
    ],
)
def test_each_mistake_has_its_place(read, message):
    with pytest.raises(InputError) as e:
        read(section())
    assert str(e.value).startswith(message)


@pytest.mark.parametrize("number", [".inf", "-.inf", ".nan", "1e300"])
def test_a_number_is_finite(number):
    with pytest.raises(InputError, match="a number was expected"):
        section(f"gain: {number}").number("gain")


@pytest.mark.parametrize(
    "text, says",
    [
        ("a: {value: 3,5}", ":1:12: '3,5' has a decimal comma; write 3.5"),
        ("a: {b: 1, value: -3,5, unit: K}", ":1:18: '-3,5' has a decimal comma; write -3.5"),
        ("a: {value: 3,5e3}", "write 3.5e3"),
        ("a: {value: 3,5 ms}", "write 3.5 ms"),
        ('{"a": {"value": 3,5}}', "write 3.5"),
        (
            "a: {rate: K * min(x - y, 2), unit: W}",
            ':1:11: a comma ends this value; quote the whole: "K * min(x - y, ..."',
        ),
    ],
)
def test_a_comma_in_braces_begins_no_key(text, says):
    with pytest.raises(InputError, match=re.escape(says)):
        loads(text)


def test_a_decimal_comma_elsewhere():
    for text in ("gain: 3,5", "gain: '3,5'", "gain: 3,5 ms"):
        with pytest.raises(InputError, match="gain: '3,5.*' has a decimal comma; write 3.5"):
            section(text).number("gain")
    with pytest.raises(InputError, match="two numbers .*write decimals with a point"):
        section("gain: [1,5, 2,5]").interval("gain")
    assert loads("{a: 1.5,b: 2, c: [1,5], d: {e: 3,4: 1}}").plain() == {
        "a": 1.5,
        "b": 2,
        "c": [1, 5],
        "d": {"e": 3, "4": 1},
    }


@pytest.mark.parametrize(
    "mark, says",
    [("\t", "a tab is not allowed"), ("\u00a0", "U\\+00A0 is no blank"), ("\u200b", "U\\+200B is")],
)
def test_what_looks_like_a_blank_is_named_with_its_line(mark, says):
    """Copied from a manual or a chat, it broke the file, and the message named the line after it."""
    with pytest.raises(InputError, match=f"not valid YAML: .*{says}.*: line 2\\)"):
        loads(f"control:\n  kp:{mark}0.01\n  ti_s: 0.004\n")
