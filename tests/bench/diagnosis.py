"""The diagnosis beside its peers: the same cases, the same candidates, the same scoring, one command.

    python tests/bench/diagnosis.py [CASES ...] [--answers DIR] [--number N] [--methods a,b] [--out DIR] [--seed S]

CASES are folders of cases (plant.yaml, recordings; answers inside, or apart in --answers); without one, a few concealed
cases are generated (short records). Done (method, case) pairs in --out are not run again.

thermoctl   `thermoctl diagnose`
sindy       PySINDy on the residual dynamics: smoothed derivatives of the measured states less the plant's slopes, sparse
            regression (STLSQ) on the candidates' forms, threshold by the error on the other recording
bic         greedy forward selection by BIC with white noise, on the free run

bic gets its candidates as a short list of the SHORT best by the product's own one-pass screening and its
starting values: fitting every candidate in full, as it would without it, takes hours. Every method's findings
are refitted and scored on held-out data by the same code, so `gain` compares the findings and nothing else. Two earlier
peers (CTSM practice, latent forces) needed the observer form and left with it; docs/proof holds their figures.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.proof import cases as proof_cases
from tests.proof import score as scoring
from thermoctl.diagnosis.data.case import Budget, Case, case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, as_refitted, fitted
from thermoctl.diagnosis.evidence.held_out import worth
from thermoctl.diagnosis.hypothesis.candidates import Candidate, candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.run import diagnose_files
from thermoctl.diagnosis.search.gains import Direction, parameter_values
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.refits import extend
from thermoctl.diagnosis.search.screen import groups_of, sharpened
from thermoctl.diagnosis.search.screening import screened
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.jobs import Job
from thermoctl.plant import expression as ex
from thermoctl.plant import load
from thermoctl.plant.fitting.estimate import report
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import SimulationError

SHORT, MOST = 8, 3


# ------------------------------------------------------------------------------------------------------- common parts


def prepared(job: Job) -> tuple[Case, Fitted]:
    """The case, and its plant refitted in white noise."""
    plant = load(job.plant)
    known = case(plant, read_recordings(plant, job.recordings), catalogue(), Budget(10**6))
    return known, as_refitted(known, fitted(known, plant, (), known.null))


def told(known: Case, base: Fitted, final: Fitted) -> dict[str, Any]:
    """A peer's result in the form of diagnosis.json. Peers give no probabilities: each finding counts as certain."""
    estimates = {e.name: e for e in report(final.fit)} if final.hypothesis.effects else {}
    findings = [
        {
            "effect": e.key[0],
            "where": e.key[1],
            "probability": 1.0,
            "when": None,
            "parameters": {
                p: {"value": estimates[n].value, "sd": estimates[n].sd}
                for p, n in e.own.items()
                if n in estimates
            },
        }
        for e in final.hypothesis.effects
    ]
    value = worth(known, base, final, ())
    return {
        "verdict": "explained" if findings else "consistent",
        "findings": findings,
        "alternatives": [],
        "fit": {
            "held_out_refit_only": value.refit_only,
            "held_out_after": value.after if findings else value.refit_only,
        },
    }


def white(f: Fitted) -> tuple[float, int]:
    """-2 log likelihood of Gaussian white residuals with their own variance per output, and the number of samples."""
    stacked = np.concatenate(f.fit.residuals)
    total, n = 0.0, 0
    for column in stacked.T:
        known = column[np.isfinite(column)]
        if len(known):
            total += len(known) * float(np.log(np.mean(known**2)))
            n += len(known)
    return total, n


def extended(known: Case, current: Fitted, direction: Direction) -> Fitted | None:
    """The current plant with one more effect, refitted in white noise; None where that cannot be simulated."""
    try:
        plant, own = extend(direction)
        effects = (*current.hypothesis.effects, Placed(direction.candidate, own))
        return as_refitted(known, fitted(known, plant, effects))
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return None


# ----------------------------------------------------------------------------------------------------------- the methods


def thermoctl(job: Job) -> dict[str, Any]:
    """The product."""
    with tempfile.TemporaryDirectory() as out:
        return diagnose_files(job.plant, job.recordings, Path(out) / "result")


def bic(job: Job) -> dict[str, Any]:
    """Greedy BIC on the free run, white noise: the candidate that gains most beyond its price, until none does."""
    known, base = prepared(job)
    current = base
    for _ in range(MOST):
        looked = screened(known, current)
        first: dict[tuple[str, str], Direction] = {}
        for d in sorted((d for d, _ in looked.promised), key=lambda d: d.log_p):
            first.setdefault(d.candidate.key, sharpened(looked.metric, looked.rig, d))
        best, margin = None, 0.0
        now, samples = white(current)
        for d in list(first.values())[:SHORT]:
            rival = extended(known, current, d)
            if rival is None:
                continue
            price = float(np.log(samples)) * len(rival.hypothesis.effects[-1].own)
            gain = now - white(rival)[0] - price
            if gain > margin:
                best, margin = rival, gain
        if best is None:
            break
        current = best
    return told(known, base, current)


