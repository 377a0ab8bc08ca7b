"""Write folders of cases with concealed physics; the answers apart, hashed.

    python -m tests.concealed.generate --out DIR --number N --seed S [--smoke] [--answers DIR] [--families a,b] [--kind none]
    python -m tests.concealed.generate --out DIR --number N --seed S --list

DIR/NNNN/{plant.yaml,run_1.csv,run_2.csv}; answers in --answers (default DIR/../<name>_answers) as NNNN.yaml with
`manifest.sha256`; `--answers inside` puts answer.yaml into each case instead (a set to develop on). A case is a
function of (seed, number) alone: any part of a set can be made again.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path

import numpy as np
import yaml
from scipy.linalg import qr
from scipy.optimize import least_squares

from tests.concealed import sensors
from tests.concealed.crowded import as_real, crowd
from tests.concealed.judge import BANDS, TELL_APART, Judge, beyond, size_for, snr
from tests.concealed.open_world import jittered, open_world, with_world
from tests.concealed.rig import Scene, Suspect
from tests.concealed.rigs_motion import Flexure, FreeStage
from tests.concealed.rigs_tanks import Tanks
from tests.concealed.rigs_thermal import Actuator, Drive, Heater
from tests.concealed.thermal import Variant

FAMILIES = {f.name: f for f in (Heater(), FreeStage(), Drive(), Flexure(), Tanks(), Actuator())}
SCHEDULES = ("production-like", "designed", "warm-up", "designed")
# physics outside the catalogue must leave this many sigmas after every single catalogue effect, or nobody can tell
STRANGE = 8.0
ONSETS = 24  # times from which an effect that begins once is tried against it
SIZES = 10.0 ** np.arange(-2.0, 1.51, 0.5)
# one period of kinds: 600 cases hold 150 of nothing missing, 360 single effects, 45 unknown, 30 pairs, 15 that cancel
_PERIOD = "one none one one none one one unknown one none one pair one one none one one unknown one none "
_PERIOD += "one one pair one none one one none one none one unknown one one none one cancel one none one"
KINDS = tuple(_PERIOD.split())
CROWDED = "crowded"  # a kind that no set of its own accord holds
ATTEMPTS = 24
STEP = 2e-4  # of a parameter's range, for the derivatives by which a refit is judged
CONVERGED = 1e-3  # of an honest refit: relative change of its sum of squares, and of its unknowns
RESIZED = 3  # times a size is chosen again because a refit from the truth's model leaves another signal than a straight one
ROOM = 20e6  # numbers that the rivals measured at a time may fill: a large rig's signals are hundreds of megabytes
FIXED = (
    "copper_resistance",
    "resistance_temperature",
)  # copper's coefficient: the drive's strength decides how visible


class NotVisible(Exception):
    """No rig of the families shows the asked effect at the asked size."""


@dataclass(frozen=True)
class Slot:
    """What case `number` of a set is to be; effect and band only of a single effect."""

    number: int
    kind: str
    family: str
    schedule: str
    effect: str | None = None
    band: str | None = None


@cache
def holders() -> dict[str, tuple[str, ...]]:
    """Every effect and the families with a place for it, by looking at a few rigs of each."""
    found: dict[str, set[str]] = {}
    for name, family in FAMILIES.items():
        for seed in range(6):
            for s in family.scene(np.random.default_rng(seed), "designed", True).suspects:
                found.setdefault(s.effect, set()).add(name)
    return {e: tuple(f for f in FAMILIES if f in found[e]) for e in sorted(found)}


def plan(
    seed: int, number: int, families: Sequence[str] = tuple(FAMILIES), kind: str | None = None
) -> list[Slot]:
    """The first `number` slots of a set. Each kind goes round the families and schedules by itself; single effects go
    round all pairs of an effect and a size in an order that the seed shuffles, so that no pair is forgotten. `kind` asks
    for one kind instead of the set's turn."""
    effects = (
        {e: [f for f in held if f in families] for e, held in holders().items()}
        if kind in (None, "one")
        else {}
    )
    cells = [(e, b) for e, held in effects.items() if held for b in BANDS]
    order = np.random.default_rng([seed, len(cells)]).permutation(len(cells))
    count: dict[str, int] = {}
    slots = []
    for n in range(number):
        what = kind or KINDS[n % len(KINDS)]
        k = count[what] = count.get(what, -1) + 1
        if what == "one":
            turn, at = divmod(k, len(cells))
            effect, band = cells[order[at]]
            held = effects[effect]
            # another family and schedule for each size of an effect, and in each turn
            shift = turn + list(BANDS).index(band) + seed
            slots.append(
                Slot(n, what, held[shift % len(held)], SCHEDULES[(k + turn) % len(SCHEDULES)], effect, band)
            )
        else:
            family = families[(k + seed) % len(families)]
            slots.append(Slot(n, what, family, SCHEDULES[(k // len(families) + k) % len(SCHEDULES)]))
    return slots


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
                np.stack(
                    [x.spectrum(n) + r**2 / 12 for x, r in zip(self.noise, scene.resolution, strict=True)],
                    axis=1,
                )
            )
        self.judge = Judge(spectra)

    def _variants(self, x: np.ndarray) -> list[Variant]:
        """By run: the truth with its parameters and starts moved by x (np,), in quarters of their ranges and sigmas."""
        scene, n = self.scene, len(self.scene.ranges)
        moved = zip(scene.ranges.items(), x, strict=False)
        theta = {p: scene.theta[p] + v * (high - low) / 4 for (p, (low, high)), v in moved}
        starts = x[n:].reshape(len(scene.runs), -1)
        return [
            Variant(theta, {p: v * s for (p, s), v in zip(scene.starts.items(), row, strict=True)})
            for row in starts
        ]

    def tangents(self, x: np.ndarray, rough: bool = False) -> tuple[list[np.ndarray], np.ndarray]:
        """Readings (N, ny) by run at x (np,), and their whitened derivatives (np, M) by the parameters and by the starts of
        each run; `rough`: derivatives from fewer volumes."""
        n, ns, runs = len(self.scene.ranges), len(self.scene.starts), range(len(self.scene.runs))
        h = np.append(np.full(n, 4 * STEP), np.full(ns, 0.1))
        base, moved = [], []
        for k in runs:
            points = np.tile(x, (1 + n + ns, 1))
            own = np.append(np.arange(n), n + k * ns + np.arange(ns))
            points[1 + np.arange(n + ns), own] += h
            rows = [self._variants(p)[k] for p in points]
            base.append(self.scene.outputs_of(k, rows[:1])[0])
            moved.append(self.scene.changes_of(k, rows, rough) / h[:, None, None])
        whole = [self.judge.whiten([d[:n] for d in moved])]
        for k in runs:  # each run has its own start
            whole.append(
                self.judge.whiten([d[n:] if j == k else np.zeros_like(d[n:]) for j, d in enumerate(moved)])
            )
        return base, np.concatenate(whole)

    def off(self, readings: list[np.ndarray], model: list[np.ndarray]) -> np.ndarray:
        """Whitened difference (M,) of readings from a model's (both (N, ny) by run)."""
        return self.judge.whiten([(y - m)[None] for y, m in zip(readings, model, strict=True)])[0]

    def measure(self, pool: list[Suspect]) -> None:
        """What a straight refit leaves of each of `pool` at SIZES (`curve`: suspect, sizes, rows)."""
        scene = self.scene
        self.base, self.derivatives = self.tangents(
            np.zeros(len(scene.ranges) + len(scene.runs) * len(scene.starts))
        )
        self.judge.set_parameters(self.derivatives)
        sized = [(s, np.array([z for z in SIZES if z <= s.top])) for s in pool]
        rows = [Variant(effects=[(s.effect, s.where, s.make(z))]) for s, sizes in sized for z in sizes]
        d = [
            scene.outputs_of(k, rows) - base if rows else np.zeros((0, *base.shape))
            for k, base in enumerate(self.base)
        ]
        left = self.judge.left_over(self.judge.whiten(d))
        ends = np.cumsum([len(sizes) for _, sizes in sized])
        self.curve = [(s, z, left[end - len(z) : end]) for (s, z), end in zip(sized, ends, strict=True)]

    def refit(self, readings: list[np.ndarray]) -> np.ndarray:
        """What an honest refit leaves of these readings (N, ny by run): least squares over all parameters, inside their
        ranges, and starts, with the truth's own model; whitened, with the ridge behind (M + np,)."""
        scene, free = self.scene, len(self.derivatives)
        walls = np.full((2, free), [[-np.inf], [np.inf]])
        for j, (p, (low, high)) in enumerate(scene.ranges.items()):
            walls[:, j] = (
                (low - scene.theta[p]) * 4 / (high - low),
                (high - scene.theta[p]) * 4 / (high - low),
            )

        left: dict[tuple[float, ...], np.ndarray] = {}

        @lru_cache(maxsize=1)
        def at(x: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
            """Residual and slopes, turned so that all but np + 1 rows are zero: the steps are those of the whole."""
            # a truth takes as long for one variant as for thirty: the slopes come with the readings
            base, slopes = self.tangents(np.array(x), True) if any(x) else (self.base, self.derivatives)
            left[x] = np.append(self.off(readings, base), x)
            whole = np.empty((len(left[x]), free + 1), order="F")
            whole[:-free, :-1], whole[-free:, :-1], whole[:, -1] = -slopes.T, np.eye(free), left[x]
            turned = qr(whole, mode="r", overwrite_a=True, check_finite=False)[0][: free + 1]
            return turned[:, -1], turned[:, :-1]

        found = least_squares(
            lambda x: at(tuple(x))[0],
            np.zeros(free),
            lambda x: at(tuple(x))[1],
            walls,
            ftol=CONVERGED,
            xtol=CONVERGED,
        )
        return np.append(left[tuple(found.x)][:-free], -found.x)

    def beyond_rivals(
        self, signals: list[np.ndarray], onsets: int = 1, beside: Sequence[np.ndarray] = ()
    ) -> list[list[tuple[Suspect, float]]]:
        """For each left-over signal (M,): every suspect of the rig at a place, and what it would leave of the signal.
        More than one of `onsets`: what begins at some time is tried from that many times. `beside`: for each signal, rows
        (k, M) of effects that are fitted as well."""
        beside = beside or [np.zeros((0, len(signals[0])))] * len(signals)
        found: list[list[tuple[Suspect, float]]] = [[] for _ in signals]
        rivals = list(self.scene.suspects)
        if onsets > 1:
            end = max(float(run["t"][-1]) for run in self.scene.runs)
            rivals += [_begun(s, t) for s in rivals if s.onset for t in np.linspace(0, end, onsets + 2)[1:-1]]
        chunk = max(8, int(ROOM / sum(2 * y.size for y in self.base)))
        for begin in range(0, len(rivals), chunk):
            part = rivals[begin : begin + chunk]
            rows = [
                Variant(effects=[(s.effect, s.where, s.make(z * min(1, s.top)))])
                for s in part
                for z in (0.1, 1)
            ]
            d = [self.scene.changes_of(k, [Variant(), *rows], True) for k in range(len(self.scene.runs))]
            left = self.judge.left_over(self.judge.whiten(d))
            for i, s in enumerate(part):
                own = left[2 * i : 2 * i + 2]
                for row, signal, others in zip(found, signals, beside, strict=True):
                    row.append((s, beyond(signal, np.concatenate([own, others]))))
        return found

    def readings(self, effects: list[tuple[str, str, dict]]) -> list[np.ndarray]:
        """Noiseless readings (N, ny) of the truth with these effects, by run."""
        return [self.scene.outputs_of(k, [Variant(effects=effects)])[0] for k in range(len(self.scene.runs))]


def _begun(s: Suspect, at: float) -> Suspect:
    """The same suspect from another time on, for as long."""

    def make(size: float) -> dict:
        p = s.make(size)
        later = at - p["T0"]
        return {k: v + later if k in ("T0", "T1") else v for k, v in p.items()}

    return replace(s, make=make)


def _alike(rivals: list[tuple[Suspect, float]], truth: Suspect) -> list[tuple[str, str]]:
    """Rivals after which too little of the signal is left to tell them from the truth."""
    return [
        (s.effect, s.where)
        for s, stays in rivals
        if (s.effect, s.where) != (truth.effect, truth.where) and stays < TELL_APART
    ]


def make_case(
    seed: int,
    number: int,
    families: Sequence[str] = tuple(FAMILIES),
    short: bool = False,
    kind: str | None = None,
    world: str = "closed",
) -> tuple[dict, list[list[tuple[str, np.ndarray]]], dict]:
    """Case `number` of a set: (plant, columns of each run, answer). world "open" adds misfits that nobody will name."""
    slot = plan(seed, number + 1, families, kind)[number]
    held = [f for f in families if slot.effect is None or f in holders()[slot.effect]]
    at = held.index(slot.family)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, number, attempt])
        late = (
            attempt // 6
        )  # not visible on this rig: another one; where no such rig shows it, another family, schedule
        family, schedule = (
            held[(at + late) % len(held)],
            SCHEDULES[(SCHEDULES.index(slot.schedule) + late) % len(SCHEDULES)],
        )
        vigour = 1.0
        for _ in range(4 if slot.effect in FIXED else 1):
            scene = FAMILIES[family].scene(
                np.random.default_rng([seed, number, attempt, 1]),
                schedule,
                short or slot.kind == CROWDED,
                vigour,
            )
            if slot.kind == CROWDED:
                scene = as_real(scene, rng)
            case, seen = _conceal(scene, slot, np.random.default_rng([seed, number, attempt, 2]))
            if case is not None or not seen:
                break
            # heat times the current itself: the signal goes with the current cubed
            vigour = min(vigour * (np.sqrt(np.prod(BANDS[slot.band or "large"])) / seen) ** (1 / 3), 1.2)
        if case is not None:
            effects, runs, told, bench = case
            break
    else:
        raise NotVisible(
            f"case {number + 1:04d}: {slot.effect or slot.kind} not visible as asked in {ATTEMPTS} draws"
        )
    kind = slot.kind
    opened, named = None, runs
    if world == "open":
        if not effects:
            bench.measure([])
        signal = told["snr"][0] if effects else 0.0
        opened = open_world(
            scene, bench, effects, runs, signal, np.random.default_rng([seed, number, attempt, 3])
        )
    opened = told.get("opened", opened)
    if opened is not None:
        scene, runs = with_world(scene, opened), opened.runs
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
        "snr_learnt": round(told["learnt"], 2) if "learnt" in told else None,
        "onset": told["onset"],
        "also_right": [list(x) for x in told["aliases"]],
        "parameters": [{k: float(f"{v:.7g}") for k, v in published(e, p).items()} for e, _, p in effects],
        "true_parameters": {k: float(f"{v:.6g}") for k, v in scene.theta.items()},
    }
    if opened is not None:
        answer |= {
            "world": "open",
            "verdict": "partly_explained" if effects else "unexplained",
            **opened.told,
        }
        if kind == "unknown":
            answer["verdict"] = "unexplained"
    if kind == "unknown":
        answer["outside_catalogue"] = [e for e, _, _ in effects]
    dirt_kind = rng.choice(["clean", "outliers", "gaps", "slow"], p=[0.55, 0.15, 0.2, 0.1])
    tables, oracle = [], []
    slow = rng.integers(len(scene.outputs)) if dirt_kind == "slow" and len(scene.outputs) > 1 else -1
    for k, run in enumerate(scene.runs):
        columns = [("t", jittered(run["t"], opened.clock_jitter if opened else 0.0, rng))]
        columns += [(c, run[key]) for c, key in scene.columns.items()]
        for j, c in enumerate(scene.outputs):
            dirt = (
                {"outliers": 0.0015}
                if dirt_kind == "outliers"
                else {"gaps": 1}
                if dirt_kind == "gaps"
                else {}
            )
            if j == slow:
                dirt = {"every": 5}
            y = sensors.record(runs[k][:, j], bench.noise[j], scene.sd[j], scene.resolution[j], dirt, rng)
            columns.append((c, y))
            oracle.append((scene.outputs[j], np.sqrt(np.nanmean((y - named[k][:, j]) ** 2))))
        tables.append(columns)
    answer["dirt"] = str(dirt_kind)
    answer["oracle_rms"] = {
        o: float(f"{np.mean([r for n, r in oracle if n == o]):.5g}") for o in scene.outputs
    }
    return scene.plant, tables, answer


def published(effect: str, p: dict) -> dict:
    """An effect's parameters by the names that the catalogue publishes."""
    if (
        effect == "directional_friction"
    ):  # F either way, D and H|v| what differs; the mean damping goes to the damper
        plus, minus = p["FP"], p["FM"]
        return {"F": (plus + minus) / 2, "D": (plus - minus) / 2, "H": (p["BP"] - p["BM"]) / 2}
    names = {"A": "ALPHA"} if effect in FIXED else {"X": "X0"} if effect == "backlash_hysteresis" else {}
    return {names.get(k, k): v for k, v in p.items()}


def _conceal(scene: Scene, slot: Slot, rng: np.random.Generator) -> tuple[tuple | None, float | None]:
    """Choose place and size: (effects, readings by run, what the answer tells, bench), or None when not visible as
    asked; and the signal in sigmas that was seen instead, where a place for the effect was found."""
    if slot.effect and slot.effect not in {s.effect for s in scene.suspects}:
        return None, None
    bench = Bench(scene, rng)
    kind = slot.kind
    told: dict = {"alike": [], "band": None, "snr": [], "onset": None, "aliases": []}
    if kind == CROWDED:
        return crowd(bench, rng, told), None
    if kind == "none":
        return ([], bench.readings([]), told, bench), None
    pool = scene.unknowns if kind == "unknown" else scene.suspects
    names = sorted({s.effect for s in pool})  # every effect alike, whatever its number of places
    picks = [slot.effect] if slot.effect else list(rng.permutation(names))[: 4 if kind == "unknown" else 8]
    chosen = [
        options[rng.integers(len(options))] for options in ([s for s in pool if s.effect == e] for e in picks)
    ]
    bench.measure(chosen)
    if kind in ("pair", "cancel"):
        return _two(bench, kind, rng, told), None
    band = slot.band or "large"
    low, high = BANDS[band]
    top = 4 * high if band == "large" else high
    seen = None
    for curve in bench.curve:
        target = float(np.exp(rng.uniform(np.log(low * 1.1), np.log(high * 0.9))))
        size = size_for(curve, target)
        s = curve[0]
        if size is None:
            seen = float(np.max(snr(curve[2])))
            continue
        for _ in range(RESIZED):
            effects = [(s.effect, s.where, s.make(size))]
            runs = bench.readings(effects)
            if not all(np.isfinite(y).all() for y in runs):  # the rig does not stand the effect at this size
                asked = False
                break
            left = bench.refit(runs)
            seen = float(snr(left))
            asked = low <= seen < top
            size *= float(np.clip(target / max(seen, 1e-3), 0.2, 5.0))
            if asked or not size <= s.top:  # beyond it a refit swallows the effect at any sensible size
                break
        if not asked:
            continue
        rivals = bench.beyond_rivals([left], ONSETS if kind == "unknown" else 1)[0]
        if kind == "unknown" and min(stays for _, stays in rivals) < STRANGE:
            continue
        told |= {
            "band": band,
            "snr": [seen],
            "learnt": bench.judge.learnt(left),
            "alike": _alike(rivals, s),
            "onset": effects[0][2].get(s.onset) if s.onset else None,
            "aliases": [(s.effect, w) for w in s.aliases],
        }
        return (effects, runs, told, bench), seen
    return None, seen


def _two(bench: Bench, kind: str, rng: np.random.Generator, told: dict):
    """Two effects at once: each large, or so that their signals partly cancel while each alone is large."""
    best = None
    for i, first in enumerate(bench.curve):
        for second in bench.curve[i + 1 :]:
            if first[0].onset and second[0].onset:
                continue
            sizes = [size_for(c, rng.uniform(18, 50)) for c in (first, second)]
            if None in sizes:
                continue
            a, b = (
                c[2][int(np.argmin(abs(np.log(c[1] / z))))]
                for c, z in zip((first, second), sizes, strict=True)
            )
            cos = float(a @ b / (snr(a) * snr(b) + 1e-12))
            score = cos if kind == "cancel" else abs(cos)
            if best is None or score < best[0]:
                best = (score, first[0], second[0], sizes)
    if best is None or (kind == "cancel" and best[0] > -0.3):
        return None
    _, one, two, sizes = best
    effects = [(s.effect, s.where, s.make(z)) for s, z in zip((one, two), sizes, strict=True)]
    alone = [bench.refit(bench.readings([e])) for e in effects]
    runs = bench.readings(effects)
    left = bench.refit(runs)
    if not snr(left) >= 6 or not 10 < min(map(snr, alone)) <= max(map(snr, alone)) < 240:
        return None
    if kind == "cancel" and snr(left) ** 2 > 0.75 * sum(snr(a) ** 2 for a in alone):
        return None
    onset = next((e[2][s.onset] for e, s in zip(effects, (one, two), strict=True) if s.onset), None)
    told |= {
        "band": "large",
        "snr": [snr(left), *(snr(a) for a in alone)],
        "learnt": bench.judge.learnt(left),
        "onset": onset,
        "alike": [
            x
            for s, rivals in zip((one, two), bench.beyond_rivals(alone), strict=True)
            for x in _alike(rivals, s)
        ],
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


def coverage(answers: Sequence[dict]) -> dict[str, Counter]:
    """How many of these answers there are of each: `size` (effect, band), `place` (kind, family, schedule), `colour`, `dirt`."""
    return {
        "size": Counter((a["effects"][0][0], a["band"]) for a in answers if a["kind"] == "one"),
        "place": Counter((a["kind"], a["family"], a["schedule"]) for a in answers),
        "colour": Counter(a["colour"] for a in answers),
        "dirt": Counter(a["dirt"] for a in answers),
    }


def listing(slots: Sequence[Slot], answers: Sequence[dict]) -> str:
    """The coverage of a set as text: what is planned, and what has been made so far, as planned/made."""
    made = coverage(answers)
    size = Counter((s.effect, s.band) for s in slots if s.kind == "one")
    place = Counter((s.kind, s.family, s.schedule) for s in slots)
    kinds, families, schedules = (sorted({p[i] for p in place | made["place"]}) for i in range(3))
    lines = [
        f"{len(slots)} cases planned, {len(answers)} made (planned/made)",
        "",
        f"{'effect':36s}" + "".join(f"{b:>9s}" for b in BANDS),
    ]
    for e, held in holders().items():
        cells = "".join(f"{size[e, b]:>6d}/{made['size'][e, b]:<2d}" for b in BANDS)
        lines.append(f"{e:36s}{cells}  {', '.join(held)}")
    lines += ["", f"{'family, schedule':36s}" + "".join(f"{k:>9s}" for k in kinds)]
    for f in families:
        for s in schedules:
            lines.append(
                f"{f + ', ' + s:36s}"
                + "".join(f"{place[k, f, s]:>6d}/{made['place'][k, f, s]:<2d}" for k in kinds)
            )
    total = [
        sum(x[k, f, s] for f in families for s in schedules) for k in kinds for x in (place, made["place"])
    ]
    lines.append(
        f"{'all':36s}" + "".join(f"{a:>6d}/{b:<2d}" for a, b in zip(total[::2], total[1::2], strict=True))
    )
    for what in ("colour", "dirt"):
        lines.append(f"{what} made: " + ", ".join(f"{k} {n}" for k, n in sorted(made[what].items())))
    return "\n".join(lines)


def _write_one(a: argparse.Namespace, answers: Path | None, number: int) -> str:
    """Make case `number` of the set that the arguments name, unless it is there; return a line about it."""
    name = f"{number + 1:04d}"
    target = a.out / name / "answer.yaml" if answers is None else answers / f"{name}.yaml"
    if target.exists():
        return ""
    world = ("closed", "open")[number % 2] if a.world == "both" else a.world
    try:
        plant, tables, answer = make_case(a.seed, number, a.families.split(","), a.smoke, a.kind, world)
    except NotVisible as e:
        return f"{e}; the set has a gap there"
    write_case(a.out / name, plant, tables)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(yaml.safe_dump(_plain(answer), sort_keys=False))
    return (
        f"{name} {answer['family']:9s} {answer['schedule']:15s} {answer['kind']:7s} {answer['band'] or '':6s} "
        f"{answer['snr']} {answer['effects']} ~ {answer['nearly_the_same']}"
    )


def main(argv: list[str] | None = None) -> int:
    """The command."""
    p = argparse.ArgumentParser(prog="tests.concealed.generate", description=__doc__)
    p.add_argument("--out", required=True, type=Path)
    p.add_argument(
        "--list", action="store_true", help="count what the set covers, planned and made so far; make nothing"
    )
    p.add_argument("--number", type=int, default=600)
    p.add_argument("--first", type=int, default=0, help="number of the first case (to make a part of a set)")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--smoke", action="store_true", help="short records")
    p.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    p.add_argument("--answers", default=None, help="folder for the sealed answers, or 'inside'")
    p.add_argument("--families", default=",".join(FAMILIES))
    p.add_argument(
        "--world",
        choices=["closed", "open", "both"],
        default="closed",
        help="open: with small misfits that nobody will name; both: every second case",
    )
    p.add_argument("--kind", choices=sorted({*KINDS, CROWDED}), help="only cases of this kind")
    a = p.parse_args(argv)
    inside = a.answers == "inside"
    answers = a.out.parent / f"{a.out.name}_answers" if a.answers is None else Path(a.answers)
    if a.list:
        files = sorted(a.out.glob("*/answer.yaml") if inside else answers.glob("[0-9]*.yaml"))
        slots = plan(a.seed, a.first + a.number, a.families.split(","), a.kind)[a.first :]
        print(listing(slots, [yaml.safe_load(f.read_text()) for f in files]))
        return 0
    a.out.mkdir(parents=True, exist_ok=True)
    numbers = range(a.first, a.first + a.number)
    one = partial(_write_one, a, None if inside else answers)
    apart = map if a.number == 1 else ProcessPoolExecutor(min(a.workers, a.number)).map
    for line in apart(one, numbers):
        if line:
            print(line, file=sys.stderr, flush=True)
    if not inside:
        files = sorted(answers.glob("[0-9]*.yaml"))
        (answers / "manifest.sha256").write_text(
            "".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n" for f in files)
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
