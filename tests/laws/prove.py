"""Concealed laws that no entry of the catalogue holds: place, variable, law, worth, false claims.

    python -m tests.laws.prove --out DIR [--number N] [--workers N]    # one line of JSON for each case, then the table

The whole diagnosis runs, in which entries of the catalogue compete with laws. Lines of an earlier run are kept: run
again to continue."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.laws.rigs import LAWS, RATIOS, RELAYS, STORAGES, Made, Truth, drawn, make
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.law.find import FoundLaw
from thermoctl.diagnosis.law.refit import law_rate
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.estimate import updated
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Input, Parameter, Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

DRAWN, NONE = 16, 40  # laws from the grammar; cases without a law
EQUAL = 0.15  # rms difference of the net flow over the law's own rms, up to which a law is equivalent
PART = 0.2  # of a law's rms, from which a term counts for its variables
AMBIENT = {"air", "jacket"}
SEED = 4200


def cases() -> list[tuple[str, Truth | None, str, str, str, int]]:
    """(name, law, family, size, world, seed): every law once for each world, the sizes in turn; then none."""
    out: list[tuple[str, Truth | None, str, str, str, int]] = []
    for w, world in enumerate(("closed", "open")):
        for k, law in enumerate((*LAWS, *drawn(DRAWN, SEED), *RELAYS, *STORAGES)):
            size = list(RATIOS)[(k + w) % len(RATIOS)]
            out.append(
                (
                    f"{law.family}: {law.name} | {size} | {world}",
                    law,
                    law.family,
                    size,
                    world,
                    SEED + 7 * k + w,
                )
            )
    for k in range(NONE):
        family = ("heater", "stage", "tanks", "reactor")[k % 4]
        size = list(RATIOS)[k // 4 % len(RATIOS)]
        world = "open" if k % 8 < 6 else "closed"
        out.append((f"{family}: none {k} | {size} | {world}", None, family, size, world, SEED + 1000 + k))
    rng = np.random.default_rng(SEED)
    return [out[i] for i in rng.permutation(len(out))]


def judge(made: Made) -> dict[str, Any]:
    """Diagnose one case, and compare with its truth."""
    started = time.process_time()
    d = diagnose(made.plant, made.tables[:3], catalogue(), limits())
    law = max(d.laws, key=lambda found: _at_place(found, made), default=None)
    plant, null = d.final.plant, d.null.plant
    out: dict[str, Any] = {
        "seconds": round(time.process_time() - started, 1),
        "verdict": d.decision.verdict,
        "named": [f"{e.key[0]} at {e.key[1]}" for e in d.shown if e.key in d.decision.named],
        "claimed": len(d.laws),
        "ratio": made.ratio,
        "law": str(law_rate(law.fitted, law.placed)) if law else None,
        "forms": [t.form.name for t in law.proposal.terms] if law else None,
    }
    if made.law is None:
        return out
    oracle = _refit(made, _with_range(made.truth))
    e = [_misfit(p, made) for p in (null, plant, oracle)]
    closed = [1 - x / max(e[0], 1e-9) for x in e[1:]]
    out |= {"closed": closed[0], "oracle": closed[1], "difference": difference(plant, made)}
    if law:
        out["place"] = _at_place(law, made)
        out["variables"] = sorted(_variables(law, made))
        out["variable"] = set(out["variables"]) == made.law.variables - AMBIENT
    return out


def _at_place(law: FoundLaw, made: Made) -> bool:
    """Return whether a law is where the truth has its own."""
    if made.law is None:
        return False
    place, nodes = law.proposal.place, {made.law.target, made.law.source} - {None}
    return ({*place.nodes}, place.part) == (nodes, made.law.part)


def _with_range(truth: Plant) -> Plant:
    """The truth's plant, whose law's size a refit may move."""
    size = Parameter("size_of_law", 1.0, None, (0.2, 5.0))
    known = {**truth.parameters, "size_of_law": size}
    flows = {
        k: replace(f, rate=ex.mul(ex.name("size_of_law"), f.rate)) if k == "hidden" else f
        for k, f in truth.flows.items()
    }
    nodes = {k: replace(n, storage=_scaled(n.storage)) for k, n in truth.nodes.items()}
    used = set().union(
        *(ex.names(e) for e in (*(f.rate for f in flows.values()), *(n.storage for n in nodes.values())))
    )
    return replace(truth, parameters={k: p for k, p in known.items() if k in used}, flows=flows, nodes=nodes)


def _scaled(storage: ex.Expr) -> ex.Expr:
    """A storage whose law, its second part, has a size that a refit may move."""
    if storage.op != "+":
        return storage
    return ex.add(storage.args[0], ex.mul(ex.name("size_of_law"), storage.args[1]))


def _refit(made: Made, plant: Plant) -> Plant:
    model = compile_plant(plant)
    drives = [model.excitation(t) for t in made.tables[:3]]
    found = fit(model, drives, default_noise(plant, drives), iterations=30, tolerance=1e-3, seconds=np.inf)
    return updated(plant, found, drives)


def _misfit(plant: Plant, made: Made) -> float:
    """Energy of the error beyond the noise on the last recording, summed over the outputs, over the noise's."""
    model = compile_plant(plant)
    d = model.excitation(made.tables[-1])
    try:
        run = model.run(d, None, None, sensitivities=True)
    except Exception:
        return float("inf")
    sd = np.array([o.noise_sd for o in made.plant.outputs.values()])
    error, start = (d.y - run.y) / sd, run.dy[:, :, len(model.active) :] / sd[None, :, None]
    if start.shape[2]:  # less what the unknown start explains
        a = start.reshape(-1, start.shape[2])
        error = (error.ravel() - a @ np.linalg.lstsq(a, error.ravel(), rcond=None)[0]).reshape(error.shape)
    return float(np.sum(np.maximum(np.mean(error**2, axis=0) - 1, 0)))


