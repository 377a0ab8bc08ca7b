"""A diagnosis as the content of diagnosis.json (format thermoctl-diagnosis/1)."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from itertools import pairwise
from typing import Any

import numpy as np

from thermoctl.diagnosis.evidence.fit import Placed
from thermoctl.diagnosis.evidence.held_out import rms_of
from thermoctl.diagnosis.hypothesis.candidates import Key, spoken
from thermoctl.diagnosis.hypothesis.places import flow_unit
from thermoctl.diagnosis.law.refit import equation, laws_of
from thermoctl.diagnosis.law.result import law_entry
from thermoctl.diagnosis.report.notes import notes
from thermoctl.diagnosis.result import Diagnosis, curves
from thermoctl.diagnosis.search.beam import Weighed
from thermoctl.diagnosis.verdict.families import Family
from thermoctl.diagnosis.verdict.misfit import standouts
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant

SHOWS = 2.0  # standard deviations from the first recording, from which a value differs there
MISFIT = 1.1  # residual rms over the stated noise, from which an output is listed under `mismatch`
UNCONFIRMED = "nothing else confirms it"  # it helps in the part that it is fitted to, and not in others
CONTRADICTED = "recordings set aside contradict it"  # with it they are predicted worse
UNTOLD = "one of its family is there, and these data do not tell which"
# Number of blocks of a recording; least rms of a block with a large error, over that of the recording.
BLOCKS, LARGE = 40, 1.5


def contract(d: Diagnosis) -> dict[str, Any]:
    """Return the content of diagnosis.json, with `next_experiment`, `not_seen` and `seconds` still empty."""
    keys = {e.key for e in d.shown} - d.of_family.keys()
    stays = bool(d.laws) or d.decision.verdict in ("partly_explained", "unexplained", "ambiguous")
    outputs = d.case.plant.outputs
    return _plain(
        {
            "format": "thermoctl-diagnosis/1",
            "verdict": d.decision.verdict,
            "findings": [_finding(d, e) for e in d.shown],
            "alternatives": [
                {"effect": e, "where": w, "probability": round(p, 4)}
                | ({"why_not": why} if (why := _doubt(d, {(e, w)})) else {})
                | _expression(d, (e, w))
                for (e, w), p in d.decision.alternatives
                if (e, w) not in keys
            ],
            "families": [
                {"members": _members(d, f), "probability": round(f.probability, 4)}
                for f in d.families
                if f not in d.of_family.values()
            ],
            "mismatch": _mismatch(d),
            "remainder": {
                "share_closed": d.worth.share_closed if d.extends else 0.0,
                "rms": d.remainder.rms,
                "over_noise": d.remainder.over_noise,
                "node": d.remainder.node,
                "follows": d.remainder.follows,
                "law": law_entry(d.laws, d.worth),
            }
            if stays
            else None,
            "fit": _fit(d),
            "next_experiment": None,
            "decision": {"row": d.decision.row, **d.decision.numbers},
            "hypotheses": _hypotheses(d),
            "lost": _lost(d),
            "refused": [{"effects": spoken(keys), "reason": why} for keys, why in d.searched.refused.items()],
            "promised": {f"{e} at {at}": gain for (e, at), gain in sorted(d.searched.promised.items())},
            "placeless": sorted(d.case.catalogue.keys() - d.searched.where.keys()),
            "not_seen": [],
            "truncated": d.searched.truncated,
            "outliers": [{"recording": r, "column": c, "times": times} for r, c, times in d.case.outliers],
            "notes": notes(d),
            "outputs": {
                o: {"unit": outputs[o].unit, "noise": s, "step": outputs[o].resolution}
                for o, s in d.remainder.noise.items()
            },
            "recordings": [c.entry() for c in curves(d)],
            "seconds": None,
        }
    )


def _fit(d: Diagnosis) -> dict[str, Any]:
    """Return the errors of the plant as it came, refitted and extended, by output."""
    return {
        "before": rms_of(d.came, list(d.case.plant.outputs))
        if d.came
        else dict.fromkeys(d.case.plant.outputs, float("nan")),
        "refit_only": d.null.fit.rms(),
        "after": d.final.fit.rms(),
        "converged": d.null.fit.converged and d.final.fit.converged,
        "held_out_before": d.worth.before,
        "held_out_refit_only": d.worth.refit_only,
        "held_out_after": d.worth.after if d.extends else d.worth.refit_only,
        "held_out": "recordings " + ", ".join(d.worth.names)
        if d.worth.reserved
        else "cross-validated: no recording is set aside",
    }


def _finding(d: Diagnosis, e: Placed) -> dict[str, Any]:
    plant, effect = d.best.plant, e.candidate.effect
    values = {n: plant.parameters[n] for n in e.own.values()}
    ends = {p.shape: values[e.own[p.name]].value for p in effect.parameters if p.name in e.own}
    last = max(float(t.t[-1] - t.t[0]) for t in d.case.tables)
    first = ends.get("onset", ends.get("start"))
    equation = _equation(plant, e)
    figures = ", ".join(f"{n} = {p.value:.4g} {p.unit or ''}".strip() for n, p in values.items())
    family, begins = d.of_family.get(e.key), e.candidate.begins
    own = next((r for r, v in begins.items() if v == 0.0), None)
    here = [
        r
        for p in values.values()
        if p.known
        for r, v in p.values.items()
        if abs(v) > SHOWS * d.best.sd[p.name]
    ]
    return {
        "effect": e.key[0],
        "where": e.key[1],
        **({"differs_in": here} if here else {}),
        "when": None if first is None else [[first, min(ends.get("end", last), last)]],
        "recording": own,
        "lasts": max(begins.values()) > 0 if own else None,
        "probability": round(d.posterior.effects.get(e.key, 0.0), 4),
        "confirmed": round(d.asked.get(e.key, 1.0), 4),
        "equation": equation,
        "parameters": {
            n: {"value": p.value, "sd": d.best.sd.get(n, 0.0), "unit": p.unit}
            | ({"values": dict(p.values)} if p.per_recording else {})
            for n, p in values.items()
        },
        "summary": f"{effect.title} at {e.key[1]}: {equation} with {figures}.",
        **(_of_family(d, family) if family else {}),
    }


def _expression(d: Diagnosis, key: Key) -> dict[str, str]:
    """Return the likeliest expression of a law, with numbers; nothing for an effect of the catalogue."""
    best = next(w.fitted for w in d.searched.tried if key in w.fitted.hypothesis.keys)
    law = next((law for law in laws_of(best) if law.key == key), None)
    return {"expression": equation(best, law, numbers=True)} if law else {}


def _of_family(d: Diagnosis, f: Family) -> dict[str, Any]:
    """Return what a finding says of its family; the rest of it is of the member in the plant."""
    return {
        "effect": " or ".join(dict.fromkeys(e for e, _ in f.members)),
        "probability": round(f.probability, 4),
        "confirmed": round(max((d.asked[k] for k in f.members if k in d.asked), default=1.0), 4),
        "members": _members(d, f),
    }


def _members(d: Diagnosis, f: Family) -> list[dict[str, Any]]:
    return [
        {"effect": e, "where": w, "probability": round(d.posterior.effects[e, w], 4)} for e, w in f.members
    ]


def _equation(after: Plant, e: Placed) -> str:
    """Return the expression that the effect adds or changes, as text."""
    mine = set(e.own.values())
    changed = (
        *(f.rate for f in reversed(tuple(after.flows.values()))),
        *(o.value for o in after.outputs.values()),
    )
    for expression in changed:
        if ex.names(expression) & mine:
            return str(expression)
    for n in after.nodes.values():
        if ex.names(n.storage) & mine:
            net = " ".join(
                f"{'+' if f.target == n.name else '-'} ({f.rate})"
                for f in after.flows.values()
                if n.name in (f.source, f.target)
            )
            return f"{n.storage} * d({n.name})/dt = {net.removeprefix('+ ')}"
    return e.candidate.effect.title


def _mismatch(d: Diagnosis) -> list[dict[str, Any]]:
    if d.decision.verdict == "consistent":
        return []
    rms, noise, node = d.null.fit.rms(), d.before.noise, d.before.node
    wrong = [o for o, ratio in d.before.over_noise.items() if ratio > MISFIT]
    return [
        {
            "channel": o,
            "rms": rms[o],
            "expected_rms": noise[o],
            "node": node,
            "missing_flow_rms": d.missing_flow,
            "missing_flow_unit": flow_unit(d.case.plant, node) if node else None,
            **_when(d, o),
            "follows": d.before.follows,
        }
        for o in sorted(wrong, key=lambda o: -rms[o] / max(noise[o], 1e-300))
    ]


def _when(d: Diagnosis, output: str) -> dict[str, Any]:
    """Return the recording where an output's error is largest, and the intervals, s, in which it is large."""
    j = d.null.fit.model.outputs.index(output)
    errors = [e[:, j] for e in d.null.fit.residuals]
    sizes = [float(np.nanmean(e**2)) if np.isfinite(e).any() else 0.0 for e in errors]
    r = int(np.argmax(sizes))
    # samples are about evenly spaced, so that blocks of samples have about the same duration
    edges = np.linspace(0, len(errors[r]), min(BLOCKS, len(errors[r])) + 1).astype(int)
    t = d.case.tables[r].t - d.case.tables[r].t[0]
    out: list[list[float]] = []
    for a, b in pairwise(edges):
        part = errors[r][a:b]
        if np.isfinite(part).any() and np.nanmean(part**2) > LARGE**2 * sizes[r]:
            start, end = float(t[a]), float(t[min(b, len(t) - 1)])
            if out and out[-1][1] == start:
                out[-1][1] = end
            else:
                out.append([start, end])
    return {"recording": d.case.tables[r].name, "when": out}


