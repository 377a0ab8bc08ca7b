"""The report of a diagnosis for a person: one self-contained page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoctl.diagnose.effects import Candidate
from thermoctl.diagnose.experiment_file import peaks
from thermoctl.diagnose.outcome import Diagnosis, sentence
from thermoctl.plant.refit import report
from thermoctl.plant.show import drawing
from thermoctl.report.page import figure, page, table, unit

if TYPE_CHECKING:
    from thermoctl.diagnose.explain import Case, Explanation

POINTS = 1500  # of a curve; more would only make the page heavy
SHOWN = 6  # outputs that are drawn, worst first
_COLOURS = {"measured": "#1b1f24", "refit": "#c7621b", "with": "#0b6bcb"}


def write_report(case: Case, found: Diagnosis, path: str | Path) -> None:
    """Write report.html for a diagnosis whose `result` is set."""
    r = found.result
    sections = [
        (
            "",
            f'<p class="lead"><b>{r["verdict"].capitalize()}.</b> {html.escape(sentence(r))}</p>'
            + _items(r["notes"]),
        ),
        ("Where", _place(case, found)),
        ("What is missing", _missing(found)),
        ("The equation", _equations(found)),
        ("What adding it is worth" if found.final.effects else "How well it fits", _worth(case, found)),
        ("Before and after", _curves(case, found)),
        ("What it could be confused with", _confused(found)),
        ("Parameters before and after", _parameters(case, found)),
        ("What could not have been seen", _unseen(found)),
        ("Next experiment", _next(r["next_experiment"])),
        ("How this was made", _made(case, found)),
    ]
    note = f"{case.plant.title} · {', '.join(t.name for t in case.tables)}"
    Path(path).write_text(page("Diagnosis", [(h, b) for h, b in sections if b], note), encoding="utf-8")


def _p(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _items(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _named(name: str, its_unit: str | None) -> str:
    return f"{name} ({unit(its_unit)})" if unit(its_unit) else name


def _label(c: Candidate) -> str:
    return f"{c.effect.title} at {c.place.where}"


# ------------------------------------------------------------------------------------------------------- where, what


def _place(case: Case, found: Diagnosis) -> str:
    marked: set[str] = set()
    for c in found.final.effects:
        marked |= {c.place.where, *c.place.nodes.values(), *(n for n in (c.place.flow, c.place.output) if n)}
    if not found.final.effects and found.verdict != "consistent" and found.suspects:
        marked.add(found.suspects[0].name)
    words = "Red: where it sits." if marked else "Nothing is marked: nothing is missing."
    body = figure(drawing(case.plant, marked, 11.0), f"The network of the plant file. {words}")
    if found.suspects and found.verdict != "consistent":
        body += table(
            ("unknown input at", "kind", "explains (chi-square)", "degrees of freedom"),
            [
                (
                    s.name,
                    "heat, force or flow into the node" if s.kind == "node" else "error of the sensor",
                    s.gain,
                    s.dims,
                )
                for s in found.suspects[:6]
            ],
            "One smooth unknown input at a time, in place of what is missing, likeliest first",
        )
    return body


def _missing(found: Diagnosis) -> str:
    m = found.missing
    if m is None:
        return ""
    from matplotlib.figure import Figure

    first = found.rounds[0]
    followed = m.follows[0] if m.follows else None
    fig = Figure(figsize=(9, 3.1), layout="constrained")
    axes = fig.subplots(1, 2 if followed else 1, squeeze=False)[0]
    for k, (t, q) in enumerate(zip(m.t, m.flow, strict=True)):
        axes[0].plot(t, q, lw=1.3, label=first.metric.drives[k].name)
        if followed:
            drive, run = first.metric.drives[k], first.metric.runs[k]
            model = first.metric.model
            column = (
                run.x[:, model.states.index(followed)]
                if followed in model.states
                else drive.u[:, model.inputs.index(followed)]
                if followed in model.inputs
                else first.rig.columns[k].get(followed)
            )
            if column is not None:
                axes[1].plot(np.interp(t, drive.t, column), q, ".", ms=5, label=drive.name)
    per = (
        unit(next((x.get("missing_flow_unit") for x in found.result["mismatch"]), None))
        or "storage x node's unit / s"
    )
    axes[0].set(xlabel="time (s)", ylabel=f"into {m.node} ({per})")
    axes[0].axhline(0, color="0.7", lw=0.8)
    if followed:
        axes[1].set(xlabel=followed)
        axes[1].axhline(0, color="0.7", lw=0.8)
    fig.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside upper right",
        ncols=len(m.flow),
        fontsize=8,
        frameon=False,
    )
    told = (
        f" It follows {', '.join(m.follows)}." if m.follows else " It follows none of the recorded signals."
    )
    when = "; ".join(f"{a:.4g} to {b:.4g} s" for a, b in m.when[:6])
    return figure(
        fig,
        f"The flow into {m.node} that the recordings ask for beyond the refitted plant, {m.rms:.3g} {per} rms."
        + told
        + (f" Largest: {when}." if when else "")
        + " Made by: smooth unknown input, ridge by cross-validation, after what the plant's own parameters can absorb.",
    )


def _equations(found: Diagnosis) -> str:
    body = ""
    for f, c in zip(found.result["findings"], found.final.effects, strict=False):
        body += f"<p><b>{html.escape(_label(c))}</b> (probability {f['probability']:.2f})</p><pre>{html.escape(f['equation'])}</pre>"
        rows = [
            (
                n,
                p["value"],
                unit(p["unit"]),
                f"{p['value'] - 1.96 * (p['sd'] or 0):.4g} .. {p['value'] + 1.96 * (p['sd'] or 0):.4g}",
            )
            for n, p in f["parameters"].items()
        ]
        body += table(("parameter", "value", "unit", "95 % interval"), rows)
        if f["when"]:
            body += _p("From " + " and from ".join(f"{a:.5g} s to {b:.5g} s" for a, b in f["when"]) + ".")
        body += f'<p class="note">{html.escape(c.effect.source)}</p>'
    return body


def _worth(case: Case, found: Diagnosis) -> str:
    fit, gain = found.result["fit"], found.result["held_out_gain"]
    rows = []
    for n, (o, out) in zip(case.noise, case.plant.outputs.items(), strict=True):
        if o not in fit["refit_only"]:
            continue
        g = gain.get(o)
        rows.append(
            (
                _named(o, out.unit),
                n.sigma,
                *(
                    fit.get(k, {}).get(o)
                    for k in (
                        "before",
                        "refit_only",
                        "after",
                        "held_out_before",
                        "held_out_refit_only",
                        "held_out_after",
                    )
                ),
                f"{g['ratio']:.2f} ({g['interval'][0]:.2f} .. {g['interval'][1]:.2f})" if g else None,
            )
        )
    how = (
        "each recording in turn, fitted without it"
        if found.held["data"] == "recordings"
        else "every other one of 16 blocks of each recording, fitted without them, and then the others"
    )
    return table(
        (
            "rms error of",
            "sensor allows",
            "as it came",
            "refitted",
            "with finding",
            "held out: as it came",
            "refitted",
            "with finding",
            "ratio (95 %)",
        ),
        rows,
        f"Held out: {how}. Ratio: with the finding over refitted, paired block bootstrap; below 1 is better.",
    )


# ----------------------------------------------------------------------------------------------------------- curves


def _thin(t: np.ndarray, *curves: np.ndarray) -> tuple[np.ndarray, ...]:
    step = max(1, -(-len(t) // POINTS))
    return tuple(c[::step] for c in (t, *curves))


def _residuals(case: Case, e: Explanation) -> list[np.ndarray]:
    """Residuals by the case's outputs, in recordings' order."""
    return [
        np.stack([r[:, e.fit.model.outputs.index(o)] for o in case.model.outputs], axis=1)
        for r in e.fit.residuals
    ]


def _curves(case: Case, found: Diagnosis) -> str:
    from matplotlib.figure import Figure

    refit, after = _residuals(case, found.base), _residuals(case, found.final)
    excess = case.excess(found.base)
    worst = sorted(excess, key=lambda o: -excess[o])[:SHOWN]
    body = ""
    for o in worst:
        j = case.model.outputs.index(o)
        fig = Figure(figsize=(9, 3.8), layout="constrained")
        axes = fig.subplots(
            2, len(case.drives), sharex="col", sharey="row", squeeze=False, height_ratios=(3, 2)
        )
        for k, d in enumerate(case.drives):
            t, y, e0, e1 = _thin(d.t, d.y[:, j], refit[k][:, j], after[k][:, j])
            top, low = axes[0, k], axes[1, k]
            top.plot(t, y, ".", ms=2.5, color=_COLOURS["measured"], label="measured")
            top.plot(t, y - e0, color=_COLOURS["refit"], lw=1.2, label="refitted only")
            low.plot(t, e0, color=_COLOURS["refit"], lw=0.9)
            if found.final.effects:
                top.plot(t, y - e1, color=_COLOURS["with"], lw=1.2, label="with the finding")
                low.plot(t, e1, color=_COLOURS["with"], lw=0.9)
            low.axhline(0, color="0.6", lw=0.8)
            top.set_title(d.name, fontsize=9)
            low.set_xlabel("time (s)")
        axes[0, 0].set_ylabel(_named(o, case.plant.outputs[o].unit), fontsize=8)
        axes[1, 0].set_ylabel(_named("error", case.plant.outputs[o].unit), fontsize=8)
        fig.legend(
            *axes[0, 0].get_legend_handles_labels(),
            loc="outside upper right",
            ncols=3,
            fontsize=8,
            frameon=False,
        )
        body += figure(
            fig, f"{o}: free run of the simulator on the recorded inputs, and what it misses below."
        )
    if len(excess) > len(worst):
        body += _p(
            f"The {len(worst)} outputs with the largest misfit of {len(excess)} are drawn; the table has all."
        )
    return body


# ------------------------------------------------------------------------------------------- rivals and parameters


def _confused(found: Diagnosis) -> str:
    shown = found.result["alternatives"]
    body = ""
    if shown:
        body += table(
            ("instead", "where", "probability"),
            [(a["effect"], a["where"], f"{a['probability']:.3f}") for a in shown],
            "Other explanations, refitted in full to the same recordings",
        )
    for c in found.final.effects:
        near = [a["effect"] for a in shown if a["effect"] in c.effect.mimics]
        body += _p(
            f"{c.effect.title} is known to look like {', '.join(m.replace('_', ' ') for m in c.effect.mimics) or 'nothing else'}. "
            + (
                "Here these recordings do not tell it from "
                + ", ".join(n.replace("_", " ") for n in near)
                + ". "
                if near
                else ""
            )
            + f"What tells them apart: {c.effect.excited_by}."
        )
    return body


def _parameters(case: Case, found: Diagnosis) -> str:
    before = {e.name: e for e in report(found.base.fit)}
    rows, said = [], []
    for e in report(found.final.fit):
        if e.name not in before:
            continue
        refit = before[e.name]
        first = case.plant.parameters[e.name].value
        words = [e.state] if e.state != "ok" else []
        if e.trades_with:
            words.append("trades with " + ", ".join(e.trades_with[:3]))
        rows.append(
            (
                _named(e.name, e.unit),
                first,
                refit.value,
                e.value,
                f"± {1.96 * e.sd:.2g}",
                "; ".join(words) or "ok",
            )
        )
        moved = abs(refit.value - e.value) > max(4 * np.hypot(e.sd, refit.sd), 0.25 * abs(e.value))
        if found.final.effects and moved and refit.value and e.value:
            said.append(
                f"{e.name}: without the missing physics the refit put it at {refit.value:.4g}, {refit.value / e.value:.2g} times "
                f"the {e.value:.4g} {e.unit or ''} that it is with it; it had stood in for what was missing."
            )
        if refit.state == "at bound":
            said.append(
                f"{e.name}: the refit alone pressed it against the end of its range ({refit.value:.4g})."
            )
    return (
        table(("parameter", "as it came", "refitted", "with the finding", "95 %", "state"), rows)
        + _items(said)
        if rows
        else ""
    )


def _unseen(found: Diagnosis) -> str:
    rows = [
        (n["effect"], n["where"], n["smallest"], _named(n["parameter"], n["unit"]))
        for n in found.result["not_seen"]
        if n["smallest"] is not None
    ]
    if not rows:
        return ""
    more = f" The first 60 of {len(rows)}." if len(rows) > 60 else ""
    return table(
        ("effect", "where", "smallest that would have been seen", "as"),
        rows[:60],
        "Five standard errors of its size, after what the plant's own parameters can absorb." + more,
    )


def _next(told: dict[str, Any] | None) -> str:
    if not told:
        return ""
    from matplotlib.figure import Figure

    body = _p(
        f"{told['profile']}, {told['duration_s']:.4g} s. {told['why']} {told.get('also_helpful') or ''}"
    )
    body += _items(peaks(told))
    moving = {
        k: np.array(v) for k, v in told["inputs"].items() if len(v) > 1 and np.ptp([p[1] for p in v]) > 0
    }
    if moving:
        fig = Figure(figsize=(9, 1.2 + 1.1 * len(moving)), layout="constrained")
        for axis, (name, corners) in zip(
            fig.subplots(len(moving), 1, sharex=True, squeeze=False)[:, 0], moving.items(), strict=True
        ):
            axis.plot(corners[:, 0], corners[:, 1], lw=1.2)
            axis.set_ylabel(name, fontsize=8)
        axis.set_xlabel("time (s)")
        body += figure(fig, "The inputs of the proposed experiment, inside the range of the recorded ones.")
    return body


def _chance(found: Diagnosis, chance: float) -> str:
    """Draws of noise say nothing finer than one in their number."""
    drawn = len(c) if found.rounds and (c := found.rounds[0].chance) is not None else 0
    return (
        f"less than 1/{drawn} (none of {drawn} draws came near)"
        if drawn and chance < 1 / drawn
        else f"{chance:.2g}"
    )


def _made(case: Case, found: Diagnosis) -> str:
    chance = found.result["chance"]
    lines = [
        f"{len(case.tables)} recordings, {sum(len(t.t) for t in case.tables)} samples. "
        + ", ".join(Path(t.path).name for t in case.tables)
        + ".",
        "Refit: bounded weighted least squares on the free-run error with exact sensitivities; noise with colour, "
        "ARMA(1,1) a channel, fitted anew under every explanation.",
        f"Chance that noise alone makes some entry of the catalogue look this good: {_chance(found, chance)}; "
        f"{len(found.rounds[0].directions) if found.rounds else 0} directions (effect, place, shape) were screened.",
        "Intervals: 1.96 standard errors of the joint refit. Probabilities: weights of the refitted explanations' scores.",
        f"Settled in {len(found.rounds)} look{'' if len(found.rounds) == 1 else 's'} at the catalogue.",
    ]
    return _items(lines)