def _signals(plant: Plant, table: Table) -> dict[str, Any]:
    """Inputs, states and time along a plant's free run of a recording."""
    model = compile_plant(plant)
    d = model.excitation(table)
    inputs = dict(zip(model.inputs, d.u.T, strict=False))  # delayed inputs have columns of their own
    return {**inputs, **dict(zip(model.states, model.run(d).x.T, strict=True)), "t": d.t, "pi": np.pi}


def difference(plant: Plant, made: Made) -> float:
    """Rms difference of the rates dx/dt at the law's place, along the truth's last run, over that of the law."""
    trajectory = _signals(made.truth, made.tables[-1])

    def net(p: Plant) -> np.ndarray:
        known = {**trajectory, **{k: v.value for k, v in p.parameters.items()}}
        total = np.zeros(len(trajectory["t"]))
        for f in p.flows.values():
            if made.law.target in (f.source, f.target):
                total = total + (1 if f.target == made.law.target else -1) * np.asarray(
                    ex.evaluate(f.rate, known), float
                )
        return total / np.asarray(ex.evaluate(p.nodes[made.law.target].storage, known), float)

    try:
        trajectory |= _memories(plant, trajectory, trajectory["t"])
        with np.errstate(all="ignore"):
            delta, own = net(plant) - net(made.truth), net(without(made.truth)) - net(made.truth)
    except KeyError:  # an effect that is named beside the law adds a state, which the truth lacks
        return float("inf")
    return float(np.sqrt(np.mean(delta**2) / np.mean(own**2)))


def without(truth: Plant) -> Plant:
    """The truth's plant without its law."""
    flows = {k: f for k, f in truth.flows.items() if k != "hidden"}
    nodes = {
        k: replace(n, storage=n.storage.args[0]) if n.storage.op == "+" else n for k, n in truth.nodes.items()
    }
    return replace(truth, flows=flows, nodes=nodes)


def _memories(plant: Plant, trajectory: dict[str, Any], t: np.ndarray) -> dict[str, np.ndarray]:
    """The states of a law's own along a trajectory of the others."""
    own = {k: n for k, n in plant.nodes.items() if k not in trajectory}
    if not own:
        return {}
    others = {k: Input(k, None, k, True) for k in trajectory if k not in ("t", "pi")}
    flows = {k: f for k, f in plant.flows.items() if f.target in own}
    model = compile_plant(replace(plant, inputs=others, nodes=own, flows=flows, outputs={}))
    columns = {k: np.asarray(trajectory[k], float) for k in others}
    return dict(zip(own, model.run(model.excitation(Table("truth", "", t, columns))).x.T, strict=True))


