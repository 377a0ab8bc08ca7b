"""Systems of published papers: our diagnosis and the peers on the same readings, five seeds each, one table.

    python -m tests.bench.published [--seeds 5] [--only NAME,NAME] [--out FILE]

thermoctl   the whole diagnosis with its catalogue: place, name or law, and parameters are its own
sindy       PySINDy's STLSQ, polynomials to the third degree, on the smoothed flow at the true place
gplearn     symbolic regression on the same flow
gp          a Gaussian process on the same flow: no law
weak        PySINDy's weak form on the readings themselves, polynomials to the third degree; where all states are read
paper       what the paper did, for those of Ebers, Steele, Kutz: low-pass filter of 4 Hz, differences, STLSQ with 0.046

The first three peers get the true place and the flow that our tracking smooths, the last two the true parameters, too.
`rate`: error of the rates dx/dt along the held-out run, over that of the refitted plant file, at the worst place that
lacks something. `right`: it is below EQUAL, and nothing is named that is not missing.
`coefficient`: largest relative error of the true form's coefficients, when the form is fitted to the rates found.
`held out`: rms error of the forecast of the held-out run from its true start over that of the refitted plant file;
`window` forecasts each of a chaotic system."""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from tests.bench.laws import PEERS, Predict, smoothed, values
from tests.laws.prove import EQUAL
from tests.laws.published import SYSTEMS, Drawn, Run, System, Values, solved
from thermoctl.diagnosis.data.pieces import in_pieces
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.law.refit import law_rate
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import expression as ex
from thermoctl.plant import loads
from thermoctl.plant.language import Input, Plant
from thermoctl.plant.parts import all_parts
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.table import Table

METHODS = ("thermoctl", *PEERS, "weak", "paper")
LOST = 10.0  # a forecast that leaves the plant file's by more counts as this
SECONDS = 60.0  # processor time, after which a forecast of a peer is given up
Rates = Callable[[Values], dict[str, np.ndarray]]  # dx/dt at the places that lack something


def plant_of(s: System, d: Drawn) -> Plant:
    """The plant file, with the noise of these readings where the paper states it relative to them."""
    sd = s.noise(d.truth[0])
    return loads(s.plant.replace("SDX", repr(sd.get("x"))).replace("SDY", repr(sd.get("y"))))


def inputs_by_name(plant: Plant, q: Values) -> dict[str, Any]:
    """Signals by the names of the plant, with its parameters."""
    columns = {n: q[i.column] for n, i in plant.inputs.items() if i.column in q}
    return {**q, **columns, **{k: p.value for k, p in plant.parameters.items()}, "pi": np.pi, "t": 0.0}


def rate_of(plant: Plant, node: str, known: Mapping[str, Any]) -> np.ndarray:
    """dx/dt of a node from its flows."""
    total = np.zeros(np.shape(known[node]))
    for f in plant.flows.values():
        if node in (f.source, f.target):
            total = total + (1 if f.target == node else -1) * np.asarray(ex.evaluate(f.rate, known), float)
    return total / np.asarray(ex.evaluate(plant.nodes[node].storage, known), float)


def of_plant(plant: Plant, s: System, t: np.ndarray) -> Rates:
    """Rates of a plant of ours along given states; states that it adds follow by themselves."""

    def rates(q: Values) -> dict[str, np.ndarray]:
        known = inputs_by_name(plant, q)
        used = {
            x
            for f in plant.flows.values()
            if {f.source, f.target} & s.missing.keys()
            for x in ex.names(f.rate)
        }
        own = {k: n for k, n in plant.nodes.items() if k not in known and k in used}
        if own:
            others = {k: Input(k, None, k, True) for k, v in known.items() if np.ndim(v) == 1}
            flows = {k: f for k, f in plant.flows.items() if f.target in own or f.source in own}
            part = dataclasses.replace(plant, inputs=others, nodes=own, flows=flows, outputs={})
            model = compile_plant(part)
            d = model.excitation(Table("truth", "", t, {k: known[k] for k in others}))
            known |= dict(zip(model.states, model.run(d).x.T, strict=True))
        return {n: rate_of(plant, n, known) for n in s.missing}

    return rates


