"""The one look of all reports: numbers as people write them, words to the left, nothing from elsewhere."""

import re

import pytest

from thermoctl.report.page import cell, page, table, unit


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0.31437, "0.3144"),
        (209310.4, "209\u202f310"),
        (-12345.0, "−12\u202f345"),
        (3.2e-7, "3.2·10<sup>-7</sup>"),
        (2.5e9, "2.5·10<sup>9</sup>"),
        (20, "20"),
        ("<b>", "&lt;b&gt;"),
    ],
)
def test_cells(value, text):
    assert cell(value).replace("−", "-").replace("<sup>-", "<sup>-") == text.replace("−", "-")


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("degC", "°C"),
        ("um/K", "µm/K"),
        ("W/K**4", "W/K⁴"),
        ("W/K**1.25", "W/K^1.25"),
        ("N*s/m", "N·s/m"),
        ("1", ""),
        (None, ""),
        ("umbra", "umbra"),
        ("J/(kg*K)", "J/(kg·K)"),
    ],
)
def test_units(given, shown):
    assert unit(given) == shown


def test_words_stand_left_and_numbers_right():
    body = table(
        ("what", "where", "how much", "interval"),
        [("a", "coil", 1.5, "0.26 .. 0.33"), ("b", None, 2.0, "± 0.1")],
    )
    head, first = re.findall(r"<tr>(.*?)</tr>", body)[:2]
    assert [("class=text" in c) for c in re.findall(r"<th[^>]*>", head)] == [True, True, False, False]
    assert [("class=text" in c) for c in re.findall(r"<td[^>]*>", first)] == [True, True, False, False]
    assert "–" in body and 'class="wide"' in body


def test_a_page_needs_nothing_from_elsewhere_and_escapes_what_it_is_given():
    text = page("<T>", [("<h>", "<p>body</p>")], "a & b")
    assert "<T>" not in text and "&lt;h&gt;" in text and "a &amp; b" in text and "<script" not in text
    assert not re.search(r"(src|href)=|url\(|@import", text)