def sindy(job: Job) -> dict[str, Any]:
    """Sparse regression of what the measured states' derivatives have beyond the plant's slopes."""
    known_case, base = prepared(job)
    looked = screened(known_case, base)
    model, drives, rig, metric = base.fit.model, looked.metric.drives, looked.rig, looked.metric
    known: list[dict[str, np.ndarray]] = []  # per recording: the derivatives of the states that are measured
    at = []
    for r in range(len(drives)):
        trajectory = Trajectory(metric, rig, r)
        rates = _measured(base.plant, model, trajectory)
        known.append(rates)
        at.append(trajectory)
    library = [c for c in candidates(rig, known_case.catalogue) if c.place.output is None]
    columns = [column for c in library for g in groups_of(c, metric) for column in g.columns()]
    forces = [[column.changes(a)[0] for a in at] for column in columns]  # by state, of each recording
    chosen: dict[tuple[str, str], tuple[float, Candidate, dict[str, float]]] = {}
    for i, state in enumerate(model.states):
        if not all(state in rates for rates in known):
            continue
        slope = model.code.slopes[i]
        target = [
            rates[state] - np.broadcast_to(np.asarray(ex.evaluate(slope, a.values), float), a.drive.t.shape)
            for rates, a in zip(known, at, strict=True)
        ]
        usable = [k for k, parts in enumerate(forces) if all(i in f for f in parts)]
        features = [[f[i] for f in forces[k]] for k in usable]
        for column, coefficient, share in _sparse(target, features, [columns[k] for k in usable]):
            c, shape, dim = column.candidate, column.shape, column.dim
            start = parameter_values(c, shape, [coefficient * v for v in dim])
            if c.key not in chosen or share > chosen[c.key][0]:
                chosen[c.key] = (share, c, {**shape, "": 0.0, **{f"={k}": v for k, v in start.items()}})
    current = base
    for _, c, kept in sorted(chosen.values(), key=lambda item: -item[0])[:MOST]:
        start = {k[1:]: v for k, v in kept.items() if k.startswith("=")}
        direction = Direction(
            dataclasses.replace(c, rig=Rig(current.plant, drives, rig.columns)),
            {k: v for k, v in kept.items() if k and not k.startswith("=")},
            0.0,
            1,
            start,
        )
        current = extended(known_case, current, direction) or current
    return told(known_case, base, current)


