"""Trend of an effect: its size in each recording, and a straight line over the recordings' dates.

Recording r alone has gradient g and curvature h by the effect's size, at the joint refit. Its own initial
states are eliminated, the plant's other parameters stay at the joint refit. So the size in recording r is

    joint size + g / h,   standard deviation 1 / sqrt(h)

The slope of a straight line over the dates is the change a month.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnosis.evidence.fit import SIGNIFICANT, Fitted
from thermoctl.diagnosis.evidence.posterior import Posterior
from thermoctl.diagnosis.hypothesis.candidates import DIFFERS
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.files.kept import reading
from thermoctl.recording.dates import begun, line


def trends(d: Diagnosis, before: Sequence[Mapping[str, Any]] = ()) -> list[dict[str, Any]]:
    """Return `trends` of the result: each effect's size by recording, and its change a month.

    An event that begins with a recording and is no finding would hide a trend. So would an other value. They
    are left out, if that was refitted. `before`: the trends of an earlier diagnosis, whose recordings come
    first."""
    effects = [e for e in d.best.hypothesis.effects if e.candidate.effect.where != DIFFERS]
    named = {e.key for e in d.shown}
    lasting = {e.key for e in effects if e.key in named or not e.candidate.begins}
    f = next((w.fitted for w in d.searched.tried if w.fitted.hypothesis.keys == lasting), d.best)
    case, shown = d.case, [e for e in f.hypothesis.effects if e.key in named]
    posterior = Posterior(case, f.plant, f.hypothesis.effects)
    dates = [begun(t) for t in case.tables]
    old = {(e["effect"], e["where"], e["parameter"]): e["recordings"] for e in before}
    out = []
    for e in shown:
        for p in e.candidate.effect.parameters:
            if not p.amplitude or p.name not in e.own:
                continue
            own = _sizes(posterior, f, e.own[p.name])
            sizes = [
                *old.get((*e.key, p.name), ()),
                *(
                    {
                        "recording": t.name,
                        "begun_s": None if math.isnan(date) else date,
                        "value": float(v),
                        "sd": float(sd),
                    }
                    for t, date, (v, sd) in zip(case.tables, dates, own, strict=True)
                    if math.isfinite(sd)
                ),
            ]
            sizes.sort(key=lambda r: (r["begun_s"] is None, r["begun_s"] or 0.0))
            dated = [r for r in sizes if r["begun_s"] is not None]
            slope, error = line([r["begun_s"] for r in dated], [(r["value"], r["sd"]) for r in dated])
            is_known = math.isfinite(error)
            out.append(
                {
                    "effect": e.key[0],
                    "where": e.key[1],
                    "parameter": p.name,
                    "unit": f.plant.parameters[e.own[p.name]].unit,
                    "recordings": sizes,
                    "per_month": slope if is_known else None,
                    "per_month_sd": error if is_known else None,
                    "changes": is_known and abs(slope) > SIGNIFICANT * error,
                }
            )
    return out


def earlier_trends(earlier: Path | None) -> Sequence[dict[str, Any]]:
    """Return the trends in the result of an earlier diagnosis. Raises InputError for a damaged one."""
    path = earlier / "diagnosis.json" if earlier else None
    if path is None or not path.exists():
        return ()
    with reading(path, "the result of a diagnosis", "diagnose all recordings again"):
        result = json.loads(path.read_bytes())
        return [
            {k: str(t[k]) for k in ("effect", "where", "parameter")}
            | {"recordings": [_read_size(r) for r in t["recordings"]]}
            for t in result.get("trends", ())
        ]


def _read_size(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an effect's size in one recording. Raises ValueError, KeyError, TypeError."""
    begun = entry["begun_s"]
    numbers = {k: float(entry[k]) for k in ("value", "sd")} | (
        {} if begun is None else {"begun_s": float(begun)}
    )
    if not all(map(math.isfinite, numbers.values())) or numbers["sd"] <= 0:
        raise ValueError(f"finite numbers and an sd above 0 were expected, found {numbers}")
    return {"recording": str(entry["recording"]), "begun_s": None, **numbers}


def trend_notes(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each significant trend."""
    return [
        f"{t['effect']} at {t['where']} changes with the recordings' dates: {t['parameter']} by {t['per_month']:+.3g} "
        f"± {1.96 * t['per_month_sd']:.2g} {t['unit'] or ''} in 30 days, {_day(t['recordings'][0])} to "
        f"{_day([r for r in t['recordings'] if r['begun_s'] is not None][-1])}"
        for t in entries
        if t["changes"]
    ]


def _day(recording: Mapping[str, Any]) -> str:
    return str(np.datetime64(int(recording["begun_s"]), "s").astype("datetime64[D]"))


def _sizes(posterior: Posterior, f: Fitted, parameter: str) -> list[tuple[float, float]]:
    """Return (value, sd) of a parameter in each recording; sd is infinite without information on it."""
    problem, z = posterior.problem, f.fit.z
    index = posterior.model.parameters.index(parameter)
    errors = posterior.errors(z)
    rows = posterior.rows(errors)
    sums = posterior.sums(z, rows, posterior.likelihood(rows)[0].inverse)
    initial = np.arange(len(z)) >= problem.n_parameters
    prior = np.where(np.outer(initial, initial), posterior.precision, 0.0)
    out = []
    for r in range(len(posterior.drives)):
        gradient, matrix = prior @ (posterior.mean - z), prior.copy()
        unknowns = sums[r].unknowns
        gradient[unknowns] += sums[r].gradient
        matrix[np.ix_(unknowns, unknowns)] += sums[r].matrix
        mine = [k for k, (q, of) in enumerate(problem.unknowns) if q == parameter and of in (None, r)]
        starts = [k for k, (q, of) in enumerate(problem.unknowns) if initial[k] and of == r]
        value = float(f.fit.values[r, index])
        if not mine:
            out.append((value, math.inf))
            continue
        a = mine[0]
        absorbed = np.linalg.solve(matrix[np.ix_(starts, starts)], matrix[np.ix_(starts, [a])])[:, 0]
        h = matrix[a, a] - float(absorbed @ matrix[starts, a])
        g = gradient[a] - float(absorbed @ gradient[starts])
        slope = problem.scales[parameter].slope(value)
        least = 1e-12 * max(matrix[a, a], 1e-300)
        shift = 0.0 if problem.unknowns[a][1] is not None else slope * g / h if h > least else 0.0
        out.append((value + shift, slope / math.sqrt(h) if h > least else math.inf))
    return out
