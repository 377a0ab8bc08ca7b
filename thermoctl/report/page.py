"""The style of all pages: self-contained HTML without scripts, light and dark, fit for print."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root{color-scheme:light dark;--fg:#1b1f24;--bg:#fff;--soft:#5b6570;--line:#d5dae0;--mark:#0b6bcb;--tint:#f3f6f9;--bad:#b3261e;--good:#1a7f37}
@media screen and (prefers-color-scheme:dark){:root{--fg:#e3e7eb;--bg:#14171a;--soft:#9aa4ae;
--line:#343b42;--mark:#6cb2ff;--tint:#1d2226;--bad:#ff8a80;--good:#6fdd8b}
figure svg{filter:invert(.92) hue-rotate(180deg)}}
body{font:15px/1.5 system-ui,sans-serif;color:var(--fg);background:var(--bg);max-width:62rem;margin:0 auto;padding:1.5rem}
h1{font-size:1.6rem;margin:.2rem 0 1rem}h2{font-size:1.2rem;margin:2rem 0 .5rem;border-bottom:1px solid var(--line)}
table{border-collapse:collapse;margin:.6rem 0;font-variant-numeric:tabular-nums}
th,td{white-space:nowrap;font-size:.94em;padding:.25rem .7rem;border-bottom:1px solid var(--line);text-align:right}
th:first-child,td:first-child,.text{text-align:left}td.text{white-space:normal;max-width:30rem}
th{white-space:normal;vertical-align:bottom}td:first-child{white-space:nowrap}
th{color:var(--soft);font-weight:600}caption{text-align:left;color:var(--soft);padding:.2rem 0}
figure{margin:1rem 0}figure svg{width:100%;height:auto;max-height:46rem}
.wide{overflow-x:auto}.lead{font-size:1.15rem}figcaption,.note{color:var(--soft);font-size:.92rem}
pre{background:var(--tint);padding:.7rem;white-space:pre-wrap;overflow-wrap:anywhere}.good{color:var(--good)}.bad{color:var(--bad)}
@media print{:root{color-scheme:light}body{max-width:none;padding:0;font-size:10.5pt}h2{break-after:avoid}
figure,tr,pre{break-inside:avoid}thead{display:table-header-group}
.wide{overflow:visible}pre{white-space:pre-wrap}}
"""
_NUMERIC = re.compile(r"^[-+−±<>≤ \d.,:/()%…eE·]*$")
_UNIT = re.compile(r"\b(degC|um|us|ohm)\b")


def page(title: str, sections: Iterable[tuple[str, str]], note: str = "") -> str:
    """Return a whole HTML page from (heading, HTML body) pairs; `note` stands under the title."""
    parts = [f"<section><h2>{html.escape(h)}</h2>\n{body}\n</section>" if h else body for h, body in sections]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>\n<h1>{html.escape(title)}</h1>\n"
        + (f'<p class="note">{html.escape(note)}</p>\n' if note else "")
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def table(head: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Return an HTML table; numbers are rounded and to the right, words to the left, None a dash."""
    rows = [list(row) for row in rows]
    words = [
        any(isinstance(v, str) and not _NUMERIC.match(v) for row in rows for v in row[k : k + 1])
        for k in range(len(head))
    ]

    def line(cells: Sequence[object], tag: str) -> str:
        """Return a row of the table; `tag`: th in the head, td in the body."""
        return (
            "<tr>"
            + "".join(
                f"<{tag}{' class=text' if k < len(words) and words[k] else ''}>{cell(v)}</{tag}>"
                for k, v in enumerate(cells)
            )
            + "</tr>\n"
        )

    top = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="wide"><table>{top}<thead>{line(head, "th")}</thead><tbody>\n'
        + "".join(line(row, "td") for row in rows)
        + "</tbody></table></div>"
    )


def cell(v: object) -> str:
    """Return a number or a word as HTML: 4 significant digits, thousands apart, powers of ten as such."""
    if v is None or (isinstance(v, float) and math.isnan(v)):
        return "–"
    if not isinstance(v, float):
        return html.escape(str(v))
    text = f"{v:,.0f}".replace(",", "\u202f") if 1e4 <= abs(v) < 1e7 else f"{v:.4g}"
    mantissa, e, power = text.partition("e")
    return (f"{mantissa}·10<sup>{int(power)}</sup>" if e else mantissa).replace("-", "−")


def unit(name: str | None) -> str:
    """Return a unit as people write it: degC is °C, um is µm, no unit is nothing."""
    text = _UNIT.sub(lambda m: {"degC": "°C", "um": "µm", "us": "µs", "ohm": "Ω"}[m[0]], name or "")
    text = (
        re.sub(r"\*\*(2|3|4)(?![.\d])", lambda m: {"2": "²", "3": "³", "4": "⁴"}[m[1]], text)
        .replace("**", "^")
        .replace("*", "·")
    )
    return "" if text == "1" else text.replace("(unit_of_y)", "reading").replace("unit_of_y", "reading")


def figure(fig: Figure, caption: str = "") -> str:
    """Return a matplotlib figure as inline SVG with its caption; the figure is closed."""
    import matplotlib.pyplot as plt

    for axis in fig.axes:
        axis.spines[["top", "right"]].set_visible(False)
    out = io.StringIO()
    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "thermoctl"}):
        fig.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(fig)
    svg = out.getvalue()
    return f"<figure>{svg[svg.index('<svg') :]}<figcaption>{html.escape(caption)}</figcaption></figure>"
