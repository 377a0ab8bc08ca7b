"""Text lines: a number that could be another one is refused or reported with its line, never misread (issue 21, B6)."""

import os
import time
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import ROLE, Sample
from thermoctl_hal.profiles.bind import bind
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.serial.port import SerialDevice
from thermoctl_hal.serial.text_number import number, takes_letters

POSITION = ROLE["position_um"]
PROFILE = """
format: thermoctl-device/1
vendor: test
model: gauge
bus: serial-lines
text: {{pattern: '{pattern}'{text}}}
channels:
  position: {{field: x, unit: um, range: [-5000, 5000], rate_hz: 10, stale_after_s: 1{channel}}}
"""


class Gauge:
    """A gauge on a pseudo-terminal, and the driver that reads it."""

    def __init__(self, folder, pattern, text="", channel=""):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        (folder / "gauge.yaml").write_text(PROFILE.format(pattern=pattern, text=text, channel=channel))
        node = f"{{name: gauge, profile: gauge.yaml, port: {os.ttyname(slave)}, roles: {{position: position_um}}}}"
        self.device, self.sample = SerialDevice(bind(yamlfile.loads(node), folder)), Sample()
        self.device.connect()
        os.write(self.master, b"\r\n")  # ends a line that began before

    def says(self, line):
        """Send a line; the reading that it gives, or None."""
        os.write(self.master, line.encode("latin-1") + b"\r\n")
        self.sample.fresh[:] = False
        end = time.monotonic() + 10.0  # a busy kernel hands a line on later
        while time.monotonic() < end:
            before = sum(self.device.counts[k] for k in ("frames", "errors"))
            self.device.read(self.sample, 1.0)
            if sum(self.device.counts[k] for k in ("frames", "errors")) > before:
                break
        return self.sample.value[POSITION] if self.sample.fresh[POSITION] else None

    def close(self):
        self.device.disconnect()
        os.close(self.master)


@pytest.fixture
def gauge(tmp_path):
    made = []

    def make(*arguments, **more):
        made.append(Gauge(tmp_path, *arguments, **more))
        return made[-1]

    yield make
    for g in made:
        g.close()


@pytest.mark.parametrize("line,counts", [("+78", 120), ("+400", 1024), ("+1E5", 485), ("-000A", -10)])
def test_hexadecimal_lines_are_read_as_such(gauge, line, counts):
    assert gauge("(?P<x>[-+][0-9A-F]+)$", channel=", base: 16").says(line) == counts


@pytest.mark.parametrize(
    "pattern", ["[-+][0-9A-F]+", r"\\S+", "[0-9A-Fa-f]{4}", "[^,]*", r"[-+]?[\\dABCDEF]+"]
)
def test_a_group_that_takes_letters_must_say_its_base(tmp_path, pattern):
    pattern = pattern.replace("\\\\", "\\")
    for base in (", base: 10", ", base: 16"):
        (tmp_path / "gauge.yaml").write_text(
            PROFILE.format(pattern=f"(?P<x>{pattern})$", text="", channel=base)
        )
        assert load_profile(tmp_path / "gauge.yaml")
    (tmp_path / "gauge.yaml").write_text(PROFILE.format(pattern=f"(?P<x>{pattern})$", text="", channel=""))
    with pytest.raises(
        InputError, match=r"gauge.yaml:\d+:\d+: .*'x' .*letters A to F: say base: 16, or base: 10"
    ):
        load_profile(tmp_path / "gauge.yaml")


def test_decimal_patterns_need_no_base():
    import re

    for group in ("[-+.0-9]+", "[-+.0-9eE]+", r"[-+]? *\d+\.\d+", r"[-+]\d{4}", "[]0-9.)(]+"):
        assert not takes_letters(re.compile(f"V=(?P<x>{group}) (?P<y>[A-F]+)"), "x"), group


