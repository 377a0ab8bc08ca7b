"""Two or three large effects and a misfit that nobody will name beside them: what a real rig lacks.

The ranges are those of the 24 diagnoses of real rigs in tests/proof/rigs.py, decided from their searches at e1915c0d:

- errors that stay: rms 1.1 to 23 times the noise of all but two sensors, of half of them 2.0 to 6.7 times (median 4.2)
- where half of their power lies: in the first 2 to 50 DCT bins of a thermal record, in some hundreds where axes move
- what a right effect removes: 1.0, 1.4, 2.4, 4.1 and 7.1 times the rms of the misfit that stays (10, 25, 50, 75, 90 %)
- one recording: in 17 of 24
- events, effects that depend on the time itself: 1 of 34
- rows: 121 to 24 840, median 1430. Records are the short ones of the families

The misfits are those of the open world that have no name in the catalogue, and the families' physics outside it, small.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.concealed.judge import BANDS, TELL_APART, apart, size_for, snr
from tests.concealed.open_world import STEPS, TOP, Misfit, World, misfits_of, readings
from tests.concealed.rig import Scene, Suspect

ERROR = (1.0, 5.0)  # rms of the errors that stay beside the effects, over the noise, at the worst output
RATIO = (1.0, 7.0)  # of an effect's own signal to those errors
LARGE = BANDS["large"][0]  # sigmas that each effect leaves at least after a refit of all others
QUIET = 4.0  # sensors are that much better than the families', or most effects never stand out of a misfit
NEAR = 1.3  # times the asked errors, up or down
ONE_RUN = 0.7  # share of cases with one recording
CLOSE = 0.5  # of the misfit's signal; rivals that leave no more of an effect's cannot be told from it
NAMED = ("contacts", "stem", "slow reference")  # misfits that are entries of the catalogue


def as_real(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with better sensors and, mostly, one recording."""
    outputs = {
        o: {**x, **{k: float(f"{x[k] / QUIET:.6g}") for k in ("noise", "resolution") if x.get(k)}}
        for o, x in scene.plant["outputs"].items()
    }
    runs = scene.runs[:1] if rng.random() < ONE_RUN else scene.runs
    plant = {**scene.plant, "outputs": outputs}
    return replace(
        scene, plant=plant, runs=runs, sd=scene.sd / QUIET, resolution=np.asarray(scene.resolution) / QUIET
    )


def crowd(bench, rng: np.random.Generator, told: dict) -> tuple | None:
    """Effects, readings with them by run, what the answer tells (`opened`: the world with the misfits, too) and the bench
    of a scene (generate.Bench); None where a drawn effect or misfit is not as large as asked, or not to be told apart."""
    scene, chosen = bench.scene, _effects(bench.scene, rng)
    bench.measure(chosen)
    misfits, error = _misfits(scene, rng), float(np.exp(rng.uniform(*np.log(ERROR))))
    found = _sizes(bench, misfits, error, rng)
    if found is None:
        return None
    size, sizes = found
    effects = [(s.effect, s.where, s.make(z)) for s, z in zip(chosen, sizes, strict=True)]
    runs, world = bench.readings(effects), readings(scene, effects, misfits, size)
    if not all(np.isfinite(y).all() for y in (*runs, *world)):
        return None
    shapes = [_shape(bench, s, z) for s, z in zip(chosen, sizes, strict=True)]
    total, stays = bench.refit(runs), apart(_left(bench, world, runs), np.concatenate(shapes))
    seen = _told_apart(bench, chosen, shapes, total, stays)
    errors = float(bench.judge.errors(stays).max())
    if seen is None or not ERROR[0] / NEAR < errors < ERROR[1] * NEAR:
        return None
    own, each = seen
    answer = {
        "world": "crowded",
        "each": each,
        "misfits": [[m.kind, m.where] for m in misfits],
        "misfit_size": float(f"{size:.4g}"),
        "misfit_snr": round(float(snr(stays)), 1),
        "misfit_over_noise": round(errors, 2),
        "own_snr": [round(x, 1) for x in own],
    }
    told |= {
        "band": "large",
        "snr": [float(snr(total)), *own],
        "opened": World(world, scene.plant, 0.0, scene.resolution, answer),
        "onset": next((e[2][s.onset] for e, s in zip(effects, chosen, strict=True) if s.onset), None),
    }
    return effects, runs, told, bench


