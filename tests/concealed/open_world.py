"""Small misfits that nobody will name: what every real rig has beside the effect that is concealed in it.

The closed world is the plant, the concealed effect and sensor noise. In the open world one to three misfits are added to
the truth or to its sensors; labels name the effect only. Together they leave SHARE of the effect's own signal after an
honest linear refit (where nothing is concealed: ALONE sigmas), in the judge's metric.

    conversion     a recorded input is off by some per cent, differently over its range
    air            the air at the rig is not the air at its thermometer: first-order noise of the room's pace
    contacts       every conductance depends a little on temperature
    finite bodies  bodies conduct badly inside: their surfaces lead their means
    stem           a thermometer's stem conducts: its reading is pulled towards the air
    hysteresis     a sensor's reading lags its own reversals by a small play
    slow reference a sensor answers with a short first-order lag
    bend           a sensor's scale is bent over its range

Three more come by chance: a stated noise that is wrong by up to two, a converter whose steps the plant file does not
state, and a clock that jitters. An axis integrates its input over wrong times, so the clock's error is kept below the
largest share, too.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from tests.concealed import sensors
from tests.concealed.judge import snr
from tests.concealed.rig import Scene
from tests.concealed.thermal import Variant

SHARE = (0.03, 0.5)  # of the effect's signal; ../shared/design/one_evidence.md, the proof in an open world
ALONE = (1.5, 15.0)  # sigmas left by the misfits where nothing is concealed
JITTER = 0.02  # of a sampling period
TOP = 8.0  # times its typical size that a misfit may have; beyond, it would be the rig's main physics
STEPS = 8  # times the common size is chosen again, since misfits are not linear in it
DRIVES = ("drive", "pump", "current")  # a rig's driving input where its heat is not given ready-made


@dataclass(frozen=True)
class Misfit:
    """One misfit: its kind, where it sits, and what it changes at `size` (1: typical)."""

    kind: str
    where: str
    run: Callable[[dict, float], dict] | None = None  # entries of a run that differ in the truth
    effects: Callable[[float], list[tuple[str, str, dict]]] | None = None
    reading: Callable[[dict, np.ndarray, float], np.ndarray] | None = None  # an output's reading (N,)


def misfits_of(scene: Scene, rng: np.random.Generator) -> list[Misfit]:
    """Every misfit that this rig can have."""
    return _of_inputs(scene, rng) + _of_bodies(scene, rng) + _of_sensors(scene, rng)


def _of_inputs(scene: Scene, rng: np.random.Generator) -> list[Misfit]:
    run = scene.runs[0]
    heats = [k for k in run if k.startswith("heat:")]
    keys = [k for k in DRIVES if k in run] + ([heats[rng.integers(len(heats))]] if heats else [])
    sign = rng.choice([-1, 1])

    def converted(run: dict, size: float) -> dict:
        x = np.abs(np.asarray(run[keys[0]], float))
        factor = 1 + sign * 0.03 * size * (x / max(x.max(), 1e-12) - 0.5)
        return {k: run[k] * factor for k in keys}

    found = [Misfit("conversion", keys[0], run=converted)]
    if "air" in scene.columns.values():
        seed = int(rng.integers(2**31))

        def wandering(run: dict, size: float) -> dict:
            t, draw = run["t"], np.random.default_rng(seed)
            rho = np.exp(-np.diff(t, prepend=t[0]) * 6 / t[-1])
            kicks = draw.standard_normal(len(t)) * np.sqrt(1 - rho**2)
            noise = np.zeros(len(t))
            for k in range(1, len(t)):
                noise[k] = rho[k] * noise[k - 1] + kicks[k]
            return {"air": run["air"] + 0.15 * size * noise}

        found.append(Misfit("air", "air", run=wandering))
    return found


def _of_bodies(scene: Scene, rng: np.random.Generator) -> list[Misfit]:
    flows = scene.plant["flows"]
    if "air" not in scene.columns.values() or "motor" in flows:  # only networks of bodies have contacts
        return []
    links = [f for f, x in flows.items() if "from" in x]
    slopes = rng.uniform(-0.0015, 0.0015, len(links))
    depend = Misfit(
        "contacts",
        "all",
        effects=lambda size: [
            ("temperature_dependent_conductance", f, {"A": a * size})
            for f, a in zip(links, slopes, strict=True)
        ],
    )
    finite = Misfit("finite bodies", "all", run=lambda run, size: {"stiffness": 150.0 / (1 + 6 * size)})
    return [depend, finite]


def _of_sensors(scene: Scene, rng: np.random.Generator) -> list[Misfit]:
    j = int(rng.integers(len(scene.outputs)))
    name, thermal = scene.outputs[j], scene.plant["outputs"][scene.outputs[j]].get("unit") == "degC"
    sign = rng.choice([-1, 1])
    found = [
        Misfit("hysteresis", name, reading=lambda run, y, size: _play(y, 0.004 * size * np.ptp(y))),
        Misfit(
            "slow reference",
            name,
            reading=lambda run, y, size: sensors.lag(run["t"], y, 1.5 * size * np.median(np.diff(run["t"]))),
        ),
        Misfit(
            "bend",
            name,
            reading=lambda run, y, size: y + sign * 0.01 * size * (y - y.mean()) ** 2 / max(np.ptp(y), 1e-12),
        ),
    ]
    if thermal and "air" in scene.columns.values():
        found.append(Misfit("stem", name, reading=lambda run, y, size: y - 0.01 * size * (y - run["air"])))
    return found


def _play(y: np.ndarray, width: float) -> np.ndarray:
    """Output (N,) of a play operator of this width: it follows y only at the ends of its slack."""
    out = np.empty_like(y)
    at = y[0]
    for k, v in enumerate(y):
        at = min(max(at, v - width / 2), v + width / 2)
        out[k] = at
    return out


@contextmanager
def _truth(scene: Scene, misfits: list[Misfit], size: float):
    """The scene's runs as they are in truth; what was recorded comes back afterwards."""
    kept = [dict(run) for run in scene.runs]
    for run in scene.runs:
        for m in misfits:
            if m.run is not None:
                run |= m.run(run, size)
    try:
        yield
    finally:
        for run, old in zip(scene.runs, kept, strict=True):
            run.clear()
            run |= old