def _hypotheses(d: Diagnosis) -> list[dict[str, Any]]:
    """Return every hypothesis that was fitted, the likeliest first.

    `physics`: each effect's probability of being physics; null if none stands out of the misfit.
    `remainder`: the largest probability of a remainder at an output."""
    null = next(w.fitted.log_evidence for w in d.searched.tried if not w.fitted.hypothesis.effects)
    out = []
    for w in d.searched.tried:
        keys = w.fitted.hypothesis.keys
        physics = d.physics.get(keys)
        out.append(
            {
                "effects": spoken(keys),
                "log_evidence": w.fitted.log_evidence - null,
                "log_prior_odds": w.log_odds,
                "posterior": d.posterior.hypotheses.get(keys, 0.0),
                "why_not": None if keys == d.final.hypothesis.keys else _why_not(d, w, keys),
                "physics": None if physics is None else [physics[k] for k in sorted(keys)],
                "remainder": max(w.fitted.average.remainder),
                "rms": w.fitted.fit.rms(),
                "cost": w.fitted.rough.cost,
                "at_bound": w.fitted.fit.at_bound,
                "converged": w.fitted.fit.converged,
                "energy": list(d.energy[keys].squares),
                "misfit": list(d.energy[keys].misfit),
                "rows": list(d.energy[keys].rows),
                "dims": [len(e.own) for e in sorted(w.fitted.hypothesis.effects, key=lambda e: e.key)],
            }
        )
    # The sort is stable: among equals the order of scores stays.
    return sorted(out, key=lambda h: -h["posterior"])


