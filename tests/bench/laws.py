"""Laws beside peers on the same smoothed inputs: right variable, right law, gain on held-out data, time.

    python tests/bench/laws.py [--number N] [--out FILE]

Every method is given the true place. The peers fit the smoothed flow there (`smooth.tracked` with that node alone) over the
signals of the place:

thermoctl   the whole diagnosis, which has to find the place itself
sindy       PySINDy's STLSQ on a library of polynomials to the third degree
gplearn     symbolic regression with abs, sqrt, log, inverse, products; parsimony 0.01
gp          Gaussian process with one length scale for each signal: no law, the bar for any function

A peer's variables are those whose permutation changes its flow by more than PART of the flow's rms. `difference` is that of
tests/laws/prove.py: the error of the net flow over the law's own, along an unseen trajectory."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.laws.prove import AMBIENT, EQUAL, PART, cases, judge, without
from tests.laws.rigs import Made, make
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted, fitted
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.law.signals import Place, Signal, signals
from thermoctl.diagnosis.law.smooth import LATENT, tracked
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

MOST = 600  # samples that a peer is given
Predict = Callable[[np.ndarray], np.ndarray]
Flow = tuple[list[Signal], np.ndarray, np.ndarray]


def sindy(x: np.ndarray, y: np.ndarray) -> Predict:
    """Sparse regression on polynomials."""
    import pysindy as ps

    library = ps.PolynomialLibrary(degree=3)
    library.fit(x)
    theta = np.asarray(library.transform(x))
    size = np.linalg.norm(theta, axis=0)
    best = None
    train = np.arange(len(y)) % 2 == 0
    for threshold in (0.3, 0.1, 0.03, 0.01):
        model = ps.STLSQ(threshold=threshold * float(np.linalg.norm(y)), alpha=1e-6)
        model.fit((theta / size)[train], y[train, None])
        c = model.coef_[0] / size
        error = float(np.mean((y[~train] - theta[~train] @ c) ** 2))
        if best is None or error < best[0]:
            best = error, c
    return lambda z, c=best[1]: np.asarray(library.transform(z)) @ c


def gplearn(x: np.ndarray, y: np.ndarray) -> Predict:
    """Symbolic regression."""
    from gplearn.genetic import SymbolicRegressor

    model = SymbolicRegressor(
        population_size=1000,
        generations=15,
        function_set=("add", "sub", "mul", "div", "sqrt", "log", "abs", "neg"),
        parsimony_coefficient=0.01,
        random_state=1,
    )
    model.fit(x, y)
    return model.predict


def gp(x: np.ndarray, y: np.ndarray) -> Predict:
    """Gaussian process with relevance of each signal."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel() * RBF(np.ones(x.shape[1]), (0.05, 1e3)) + WhiteKernel()
    return GaussianProcessRegressor(kernel, normalize_y=True, random_state=1).fit(x, y).predict


PEERS = {"sindy": sindy, "gplearn": gplearn, "gp": gp}


def smoothed(plant: Plant, tables: Sequence[Table], nodes: Sequence[str]) -> tuple[Fitted, dict[str, Flow]]:
    """The refitted plant; by node the signals there, their values (N, k) and the smoothed flow (N,)."""
    known = case(plant, tables, {}, Budget(limits().fits))
    first = as_refitted(known, fitted(known, known.plant, (), known.null))
    at = tracked(known, first, list(nodes))
    rig = Rig(first.rough_plant, known.drives(first.rough.model), [t.columns for t in known.tables])
    runs = [{**run, "t": d.t} for run, d in zip(at.metric.signals, at.metric.drives, strict=True)]
    flows = {}
    for node in nodes:
        found = signals(rig, Place(node), runs)
        x = np.concatenate([values(found, run) for run in runs])
        y = np.concatenate([np.asarray(run[f"{LATENT}{node}"]) for run in runs])
        keep = np.linspace(0, len(y) - 1, min(MOST, len(y))).astype(int)
        flows[node] = found, x[keep], y[keep]
    return first, flows


