"""The style of all pages: self-contained HTML without scripts, light and dark, on telephones and on paper."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Colours in figures, and their variables in the style sheet: each theme has shades of its own.
BLACK, GREY, ORANGE, BLUE, FAINT = "#1b1f24", "#7d8894", "#c7621b", "#0b6bcb", "#d9d9d9"
_VARIABLES = {
    BLACK: "fg",
    GREY: "soft",
    ORANGE: "warm",
    BLUE: "mark",
    FAINT: "line",
    "#000000": "fg",
    "#f3f6f9": "tint",
    "#1a7f37": "good",
    "#b3261e": "bad",
    "#ffffff": "bg",
}
HALF, THIRD, HEIGHT = 4.4, 3.2, 2.4  # inches of panels: two or three stand side by side on a screen
TICKS = 6  # largest number of intervals between the numbers at an axis
LETTER, LINE = 0.08, 0.2  # inches that a digit and a line of text take
_STYLE = Path(__file__).with_name("style.css")
_NUMERIC = re.compile(r"^[-+−±<>≤ \d.,:/()%…eE·–]*$")
_UNIT = re.compile(r"\b(degC|um|us|ohm)\b")
_TEXT: Any = {  # style of figures: one size of letters, no frame
    "font.size": 9,
    **dict.fromkeys(
        ("axes.titlesize", "axes.labelsize", "legend.fontsize", "xtick.labelsize", "ytick.labelsize"), 9
    ),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), GREY),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor", "axes.labelcolor", "text.color"), BLACK),
    "axes.titley": 1.0,
    "path.simplify": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "thermoctl",
}


def page(title: str, sections: Iterable[tuple[str, str]], note: str = "") -> str:
    """Return a whole HTML page from (heading, HTML body) pairs; `note` stands under the title."""
    parts = [f"<section><h2>{html.escape(h)}</h2>\n{body}\n</section>" if h else body for h, body in sections]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE.read_text()}</style></head><body>\n<h1>{html.escape(title)}</h1>\n"
        + (f'<p class="note">{html.escape(note)}</p>\n' if note else "")
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def table(head: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Return an HTML table; numbers are rounded and to the right, words to the left, None a dash.

    On a telephone each row is a card, with the heads beside the values."""
    rows = [list(row) for row in rows]
    words = [
        any(isinstance(v, str) and not _NUMERIC.match(v) for row in rows for v in row[k : k + 1])
        for k in range(len(head))
    ]

    def line(cells: Sequence[object], tag: str) -> str:
        """Return a row of the table; `tag`: th in the head, td in the body."""
        out = ""
        for k, v in enumerate(cells):
            kind = " class=text" if k < len(words) and words[k] else ""
            of = f' data-head="{html.escape(head[k])}"' if tag == "td" and k and k < len(head) else ""
            out += f"<{tag}{kind}{of}>{cell(v)}</{tag}>"
        return f"<tr>{out}</tr>\n"

    top = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="wide"><table class="cards">{top}<thead>{line(head, "th")}</thead><tbody>\n'
        + "".join(line(row, "td") for row in rows)
        + "</tbody></table></div>"
    )


def cell(v: object) -> str:
    """Return a number or a word as HTML: 4 significant digits, separated thousands, powers of ten."""
    if v is None or (isinstance(v, float) and math.isnan(v)):
        return "–"
    if not isinstance(v, float):
        return html.escape(str(v))
    text = f"{v:,.0f}".replace(",", "\u202f") if 1e4 <= abs(v) < 1e7 else f"{v:.4g}"
    mantissa, e, power = text.partition("e")
    return (f"{mantissa}·10<sup>{int(power)}</sup>" if e else mantissa).replace("-", "−")


def paragraph(text: str) -> str:
    """Return a paragraph of plain text."""
    return f"<p>{html.escape(text)}</p>"