def of_flow(first: Fitted, s: System, found: Mapping[str, tuple[list, Predict]]) -> Rates:
    """Rates of the refitted plant with a peer's flow into each node."""

    def rates(q: Values) -> dict[str, np.ndarray]:
        known = inputs_by_name(first.plant, {k: np.atleast_1d(v) for k, v in q.items()})
        known["t"] = np.zeros(len(known[s.states[0]]))
        out = {}
        for n, (signals, predict) in found.items():
            storage = np.asarray(ex.evaluate(first.plant.nodes[n].storage, known), float)
            out[n] = rate_of(first.plant, n, known) + predict(values(signals, known)) / storage
        return out

    return rates


# ------------------------------------------------------------------------------------------------------- measures


def judged(s: System, d: Drawn, before: Rates, after: Rates) -> dict[str, Any]:
    """Rate and coefficient errors along the held-out run."""
    q = {**d.truth[-1], **d.runs[-1].u}
    true = dict(zip(s.states, s.rates(q), strict=True))
    with np.errstate(all="ignore"):
        was, now = before(q), after(q)
    shares, errors = [], []
    for n, law in s.missing.items():
        shares.append(float(np.sqrt(np.mean((now[n] - true[n]) ** 2) / np.mean((was[n] - true[n]) ** 2))))
        k = np.array(s.coefficients[n])
        flow = law(q, *k) + now[n] - true[n]
        size = float(np.sqrt(np.mean(law(q, *k) ** 2)))
        if np.isfinite(flow).all():
            fit = least_squares(
                lambda z, law=law, k=k, flow=flow, size=size: (law(q, *(z * k)) - flow) / size,
                np.ones(len(k)),
            )
            errors.append(float(np.max(np.abs(fit.x - 1))))
    rate = max(shares) if np.isfinite(shares).all() else float("inf")
    return {
        "rate": rate,
        "right": rate < EQUAL,
        "coefficient": max(errors) if len(errors) == len(shares) else float("inf"),
    }


def windows(s: System, d: Drawn) -> list[tuple[Run, dict[str, np.ndarray]]]:
    """The held-out run, or windows of it, each with its true start and its true states."""
    run, truth = d.runs[-1], d.truth[-1]
    if s.window is None:
        return [(run, truth)]
    n = round(s.window / (run.t[1] - run.t[0])) + 1
    out = []
    for a in range(0, len(run.t) - n, n - 1):
        part = slice(a, a + n)
        x = {k: v[part] for k, v in truth.items()}
        start = tuple(float(v[0]) for v in x.values())
        out.append((Run(run.t[part] - run.t[a], {k: v[part] for k, v in run.u.items()}, start), x))
    return out


def forecast_of_plant(plant: Plant, s: System) -> Callable[[Run], dict[str, np.ndarray]]:
    """The states that a plant of ours forecasts."""

    def forecast(run: Run) -> dict[str, np.ndarray]:
        start = dict(zip(s.states, run.x0, strict=True))
        nodes = {
            k: dataclasses.replace(n, initial=ex.num(start[k]) if k in start else n.initial)
            for k, n in plant.nodes.items()
        }
        model = compile_plant(dataclasses.replace(plant, nodes=nodes))
        read = {c: np.full(len(run.t), start[x]) for c, x in s.reads.items()}
        x = model.run(model.excitation(Table("held_out", "", run.t, {**run.u, **read}))).x
        return {k: x[:, model.states.index(k)] for k in s.states}

    return forecast


def forecast_of_rates(rates: Rates, s: System) -> Callable[[Run], dict[str, np.ndarray]]:
    """The states that follow from the true equations of all other places and a peer's rates."""

    def forecast(run: Run) -> dict[str, np.ndarray]:
        ends = time.process_time() + SECONDS

        def slopes(q: Values) -> list:
            if time.process_time() > ends:
                raise ArithmeticError("too slow")
            found = rates(q)
            return [
                np.squeeze(found[n]) if n in found else r for n, r in zip(s.states, s.rates(q), strict=True)
            ]

        return solved(slopes, s.states, run, 1e-4)

    return forecast


def forecast_error(s: System, d: Drawn, forecast: Callable[[Run], dict[str, np.ndarray]]) -> float:
    """Rms error of the read states, each over its noise."""
    total, rows = 0.0, 0
    sd = s.noise(d.truth[-1])
    for run, truth in windows(s, d):
        try:
            with np.errstate(all="ignore"):
                x = forecast(run)
        except (SimulationError, ArithmeticError, ValueError):
            return float("inf")
        for c, state in s.reads.items():
            total += float(np.sum(((x[state] - truth[state]) / sd[c]) ** 2))
            rows += len(run.t)
    return float(np.sqrt(total / rows))


