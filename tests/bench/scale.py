"""Cost of a diagnosis against the size of the data: rows of a recording, bodies of a plant.

python -m tests.bench.scale rows [--rows 260000]
python -m tests.bench.scale bodies [--bodies 12 30 60 120] [--shape chain network]
python -m tests.bench.scale recordings [--recordings 1 6 12] [--workers 1 2]
python -m tests.bench.scale weak [--weak 1 4 10 24]

`rows`: a rig of two blocks whose free convection is concealed, logged every second, and the same record with
one row in a hundred. Every diagnosis is a process of its own: CPU time (with the compiler's), memory, result.
--before FOLDER, with each of them: a checkout of an older version; it works on the same records, right after, with a limit of 30 minutes.
`bodies`: blocks of which every third one is measured and every sixth one heated. In a chain a middle one, not heated,
has a heat source that the plant lacks. In a network, whose blocks are linked with near ones as in a CAD model, a link is missing.
`recordings`: the actuator of twelve bodies, 30 000 rows a recording, with a missing link of two standard deviations in
one of them, on one core and on two.
`weak`: four blocks, with a missing link of two standard deviations in one recording of 1 200 rows.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.plants import TWO_BLOCKS
from thermoctl.plant import load
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

BODY = """
import json, resource, sys
try:
    from thermoctl.diagnosis.run import diagnose_files
except ModuleNotFoundError:  # the folders of a372a6a and older
    from thermoctl.diagnose.run import diagnose_files
found = diagnose_files(sys.argv[1], sys.argv[3:], sys.argv[2])
used = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
print(json.dumps({"verdict": found["verdict"], "found": [f"{f['effect']} at {f['where']}" for f in found["findings"]],
    "probability": [round(f["probability"], 3) for f in found["findings"]],
    "cpu_s": sum(u.ru_utime + u.ru_stime for u in used), "MiB": used[0].ru_maxrss / 1024, "notes": found["notes"]}))
