"""Write folders of cases with concealed physics; the answers apart, hashed.

    python -m tests.concealed.generate --out DIR --number N --seed S [--smoke] [--answers DIR] [--families a,b] [--kind none]

DIR/NNNN/{plant.yaml,run_1.csv,run_2.csv}; answers in --answers (default DIR/../<name>_answers) as NNNN.yaml with
`manifest.sha256`; `--answers inside` puts answer.yaml into each case instead (a set to develop on). A case is a
function of (seed, number) alone: any part of a set can be made again.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

import numpy as np
import yaml

from tests.concealed import sensors
from tests.concealed.judge import BANDS, TELL_APART, Judge, beyond, snr
from tests.concealed.rig import Scene, Suspect
from tests.concealed.rigs_motion import Flexure, FreeStage
from tests.concealed.rigs_tanks import Tanks
from tests.concealed.rigs_thermal import Actuator, Drive, Heater
from tests.concealed.thermal import Variant

FAMILIES = {f.name: f for f in (Heater(), FreeStage(), Drive(), Flexure(), Tanks(), Actuator())}
SCHEDULES = ("production-like", "designed", "warm-up", "designed")
# physics outside the catalogue must leave this many sigmas after every single catalogue effect, or nobody can tell
STRANGE = 8.0
SIZES = 10.0 ** np.arange(-2.0, 1.51, 0.5)
# one period of kinds: 600 cases hold 150 of nothing missing, 360 single effects, 45 unknown, 30 pairs, 15 that cancel
KINDS = (
    "one",
    "none",
    "one",
    "one",
    "none",
    "one",
    "one",
    "unknown",
    "one",
    "none",
    "one",
    "pair",
    "one",
    "one",
    "none",
    "one",
    "one",
    "unknown",
    "one",
    "none",
    "one",
    "one",
    "pair",
    "one",
    "none",
    "one",
    "one",
    "one",
    "none",
    "one",
    "unknown",
    "one",
    "one",
    "none",
    "one",
    "cancel",
    "one",
    "none",
    "one",
    "one",
)


class Bench:
    """One scene made measurable: noise, whitening, parameter derivatives, signatures of its suspects."""

    def __init__(self, scene: Scene, rng: np.random.Generator):
        self.scene = scene
        colour = str(rng.choice(["white", "ar", "flicker"]))
        self.noise = [sensors.draw_noise(sd, rng, colour) for sd in scene.sd]
        self.colour = colour
        spectra = []
        for run in scene.runs:
            n = len(run["t"])
            spectra.append(
                np.stack([x.spectrum(n) + r**2 / 12 for x, r in zip(self.noise, scene.resolution, strict=True)], axis=1)
            )
        self.judge = Judge(spectra)

    def measure(self, pool: list[Suspect], rivals: list[Suspect]) -> None:
        """Signals left of `pool` at SIZES and of `rivals` at two sizes, all in one batch per run."""
        scene = self.scene
        rows, steps = [Variant()], []
        for name, (low, high) in scene.ranges.items():
            steps.append(2e-3 * (high - low))
            rows.append(Variant(theta={name: scene.theta[name] + steps[-1]}))
        n_theta = len(rows)
        rows += [Variant(start={n: 0.1 * s}) for n, s in scene.starts.items()]
        n_nuisance = len(rows)
        sized = [(s, [z for z in SIZES if z <= s.top]) for s in pool]
        for s, sizes in sized:
            rows += [Variant(effects=[(s.effect, s.where, s.make(z))]) for z in sizes]
        for s in rivals:
            rows += [Variant(effects=[(s.effect, s.where, s.make(z))]) for z in (0.1 * min(1, s.top), min(1, s.top))]
        runs = [scene.outputs_of(k, rows) for k in range(len(scene.runs))]
        self.base = [y[0] for y in runs]
        d = [y - y[:1] for y in runs]
        tangents = [d[k][1:n_theta] / np.array(steps)[:, None, None] for k in range(len(runs))]
        scale = np.array([(h - lo) / 4 for lo, h in scene.ranges.values()])
        whole = [self.judge.whiten([x * scale[:, None, None] for x in tangents])] if len(scale) else []
        for k in range(len(runs)):  # each run has its own start
            alone = [
                np.zeros_like(d[j][n_theta:n_nuisance]) if j != k else d[j][n_theta:n_nuisance] / 0.1
                for j in range(len(runs))
            ]
            if n_nuisance > n_theta:
                whole.append(self.judge.whiten(alone))
        self.judge.set_parameters(np.concatenate(whole))
        left = self.judge.left_over(self.judge.whiten([x[n_nuisance:] for x in d]))
        at = 0
        self.curve = []
        for s, sizes in sized:
            self.curve.append((s, np.array(sizes), left[at : at + len(sizes)]))
            at += len(sizes)
        self.rivals = [(s, left[at + 2 * i : at + 2 * i + 2]) for i, s in enumerate(rivals)]

    def left_of(self, effects: list[tuple[str, str, dict]]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Left-over row (M,) and readings of the truth with these effects."""
        runs = [self.scene.outputs_of(k, [Variant(effects=effects)])[0] for k in range(len(self.scene.runs))]
        d = self.judge.whiten([(y - b)[None] for y, b in zip(runs, self.base, strict=True)])
        return self.judge.left_over(d)[0], runs

    def strangest(self, left: np.ndarray) -> float:
        """What is left of a signal after the single catalogue effect that comes nearest to it."""
        return min(beyond(left, row) for _, row in self.rivals)

    def like(self, left: np.ndarray, truth: Suspect) -> list[tuple[str, str]]:
        """Rivals after which too little of the signal is left to tell them from the truth."""
        return [
            (s.effect, s.where)
            for s, row in self.rivals
            if (s.effect, s.where) != (truth.effect, truth.where) and beyond(left, row) < TELL_APART
        ]