def values(found: Sequence[Signal], run: Mapping[str, Any]) -> np.ndarray:
    """The signals (N, k) along a run, each in its own size."""
    n = len(run["t"])
    return np.stack(
        [(np.broadcast_to(ex.evaluate(s.value, run), n) - s.centre) / s.size for s in found], axis=1
    )


def judged(made: Made, first: Fitted, found: list, x: np.ndarray, predict: Predict) -> dict:
    """Variables and difference of a peer's flow."""
    rng, base = np.random.default_rng(0), predict(x)
    used = set()
    for k, s in enumerate(found):
        mixed = x.copy()
        mixed[:, k] = rng.permutation(mixed[:, k])
        if np.sqrt(np.mean((predict(mixed) - base) ** 2)) > PART * np.sqrt(np.mean(base**2)):
            used |= set(ex.names(s.value))
    model = compile_plant(made.truth)
    d = model.excitation(made.tables[-1])
    run = {
        **dict(zip(model.inputs, d.u.T, strict=False)),
        **dict(zip(model.states, model.run(d).x.T, strict=True)),
        "t": d.t,
        "pi": np.pi,
    }

    def net(plant):
        known = {**run, **{k: v.value for k, v in plant.parameters.items()}}
        total = np.zeros(len(d.t))
        for f in plant.flows.values():
            if made.law.target in (f.source, f.target):
                total = total + (1 if f.target == made.law.target else -1) * np.asarray(
                    ex.evaluate(f.rate, known), float
                )
        return total / np.asarray(ex.evaluate(plant.nodes[made.law.target].storage, known), float)

    storage = float(
        np.mean(
            np.asarray(
                ex.evaluate(
                    first.plant.nodes[made.law.target].storage,
                    {k: v.value for k, v in first.plant.parameters.items()},
                )
            )
        )
    )
    delta = net(first.plant) + predict(values(found, run)) / storage - net(made.truth)
    own = net(without(made.truth)) - net(made.truth)
    return {
        "variable": used - AMBIENT == set(made.law.variables) - AMBIENT,
        "difference": float(np.sqrt(np.mean(delta**2) / np.mean(own**2))),
    }


def main() -> None:
    """Print the table."""
    p = argparse.ArgumentParser()
    p.add_argument("--number", type=int, default=12)
    p.add_argument("--out", type=Path)
    args = p.parse_args()
    rows: dict[str, list[dict]] = {m: [] for m in ("thermoctl", *PEERS)}
    for name, law, family, size, world, seed in [c for c in cases() if c[1]][: args.number]:
        made = make(law, family, size, world, seed)
        ours = judge(made)
        rows["thermoctl"].append(
            {
                "variable": bool(ours.get("variable")),
                "difference": ours["difference"],
                "seconds": ours["seconds"],
            }
        )
        first, flows = smoothed(made.plant, made.tables[:2], [made.law.target])
        found, x, y = flows[made.law.target]
        for m, method in PEERS.items():
            started = time.process_time()
            try:
                r = judged(made, first, found, x, method(x, y))
            except Exception as e:
                r = {"variable": False, "difference": float("inf"), "error": str(e)[:100]}
            rows[m].append({**r, "seconds": time.process_time() - started})
        print(
            name,
            {
                m: (r[-1]["variable"], round(r[-1]["difference"], 2), r[-1].get("error"))
                for m, r in rows.items()
            },
            flush=True,
        )
    lines = [
        "| method | variable right | law equivalent | difference, median | processor time, median |",
        "|---|---|---|---|---|",
    ]
    for m, r in rows.items():
        n = len(r)
        lines.append(
            f"| {m} | {sum(q['variable'] for q in r)} of {n} | {sum(q['difference'] < EQUAL for q in r)} of {n} "
            f"| {np.median([q['difference'] for q in r]):.2f} | {np.median([q['seconds'] for q in r]):.1f} s |"
        )
    print("\n".join(lines))
    if args.out:
        args.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