def _variables(law: FoundLaw, made: Made) -> set[str]:
    """The signals of the terms that matter, without the ambient."""
    known = {
        q: p.value for q, p in made.plant.parameters.items()
    }  # a flow of the plant file is a signal, too
    run = {**known, **_signals(made.plant, made.tables[0])}
    sizes, out, at = [], set(), 0
    for k, t in enumerate(law.proposal.terms):
        flow = t.values(run, run["t"]) @ np.array(law.proposal.sizes[at : at + len(t.form.sizes)])
        at += len(t.form.sizes)
        sizes.append((k, float(np.sqrt(np.mean(flow**2)))))
    for k, size in sizes:
        if size >= PART * max(s for _, s in sizes):
            out |= {n for s in law.proposal.terms[k].signals for n in ex.names(s.value)}
    return out - AMBIENT - known.keys()


def table(lines: Sequence[dict[str, Any]]) -> str:
    """The figures, in Markdown."""
    with_law = [r for r in lines if r["truth"]]
    shown = [r for r in with_law if r.get("ratio", 0) and r["oracle"] > 0.5]
    claimed = [r for r in shown if r["claimed"]]
    none = [r for r in lines if not r["truth"]]

    def share(rows: Sequence[Any], good: Sequence[Any]) -> str:
        return f"{100 * len(good) / max(len(rows), 1):.0f} % ({len(good)} of {len(rows)})"

    def row(name: str, goal: str, value: str) -> str:
        return f"| {name} | {goal} | {value} |"

    ratio = [r["closed"] / r["oracle"] for r in shown]
    out = [
        "| | goal | measured |",
        "|---|---|---|",
        row("a law claimed", "", share(shown, claimed)),
        row("place right, of the claimed", "90 %", share(claimed, [r for r in claimed if r["place"]])),
        row("variable right, of the claimed", "85 %", share(claimed, [r for r in claimed if r["variable"]])),
        row(
            "held-out misfit closed over the oracle's, median of all",
            "80 %",
            f"{100 * float(np.median(ratio)) if ratio else 0:.0f} %",
        ),
        row("equivalent law, of all", "60 %", share(shown, [r for r in claimed if r["difference"] < EQUAL])),
        row("an effect of the catalogue named too", "", share(shown, [r for r in claimed if r["named"]])),
        row(
            "an effect named in its place",
            "",
            share(shown, [r for r in shown if r["named"] and not r["claimed"]]),
        ),
        row("a law claimed where none is", "2 %", share(none, [r for r in none if r["claimed"]])),
        row("an effect named where none is", "2 %", share(none, [r for r in none if r["named"]])),
        row(
            "processor time, median",
            "60 s",
            f"{np.median([r['seconds'] for r in lines]):.0f} s" if lines else "-",
        ),
    ]
    for key in ("small", "middle", "large", "closed", "open", "heater", "stage", "tanks", "reactor"):
        part = [r for r in shown if key in r["case"].split(" | ")[1:] or r["case"].startswith(key)]
        good = [r for r in part if r["claimed"] and r["place"]]
        right = [r for r in part if r["claimed"] and r["variable"]]
        same = [r for r in part if r["claimed"] and r["difference"] < EQUAL]
        out.append(
            row(
                f"{key}: place, variable, equivalent, of {len(part)}",
                "",
                f"{len(good)}, {len(right)}, {len(same)}",
            )
        )
    return "\n".join(out) + "\n"


def _line(case: tuple[str, Truth | None, str, str, str, int]) -> dict[str, Any]:
    """Make and judge one case; an error is a line of the result, too."""
    name, law, family, size, world, seed = case
    try:
        result = judge(make(law, family, size, world, seed))
    except Exception as e:
        result = {"error": f"{type(e).__name__}: {e}"[:300]}
    return {"case": name, "truth": law.rate if law else None, **result}


def main() -> None:
    """Run the cases that an earlier run left, and print the table."""
    p = argparse.ArgumentParser()
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--number", type=int)
    p.add_argument("--workers", type=int, default=2)
    args = p.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "laws.jsonl"
    kept.touch()
    lines = [json.loads(x) for x in kept.read_text().splitlines()]
    done = {r["case"] for r in lines}
    left = [c for c in cases()[: args.number] if c[0] not in done]
    with kept.open("a") as file, ProcessPoolExecutor(args.workers, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(_line, c) for c in left]):
            lines.append(future.result())
            print(json.dumps(lines[-1]), file=file, flush=True)
            print(json.dumps({k: v for k, v in lines[-1].items() if k != "truth"}), flush=True)
    failed = [r for r in lines if "error" in r]
    print(
        table([r for r in lines if r not in failed]),
        *(f"{r['case']}: {r['error']}" for r in failed),
        sep="\n",
    )


if __name__ == "__main__":
    main()