def _sizes(bench, misfits: list[Misfit], error: float, rng: np.random.Generator) -> tuple[float, list] | None:
    """The misfits' common size, with which their errors beside the effects are `error` times the noise at the worst output,
    and the effects' sizes, each RATIO above those errors beside the others; None where one cannot be that large."""
    if not all(np.isfinite(left).all() for *_, left in bench.curve):
        return None
    shapes = [left[[len(z) // 2, -1]] for _, z, left in bench.curve]
    size, stays = _sized(bench, misfits, np.concatenate(shapes), error)
    if not 1 / NEAR < bench.judge.errors(stays).max() / error < NEAR:
        return None
    sizes = []
    for i, (s, z, left) in enumerate(bench.curve):
        own = np.array([apart(row, _but(shapes, i)) for row in left])
        target = max(LARGE, float(snr(stays))) * float(np.exp(rng.uniform(*np.log(RATIO))))
        sizes.append(size_for((s, z, own), target))
    return (size, sizes) if all(sizes) else None


def _told_apart(
    bench, chosen: list[Suspect], shapes: list[np.ndarray], total: np.ndarray, stays: np.ndarray
) -> tuple[list[float], list] | None:
    """Of the effects' whole signal `total` and the misfits' `stays` (M + np,), by effect: sigmas without the other effects'
    part, and the names that cannot be told from it beside them. None where one is lost in the misfit or imitates all."""
    least, bent = max(LARGE, float(snr(stays))), float(snr(apart(total, np.concatenate(shapes))))
    others = [_but(shapes, i) for i in range(len(chosen))]
    own = [float(snr(apart(total, rows))) for rows in others]
    if bent > least or min(own) < least:
        return None
    alone, *beside = bench.beyond_rivals([total] * (len(chosen) + 1), beside=[total[None][:0], *others])
    if min(left for _, left in alone) < least:
        return None
    limit = float(np.hypot(bent, max(TELL_APART, CLOSE * snr(stays))))
    each = []
    for s, rivals in zip(chosen, beside, strict=True):
        alike = {(r.effect, r.where) for r, left in rivals if left < limit}
        each.append([list(x) for x in sorted(alike | {(s.effect, w) for w in (s.where, *s.aliases)})])
    return (own, each) if len({tuple(x) for x in sum(each, [])}) == sum(map(len, each)) else None


def _effects(scene: Scene, rng: np.random.Generator) -> list[Suspect]:
    """Two or three different effects, every effect alike, at most one of them an event."""
    found: list[Suspect] = []
    count = rng.integers(2, 4)
    for name in rng.permutation(sorted({s.effect for s in scene.suspects})):
        options = [s for s in scene.suspects if s.effect == name]
        s = options[rng.integers(len(options))]
        if len(found) < count and not (s.onset and any(x.onset for x in found)):
            found.append(s)
    return found


def _misfits(scene: Scene, rng: np.random.Generator) -> list[Misfit]:
    """One or two kinds of physics outside the catalogue."""
    every = [m for m in misfits_of(scene, rng) if m.kind not in NAMED]
    every += [
        Misfit(s.effect, s.where, effects=lambda size, s=s: [(s.effect, s.where, s.make(size))])
        for s in scene.unknowns
    ]
    kinds = rng.permutation(sorted({m.kind for m in every}))[: rng.integers(1, 3)]
    options = [[m for m in every if m.kind == kind] for kind in kinds]
    return [of[rng.integers(len(of))] for of in options]


def _sized(bench, misfits: list[Misfit], rows: np.ndarray, error: float) -> tuple[float, np.ndarray]:
    """The misfits' size, and the signal (M + np,) that stays of them beside the effects' `rows` (k, M + np).

    At this size their errors are nearest to `error` times the noise at the worst output."""
    size = then = 1.0
    for _ in range(STEPS):
        size = then
        world = readings(bench.scene, [], misfits, size)
        if not all(np.isfinite(y).all() for y in world):
            return size, np.zeros_like(rows[0])
        stays = apart(_left(bench, world, bench.base), rows)
        worst = float(bench.judge.errors(stays).max())
        if 1 / NEAR < worst / error < NEAR:
            break
        then = min(size * min(error / max(worst, 1e-6), 10.0), TOP)
    return size, stays


def _left(bench, one: list[np.ndarray], other: list[np.ndarray]) -> np.ndarray:
    """What a straight refit leaves (M + np,) of the difference of two readings (both (N, ny) by run)."""
    return bench.judge.left_over(bench.off(one, other)[None])[0]


def _shape(bench, s: Suspect, size: float) -> np.ndarray:
    """What a straight refit leaves of an effect alone, at half its size and all of it (2, M + np)."""
    return np.array(
        [_left(bench, bench.readings([(s.effect, s.where, s.make(z))]), bench.base) for z in (size / 2, size)]
    )


def _but(shapes: list[np.ndarray], i: int) -> np.ndarray:
    """The rows of all shapes but one."""
    return np.concatenate([x for j, x in enumerate(shapes) if j != i])
