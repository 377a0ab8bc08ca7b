"""The report of a diagnosis for a person: one self-contained page."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnosis.evidence.fit import Fitted, Placed
from thermoctl.diagnosis.experiment.file import peaks
from thermoctl.diagnosis.law.result import law_section
from thermoctl.diagnosis.report.words import chance, name, sentences, what_next
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.plant.estimate import Estimate, report
from thermoctl.plant.refit import Fit
from thermoctl.plant.show import drawing
from thermoctl.report.page import figure, page, table, unit
from thermoctl.safe_file import write_text

POINTS = 1500  # of a curve; more would only make the page heavy
SHOWN = 6  # outputs that are drawn, worst first
DRAWN = 6  # recordings of an output that are drawn: those with the largest error
WIDE = 1.96  # standard deviations to either side of a 95 % interval
MOVED, MOVED_SHARE = 4.0, 0.25  # change of a parameter by a finding that is worth a sentence: sd, share of it
_COLOURS = {"measured": "#1b1f24", "refit": "#c7621b", "with": "#0b6bcb"}


def write_report(found: Diagnosis, result: Mapping[str, Any], path: str | Path) -> None:
    """Write report.html of a diagnosis; `result`: the content of its diagnosis.json."""
    sections = [
        ("", _lead(result)),
        ("What next", _p(what_next(result)) + _experiment(result["next_experiment"])),
        ("Where", _place(found, result)),
        ("What was found", _findings(found, result)),
        ("What it is worth" if found.extends else "How well the plant fits", _worth(found, result)),
        ("Before and after", _curves(found)),
        ("What remains", _remains(found, result)),
        ("A law for the remainder", law_section(found.law, (result["remainder"] or {}).get("law"))),
        ("Why this verdict", _why(result)),
        ("Tried and lost", _lost(result)),
        ("Parameters before and after", _parameters(found)),
        ("What could not have been seen", _unseen(result)),
        ("How this was made", _made(found, result)),
    ]
    case = found.case
    note = f"{case.plant.title} · {', '.join(t.name for t in case.tables)}"
    write_text(path, page("Diagnosis", [(h, b) for h, b in sections if b], note))


def _lead(result: Mapping[str, Any]) -> str:
    verdict = str(result["verdict"]).replace("_", " ").capitalize()
    text = html.escape(" ".join(sentences(result)))
    return f'<p class="lead"><b>{verdict}.</b> {text}</p>' + _items(result["notes"])


def _p(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _items(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _named(quantity: str, its_unit: str | None) -> str:
    return f"{quantity} ({unit(its_unit)})" if unit(its_unit) else quantity


def _error_unit(its_unit: str | None) -> str:
    """The unit of a difference of readings."""
    return "K" if its_unit == "degC" else unit(its_unit)


def _place(found: Diagnosis, result: Mapping[str, Any]) -> str:
    marked: set[str] = set()
    for e in found.shown:
        place = e.candidate.place
        marked |= {place.where, *place.nodes.values(), *(n for n in (place.flow, place.output) if n)}
    words = "Red: where the findings sit." if marked else "Nothing is marked: nothing is named."
    remainder = result["remainder"]
    if not marked and remainder and remainder["node"]:
        marked, words = {remainder["node"]}, "Red: the node where the remainder enters."
    return figure(drawing(found.case.plant, marked, 11.0), f"The network of the plant file. {words}")


def _findings(found: Diagnosis, result: Mapping[str, Any]) -> str:
    body = ""
    for f, e in zip(result["findings"], found.shown, strict=True):
        effect = e.candidate.effect
        body += f"<h3>{html.escape(name(f))} (probability {chance(f['probability'])})</h3>"
        body += f"{_p(effect.title + '.')}<pre>{html.escape(f['equation'])}</pre>"
        rows = [
            (n, p["value"], unit(p["unit"]), _interval(p["value"], p["sd"]))
            for n, p in f["parameters"].items()
        ]
        body += table(("parameter", "value", "unit", "95 % interval"), rows)
        if f["when"]:
            body += _p("Active " + " and ".join(f"from {a:.5g} s to {b:.5g} s" for a, b in f["when"]) + ".")
        body += _similar(e, result) + f'<p class="note">Source: {html.escape(effect.source)}</p>'
    return body


def _interval(value: float, sd: float | None) -> str:
    return f"{value - WIDE * sd:.4g} .. {value + WIDE * sd:.4g}" if sd else "–"


def _similar(e: Placed, result: Mapping[str, Any]) -> str:
    effect = e.candidate.effect
    if not effect.mimics:
        return ""
    near = {a["effect"] for a in result["alternatives"]} & set(effect.mimics)
    text = f"It can be confused with {', '.join(effect.mimics)}".replace("_", " ")
    text += "; here these stay possible: " + ", ".join(sorted(near)).replace("_", " ") if near else ""
    return _p(text + (f". Excited by: {effect.excited_by}." if effect.excited_by else "."))


def _worth(found: Diagnosis, result: Mapping[str, Any]) -> str:
    fit, outputs = result["fit"], result["outputs"]
    keys = ["before", "refit_only", "after", "held_out_before", "held_out_refit_only", "held_out_after"]
    if not found.extends:
        keys = [k for k in keys if not k.endswith("after")]
    heads = {"before": "as it came", "refit_only": "refitted", "after": "with the findings"}
    rows = [
        (_named(o, _error_unit(x["unit"])), x["noise"], *(fit[k].get(o) for k in keys))
        for o, x in outputs.items()
    ]
    titles = [
        ("held out: " if k.startswith("held_out") else "") + heads[k.removeprefix("held_out_")] for k in keys
    ]
    return table(("rms error of", "sensor's noise", *titles), rows, f"Held out: {fit['held_out']}.")


def _thin(t: np.ndarray, *curves: np.ndarray) -> tuple[np.ndarray, ...]:
    step = max(1, -(-len(t) // POINTS))
    return tuple(c[::step] for c in (t, *curves))


def _errors(f: Fitted, output: str) -> list[np.ndarray]:
    j = f.fit.model.outputs.index(output)
    return [r[:, j] for r in f.fit.residuals]


def _curves(found: Diagnosis) -> str:
    from matplotlib.figure import Figure

    case = found.case
    over = found.before.over_noise
    worst = sorted(over, key=lambda o: -over[o])[:SHOWN]
    drives = case.drives(case.null.model)
    body = ""
    for o in worst:
        j = case.null.model.outputs.index(o)
        refit, after = _errors(found.null, o), _errors(found.final, o)
        size = [np.nanmean(e**2) if np.isfinite(e).any() else 0.0 for e in refit]
        drawn = sorted(sorted(range(len(drives)), key=lambda r: -size[r])[:DRAWN])
        fig = Figure(figsize=(9, 3.8), layout="constrained")
        axes = fig.subplots(2, len(drawn), sharex="col", sharey="row", squeeze=False, height_ratios=(3, 2))
        for k, r in enumerate(drawn):
            d = drives[r]
            t, y, e0, e1 = _thin(d.t, d.y[:, j], refit[r], after[r])
            top, low = axes[0, k], axes[1, k]
            top.plot(t, y, ".", ms=2.5, color=_COLOURS["measured"], label="measured")
            top.plot(t, y - e0, color=_COLOURS["refit"], lw=1.2, label="refitted only")
            low.plot(t, e0, color=_COLOURS["refit"], lw=0.9)
            if found.extends:
                top.plot(t, y - e1, color=_COLOURS["with"], lw=1.2, label="with the findings")
                low.plot(t, e1, color=_COLOURS["with"], lw=0.9)
            low.axhline(0, color="0.6", lw=0.8)
            top.set_title(d.name, fontsize=9)
            low.set_xlabel("time (s)")
        its = case.plant.outputs[o].unit
        axes[0, 0].set_ylabel(_named(o, its), fontsize=8)
        axes[1, 0].set_ylabel(f"error ({_error_unit(its)})" if its else "error", fontsize=8)
        handles = axes[0, 0].get_legend_handles_labels()
        fig.legend(*handles, loc="outside upper right", ncols=3, fontsize=8, frameon=False)
        of = (
            ""
            if len(drawn) == len(drives)
            else f" The {DRAWN} of {len(drives)} recordings with the largest error."
        )
        body += figure(fig, f"{o}: simulation on the recorded inputs alone, and its error below.{of}")
    if len(over) > len(worst):
        body += _p(
            f"The {len(worst)} outputs with the largest misfit of {len(over)} are drawn; the table has all."
        )
    return body


def _remains(found: Diagnosis, result: Mapping[str, Any]) -> str:
    r = result["remainder"]
    if not r:
        return ""
    rows = [
        (_named(o, _error_unit(x["unit"])), r["rms"].get(o), x["noise"], r["over_noise"].get(o))
        for o, x in result["outputs"].items()
    ]
    body = table(("output", "remainder, rms", "sensor's noise", "whole residual over the noise"), rows)
    facts = []
    if found.extends and r["share_closed"] is not None:
        facts.append(
            f"The findings close {100 * max(r['share_closed'], 0.0):.1f} % of the energy of the misfit that a refit leaves."
        )
    if r["node"]:
        facts.append(f"Small random forces at {r['node']} would explain the remainder best.")
    follows = ", ".join(r["follows"])
    facts.append(f"It follows {follows}." if follows else "It follows none of the recorded signals.")
    for m in result["mismatch"][:1]:
        if m["missing_flow_rms"] and not found.extends:
            size = f"{m['missing_flow_rms']:.3g} {unit(m['missing_flow_unit'])}".strip()
            facts.append(f"A flow of {size} (rms) into {m['node']} would bring the plant to the recordings.")
    for m in result["mismatch"]:
        if m["when"] and not found.extends:
            spans = "; ".join(f"{a:.4g} to {b:.4g} s" for a, b in m["when"][:6])
            facts.append(f"The error of {m['channel']} is largest at {spans}.")
    return body + _items(facts)


def _why(result: Mapping[str, Any]) -> str:
    decision = result["decision"]
    rows = [(k, v) for k, v in decision.items() if k != "row"]
    meanings = {
        "something": "probability that some effect or an unknown law is missing",
        "known": "probability that some effect is missing",
        "over_noise": "largest residual rms over its sensor's noise",
        "remains": "largest probability of a remainder at an output that does not rest on its rounding's steps",
        "worth": "held-out error with the findings over that of a refit alone (1: not measured)",
    }
    body = _p(f"Row of the decision table that applies: {decision['row']}.")
    body += table(("number", "value"), [(meanings.get(k, f"probability of {k}"), v) for k, v in rows])
    hypotheses = [
        (
            f"{h['log_evidence']:.1f}",
            f"{h['log_prior_odds']:.1f}",
            f"{h['posterior']:.3f}",
            "–"
            if not h["effects"]
            else "no"
            if h["physics"] is None
            else ", ".join(f"{p:.3f}" for p in h["physics"]),
            f"{h['remainder']:.3f}",
            " + ".join(h["effects"]).replace("_", " ") or "no effect",
        )
        for h in result["hypotheses"]
    ]
    heads = ("log evidence", "log prior odds", "probability", "stands out", "remainder", "hypothesis")
    return body + table(
        heads,
        hypotheses,
        "Every hypothesis that was fitted. Log evidence and prior odds are relative to no effect. Stands out: each effect's "
        "probability to be physics and no part of the misfit that nobody will name. Remainder: probability of a remainder.",
    )


def _lost(result: Mapping[str, Any]) -> str:
    rows = [
        (
            f"{e['effect'].replace('_', ' ')} at {e['where']}",
            chance(e["probability"]),
            f"{e['below_best']:.1f}",
            e["reason"]
            + (f"; best beside {' + '.join(e['beside'])}".replace("_", " ") if e["beside"] else ""),
        )
        for e in result["lost"]
    ]
    heads = ("effect", "probability", "below the result (nats)", "reason")
    return table(heads, rows) if rows else ""


def _estimates(fit: Fit) -> dict[str, Estimate]:
    """Parameters by name; one that differs between recordings is shown for the first."""
    out: dict[str, Estimate] = {}
    for e in report(dataclasses.replace(fit, cost=0.0)):  # its Hessian is scaled to the noise already
        out.setdefault(e.name, e)
    return out


def _parameters(found: Diagnosis) -> str:
    before, after = _estimates(found.null.fit), _estimates(found.final.fit)
    rows, changed = [], []
    for n, e in after.items():
        if n not in before:
            continue
        refit, first = before[n], found.case.plant.parameters[n].value
        words = [] if e.state == "ok" else [e.state]
        words += ["trades with " + ", ".join(e.trades_with[:3])] if e.trades_with else []
        rows.append(
            (_named(n, e.unit), first, refit.value, e.value, f"± {WIDE * e.sd:.2g}", "; ".join(words) or "ok")
        )
        moved = abs(refit.value - e.value)
        if found.extends and moved > max(MOVED * np.hypot(e.sd, refit.sd), MOVED_SHARE * abs(e.value)):
            changed.append(
                f"{n}: a refit alone put it at {refit.value:.4g}; with the findings it is {e.value:.4g} {e.unit or ''}. "
                "It had stood in for the missing physics."
            )
        if refit.state == "at bound":
            changed.append(
                f"{n}: the refit alone pressed it against the end of its range ({refit.value:.4g})."
            )
    heads = ("parameter", "as it came", "refitted", "with the findings", "95 %", "state")
    return table(heads, rows) + _items(changed) if rows else ""


def _unseen(result: Mapping[str, Any]) -> str:
    rows = [
        (e["effect"].replace("_", " "), e["where"], e["smallest"], _named(e["parameter"], e["unit"]))
        for e in result["not_seen"]
    ]
    caption = "Five standard errors of its size, beside a refit of the plant's own parameters."
    return (
        table(("effect", "where", "smallest that would have been seen", "as"), rows, caption) if rows else ""
    )


def _experiment(entry: Mapping[str, Any] | None) -> str:
    if not entry:
        return ""
    from matplotlib.figure import Figure

    body = _p(
        f"{entry['profile']}, {entry['duration_s']:.4g} s. {entry['why']} {entry.get('also_helpful') or ''}"
    )
    body += _items(peaks(entry))
    corners = {n: np.array(v) for n, v in entry["inputs"].items()}
    moving = {n: c for n, c in corners.items() if len(c) > 1 and np.ptp(c[:, 1]) > 0}
    if moving:
        fig = Figure(figsize=(9, 1.2 + 1.1 * len(moving)), layout="constrained")
        axes = fig.subplots(len(moving), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (n, c) in zip(axes, moving.items(), strict=True):
            axis.plot(c[:, 0], c[:, 1], lw=1.2)
            axis.set_ylabel(n, fontsize=8)
        axes[-1].set_xlabel("time (s)")
        body += figure(fig, "The inputs of the proposed experiment, inside the range of the recorded ones.")
    return body


def _made(found: Diagnosis, result: Mapping[str, Any]) -> str:
    case, budget = found.case, found.case.budget
    samples, count = sum(len(t.t) for t in case.tables), len(case.tables)
    recordings = f"{count} recording{'s' if count > 1 else ''}, {samples} samples: "
    lines = [
        recordings + ", ".join(Path(t.path).name for t in case.tables) + ".",
        f"{budget.fits_done} of at most {budget.fits} refits; {len(result['hypotheses'])} hypotheses, in {result['seconds']:.0f} s."
        + (" The budget ended the search." if result["truncated"] else ""),
        "Each hypothesis: simulation on the recorded inputs, refitted with exact sensitivities; log evidence by Laplace's method, "
        "averaged over the noise and over a remainder.",
        "Intervals: 1.96 standard deviations of the joint fit. `thermoctl diagnose --explain DIR` prints the reasons in ten lines.",
    ]
    return _items(lines)