# --------------------------------------------------------------------------------------- peers on the readings


def _read(s: System, d: Drawn) -> list[np.ndarray]:
    column = {state: c for c, state in s.reads.items()}
    return [np.stack([t.columns[column[x]] for x in s.states], axis=1) for t in d.tables[:-1]]


def _inputs(d: Drawn) -> list[np.ndarray]:
    return [np.stack(list(r.u.values()), axis=1) if r.u else np.zeros((len(r.t), 0)) for r in d.runs[:-1]]


def _sparse(theta: np.ndarray, y: np.ndarray, thresholds: Sequence[float]) -> np.ndarray:
    """STLSQ on normed columns; of several thresholds the one that predicts every second row best."""
    import pysindy as ps

    size, best, train = np.linalg.norm(theta, axis=0), None, np.arange(len(y)) % 2 == 0
    for threshold in thresholds:
        model = ps.STLSQ(threshold=threshold * float(np.linalg.norm(y)), alpha=1e-6)
        model.fit((theta / size)[train], y[train, None])
        error = float(np.mean((y[~train] - theta[~train] @ (model.coef_[0] / size)) ** 2))
        if best is None or error < best[0]:
            best = error, model.coef_[0] / size
    assert best is not None
    return best[1]


def weak(s: System, d: Drawn) -> Rates:
    """The whole right side of each equation that lacks something, by the weak form."""
    import pysindy as ps

    rng = np.random.default_rng(0)
    theta, slopes, names = [], [], list(s.states)
    for x, u, run in zip(_read(s, d), _inputs(d), d.runs[:-1], strict=True):
        np.random.seed(int(rng.integers(1 << 31)))
        library = ps.WeakPDELibrary(
            ps.PolynomialLibrary(degree=3, include_bias=True), spatiotemporal_grid=run.t, K=200
        )
        z = np.concatenate([x, u], axis=1)
        library.fit([ps.AxesArray(z, {"ax_time": 0, "ax_coord": 1})])
        theta.append(np.asarray(library.transform([ps.AxesArray(z, {"ax_time": 0, "ax_coord": 1})])[0]))
        slopes.append(
            np.asarray(library.convert_u_dot_integral(ps.AxesArray(x, {"ax_time": 0, "ax_coord": 1})))
        )
    a, b = np.concatenate(theta), np.concatenate(slopes)
    polynomials = ps.PolynomialLibrary(degree=3)
    width = len(names) + len(d.runs[0].u)
    polynomials.fit(np.zeros((2, width)))
    found = {n: _sparse(a, b[:, s.states.index(n)], (0.3, 0.1, 0.03, 0.01, 0.003)) for n in s.missing}

    def rates(q: Values) -> dict[str, np.ndarray]:
        z = np.stack([np.atleast_1d(q[k]) for k in (*names, *d.runs[0].u)], axis=1)
        terms = np.asarray(polynomials.transform(z))
        return {n: terms @ c for n, c in found.items()}

    return rates


def paper(s: System, d: Drawn) -> Rates:
    """Filtered readings, differences less the known rates, sparse regression on polynomials of the third degree."""
    import pysindy as ps

    theta, left = [], []
    polynomials = ps.PolynomialLibrary(degree=3)
    for x, run in zip(_read(s, d), d.runs[:-1], strict=True):
        step = run.t[1] - run.t[0]
        x = sosfiltfilt(butter(4, 4, fs=1 / step, output="sos"), x, axis=0)
        q = {**dict(zip(s.states, x.T, strict=True)), **run.u}
        known = dict(zip(s.states, s.rates(q), strict=True))
        slope = dict(zip(s.states, np.gradient(x, step, axis=0).T, strict=True))
        theta.append(np.asarray(polynomials.fit_transform(x)))
        left.append(
            np.stack(
                [slope[n] - known[n] + law(q, *s.coefficients[n]) for n, law in s.missing.items()], axis=1
            )
        )
    a, b = np.concatenate(theta), np.concatenate(left)
    model = ps.STLSQ(threshold=0.046, alpha=1e-9)
    model.fit(a, b)
    coefficients = np.asarray(model.coef_)

    def rates(q: Values) -> dict[str, np.ndarray]:
        terms = np.asarray(polynomials.transform(np.stack([np.atleast_1d(q[k]) for k in s.states], axis=1)))
        known = dict(zip(s.states, s.rates(q), strict=True))
        return {
            n: known[n] - law(q, *s.coefficients[n]) + terms @ c
            for (n, law), c in zip(s.missing.items(), coefficients, strict=True)
        }

    return rates