def _size_for(curve: tuple, target: float) -> float | None:
    """The size at which the left-over SNR is `target`; None where the effect cannot be that visible."""
    suspect, sizes, left = curve
    s = snr(left)
    if not np.all(np.isfinite(s)) or s.max() < target:
        return None
    k = int(np.argmax(s >= target))
    if k == 0:
        return float(sizes[0] * target / s[0]) if suspect.top > 1 else float(sizes[0])
    x = np.interp(np.log(target), np.log(s[k - 1 : k + 1] + 1e-12), np.log(sizes[k - 1 : k + 1]))
    return float(np.exp(x))


def make_case(
    seed: int, number: int, families: list[str], short: bool, kind: str | None = None
) -> tuple[dict, list[list[tuple[str, np.ndarray]]], dict]:
    """Case `number` of a set: (plant, columns of each run, answer). `kind` asks for one kind instead of the set's turn."""
    turn = KINDS[(number // len(families) + 7 * (number % len(families))) % len(KINDS)]
    kind = kind or turn
    for attempt in range(20):
        rng = np.random.default_rng([seed, number, attempt])
        family = families[number % len(families)]
        schedule = SCHEDULES[(number // 3) % len(SCHEDULES)]
        scene = FAMILIES[family].scene(rng, schedule, short)
        case = _conceal(scene, kind, rng, number)
        if case is not None:
            effects, runs, told, bench = case
            break
    else:
        raise RuntimeError(f"case {number}: no visible effect in 20 draws")
    answer = {
        "verdict": "consistent" if kind == "none" else "unexplained" if kind == "unknown" else "explained",
        "effects": [["?" if e.startswith("?") else e, w] for e, w, _ in effects],
        "nearly_the_same": sorted({e for e, _ in told["alike"] if e not in {x for x, _, _ in effects}}),
        "nearly_the_same_places": [list(x) for x in sorted(set(told["alike"]))],
        "family": family,
        "schedule": schedule,
        "kind": kind,
        "colour": bench.colour,
        "band": told["band"],
        "snr": [round(float(s), 2) for s in told["snr"]],
        "onset": told["onset"],
        "also_right": [list(x) for x in told["aliases"]],
        "parameters": [{k: float(v) for k, v in p.items()} for _, _, p in effects],
        "true_parameters": {k: float(f"{v:.6g}") for k, v in scene.theta.items()},
    }
    if kind == "unknown":
        answer["outside_catalogue"] = [e for e, _, _ in effects]
    dirt_kind = rng.choice(["clean", "outliers", "gaps", "slow"], p=[0.55, 0.15, 0.2, 0.1])
    tables, oracle = [], []
    slow = rng.integers(len(scene.outputs)) if dirt_kind == "slow" and len(scene.outputs) > 1 else -1
    for k, run in enumerate(scene.runs):
        columns = [("t", run["t"])]
        columns += [(c, run[key]) for c, key in scene.columns.items()]
        for j, c in enumerate(scene.output_columns):
            dirt = {"outliers": 0.0015} if dirt_kind == "outliers" else {"gaps": 1} if dirt_kind == "gaps" else {}
            if j == slow:
                dirt = {"every": 5}
            y = sensors.record(runs[k][:, j], bench.noise[j], scene.sd[j], scene.resolution[j], dirt, rng)
            columns.append((c, y))
            oracle.append((scene.outputs[j], np.sqrt(np.nanmean((y - runs[k][:, j]) ** 2))))
        tables.append(columns)
    answer["dirt"] = str(dirt_kind)
    answer["oracle_rms"] = {o: float(f"{np.mean([r for n, r in oracle if n == o]):.5g}") for o in scene.outputs}
    return scene.plant, tables, answer


def _conceal(scene: Scene, kind: str, rng: np.random.Generator, number: int):
    """Choose effects and sizes: (effects, readings by run, what the answer tells, bench), or None when not visible."""
    bench = Bench(scene, rng)
    told: dict = {"alike": [], "band": None, "snr": [], "onset": None, "aliases": []}
    if kind == "none":
        bench.base = [scene.outputs_of(k, [Variant()])[0] for k in range(len(scene.runs))]
        return [], bench.base, told, bench
    pool = scene.unknowns if kind == "unknown" else scene.suspects
    names = sorted({s.effect for s in pool})  # every effect alike, whatever its number of places
    picks = list(rng.permutation(names))[: 4 if kind in ("one", "unknown") else 8]
    chosen = [options[rng.integers(len(options))] for options in ([s for s in pool if s.effect == e] for e in picks)]
    bench.measure(chosen, scene.suspects)
    if kind in ("one", "unknown"):
        band = "large" if kind == "unknown" else ("large", "middle", "large", "small")[number // 2 % 4]
        low, high = BANDS[band]
        for curve in bench.curve:
            size = _size_for(curve, float(np.exp(rng.uniform(np.log(low * 1.1), np.log(high * 0.9)))))
            if size is None:
                continue
            s = curve[0]
            effects = [(s.effect, s.where, s.make(size))]
            left, runs = bench.left_of(effects)
            if not low <= snr(left) < high * (4 if band == "large" else 1):
                continue
            if kind == "unknown" and bench.strangest(left) < STRANGE:
                continue
            told |= {
                "band": band,
                "snr": [snr(left)],
                "alike": bench.like(left, s),
                "onset": effects[0][2].get(s.onset) if s.onset else None,
                "aliases": [(s.effect, w) for w in s.aliases],
            }
            return effects, runs, told, bench
        return None
    return _two(bench, kind, rng, told)


def _two(bench: Bench, kind: str, rng: np.random.Generator, told: dict):
    """Two effects at once: each large, or so that their signals partly cancel while each alone is large."""
    best = None
    for i, first in enumerate(bench.curve):
        for second in bench.curve[i + 1 :]:
            if first[0].onset and second[0].onset:
                continue
            sizes = [_size_for(c, rng.uniform(18, 50)) for c in (first, second)]
            if None in sizes:
                continue
            a, b = (c[2][int(np.argmin(abs(np.log(c[1] / z))))] for c, z in zip((first, second), sizes, strict=True))
            cos = float(a @ b / (snr(a) * snr(b) + 1e-12))
            score = cos if kind == "cancel" else abs(cos)
            if best is None or score < best[0]:
                best = (score, first[0], second[0], sizes)
    if best is None or (kind == "cancel" and best[0] > -0.3):
        return None
    _, one, two, sizes = best
    effects = [(s.effect, s.where, s.make(z)) for s, z in zip((one, two), sizes, strict=True)]
    alone = [bench.left_of([e])[0] for e in effects]
    left, runs = bench.left_of(effects)
    if snr(left) < 6 or not 10 < min(map(snr, alone)) <= max(map(snr, alone)) < 240:
        return None
    if kind == "cancel" and snr(left) ** 2 > 0.75 * sum(snr(a) ** 2 for a in alone):
        return None
    onset = next((e[2][s.onset] for e, s in zip(effects, (one, two), strict=True) if s.onset), None)
    told |= {
        "band": "large",
        "snr": [snr(left), *(snr(a) for a in alone)],
        "onset": onset,
        "alike": [x for s, a in zip((one, two), alone, strict=True) for x in bench.like(a, s)],
    }
    return effects, runs, told, bench


def write_case(folder: Path, plant: dict, tables: list) -> None:
    """The public files of a case."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plant.yaml").write_text(yaml.safe_dump(_plain(plant), sort_keys=False, width=110))
    for k, columns in enumerate(tables):
        cells = [np.char.mod("%.7g" if n != "t" else "%.10g", c) for n, c in columns]
        cells = [np.where(np.isnan(c), "", x) for x, (_, c) in zip(cells, columns, strict=True)]
        lines = [",".join(n for n, _ in columns), *(",".join(row) for row in zip(*cells, strict=True))]
        (folder / f"run_{k + 1}.csv").write_text("\n".join(lines) + "\n")


def _plain(x):
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, np.generic):
        return x.item()
    return x


def main(argv: list[str] | None = None) -> int:
    """The command."""
    p = argparse.ArgumentParser(prog="tests.concealed.generate", description=__doc__)
    p.add_argument("--out", required=True, type=Path)
    p.add_argument("--number", type=int, default=600)
    p.add_argument("--first", type=int, default=0, help="number of the first case (to make a part of a set)")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--smoke", action="store_true", help="short records")
    p.add_argument("--answers", default=None, help="folder for the sealed answers, or 'inside'")
    p.add_argument("--families", default=",".join(FAMILIES))
    p.add_argument("--kind", choices=sorted(set(KINDS)), help="only cases of this kind")
    a = p.parse_args(argv)
    inside = a.answers == "inside"
    answers = a.out.parent / f"{a.out.name}_answers" if a.answers is None else Path(a.answers)
    a.out.mkdir(parents=True, exist_ok=True)
    for number in range(a.first, a.first + a.number):
        name = f"{number + 1:04d}"
        target = a.out / name / "answer.yaml" if inside else answers / f"{name}.yaml"
        if target.exists():
            continue
        plant, tables, answer = make_case(a.seed, number, a.families.split(","), a.smoke, a.kind)
        write_case(a.out / name, plant, tables)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(yaml.safe_dump(_plain(answer), sort_keys=False))
        print(
            f"{name} {answer['family']:9s} {answer['schedule']:15s} {answer['kind']:7s} {answer['band'] or '':6s} "
            f"{answer['snr']} {answer['effects']} ~ {answer['nearly_the_same']}",
            file=sys.stderr,
            flush=True,
        )
    if not inside:
        files = sorted(answers.glob("[0-9]*.yaml"))
        (answers / "manifest.sha256").write_text(
            "".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n" for f in files)
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