@pytest.mark.parametrize(
    "pattern,line,words",
    [
        ("(?P<x>[-+.0-9]+)$", "1,5", ["'1,5'", "does not match", "decimal: ','"]),
        ("(?P<x>[-+.,0-9]+)$", "1,5", ["'1,5'", "is no decimal", "decimal: ','"]),
        ("(?P<x>[-+.0-9]+)", "1,5", ["'1,5'", "the number goes on behind '1'"]),
        ("(?P<x>[-+.0-9]+)", "1.5e3", ["'1.5e3'", "the number goes on behind '1.5'"]),
        (
            "(?P<x>[-+.0-9]+)$",
            "-   5.23",
            ["'-   5.23'", "blanks stand between sign and digits", "[-+] *[0-9.]+"],
        ),
        ("X=(?P<x>[-+.0-9]+)$", "ERR 7", ["'ERR 7'", "the pattern is X="]),
        ("X=(?P<x>[-+.0-9]+)$", "0: X=5", ["fits further right"]),
        ("(?P<x>[-+.0-9]+)$", "--5", ["'--5' is no decimal"]),
        ("(?P<x>[-+.0-9]+)$", "\xff\x00\x1b" + "9" * 200, ["\\x00\\x1b999", "..."]),
    ],
)
def test_a_line_that_gives_no_reading_is_told_with_its_reason(gauge, pattern, line, words):
    g = gauge(pattern)
    assert g.says(line) is None
    text = g.device.silence()
    assert text.startswith("1 lines gave no reading; received ") and "\n" not in text
    assert all(w in text for w in words), text
    assert g.says("5.25") == 5.25 if "X=" not in pattern else g.says("X=5.25") == 5.25
    assert "nothing arrives" in g.device.silence()  # a good line starts anew


def test_the_other_decimal_sign_and_blanks_are_read_where_the_profile_says_so(gauge):
    comma = gauge("(?P<x>[-+] *[0-9,]+)$", text=", decimal: ','")
    assert comma.says("-   5,23") == -5.23
    assert comma.says("+1,2,3") is None and "is no decimal" in comma.device.silence()


def test_a_half_answer_is_no_part_of_the_next_one(gauge):
    """`2` of an answer that was cut, and `21.5` of the next one, gave 221.5."""
    made = gauge("(?P<x>[0-9.]+)$", ", request: 'T?', request_hz: 20")
    os.write(made.master, b"2")
    end = time.monotonic() + 10.0
    while made.device._lines.pending == 0 and time.monotonic() < end:
        made.device.read(made.sample, 1.0)
    made.device._lines._heard_s -= 1.0  # and the rest does not come
    made.device.read(made.sample, 2.0)  # asks again
    assert made.device._lines.pending == 0
    os.write(made.master, b"21.5\r\n")
    while not made.sample.fresh[POSITION] and time.monotonic() < end:
        made.device.read(made.sample, 2.0)
    assert made.sample.value[POSITION] == 21.5


def test_bytes_without_a_line_end_are_told(gauge):
    g = gauge("(?P<x>[-+.0-9]+)$")
    assert "nothing arrives" in g.device.silence()
    os.write(g.master, b"12.5 12.5 12.5")
    while not g.device._lines.pending:
        g.device.read(g.sample, 1.0)
    assert "14 bytes came and no line end" in g.device.silence()


@given(st.floats(-1e6, 1e6), st.sampled_from([".", ","]))
def test_decimal_numbers_round_trip(value, decimal):
    text = repr(value).replace(".", decimal)
    assert number(text, 10, decimal) == value and number(f" {text} ", 10, decimal) == value


@given(st.text(max_size=20), st.sampled_from([10, 16]), st.sampled_from([".", ","]))
def test_any_text_is_a_number_or_none(text, base, decimal):
    value = number(text, base, decimal)
    assert value is None or value == value


def test_a_line_of_another_kind_leaves_the_other_reading_alone(gauge):
    g = gauge("(?:X=(?P<x>[-+.0-9]+)|T=(?P<t>[-+.0-9]+))$")
    assert g.says("X=1.5") == 1.5
    assert g.says("T=7") is None and g.device.counts["errors"] == 0


def test_the_rest_of_a_line_from_before_is_no_reading(gauge):
    """+0012.456 was read as 2.456 by a port that was opened in the middle of it."""
    made = gauge("(?P<x>[-+0-9.]+)$")
    made.device.disconnect()
    made.device.connect()
    os.write(made.master, b"2.456\r\n")
    assert made.says("+0012.789") == 12.789 and made.device.counts["frames"] == 1
