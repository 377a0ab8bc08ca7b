"""The report of a diagnosis for a person: one self-contained page.

The first screen holds the verdict, its sentences, and the readings beside the simulations."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnosis.curves import Curve
from thermoctl.diagnosis.experiment.file import peaks
from thermoctl.diagnosis.law.result import law_section
from thermoctl.diagnosis.report import figures
from thermoctl.diagnosis.report.figures import Output, Rows, chance, outputs
from thermoctl.diagnosis.report.plots import compared, remaining
from thermoctl.diagnosis.report.words import listed, name, sentences, what_next
from thermoctl.diagnosis.result import Diagnosis, curves
from thermoctl.files.safe_file import write_text
from thermoctl.plant.fitting.estimate import Estimate, correlations, report
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.show import drawing
from thermoctl.report.page import BLUE, figure, folded, items, page, panel, panels, paragraph, table, unit
from thermoctl.report.residuals import titled

SHOWN = 4  # largest number of further curves, those with the largest errors
# Least change of a parameter by a finding that is reported: in standard deviations, and relative.
MOVED, MOVED_SHARE = 4.0, 0.25
BROAD, NARROW = 10.0, 3.6  # widths of the network in inches: on a screen, and on a telephone
WORTH = 0.5  # least correlation whose number is written into its cell
TONES = {"consistent": "good", "explained": "good", "unexplained": "bad"}


def write_report(diagnosis: Diagnosis, result: Mapping[str, Any], path: str | Path) -> None:
    """Write report.html of a diagnosis; `result`: the content of its diagnosis.json."""
    drawn = _ordered(curves(diagnosis), outputs(result), figures.extends(result))
    more = "".join(_compared(c, result) for c in drawn[1:])
    rest = folded(f"{len(drawn) - 1} more curves", more)
    sections = [
        ("", _lead(result) + "".join(_compared(c, result, True) for c in drawn[:1])),
        ("What next", _next(result)),
        (
            "The likeliest" if result["verdict"] == "ambiguous" else "What was found",
            _findings(diagnosis, result),
        ),
        ("A law for what remains", law_section(diagnosis.laws, result)),
        ("How well it fits", _worth(result) + rest),
        ("The error that is left", _remains(drawn, result)),
        ("Where", _place(diagnosis, result)),
        ("Parameters", _parameters(diagnosis)),
        ("Why this verdict", _why(result)),
        ("What could not have been seen", _unseen(result)),
        ("How this was made", _made(diagnosis, result)),
    ]
    case = diagnosis.case
    of = dict.fromkeys([*(t.name for t in case.tables), *(c.recording for c in drawn)])
    note = f"{case.plant.title} · {', '.join(of)}"
    write_text(path, page("Diagnosis", [(h, b) for h, b in sections if b], note))


def _ordered(every: Sequence[Curve], rows: Sequence[Output], extended: bool) -> list[Curve]:
    """Return the curves to draw. The first is of the output that matters most, held out if possible."""
    first_output = max(rows, key=lambda o: o.gain if extended else o.over("refit_only")).name if rows else ""

    def weight(c: Curve) -> tuple[bool, bool, float]:
        """Return the sort key: is the curve of `first_output`, is it held out, its error over the noise."""
        noise = next((o.noise for o in rows if o.name == c.output), 0.0) or 1.0
        return c.output == first_output, c.held_out, (c.rms("refit_only") or 0.0) / noise

    every = sorted(every, key=weight, reverse=True)
    rest = sorted(every[1:], key=lambda c: weight(c)[2], reverse=True)
    seen = {(every[0].recording, every[0].output)} if every else set()
    others = [c for c in rest if (c.recording, c.output) not in seen and not c.held_out]
    return [*every[:1], *others[:SHOWN]]


def _lead(result: Mapping[str, Any]) -> str:
    verdict = str(result["verdict"])
    tone, words = TONES.get(verdict, "fair"), verdict.replace("_", " ").capitalize()
    return f'<p class="lead"><b class="{tone}">{words}.</b> {html.escape(" ".join(sentences(result)))}</p>'


def _compared(c: Curve, result: Mapping[str, Any], first: bool = False) -> str:
    aside = str(result["fit"]["held_out"]).startswith("recordings")
    if not c.held_out:
        how = "It took part in the fit."
    elif aside:
        how = "It was set aside: it took no part in any choice or fit."
    else:
        how = "Each part is predicted by a fit to the other parts; the first is always fitted."
    text = f"{c.output} in {c.recording}, simulated on the recorded inputs alone. {how}"
    if first and any(c.fit_percent(k) is not None for k in c.errors):
        text += " Percentages: fit, 100 (1 − |error| / |reading − its mean|)."
    return compared(c, text)


def _next(result: Mapping[str, Any]) -> str:
    text = f'<p class="next">{html.escape(what_next(result))}</p>'
    return text + _experiment(result["next_experiment"]) + items(figures.merged(result["notes"]))


def _table(rows: Rows, caption: str = "") -> str:
    return table(*rows, caption) if rows[1] else ""


def _findings(diagnosis: Diagnosis, result: Mapping[str, Any]) -> str:
    body = ""
    for f, e in zip(result["findings"], diagnosis.shown, strict=True):
        effect, end = e.candidate.effect, ""
        for n in f["parameters"]:
            end = n.removeprefix(figures.short(n, f)) or end
        sure = f"probability {chance(f['probability'])}; that other data confirm it {chance(f['confirmed'])}"
        kinds = ", ".join(f"{name(m)} ({chance(m['probability'])})" for m in f.get("members", ()))
        what = f"One of {kinds}, of which the plant has: {effect.title}" if kinds else effect.title
        body += f"<h3>{html.escape(name(f))}</h3>{paragraph(f'{what}; {sure}.')}"
        body += f"<pre>{html.escape(figures.equation(f))}</pre>"
        heads, rows = figures.parameter_rows(f)
        body += _table((heads, [(*r[:2], unit(r[2])) for r in rows]))
        excited = f"Excited by: {effect.excited_by}. " if effect.excited_by else ""
        where = f"In plant.yaml these names end in {end}. " if end else ""
        body += f'<p class="note">{html.escape(f"{where}{excited}Source: {effect.source}.")}</p>'
    return body


def _worth(result: Mapping[str, Any]) -> str:
    body = _table(figures.error_rows(result), f"Held out: {result['fit']['held_out']}.")
    return body + folded("Fit in % by recording", _table(figures.fit_rows(result)))


def _remains(drawn: Sequence[Curve], result: Mapping[str, Any]) -> str:
    key = "after" if figures.extends(result) else "refit_only"
    rows = {o.name: o for o in outputs(result)}
    names = dict.fromkeys(c.output for c in drawn if c.output in rows and key in c.errors)
    over = sorted(names, key=lambda n: -round(rows[n].over(key), 1))
    firsts = [next(c for c in drawn if c.output == n and key in c.errors) for n in over]
    body = ""
    for k, c in enumerate(firsts):
        held = "held-out " if c.held_out else ""
        text = f"The {held}error of {c.output} in {c.recording}. Noise alone stays between the dashed lines, 19 times in 20."
        part = remaining(c, key, rows[c.output].noise, text)
        body += folded(f"The same of {c.output}", part) if k else part
    r = result["remainder"]
    if not r or result["verdict"] == "explained":
        return body
    facts = [f"It follows {listed(r['follows']) or 'none of the recorded signals'}."]
    if r["node"]:
        facts.append(f"Small random changes at {r['node']} would explain it best; they name no cause.")
    for k, m in enumerate([] if figures.extends(result) else result["mismatch"]):
        if m["missing_flow_rms"] and not k:
            size = f"{m['missing_flow_rms']:.3g} {unit(m['missing_flow_unit'])}".strip()
            facts.append(f"A flow of {size} (rms) into {m['node']} would bring the plant to the recordings.")
        if m["when"]:
            spans = "; ".join(f"{a:.4g} to {b:.4g} s" for a, b in m["when"][:6])
            facts.append(f"The error of {m['channel']} is largest at {spans} of {m['recording']}.")
    return body + _table(figures.remainder_rows(result)) + items(facts)


def _place(diagnosis: Diagnosis, result: Mapping[str, Any]) -> str:
    marked: set[str] = set()
    for e in diagnosis.shown:
        place = e.candidate.place
        marked |= {place.where, *place.nodes.values(), *(n for n in (place.flow, place.output) if n)}
    words = "Red: where the findings sit." if marked else "Nothing is marked: nothing is named."
    remainder = result["remainder"]
    if not marked and remainder and remainder["node"]:
        marked, words = {remainder["node"]}, "Red: the node where the remainder enters."
    broad, narrow = (drawing(diagnosis.case.plant, marked, width, title=False) for width in (BROAD, NARROW))
    return figure(broad, f"The network of the plant file. {words}", narrow)


def _parameters(diagnosis: Diagnosis) -> str:
    before, after = _estimates(diagnosis.null.fit), _estimates(diagnosis.final.fit)
    rows = []
    for n, e in after.items():
        refit, first = before.get(n), diagnosis.case.plant.parameters.get(n)
        remarks = [] if e.state == "ok" else [e.state]
        remarks += ["trades with " + ", ".join(e.trades_with[:3])] if e.trades_with else []
        if refit and diagnosis.extends:
            moved = abs(refit.value - e.value)
            least = max(MOVED * np.hypot(e.sd, refit.sd), MOVED_SHARE * abs(e.value))
            remarks += ["stood in for what was missing"] if moved > least else []
            remarks += ["refitted, at the end of its range"] if refit.state == "at bound" else []
        values = figures.with_interval(e.value, e.sd, e.unit), unit(e.unit), "; ".join(remarks) or "ok"
        rows.append(
            (n, first and first.value, *([refit and refit.value] if diagnosis.extends else []), *values)
        )
    came = ("as it came", "refitted", "extended") if diagnosis.extends else ("as it came", "refitted")
    heads = ("parameter", *came, "unit", "state")
    return table(heads, rows) + folded("Correlations", _matrix(diagnosis.final.fit)) if rows else ""


def _estimates(fit: Fit) -> dict[str, Estimate]:
    """Return the estimates by parameter; of one that differs between recordings, that of the first."""
    out: dict[str, Estimate] = {}
    for e in report(_scaled(fit)):
        out.setdefault(e.name, e)
    return out


def _scaled(fit: Fit) -> Fit:
    """Return the fit with a cost of 0, so that `report` does not scale its Hessian to the noise again."""
    return dataclasses.replace(fit, cost=0.0)


def _matrix(fit: Fit) -> str:
    """Return the correlations of the parameters as a table of coloured cells."""
    names = [q for q, _ in fit.unknowns if q in fit.model.active]
    corr = correlations(_scaled(fit))[1][: len(names), : len(names)]
    heads = "".join(f"<th>{k + 1}</th>" for k in range(len(names)))
    lines = ""
    for k, n in enumerate(names):
        cells = ""
        for v in corr[k, : k + 1]:
            tone = f"color-mix(in srgb,var(--{'mark' if v > 0 else 'warm'}) {60 * min(abs(v), 1.0):.0f}%,transparent)"
            text = f"{v:.2f}".replace("0.", ".", 1) if abs(v) >= WORTH else ""
            cells += f'<td style="background:{tone}">{text}</td>'
        lines += f"<tr><td>{k + 1} {html.escape(n)}</td>{cells}</tr>"
    note = f'<p class="note">Between the estimates, from −1 to 1; numbers from {WORTH} on.</p>'
    return f'{note}<div class="wide"><table class="matrix"><tr><th></th>{heads}</tr>{lines}</table></div>'


def _why(result: Mapping[str, Any]) -> str:
    lost, every = figures.lost_rows(result), figures.hypothesis_rows(result)
    caption = (
        "Log evidence and prior odds are relative to no effect. Stands out: how surely each effect differs from unexplained "
        "drift of the same size. Remainder: probability of a systematic error that stays."
    )
    return (
        paragraph(f"{result['decision']['row'][:1].upper()}{result['decision']['row'][1:]}.")
        + _table(figures.decision_rows(result))
        + folded(f"What lost, and why: {len(lost[1])} effects", _table(lost))
        + folded(f"Every hypothesis that was fitted: {len(every[1])}", _table(every, caption))
    )


def _unseen(result: Mapping[str, Any]) -> str:
    rows = [
        (e["effect"].replace("_", " "), e["where"], e["smallest"], e["parameter"], unit(e["unit"]))
        for e in result["not_seen"]
    ]
    caption = "Five standard errors of its size, beside a refit of the plant's own parameters."
    heads = ("effect", "where", "smallest that would have been seen", "as", "unit")
    return folded(f"{len(rows)} effects, by the size from which they show", _table((heads, rows), caption))


def _experiment(entry: Mapping[str, Any] | None) -> str:
    if not entry:
        return ""
    body = paragraph(f"{entry['profile'][:1].upper()}{entry['profile'][1:]}. {entry['why']}")
    body += items(peaks(entry))
    corners = {n: np.array(v) for n, v in entry["inputs"].items()}
    moving = {n: c for n, c in corners.items() if len(c) > 1 and np.ptp(c[:, 1]) > 0}
    if not moving:
        return body
    drawn = [panel() for _ in moving]
    for axes, (n, c) in zip(drawn, moving.items(), strict=True):
        axes.plot(c[:, 0], c[:, 1], lw=1.2, color=BLUE)
        titled(axes, "", "time (s)", n)
    return body + panels(
        drawn, "The inputs of the proposed experiment, inside the range of the recorded ones."
    )


def _made(diagnosis: Diagnosis, result: Mapping[str, Any]) -> str:
    case = diagnosis.case
    files = ", ".join(Path(t.path).name for t in case.tables)
    ended = " The budget ended the search." if result["truncated"] else ""
    return items(
        [
            f"{sum(len(t.t) for t in case.tables)} samples of {files}.",
            f"{case.budget.fits_done} refits; {len(result['hypotheses'])} hypotheses, in "
            f"{result['seconds']:.0f} s.{ended}",
            "Each hypothesis: simulation on the recorded inputs, refitted with exact sensitivities; log evidence by Laplace's "
            "method, averaged over the noise and over a remainder.",
            "Intervals: 1.96 standard deviations of the joint fit.",
        ]
    )
