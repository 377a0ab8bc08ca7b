"""The one look of all pages: self-contained HTML, no script and no request, light and dark, fit for printing."""
from __future__ import annotations

import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

_STYLE = """
:root{color-scheme:light dark;--fg:#1b1f24;--bg:#fff;--soft:#5b6570;--line:#d5dae0;--mark:#0b6bcb;--tint:#f3f6f9;--bad:#b3261e;--good:#1a7f37}
@media(prefers-color-scheme:dark){:root{--fg:#e3e7eb;--bg:#14171a;--soft:#9aa4ae;--line:#343b42;--mark:#6cb2ff;--tint:#1d2226;--bad:#ff8a80;--good:#6fdd8b}
figure svg{background:#fff;border-radius:4px}}
body{font:15px/1.5 system-ui,sans-serif;color:var(--fg);background:var(--bg);max-width:62rem;margin:0 auto;padding:1.5rem}
h1{font-size:1.6rem;margin:.2rem 0 1rem}h2{font-size:1.2rem;margin:2rem 0 .5rem;border-bottom:1px solid var(--line)}
table{border-collapse:collapse;margin:.6rem 0;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .7rem;border-bottom:1px solid var(--line);text-align:right}
th:first-child,td:first-child{text-align:left}th{color:var(--soft);font-weight:600}caption{text-align:left;color:var(--soft);padding:.2rem 0}
figure{margin:1rem 0}figure svg{max-width:100%;height:auto}figcaption,.note{color:var(--soft);font-size:.92rem}
pre{background:var(--tint);padding:.7rem;overflow-x:auto}.good{color:var(--good)}.bad{color:var(--bad)}
@media print{body{max-width:none;padding:0}h2{break-after:avoid}figure,table{break-inside:avoid}}
"""


def page(title: str, sections: Iterable[tuple[str, str]], note: str = "") -> str:
    """A whole HTML page from (heading, HTML body) pairs; `note` stands under the title."""
    parts = [f"<section><h2>{html.escape(h)}</h2>\n{body}\n</section>" if h else body for h, body in sections]
    return (f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
            f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>\n<h1>{html.escape(title)}</h1>\n"
            + (f'<p class="note">{html.escape(note)}</p>\n' if note else "") + "\n".join(parts) + "\n</body></html>\n")


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = "") -> str:
    """An HTML table; numbers with four significant digits, None as a dash."""
    def cell(v: Any) -> str:
        return "–" if v is None else f"{v:.4g}" if isinstance(v, float) else html.escape(str(v))
    body = "".join("<tr>" + "".join(f"<td>{cell(v)}</td>" for v in row) + "</tr>\n" for row in rows)
    top = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return f"<table>{top}<thead><tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in head) + f"</tr></thead><tbody>\n{body}</tbody></table>"


def figure(fig: Any, caption: str = "") -> str:
    """A matplotlib figure as inline SVG with its caption; the figure is closed."""
    import matplotlib.pyplot as plt
    out = io.StringIO()
    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "thermoctl"}):
        fig.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(fig)
    svg = out.getvalue()
    return f"<figure>{svg[svg.index('<svg'):]}<figcaption>{html.escape(caption)}</figcaption></figure>"
