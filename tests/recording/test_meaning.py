"""A table in any dialect, clock, unit, spelling and order is read to its own numbers or refused; never to others."""

import os
from datetime import UTC, datetime, timedelta

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import read_recording

EXAMPLES = int(os.environ.get("THERMOCTL_READINGS", "60"))
BEGIN = datetime(2026, 3, 1, 9, 59, 58, tzinfo=UTC)
SECONDS = {"s": 1, "sec": 1, "ms": 1e-3, "msec": 1e-3, "min": 60, "h": 3600, "hours": 3600, "us": 1e-6}
EXCEL, LABVIEW = datetime(1899, 12, 30, tzinfo=UTC), datetime(1904, 1, 1, tzinfo=UTC)


def dated(pattern, digits=0):
    """Return a writer of dates: the pattern of strftime and the digits of its fraction."""

    def write(t, decimal):
        """Return cells of the times t."""
        stamps = [BEGIN + timedelta(seconds=float(x)) for x in t]
        fraction = [f"{s.microsecond:06d}"[:digits] for s in stamps]
        return [
            s.strftime(pattern).replace("@", (decimal if digits else "") + f)
            for s, f in zip(stamps, fraction, strict=True)
        ]

    return write


def counted(scale, since=None, digits=9):
    """Return a writer of numbers: seconds over `scale` since a date, or from zero."""
    zero = (BEGIN - since).total_seconds() if since else 0.0

    def write(t, decimal):
        """Return cells of the times t."""
        cells = [f"{(zero + x) / scale:.{digits}f}" for x in t]
        return [(c.rstrip("0").rstrip(".") if "." in c else c).replace(".", decimal) for c in cells]

    return write


# name: (headers, writer, smallest step of its digits in s)
CLOCKS = {
    "ISO": (("time", "Zeit", "timestamp", "Date/Time", "stamp"), dated("%Y-%m-%d %H:%M:%S@", 3), 1e-3),
    "ISO, T and zone": (("time", "_time"), dated("%Y-%m-%dT%H:%M:%S@Z", 3), 1e-3),
    "German": (("Datum", "Zeitstempel"), dated("%d.%m.%Y %H:%M:%S"), 1),
    "American": (("Date Time", "time"), dated("%m/%d/%Y %I:%M:%S %p"), 1),
    "time of day": (("Uhrzeit", "Time"), dated("%H:%M:%S@", 3), 1e-3),
    "named month": (("Time",), dated("%d-%b-%Y %H:%M:%S"), 1),
    "compact": (("time", "DateTime"), dated("%Y%m%d%H%M%S"), 1),
    "zone's name": (("time",), dated("%Y-%m-%d %H:%M:%S CET"), 1),
    "unix": (("time", "unix", "timestamp"), counted(1, datetime(1970, 1, 1, tzinfo=UTC), 3), 1e-3),
    "unix ms": (("time", "epoch"), counted(1e-3, datetime(1970, 1, 1, tzinfo=UTC), 0), 1e-3),
    "1904": (("Timestamp", "time"), counted(1, LABVIEW, 3), 1e-3),
    "Excel": (("Date/Time", "Datum"), counted(86400, EXCEL, 10), 1e-3),
    **{
        f"[{u}]": ((f"time [{u}]", f"Zeit ({u})", f"elapsed_{u}"), counted(s), max(s * 1e-3, 1e-3))
        for u, s in SECONDS.items()
    },
    "no unit": (("t", "time", "Zeit", "elapsed"), counted(1), 1e-3),
}
FIXED = ("time of day",)
MISSING = ("", "NaN", "n/a", "--", "unavailable", "#N/A")


def spelled(value, style, decimal, thousands, unit):
    """Return one number (thousandths) in a spelling."""
    sign, size = ("-" if value < 0 else ""), abs(value)
    whole, rest = divmod(size, 1000)
    text = f"{whole:,}".replace(",", thousands) if thousands else str(whole)
    text += f"{decimal}{rest:03d}" if rest or style == "fixed" else ""
    if style == "exponent":
        text = f"{size}{'E' if not thousands else 'D'}-03"
    sign = {"minus": "−", "blank": "- "}.get(style, "-") if sign else ("+" if style == "plus" else "")
    return sign + text + (f" {unit}" if unit else "")