def readings(
    scene: Scene, effects: list[tuple[str, str, dict]], misfits: list[Misfit], size: float
) -> list[np.ndarray]:
    """Noiseless readings (N, ny) by run of the truth with the effects and the misfits at this size."""
    row = Variant(effects=effects + [e for m in misfits if m.effects for e in m.effects(size)])
    with _truth(scene, misfits, size):
        out = [scene.outputs_of(k, [row])[0].copy() for k in range(len(scene.runs))]
    for m in misfits:
        if m.reading is not None:
            j = scene.outputs.index(m.where)
            for run, y in zip(scene.runs, out, strict=True):
                y[:, j] = m.reading(run, y[:, j], size)
    return out


@dataclass(frozen=True)
class World:
    """An open world: readings (N, ny) by run, the plant file as stated, and what the answer says of the misfits."""

    runs: list[np.ndarray]
    plant: dict
    clock_jitter: float
    steps: np.ndarray
    told: dict


def open_world(
    scene: Scene, bench, effects: list[tuple[str, str, dict]], runs: list[np.ndarray], signal: float, rng
) -> World:
    """Add one to three misfits to a concealed case. `bench` a measured generate.Bench, `runs` its readings (N, ny) with
    the effects, `signal` what the effects leave after a refit, in sigmas (0: nothing is concealed)."""
    every = misfits_of(scene, rng)
    chosen = [every[i] for i in rng.permutation(len(every))[: rng.integers(1, 4)]]
    low, high = SHARE if signal else ALONE
    target = float(np.exp(rng.uniform(np.log(low), np.log(high)))) * (signal or 1.0)
    size = then = 1.0
    for _ in range(STEPS):
        size = then
        world = readings(scene, effects, chosen, size)
        delta = [(a - b)[None] for a, b in zip(world, runs, strict=True)]
        left = float(snr(bench.judge.left_over(bench.judge.whiten(delta)))[0])
        if 0.8 < left / target < 1.25 or (left < target and size >= TOP):
            break
        then = min(size * min(target / max(left, 1e-6), 10.0), TOP)
    factor = {o: float(np.exp(rng.uniform(-np.log(2), np.log(2)))) for o in scene.outputs}
    wrong_noise = bool(rng.random() < 0.3)
    plant = scene.plant
    if wrong_noise:
        outputs = {
            o: {**x, "noise": float(f"{x['noise'] * factor[o]:.3g}")} for o, x in plant["outputs"].items()
        }
        plant = {**plant, "outputs": outputs}
    jitter = float(rng.random() < 0.2) * JITTER
    late = _late(scene, bench, jitter, rng) if jitter else 0.0
    most = high * (signal or 1.0)
    jitter *= min(1.0, most / max(late, 1e-6))
    coarse = np.where(rng.random(len(scene.outputs)) < 0.2, 1.5 * scene.sd, 0.0)
    told = {
        "misfits": [[m.kind, m.where] for m in chosen],
        "misfit_size": float(f"{size:.4g}"),
        "misfit_snr": round(left, 2),
        "wrong_noise": {o: round(f, 2) for o, f in factor.items()} if wrong_noise else {},
        "clock_jitter": float(f"{jitter:.4g}"),
        "clock_snr": round(min(late, most), 2),
        "hidden_steps": {o: float(f"{s:.4g}") for o, s in zip(scene.outputs, coarse, strict=True) if s},
    }
    return World(world, plant, jitter, np.maximum(coarse, scene.resolution), told)


def _late(scene: Scene, bench, share: float, rng: np.random.Generator) -> float:
    """Sigmas of the readings' error that a refit leaves where the truth runs on the recorded times."""
    plain, kept = bench.readings([]), [run["t"] for run in scene.runs]
    try:
        for run in scene.runs:
            run["t"] = jittered(run["t"], share, rng)
        moved = bench.readings([])
    finally:
        for run, t in zip(scene.runs, kept, strict=True):
            run["t"] = t
    delta = [(a - b)[None] for a, b in zip(moved, plain, strict=True)]
    return float(snr(bench.judge.left_over(bench.judge.whiten(delta)))[0])


def jittered(t: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Recorded times (N,) of a clock that is off by `share` of a period at random; still increasing."""
    if not share:
        return t
    step = np.diff(t).min()
    return np.round(t + np.clip(rng.standard_normal(len(t)) * share, -0.4, 0.4) * step, 6)


def with_world(scene: Scene, world: World) -> Scene:
    """The scene as its plant file states it, with the converter steps that its recordings have."""
    return replace(scene, plant=world.plant, resolution=world.steps)