def _lost(d: Diagnosis) -> list[dict[str, Any]]:
    """Return the fitted effects that are not findings, each in its best hypothesis, with the reason."""
    out: dict[Key, dict[str, Any]] = {}
    shown = {e.key for e in d.shown} - d.of_family.keys()
    shown |= {law.placed.key for law in d.laws}
    for w in d.searched.tried:
        keys = w.fitted.hypothesis.keys
        for key in sorted(keys - shown - out.keys()):
            out[key] = {
                "effect": key[0],
                "where": key[1],
                "beside": spoken(keys - {key}),
                "probability": d.posterior.effects.get(key, 0.0),
                "below_best": _final_score(d) - w.score,
                "reason": _why_not(d, w, {key}),
            }
    return sorted(out.values(), key=lambda e: (-e["probability"], e["below_best"]))


def _why_not(d: Diagnosis, w: Weighed, keys: AbstractSet[Key]) -> str:
    """Return why a hypothesis with these effects is not the result."""
    if any(keys & {*f.members} for f in d.of_family.values()):
        return UNTOLD
    if doubt := _doubt(d, keys):
        return doubt
    if w.score < _final_score(d):
        return "less likely than the result"
    if keys & standouts(d.physics.get(w.fitted.hypothesis.keys, {})):
        return "fits better, but not surely enough for a name"
    return "does not stand out of the misfit that it leaves"


def _doubt(d: Diagnosis, keys: AbstractSet[Key]) -> str | None:
    """Return what other data say against these effects, None where that is nothing."""
    return UNCONFIRMED if keys & d.refused else CONTRADICTED if keys & d.contradicted else None


def _final_score(d: Diagnosis) -> float:
    return next(w.score for w in d.searched.tried if w.fitted.hypothesis.keys == d.final.hypothesis.keys)


def _plain(value: Any) -> Any:
    """Convert to JSON's own types; NaN and infinity become null, numbers are rounded to ten digits."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.bool_ | bool):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.10g}") if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