def items(lines: Sequence[str]) -> str:
    """Return a list of plain lines; '' without one."""
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def folded(title: str, body: str) -> str:
    """Return a body that opens by a click on its title."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>" if body else ""


def unit(name: str | None) -> str:
    """Return a unit as people write it: degC is °C, um is µm, no unit is nothing."""
    text = _UNIT.sub(lambda m: {"degC": "°C", "um": "µm", "us": "µs", "ohm": "Ω"}[m[0]], name or "")
    text = (
        re.sub(r"\*\*(2|3|4)(?![.\d])", lambda m: {"2": "²", "3": "³", "4": "⁴"}[m[1]], text)
        .replace("**", "^")
        .replace("*", "·")
    )
    return "" if text == "1" else text.replace("(unit_of_y)", "reading").replace("unit_of_y", "reading")


def figure(fig: Figure, caption: str = "", narrow: Figure | None = None) -> str:
    """Return a matplotlib figure as inline SVG with its caption; `narrow`: the figure for telephones."""
    body = _svg(fig)
    if narrow:
        body = f'<div class="broad">{body}</div><div class="narrow">{_svg(narrow)}</div>'
    return _captioned(body, caption)


def panel(width: float = HALF) -> Axes:
    """Return the axes of a new panel in the pages' style, `width` in inches."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_TEXT):
        return Figure(figsize=(width, HEIGHT)).add_subplot()


def panels(every: Sequence[Axes], caption: str) -> str:
    """Return panels as inline SVG, side by side where there is room, below the legend of the first."""
    lines = zip(*every[0].get_legend_handles_labels(), strict=True)
    legend = "".join(_legend(cast("Line2D", line), label) for line, label in lines)
    _make_room(every)
    drawn = "".join(_svg(cast("Figure", axes.figure)) for axes in every)
    return _captioned(f'<p class="legend">{legend}</p><div class="panels">{drawn}</div>', caption)


def _captioned(body: str, caption: str) -> str:
    return f"<figure>{body}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _legend(line: Line2D, label: str) -> str:
    """Return a line's label beside a piece of the line."""
    kind = {"--": "dashed", "None": "dotted"}.get(str(line.get_linestyle()), "solid")
    style = f"border-top:{max(line.get_linewidth(), 1)}pt {kind} {_themed(str(line.get_color()))}"
    return f'<span><i style="{style}"></i>{html.escape(label)}</span>'


def _make_room(every: Sequence[Axes]) -> None:
    """Place axes beside their texts, by numbers of letters: layouts of matplotlib's draw all three times."""
    letters = 0
    for axes in every:
        axes.locator_params(nbins=TICKS)
        numbers = axes.yaxis.get_major_formatter().format_ticks(list(axes.yaxis.get_majorticklocs()))
        letters = max(letters, *map(len, numbers))
    left, low, high = LETTER * letters + 1.5 * LINE, 2.3 * LINE, HEIGHT - 3.6 * LINE
    for axes in every:
        whole = cast("Figure", axes.figure).get_figwidth()
        width = whole - left - LINE
        axes.set_position((left / whole, low / HEIGHT, width / whole, high / HEIGHT))
        axes.yaxis.set_label_coords((0.7 * LINE - left) / width, 0.5)
        axes.xaxis.set_label_coords(0.5, (1.1 * LINE - low) / high)


def _svg(fig: Figure) -> str:
    """Return a figure as SVG without a ground, in the page's colours, lines to tenths of a point."""
    import matplotlib

    for axis in fig.axes:
        axis.spines[["top", "right"]].set_visible(False)
    out = io.StringIO()
    with matplotlib.rc_context(_TEXT):
        fig.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    svg = out.getvalue()
    svg = re.sub(r' d="[^"]*"', lambda m: re.sub(r"(\.\d)\d+", r"\1", m[0]), svg[svg.index("<svg") :])
    return _themed(svg)


def _themed(text: str) -> str:
    """Return a text with the page's colours in the place of a figure's."""
    return re.sub("|".join(_VARIABLES), lambda m: f"var(--{_VARIABLES[m[0]]},{m[0]})", text)