# ------------------------------------------------------------------------------------------------------------ runs


def ours(plant: Plant, d: Drawn) -> tuple[Plant, dict[str, Any]]:
    """The plant that the diagnosis leads to, and what it states."""
    tables = all_parts(plant, d.tables[:-1])
    found = diagnose(plant, tables, catalogue(), limits())
    names = [f"{e.key[0]} at {e.key[1]}" for e in found.shown]
    law = str(law_rate(found.law.fitted, found.law.placed)) if found.law else None
    return found.final.plant, {
        "verdict": found.decision.verdict,
        "names": names,
        "law": law,
        "parts": len(tables),
    }


def compared(s: System, seed: int) -> dict[str, dict[str, Any]]:
    """All methods on one seed."""
    d = s.draw(seed)
    plant = plant_of(s, d)
    pieces, _ = in_pieces(plant, all_parts(plant, d.tables[:-1]))
    first, flows = smoothed(plant, pieces, list(s.missing))
    t = d.runs[-1].t
    before = of_plant(first.plant, s, t)
    null = forecast_error(s, d, forecast_of_plant(first.plant, s))
    whole = set(s.states) <= set(s.reads.values())
    out: dict[str, dict[str, Any]] = {}
    for method in METHODS:
        if (method == "weak" and not whole) or (method == "paper" and not s.filtered):
            continue
        started, r = time.process_time(), {}
        try:
            if method == "thermoctl":
                extended, r = ours(plant, d)
                rates, forecast = of_plant(extended, s, t), forecast_of_plant(extended, s)
            else:
                if method in PEERS:
                    found = {n: (sig, PEERS[method](x, y)) for n, (sig, x, y) in flows.items()}
                    rates = of_flow(first, s, found)
                else:
                    rates = {"weak": weak, "paper": paper}[method](s, d)
                forecast = forecast_of_rates(rates, s)
            r["seconds"] = round(time.process_time() - started, 2)
            r |= judged(s, d, before, rates)
            r["right"] = bool(r["right"] and {n.split(" at ")[0] for n in r.get("names", ())} <= s.names)
            r["held_out"] = float(np.nan_to_num(min(forecast_error(s, d, forecast) / null, LOST), nan=LOST))
        except Exception as e:  # a method that fails is a line of the table, too
            failed = {"rate": float("inf"), "right": False, "coefficient": float("inf"), "held_out": LOST}
            r = {
                **failed,
                "seconds": round(time.process_time() - started, 2),
                **r,
                "error": f"{type(e).__name__}: {e}",
            }
        out[method] = r
    return out


def table(results: Sequence[dict[str, Any]]) -> str:
    """The page's table: medians over the seeds."""
    lines = [
        "| system | method | right | rate error left | coefficient error | held-out error left | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(r["system"] for r in results):
        rows = [r for r in results if r["system"] == name]
        for m in METHODS:
            own = [r[m] for r in rows if m in r]
            if own:
                rate, k, out, cpu = (
                    float(np.median([q[key] for q in own]))
                    for key in ("rate", "coefficient", "held_out", "seconds")
                )
                lines.append(
                    f"| {name} | {m} | {sum(q['right'] for q in own)} of {len(own)} | {rate:.2f} "
                    f"| {'-' if k > 9.99 else f'{100 * k:.3g} %'} | {'lost' if out >= LOST else f'{out:.3f}'} | {cpu:.1f} |"
                )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the systems, keep each result as a line of JSON, print the table."""
    p = argparse.ArgumentParser()
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--only", default="", help="systems whose names hold one of these words")
    p.add_argument("--out", type=Path, default=Path("build/proof/published.jsonl"))
    args = p.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    kept = [json.loads(x) for x in args.out.read_text().splitlines()] if args.out.exists() else []
    done = {(r["system"], r["seed"]) for r in kept}
    words = [w for w in args.only.split(",") if w]
    for seed in range(args.seeds):
        for s in SYSTEMS:
            if (s.name, seed) in done or (words and not any(w in s.name for w in words)):
                continue
            kept.append({"system": s.name, "seed": seed, **compared(s, seed)})
            with args.out.open("a") as f:
                f.write(json.dumps(kept[-1]) + "\n")
            print(json.dumps(kept[-1]), flush=True)
    print(table(kept))


if __name__ == "__main__":
    main()
