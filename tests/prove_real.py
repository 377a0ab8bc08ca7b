"""Old engine beside new on the shared real rigs and concealed cases: found, strays, verdict, held-out ratio, CPU seconds.

    python tests/prove_real.py --out DIR [--engine new|old] [TASK ...]      diagnose (results that are there are kept)
    python tests/prove_real.py --out DIR --table                           print the results so far
    ... --cases DIR      generated cases (python -m tests.concealed.generate --answers inside) instead

Accepted effects: `answers.yaml` of each rig; where a rig has none, what its README says is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

RECORDINGS = Path(os.environ.get("THERMOCTL_RECORDINGS", "../shared/recordings"))


@dataclass(frozen=True)
class Task:
    """One diagnosis. `accepted`: each a set of names of which one has to be found; `tolerated`: names that are no strays."""

    name: str
    folder: Path
    plant: str
    runs: tuple[str, ...]
    held_out: tuple[str, ...] = ()
    accepted: tuple[frozenset[str], ...] = ()
    tolerated: frozenset[str] = frozenset()


_MASS, _LAG = frozenset({"hidden_thermal_mass"}), frozenset({"sensor_lag"})
_FRICTION = frozenset({"coulomb_friction", "stribeck_friction", "directional_friction"})
_WARM = frozenset({"radiation", "natural_convection", "temperature_dependent_conductance"})
_MEMBER = frozenset({"missing_member", "bending"})
_SOFT = frozenset({"expansion_lag", "sensor_lag"})


def _rig(
    name: str,
    folder: str,
    runs: str,
    accepted=(),
    tolerated=(),
    held_out: str = "",
    plant: str = "plant.yaml",
) -> Task:
    return Task(
        name,
        RECORDINGS / folder,
        plant,
        tuple(runs.split()),
        tuple(held_out.split()),
        tuple(accepted),
        frozenset(tolerated),
    )


RIGS = (
    _rig("dyno_1", "actuator_dyno", "run_1", (_MASS,), ("sensor_lag", "copper_resistance")),
    _rig("dyno_2", "actuator_dyno", "run_2", (_LAG,), ("hidden_thermal_mass", "copper_resistance")),
    _rig("dyno_3", "actuator_dyno", "run_3", (_MASS, _LAG), ("copper_resistance",)),
    _rig(
        "battery",
        "battery_18650",
        "run_1 run_2",
        (),
        ("hidden_thermal_mass", "sensor_lag", "second_ambient"),
        "run_3 run_4",
    ),
    _rig("building", "building_prbs", "run_1", (_MASS,), ("sensor_lag",)),
    _rig(
        "tanks",
        "cascaded_tanks",
        "run_1",
        (frozenset({"overflow"}),),
        ("orifice_exponent", "sensor_saturation"),
        "run_2",
    ),
    _rig("daisy", "daisy_heating", "run_1", (_MASS, _WARM), ("sensor_lag",)),
    _rig("emps", "emps", "run_1", (_FRICTION,), ("constant_load", "viscous_friction")),
    _rig("klipper_1", "klipper_frame_expansion", "run_1", (_MEMBER, _SOFT)),
    _rig("klipper_2", "klipper_frame_expansion", "run_2", (_MEMBER, _SOFT)),
    _rig("klipper_3", "klipper_frame_expansion", "run_3", (_MEMBER, _SOFT), plant="plant_run_3.yaml"),
    _rig(
        "pendulum", "pendulum_free_rotary", "run_1", (_FRICTION, frozenset({"quadratic_drag"})), (), "run_2"
    ),
    _rig("silverbox", "silverbox", "run_1", (frozenset({"cubic_stiffness"}),), (), "run_2 run_3"),
    _rig("tclab_12", "tclab", "run_1 run_2", (frozenset({"missing_link"}), _LAG), ("radiation",)),
    _rig("tclab_3", "tclab", "run_3", (frozenset({"missing_link"}), _LAG), ("radiation",)),
    _rig("ak109", "tmotor_ak109", "run_1 run_2 run_3", (_MASS,), ("copper_resistance",)),
    _rig("ak809", "tmotor_ak809", "run_1", (_MASS,), ("copper_resistance",)),
    _rig("zprobe_1", "zprobe_drift", "run_1", (_SOFT,), ("missing_member",)),
    _rig("zprobe_3", "zprobe_drift", "run_3", (_SOFT,), ("missing_member",)),
)


def cases(folder: Path) -> list[Task]:
    """Concealed cases with their answers."""
    out = []
    for case in sorted(folder.glob("[0-9]*")):
        answer = yaml.safe_load((case / "answer.yaml").read_text())
        names = [e for e, _ in answer["effects"] if e != "?"]
        accepted = tuple(frozenset({e, *answer["nearly_the_same"]}) for e in names)
        out.append(Task(f"case_{case.name}", case, "plant.yaml", ("run_1", "run_2"), (), accepted))
    return out


def diagnose(task: Task, engine: str, out: Path) -> None:
    """Run one diagnosis in its own process and note its CPU seconds."""
    module = ["thermoctl.evidence"] if engine == "new" else ["thermoctl.cli", "diagnose", "--quiet"]
    held = (
        [a for r in task.held_out for a in ("--held-out", str(task.folder / f"{r}.csv"))]
        if engine == "new"
        else []
    )
    runs = [str(task.folder / f"{r}.csv") for r in task.runs]
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    command = [
        sys.executable,
        "-m",
        *module,
        "--plant",
        str(task.folder / task.plant),
        "--out",
        str(out),
        *held,
        *runs,
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    out.mkdir(parents=True, exist_ok=True)
    seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    error = done.stderr.strip().splitlines()[-1:] if done.returncode else []
    (out / "run.json").write_text(json.dumps({"seconds": seconds, "status": done.returncode, "error": error}))


def row(task: Task, out: Path) -> str:
    """One line of the table: found / accepted, strays, verdict, held-out ratio, seconds."""
    if not (out / "diagnosis.json").exists():
        return (
            "-"
            if not (out / "run.json").exists()
            else f"failed: {json.loads((out / 'run.json').read_text())['error']}"
        )
    found = json.loads((out / "diagnosis.json").read_text())
    named = {f["effect"]: f["probability"] for f in found["findings"]}
    hits = [max((named[e] for e in options if e in named), default=0.0) for options in task.accepted]
    known = frozenset().union(*task.accepted, task.tolerated)
    strays = [e for e in named if e not in known]
    before, after = found["fit"].get("held_out_refit_only") or {}, found["fit"].get("held_out_after") or {}
    ratios = [after[o] / before[o] for o in after if before.get(o) and after[o] is not None]
    ratio = f"{sum(ratios) / len(ratios):.2f}" if ratios else "-"
    seconds = json.loads((out / "run.json").read_text())["seconds"]
    return (
        f"{sum(p > 0 for p in hits)}/{len(hits)} ({' '.join(f'{p:.2f}' for p in hits) or '-'}) "
        f"strays {len(strays)} {found['verdict']} ratio {ratio} {seconds:.0f} s  {', '.join(named)}"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Diagnose the tasks, or print the table."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--engine", choices=("new", "old"), default="new")
    p.add_argument("--table", action="store_true")
    p.add_argument("--cases", type=Path)
    p.add_argument("tasks", nargs="*")
    args = p.parse_args(argv)
    for task in cases(args.cases) if args.cases else [*RIGS, *cases(RECORDINGS.parent / "cases")]:
        if args.tasks and task.name not in args.tasks:
            continue
        if args.table:
            print(f"{task.name:10} old: {row(task, args.out / 'old' / task.name)}")
            print(f"{'':10} new: {row(task, args.out / 'new' / task.name)}")
        elif not (args.out / args.engine / task.name / "run.json").exists():
            diagnose(task, args.engine, args.out / args.engine / task.name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