"""
LIMIT_S = 1800
SIGMAS = 2.0  # of `weak` and `recordings`: size of the effect in one recording, in standard deviations
CONVERTER = (
    0.01  # K, of `recordings`: in steps of 0.25 K a reading that hardly moves has errors that last for hours
)
THINNED = 100  # rows of the long record for one of the short


Links = list[tuple[int, int]]


def chain(n: int) -> Links:
    """Return the links of a chain of n blocks."""
    return [(k, k + 1) for k in range(1, n)]


def network(n: int) -> tuple[Links, tuple[int, int]]:
    """Return links of n blocks, each with its nearest three, and the one that the plant lacks.

    That is the closest pair without a link, one of them heated."""
    at = np.random.default_rng(8).uniform(0, 1, (n, 3))
    far = np.linalg.norm(at[:, None] - at, axis=2)
    near = {(min(a, b), max(a, b)) for a in range(n) for b in np.argsort(far[a])[1:4]}
    reached = {0}
    while len(reached) < n:  # one piece: the closest pair of a reached and another block
        a, b = min(
            ((a, b) for a in reached for b in set(range(n)) - reached),
            key=lambda p: (p not in near and p[::-1] not in near, far[p]),
        )
        near.add((min(a, b), max(a, b)))
        reached.add(b)
    pairs = [
        (a, b) for a in range(0, n, 6) for b in range(n) if a != b and (min(a, b), max(a, b)) not in near
    ]
    a, b = min(pairs, key=lambda p: far[p])
    return [(int(a) + 1, int(b) + 1) for a, b in sorted(near)], (a + 1, b + 1)


def block_plant(n: int, links: Links | None = None) -> str:
    """A plant of n blocks in air, a chain unless links are given; every third one has a sensor, every sixth a heater."""
    at = range(1, n + 1)
    held, heated = [k for k in at if k % 3 == 1], [k for k in at if k % 6 == 1]
    lines = ["format: thermoctl-plant/1", f"title: {n} blocks", "inputs:"]
    lines += [f"  heat_{k}: {{unit: W}}" for k in heated]
    lines += ["  air: {unit: degC, between_samples: linear}", "parameters:"]
    lines += [
        f"  {name}: {{value: {value}, unit: {unit}, range: [{low}, {high}]}}"
        for name, value, unit, low, high in (
            ("C", 60.0, "J/K", 20, 180),
            ("G", 0.05, "W/K", 0.015, 0.15),
            ("G_between", 0.5, "W/K", 0.1, 2.0),
        )
    ]
    lines += ["nodes:"]
    lines += [f"  block_{k}: {{unit: degC, storage: C, initial: air, initial_sigma: 0.5}}" for k in at]
    lines += ["flows:"]
    lines += [f"  power_{k}: {{into: block_{k}, rate: heat_{k}, unit: W}}" for k in heated]
    lines += [f"  loss_{k}: {{from: block_{k}, rate: G * (block_{k} - air), unit: W}}" for k in at]
    lines += [
        f"  link_{a}_{b}: {{from: block_{a}, into: block_{b}, rate: G_between * (block_{a} - block_{b}), unit: W}}"
        for a, b in links or chain(n)
    ]
    lines += ["outputs:"]
    lines += [f"  temperature_{k}: {{value: block_{k}, unit: degC, noise: 0.05}}" for k in held]
    return "\n".join(lines) + "\n"


def recorded(
    folder: Path,
    plant_text: str,
    flow: str,
    rows: int,
    interval: float,
    power: float,
    grid: int = 1,
    seed: int = 0,
) -> None:
    """Write plant.yaml and run_1.csv, recorded on the plant with one flow more.

    Heaters change at random rows, at every `grid`-th one at most: a record thinned by `grid` keeps their times."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plant.yaml").write_text(plant_text)
    (folder / "truth.yaml").write_text(plant_text.replace("flows:\n", f"flows:\n  concealed: {flow}\n"))
    plant = load(folder / "truth.yaml")
    t, rng = np.arange(rows) * interval, np.random.default_rng(5 + seed)
    columns: dict[str, np.ndarray] = {}
    for i in plant.inputs.values():
        if i.name == "air":
            columns[i.column] = 20 + 0.5 * np.sin(2 * np.pi * t / 86_400)
        else:
            ends = np.sort(rng.integers(0, rows // grid, 60)) * grid * interval
            columns[i.column] = np.round(rng.uniform(0, power, 61), 2)[np.searchsorted(ends, t, side="right")]
    table = compile_plant(plant).measure(Table("run_1", "run_1", t, columns), seed=7 + seed)
    write(folder / "run_1.csv", table)


def write(path: Path, table: Table) -> None:
    """Write a table as text."""
    names = list(table.columns)
    values = np.column_stack([table.t, *(table.columns[n] for n in names)])
    np.savetxt(path, values, fmt="%.7g", delimiter=",", header=",".join(["time", *names]), comments="")


def diagnosed(
    folder: Path, names: Sequence[str], checkout: Path | None = None, workers: int = 0
) -> dict[str, object]:
    """Diagnose recordings in a process of its own, on `workers` cores (0: all); return its figures."""
    with tempfile.TemporaryDirectory() as work:
        env = dict(os.environ, OPENBLAS_NUM_THREADS="1", THERMOCTL_CACHE=f"{work}/plants")
        if checkout:
            env["PYTHONPATH"] = str(checkout)
        files = [str(folder / name) for name in names]
        command = [sys.executable, "-c", BODY, str(folder / "plant.yaml"), f"{work}/out", *files]
        cores = sorted(os.sched_getaffinity(0))[: workers or None]
        command = ["taskset", "-c", ",".join(map(str, cores)), *command]
        started = time.monotonic()
        try:
            done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=LIMIT_S, cwd=work)
        except subprocess.TimeoutExpired:
            return {
                "verdict": f"none within {LIMIT_S} s",
                "cpu_s": float("nan"),
                "MiB": float("nan"),
                "wall_s": LIMIT_S,
            }
        if done.returncode:
            return {
                "verdict": done.stderr.strip().splitlines()[-1][:100],
                "cpu_s": float("nan"),
                "MiB": float("nan"),
            }
    return {**json.loads(done.stdout.splitlines()[-1]), "wall_s": time.monotonic() - started}


def line(label: str, found: dict[str, object]) -> None:
    """Print one result."""
    print(
        f"{label:28} CPU {found['cpu_s']:7.1f} s  {found['MiB']:6.0f} MiB  {found['verdict']} {found.get('found', '')} "
        f"{found.get('probability', '')}",
        flush=True,
    )
    for note in found.get("notes", ()):  # type: ignore[attr-defined]
        if "rows were needed" in note:
            print(f"{'':28} {note}")


def compared(
    label: str, folder: Path, names: Sequence[str], before: Path | None, workers: int = 0
) -> dict[str, object]:
    """Print and return the result of a diagnosis, and print that of an older version beside it."""
    found = diagnosed(folder, names, workers=workers)
    line(label, found)
    if before:
        old = diagnosed(folder, names, before, workers)
        line(f"{label}, before", old)
        print(f"{'':28} before / now: {old['cpu_s'] / found['cpu_s']:.2f}", flush=True)  # type: ignore[operator]
    return found


def rows(number: int, before: Path | None) -> None:
    """Print cost and result of a long record and of its thinned equivalent."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        recorded(
            folder,
            TWO_BLOCKS,
            '{from: one, rate: "0.006 * max(one - air, 0)**1.25", unit: W}',
            number,
            1.0,
            2.0,
            THINNED,
        )
        names = (folder / "run_1.csv").read_text().splitlines()
        (folder / "few.csv").write_text("\n".join([names[0], *names[1::THINNED]]) + "\n")
        few = compared(f"{number // THINNED} rows", folder, ["few.csv"], before)
        many = compared(f"{number} rows", folder, ["run_1.csv"], before)
        print(f"{number} rows / {number // THINNED} rows: {many['cpu_s'] / few['cpu_s']:.2f} times the time")  # type: ignore[operator]


def concealed(shape: str, n: int) -> tuple[str, str, str]:
    """Return a plant of n bodies, the flow that it lacks, and the finding that names it."""
    if shape == "chain":
        middle = n // 12 * 6 + 4
        flow = f"{{into: block_{middle}, rate: 1.5 * step(t - 4000), unit: W}}"
        return block_plant(n), flow, f"external_heat_source at block_{middle}"
    links, (a, b) = network(n)
    flow = f"{{from: block_{a}, into: block_{b}, rate: 0.3 * (block_{a} - block_{b}), unit: W}}"
    first, second = sorted((a, b))
    return block_plant(n, links), flow, f"missing_link at block_{first}-block_{second}"


def bodies(numbers: list[int], shapes: list[str], before: Path | None) -> None:
    """Print time and memory of a diagnosis against the number of bodies, and the exponent between neighbours."""
    for shape in shapes:
        last: tuple[int, float] | None = None
        for n in numbers:
            plant, flow, truth = concealed(shape, n)
            with tempfile.TemporaryDirectory() as work:
                recorded(Path(work), plant, flow, 1200, 10.0, 10.0)
                found = compared(f"{shape} of {n} bodies", Path(work), ["run_1.csv"], before)
            cpu = float(found["cpu_s"])  # type: ignore[arg-type]
            exponent = (
                f", exponent from {last[0]}: {np.log(cpu / last[1]) / np.log(n / last[0]):.2f}"
                if last
                else ""
            )
            named = truth in found.get("found", ())  # type: ignore[operator]
            print(f"{'':28} {truth}: {'named' if named else 'not named'}{exponent}", flush=True)
            last = n, cpu


def recordings(numbers: list[int], workers: list[int], before: Path | None) -> None:
    """Print time, memory and result against the number of recordings of a 12-body actuator, and of workers."""
    source = (Path(__file__).parents[2] / "config/plants/actuator_thermal.yaml").read_text()
    source = source.replace("resolution: 0.25", f"resolution: {CONVERTER}")
    name, t = "missing_link at outer_stator-bracket_1", np.arange(30_000.0)
    with tempfile.TemporaryDirectory() as work:
        folder, size = Path(work), 0.0
        (folder / "plant.yaml").write_text(source)
        for k in range(max(numbers) + 1):  # the first one, without the link, gives its standard deviation
            flow = (
                f"{{from: outer_stator, into: bracket_1, rate: {size} * (outer_stator - bracket_1), unit: W}}"
            )
            (folder / "truth.yaml").write_text(source.replace("flows:\n", f"flows:\n  concealed: {flow}\n"))
            rng = np.random.default_rng(k)
            ends = np.sort(rng.choice(np.arange(600, 30_000, 60), 20, replace=False))
            current = np.round(rng.uniform(0, 2, 21), 2)[np.searchsorted(ends, t, side="right")]
            inputs = {
                "current_a": current,
                "voltage_v": 4 * current,
                "air_c": 22 + 0.2 * np.sin(t / 4000 + k),
            }
            truth = compile_plant(load(folder / "truth.yaml"))
            write(folder / f"run_{k}.csv", truth.measure(Table(f"run_{k}", f"run_{k}", t, inputs), seed=k))
            if k == 0:
                size = SIGMAS * _deviation(folder, flow, "run_0.csv")
                print(f"a link of {size:.3g} W/K: {SIGMAS} standard deviations in one recording", flush=True)
        for n in numbers:
            for w in workers if n == max(numbers) else workers[-1:]:
                files = [f"run_{k}.csv" for k in range(1, n + 1)]
                found = compared(f"{n} recordings, {w} workers", folder, files, before, w)
                named = "named" if name in found.get("found", ()) else "not named"  # type: ignore[operator]
                print(
                    f"{'':28} {found.get('wall_s', float('nan')):.1f} s; {SIGMAS * np.sqrt(n):.1f} sd: {named}",
                    flush=True,
                )


def weak(numbers: list[int], before: Path | None) -> None:
    """Print what is found of a missing link that one recording shows with SIGMAS standard deviations only."""
    name = "missing_link at block_1-block_4"
    with tempfile.TemporaryDirectory() as work:
        folder, plant = Path(work), block_plant(4)
        (folder / "plant.yaml").write_text(plant)
        size = 0.0
        for k in range(max(numbers) + 1):  # the first one, without the link, gives its standard deviation
            flow = f"{{from: block_1, into: block_4, rate: {size} * (block_1 - block_4), unit: W}}"
            recorded(folder / str(k), plant, flow, 1200, 10.0, 10.0, seed=k)
            if k == 0:
                size = SIGMAS * _deviation(folder / "0", flow)
                print(f"a link of {size:.3g} W/K: {SIGMAS} standard deviations in one recording", flush=True)
            else:
                (folder / str(k) / "run_1.csv").rename(folder / f"run_{k}.csv")
        for n in numbers:
            files = [f"run_{k}.csv" for k in range(1, n + 1)]
            found = compared(f"{n} recordings, {SIGMAS * np.sqrt(n):.1f} sd", folder, files, before)
            print(f"{'':28} {name}: {'named' if name in found.get('found', ()) else 'not named'}", flush=True)  # type: ignore[operator]


def _deviation(folder: Path, flow: str, recording: str = "run_1.csv") -> float:
    """Return the standard deviation of the link's conductance, all parameters and initial states unknown."""
    free = "  G_link: {value: 0.0, unit: W/K, range: [-0.1, 0.1]}\nnodes:"
    text = (folder / "plant.yaml").read_text().replace("nodes:", free, 1)
    (folder / "free.yaml").write_text(
        text.replace("flows:\n", f"flows:\n  concealed: {flow}\n".replace("rate: 0.0", "rate: G_link"))
    )
    plant = load(folder / "free.yaml")
    model = compile_plant(plant)
    found = fit(model, [model.excitation(t) for t in read_recordings(plant, [folder / recording])])
    k = found.unknowns.index(("G_link", None))
    return float(0.2 * np.sqrt(np.linalg.inv(found.hessian)[k, k]))


def main() -> int:
    """Run one of the benchmarks."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("what", choices=("rows", "bodies", "recordings", "weak"))
    p.add_argument("--rows", type=int, default=260_000)
    p.add_argument("--before", type=Path)
    p.add_argument("--bodies", type=int, nargs="*", default=[12, 30, 60, 120])
    p.add_argument("--shape", nargs="*", choices=("chain", "network"), default=["chain", "network"])
    p.add_argument("--recordings", type=int, nargs="*", default=[1, 6, 12])
    p.add_argument("--weak", type=int, nargs="*", default=[1, 4, 10, 24])
    p.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    a = p.parse_args()
    if a.what == "rows":
        rows(a.rows, a.before)
    elif a.what == "bodies":
        bodies(a.bodies, a.shape, a.before)
    elif a.what == "weak":
        weak(a.weak, a.before)
    else:
        recordings(a.recordings, a.workers, a.before)
    return 0


if __name__ == "__main__":
    sys.exit(main())