def _measured(plant: Any, model: Any, at: Trajectory) -> dict[str, np.ndarray]:
    """Derivatives (N,) of the states with a sensor (an output that is a multiple of one state) and of speeds whose position
    has one; puts the smoothed measurements into the trajectory's values in place of the simulated ones."""
    from pysindy import SmoothedFiniteDifference

    n = len(at.drive.t)
    window = int(np.clip(n // 60, 5, 100)) * 2 + 1
    derive = SmoothedFiniteDifference(smoother_kws={"window_length": window, "polyorder": 3})
    rates: dict[str, np.ndarray] = {}

    def take(state: str, z: np.ndarray) -> None:
        rates[state] = np.asarray(derive._differentiate(z[:, None], at.drive.t))[:, 0]
        at.values[state] = np.asarray(derive.smoothed_x_)[:, 0]

    for j, o in enumerate(plant.outputs.values()):
        used = ex.names(o.value)
        (state,) = used if len(used) == 1 else ("",)
        y = at.drive.y[:, j]
        if state not in model.states or np.isfinite(y).sum() < n // 2:
            continue
        offset = float(ex.evaluate(o.value, {state: 0.0}))
        gain = float(ex.evaluate(o.value, {state: 1.0})) - offset
        good = np.isfinite(y)
        take(state, (np.interp(at.drive.t, at.drive.t[good], y[good]) - offset) / gain)
    for i, slope in enumerate(model.code.slopes):  # dx/dt = v: the position's derivative measures the speed
        used = ex.names(slope)
        if (
            model.states[i] in rates
            and len(used) == 1
            and (v := next(iter(used))) in model.states
            and v not in rates
        ):
            take(v, rates[model.states[i]])
    return rates


def _sparse(
    target: list[np.ndarray], features: list[list[np.ndarray]], usable: list
) -> list[tuple[Any, float, float]]:
    """(column, coefficient, share of the target's energy) that STLSQ keeps; the threshold whose error on the recording that was
    not fitted is least wins, and none where the error falls by less than a hundredth."""
    from pysindy import STLSQ

    if not features:
        return []
    y = np.concatenate(target)
    best: dict[tuple[str, str], tuple[float, int]] = {}  # of each candidate the shape that correlates best
    for k, column in enumerate(features):
        x = np.concatenate(column)
        size = float(np.linalg.norm(x))
        like = abs(float(x @ y)) / size if size > 0 else 0.0
        key = usable[k].candidate.key
        if size > 0 and (key not in best or like > best[key][0]):
            best[key] = (like, k)
    take = [k for _, k in best.values()]
    if not take:
        return []
    theta = [np.stack([features[k][r] for k in take], axis=1) for r in range(len(target))]
    scale = np.linalg.norm(np.concatenate(theta), axis=0) / np.sqrt(len(y))
    theta = [x / scale for x in theta]
    folds = (
        [(theta[0], target[0], theta[1], target[1]), (theta[1], target[1], theta[0], target[0])]
        if len(target) > 1
        else [(theta[0][::2], target[0][::2], theta[0][1::2], target[0][1::2])]
    )
    spread = float(np.std(y))

    def fitted(x: np.ndarray, z: np.ndarray, threshold: float) -> np.ndarray:
        return np.asarray(STLSQ(threshold=threshold, alpha=1e-3, unbias=True).fit(x, z[:, None]).coef_)[0]

    least = sum(float(np.sum(z**2)) for *_, z in folds)
    chosen, limit = None, 0.99 * least
    for threshold in spread * np.geomspace(0.03, 1.0, 12):
        error = sum(float(np.sum((z1 - x1 @ fitted(x0, z0, threshold)) ** 2)) for x0, z0, x1, z1 in folds)
        if error < limit:
            chosen, limit = threshold, error
    if chosen is None:
        return []
    coefficients = fitted(np.concatenate(theta), y, chosen)
    return [
        (usable[k], float(w / s), float(w * w) / spread**2)
        for k, w, s in zip(take, coefficients, scale, strict=True)
        if w
    ]


METHODS: dict[str, Callable[[Job], dict[str, Any]]] = {"thermoctl": thermoctl, "sindy": sindy, "bic": bic}


# ---------------------------------------------------------------------------------------------------------- the bench


def placed(answer: Mapping[str, Any], row: scoring.Row) -> bool:
    """Whether a finding of any name is at a true place."""
    places = {str(w) for _, w in answer["effects"]}
    return any(scoring.same_place(e, w, p) for e, w in row.findings for p in places)


def noise_of(job: Job) -> dict[str, float]:
    """What the truth would leave, for answers that do not tell: the sensors' noise as the plant file has it."""
    return {
        o.name: float(np.hypot(o.noise_sd, (o.resolution or 0.0) / np.sqrt(12)))
        for o in load(job.plant).outputs.values()
        if o.noise_sd
    }


def one(method: str, job: Job, out: Path) -> dict[str, Any]:
    """Run a method on a case, or take what it gave before; keeps it in OUT/METHOD/CASE.json."""
    kept = out / method / f"{job.name}.json"
    if kept.exists() and (old := json.loads(kept.read_text()))["fingerprint"] == job.fingerprint():
        return old
    begun, cpu = time.monotonic(), time.process_time()
    try:
        result, error = METHODS[method](job), None
    except (InputError, SimulationError, np.linalg.LinAlgError, ValueError) as e:
        result, error = None, f"{type(e).__name__}: {e}"
    content = {
        "fingerprint": job.fingerprint(),
        "seconds": time.monotonic() - begun,
        "cpu_s": time.process_time() - cpu,
        "result": result,
        "error": error,
    }
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(content) + "\n")
    return content


def figures(
    jobs: Sequence[Job], answers: Mapping[str, Mapping[str, Any]], results: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """One method's figures over all cases; each share as [k, n]."""
    rows, spots = [], []
    for job in jobs:
        x = results[job.name]
        row = scoring.score(job.name, answers[job.name], x["result"], x["seconds"], x["error"])
        rows.append(row)
        if row.truth:
            spots.append(placed(answers[job.name], row))
    null = [r for r in rows if r.kind == "none"]
    there = [r for r in rows if r.kind not in ("none", "unknown")]
    unknown = [r for r in rows if r.kind == "unknown"]
    gains = [
        min(max(r.gain, -1.0), 1.2) if r.gain is not None else 0.0
        for r in there
        if r.gain is not None or not (results[r.case]["result"] or {}).get("fit", {}).get("held_out_after")
    ]
    return {
        "cases": len(rows),
        "detected": [sum(r.detected for r in there), len(there)],
        "right_name": [sum(r.alike for r in there), len(there)],
        "exact_name": [sum(r.exact for r in there), len(there)],
        "right_place": [sum(spots), len(spots)],
        "false_alarms": [sum(r.detected for r in null), len(null)],
        "unknown_misnamed": [sum(r.verdict == "explained" for r in unknown), len(unknown)],
        "gain_median": float(np.median(gains)) if gains else None,
        "cpu_s_median": float(np.median([x["cpu_s"] for x in results.values()])),
        "cpu_s_longest": max(x["cpu_s"] for x in results.values()),
        "failed": sum(x["error"] is not None for x in results.values()),
    }


def table(found: Mapping[str, Mapping[str, Any]]) -> Any:
    """The figures as a rich table, a row a method."""
    from rich.table import Table

    t = Table(title=f"{next(iter(found.values()))['cases']} cases")
    for title in (
        "method",
        "detected",
        "right name*",
        "exact name",
        "right place",
        "false alarms",
        "unknown named",
        "gain** (median)",
        "CPU s (median)",
        "longest",
        "failed",
    ):
        t.add_column(title, justify="left" if title == "method" else "right")
    for name, f in found.items():
        t.add_row(
            name,
            *(
                f"{f[k][0]}/{f[k][1]}"
                for k in (
                    "detected",
                    "right_name",
                    "exact_name",
                    "right_place",
                    "false_alarms",
                    "unknown_misnamed",
                )
            ),
            "–" if f["gain_median"] is None else f"{f['gain_median']:.2f}",
            f"{f['cpu_s_median']:.1f}",
            f"{f['cpu_s_longest']:.1f}",
            str(f["failed"]),
        )
    t.caption = (
        "* or a name that the data cannot tell from it; an ambiguous verdict counts by its first finding. ** share of the held-out "
        "gain that the truth itself would bring, over cases with something missing; nothing found counts 0"
    )
    return t


def main(argv: Sequence[str] | None = None) -> int:
    """The command."""
    from rich.console import Console

    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("cases", nargs="*", type=Path, help="folders of cases; none: a few are generated")
    p.add_argument("--answers", type=Path, help="folder of answers (default: answer.yaml inside each case)")
    p.add_argument(
        "--number", type=int, help="only the first N cases of each folder (generated: how many, default 10)"
    )
    p.add_argument("--methods", default=",".join(METHODS))
    p.add_argument("--seed", type=int, default=31, help="of generated cases")
    p.add_argument("--families", default="heater,stage,drive,flexure,tanks", help="of generated cases")
    p.add_argument("--out", type=Path, default=Path("build/bench-diagnosis"))
    a = p.parse_args(argv)
    methods = [m for m in a.methods.split(",") if m]
    if unknown := set(methods) - set(METHODS):
        p.error(f"--methods: {', '.join(sorted(unknown))}: expected some of {', '.join(METHODS)}")
    folders = list(a.cases)
    if not folders:
        sys.path.insert(0, str(Path(__file__).parents[2]))
        from tests.concealed import generate

        made = a.out / f"cases-{a.seed}"
        generate.main(
            [
                "--out",
                str(made),
                "--number",
                str(a.number or 10),
                "--seed",
                str(a.seed),
                "--smoke",
                "--answers",
                "inside",
                "--families",
                a.families,
            ]
        )
        folders = [made]
    jobs, answers = [], {}
    for folder in folders:
        some = proof_cases.find_jobs(folder, a.number)
        for job, answer in zip(some, proof_cases.read_answers(some, a.answers).values(), strict=True):
            answers[f"{folder.name}-{job.name}"] = {"oracle_rms": noise_of(job), **answer}
        jobs += [dataclasses.replace(j, name=f"{folder.name}-{j.name}") for j in some]
    found = {}
    for method in methods:
        results = {}
        for count, job in enumerate(jobs, 1):
            results[job.name] = x = one(method, job, a.out)
            said = (
                x["error"]
                or ", ".join(f"{f['effect']} at {f['where']}" for f in x["result"]["findings"])
                or "nothing"
            )
            verdict = (x["result"] or {}).get("verdict", "failed")
            print(
                f"{method} [{count}/{len(jobs)}] {job.name} {x['cpu_s']:.1f} s: {verdict}: {said}"
                f"   (true: {answers[job.name]['effects']})",
                file=sys.stderr,
                flush=True,
            )
        found[method] = figures(jobs, answers, results)
    Console(width=150).print(table(found))
    (a.out / "figures.json").write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