@st.composite
def tables(draw):
    """Draw the text of a table, and the times and columns that it holds."""
    kind = draw(st.sampled_from(sorted(CLOCKS)))
    headers, write, quantum = CLOCKS[kind]
    count = draw(st.integers(3, 9))
    unit_step = draw(st.sampled_from([1, 2, 5, 60, 3600] if quantum >= 1 else [0.005, 0.5, 1, 10, 60]))
    step = max(unit_step, quantum) if kind != "[h]" else 3.6
    if draw(st.booleans()) or kind.startswith("["):
        t = np.arange(count) * step
    else:
        t = np.cumsum([0, *(step * draw(st.integers(1, 4)) for _ in range(count - 1))])
    separator = draw(st.sampled_from([",", ";", "\t", "|"]))
    decimal = draw(st.sampled_from([".", ","]))
    quote = separator == "," and (decimal == "," or draw(st.booleans()))
    thousands = draw(st.sampled_from(["", "", "", " ", "'", "." if decimal == "," else ","]))
    if thousands == "," and separator == ";":
        thousands = ""  # in a file with semicolons a comma is the decimal sign
    quote |= separator == "," and thousands == ","
    columns = {"time": (draw(st.sampled_from(headers)), write(t, "." if "unix" not in kind else decimal))}
    if kind.startswith("[") or kind in ("no unit", "1904", "Excel"):
        columns["time"] = columns["time"][0], write(t, decimal)
    values, units = {}, {}
    for name in ("T", "P", "T_block")[: draw(st.integers(1, 3))]:
        style = draw(st.sampled_from(["plain", "fixed", "minus", "blank", "plus", "exponent"]))
        unit = draw(st.sampled_from(["", "", "degC", "mV"]))
        where = draw(st.sampled_from(["header", "cell"])) if unit else ""
        numbers = draw(st.lists(st.integers(-2_000_000, 2_000_000), min_size=count, max_size=count))
        empty = draw(st.lists(st.sampled_from([False, False, False, True]), min_size=count, max_size=count))
        word = draw(st.sampled_from(MISSING))
        cells = [
            word if gone else spelled(x, style, decimal, thousands, unit if where == "cell" else "")
            for x, gone in zip(numbers, empty, strict=True)
        ]
        columns[name] = (f"{name} [{unit}]" if where == "header" else name), cells
        values[name] = np.where(empty, np.nan, np.array(numbers) / 1000)
        units[name] = unit if where == "header" or not all(empty) else ""
    if draw(st.booleans()):
        columns["counter"] = (
            draw(st.sampled_from(["#", "No", "Index", "Sample"])),
            [str(i) for i in range(count)],
        )
        values[columns["counter"][0]] = np.arange(count)
    if draw(st.integers(0, 3)) == 0:
        words = draw(st.sampled_from([("off", "on"), ("False", "True"), ("no", "yes")]))
        bits = draw(st.lists(st.integers(0, 1), min_size=count, max_size=count))
        columns["heater"] = "heater", [words[b] for b in bits]
        values["heater"] = np.array(bits, float)
    order = draw(st.permutations(sorted(columns)))
    cell = (lambda x: f'"{x}"') if quote else str
    rows = [[columns[k][0] for k in order], *zip(*(columns[k][1] for k in order), strict=True)]
    body = "\n".join(separator.join(map(cell, r)) for r in rows)
    preamble = draw(st.sampled_from(["", "", "Logger 7\n", "# a run\n", "Serial: 12\n\n"]))
    text = preamble + body + draw(st.sampled_from(["", "\n", "\n\n"]))
    encoding = draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]))
    return text.replace("\n", draw(st.sampled_from(["\n", "\r\n"]))).encode(encoding), t, values, units, text


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=EXAMPLES == 60,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
    ],
)
@given(tables())
def test_the_same_numbers_or_an_error(tmp_path, drawn):
    data, t, values, units, text = drawn
    path = tmp_path / "run.csv"
    path.write_bytes(data)
    try:
        table = read_recording(path)
    except InputError as e:
        COUNT["refused"] += 1
        assert str(e).startswith(str(path))
        return
    COUNT["read"] += 1
    np.testing.assert_allclose(table.t - table.t[0], t - t[0], atol=2e-5, err_msg=text)
    for name, expected in values.items():
        assert name in table.columns, text
        np.testing.assert_allclose(table.columns[name], expected, rtol=1e-12, atol=1e-12, err_msg=text)
    assert all(table.units.get(n, "") in (u, "") and (not u or n in table.units) for n, u in units.items()), (
        text
    )


COUNT = {"read": 0, "refused": 0}


def test_most_tables_are_read():
    assert COUNT["read"] > 4 * COUNT["refused"], COUNT
    print(COUNT)
