"""The diagnosis as the contract's JSON, the extended plant, and the words of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.evidence.case import Case
from thermoctl.evidence.decide import Decision, Posterior
from thermoctl.evidence.fit import Fitted, Placed
from thermoctl.evidence.held_out import Worth
from thermoctl.evidence.search import Searched
from thermoctl.evidence.unknown import Left
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.simulate import compile_plant

NEXT = {
    "consistent": "Nothing. The smallest effects that these recordings would have shown depend on their excitation: wider steps show more.",
    "explained": "Use the extended plant. Check it on a recording with another schedule before it is trusted outside these ranges.",
    "ambiguous": "Record with an excitation on which the alternatives differ (`thermoctl diagnose --resolve` proposes one).",
    "partly_explained": "Use the extended plant for what is named. Look for the rest where and when the remainder is largest.",
    "unexplained": "Look for the cause where the remainder enters; add an entry to the catalogue once it is known.",
}


@dataclass(frozen=True)
class Diagnosis:
    """All that was found."""

    case: Case
    searched: Searched
    posterior: Posterior
    best: Fitted
    null: Fitted  # as an ordinary refit leaves it
    left: Left
    before: Left
    worth: Worth
    decision: Decision

    @property
    def shown(self) -> tuple[Placed, ...]:
        """The effects that the result reports as findings."""
        supported = self.decision.verdict in ("explained", "partly_explained")
        if self.decision.verdict == "ambiguous":
            return self.best.hypothesis.effects
        return (
            tuple(e for e in self.best.hypothesis.effects if e.key in self.decision.named)
            if supported
            else ()
        )


def contract(d: Diagnosis) -> dict[str, Any]:
    """thermoctl-diagnosis/1."""
    shown = d.shown
    keys = {e.key for e in shown}
    remainder = d.decision.verdict in ("partly_explained", "unexplained", "ambiguous")
    return _plain(
        {
            "format": "thermoctl-diagnosis/1",
            "verdict": d.decision.verdict,
            "findings": [_finding(d, e) for e in shown],
            "alternatives": [
                {"effect": e, "where": w, "probability": round(p, 4)}
                for (e, w), p in d.decision.alternatives
                if (e, w) not in keys
            ],
            "mismatch": _mismatch(d),
            "remainder": {
                "share_closed": d.worth.share_closed if shown else 0.0,
                "rms": d.left.rms,
                "over_noise": d.left.over_noise,
                "node": d.left.node,
                "follows": d.left.follows,
                "law": None,
            }
            if remainder
            else None,
            "fit": {
                "before": _before(d),
                "refit_only": d.null.fit.rms(),
                "after": (d.best if shown else d.null).fit.rms(),
                "held_out_before": d.worth.before,
                "held_out_refit_only": d.worth.refit_only,
                "held_out_after": d.worth.after,
                "held_out": "recordings " + ", ".join(d.worth.names)
                if d.worth.reserved
                else "cross-validated: too few recordings to set one aside",
            },
            "next_experiment": None,
            "decision": {"row": d.decision.row, **d.decision.numbers},
            "hypotheses": _hypotheses(d),
            "truncated": d.searched.truncated,
            "notes": d.case.notes,
        }
    )


def _finding(d: Diagnosis, e: Placed) -> dict[str, Any]:
    plant = d.best.plant
    values = {n: plant.parameters[n] for n in e.own.values()}
    ends = {
        p.shape: plant.parameters[e.own[p.name]].value
        for p in e.candidate.effect.parameters
        if p.name in e.own and p.shape
    }
    last = max(float(t.t[-1] - t.t[0]) for t in d.case.tables)
    first = ends.get("onset", ends.get("start"))
    equation = _equation(d.case.plant, plant, e)
    figures = ", ".join(f"{n} = {p.value:.4g} {p.unit or ''}".strip() for n, p in values.items())
    return {
        "effect": e.key[0],
        "where": e.key[1],
        "when": None if first is None else [[first, min(ends.get("end", last), last)]],
        "probability": round(d.posterior.effects.get(e.key, 0.0), 4),
        "equation": equation,
        "parameters": {
            n: {"value": p.value, "sd": d.best.sd.get(n, 0.0), "unit": p.unit} for n, p in values.items()
        },
        "summary": f"{e.candidate.effect.title} at {e.key[1]}: {equation} with {figures}.",
    }


def _equation(before: Plant, after: Plant, e: Placed) -> str:
    """The expression that the effect brings or changes."""
    mine = set(e.own.values())
    for f in reversed(list(after.flows.values())):
        if ex.names(f.rate) & mine:
            return str(f.rate)
    for o in after.outputs.values():
        if ex.names(o.value) & mine:
            return str(o.value)
    for n in after.nodes.values():
        if ex.names(n.storage) & mine:
            return (
                str(after.outputs[e.candidate.place.output].value)
                if e.candidate.place.output
                else str(n.storage)
            )
    return e.candidate.effect.title


def _mismatch(d: Diagnosis) -> list[dict[str, Any]]:
    if d.decision.verdict == "consistent":
        return []
    rms = d.null.fit.rms()
    found = [
        {"channel": o, "rms": rms[o], "expected_rms": d.before.noise[o], "node": d.before.node}
        for o, ratio in d.before.over_noise.items()
        if ratio > 1.1
    ]
    return sorted(found, key=lambda m: -m["rms"] / max(m["expected_rms"], 1e-300))


def _before(d: Diagnosis) -> dict[str, float]:
    model = compile_plant(d.case.plant)
    errors = np.concatenate([x.y - model.run(x).y for x in d.case.drives(model)])
    return {
        o: float(np.sqrt(np.nanmean(errors[:, j] ** 2)))
        for j, o in enumerate(model.outputs)
        if np.isfinite(errors[:, j]).any()
    }


def _hypotheses(d: Diagnosis) -> list[dict[str, Any]]:
    """Every hypothesis that was fitted, the likeliest first."""
    null = next(w.fitted.log_evidence for w in d.searched.tried if not w.fitted.hypothesis.effects)
    return [
        {
            "effects": [f"{e} at {w}" for e, w in sorted(w.fitted.hypothesis.keys)],
            "log_evidence": w.fitted.log_evidence - null,
            "log_prior_odds": w.log_odds,
            "posterior": d.posterior.hypotheses.get(w.fitted.hypothesis.keys, 0.0),
            "remainder": max(w.fitted.average.remainder),
            "rms": w.fitted.fit.rms(),
            "cost": w.fitted.rough.cost,
            "at_bound": w.fitted.fit.at_bound,
        }
        for w in d.searched.tried
    ]


def words(found: Mapping[str, Any]) -> str:
    """The result in a few sentences, by size."""
    fit, lines = found["fit"], []
    worst = (
        max(fit["refit_only"], key=lambda o: fit["refit_only"][o] / max(fit["after"].get(o, 1e-300), 1e-300))
        if fit["refit_only"]
        else None
    )
    names = " and ".join(
        f"{f['effect'].replace('_', ' ')} at {f['where']} (probability {f['probability']:.2f})"
        for f in found["findings"]
    )
    if names:
        start = "Found" if found["verdict"] != "ambiguous" else "Something is missing, most likely"
        lines.append(f"{start}: {names}.")
        lines.append(
            f"The error of {worst} falls from {fit['before'][worst]:.3g} (refit alone: {fit['refit_only'][worst]:.3g}) to {fit['after'][worst]:.3g}."
        )
    elif found["verdict"] == "consistent":
        lines.append("The recordings agree with the plant within its sensors' noise: nothing is missing.")
    else:
        lines.append("Something is missing that no entry of the catalogue explains.")
    if found["remainder"]:
        r = found["remainder"]
        left = ", ".join(f"{v:.3g} of {o}" for o, v in r["rms"].items() if v > 0)
        at = f"; it enters at {r['node']}" if r["node"] else ""
        if left:
            lines.append(f"Nothing known explains the remaining {left}{at}.")
    lines.append("What next: " + NEXT[found["verdict"]])
    return " ".join(lines)


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
