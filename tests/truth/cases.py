"""The cases by which a diagnosis is judged, each with what is right, tolerated and wrong in it.

- generated: the first cases of frozen seeds, of the closed and the open world, and of a crowded one only if
  asked (tests/concealed/crowded.py); made once, kept by the generator's hash
- home: the rigs of THERMOCTL_RECORDINGS (tests/proof/rigs.py)
- foreign: the systems of THERMOCTL_FOREIGN, a folder of folders with plant.yaml, recordings and answer.yaml
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.concealed import generate
from tests.proof.recordings import VARIABLE, rig_job
from tests.proof.rigs import RIGS, Rig
from tests.proof.score import Named, Truth, same_place
from tests.truth.forms import changed
from thermoctl.files.yamlfile import load
from thermoctl.fleet.jobs import Job

# frozen: a table stays comparable with an older one
SEEDS = {"closed": 141421, "open": 173205, "crowded": 223606}
FOREIGN = "THERMOCTL_FOREIGN"  # of the environment: the folder of other people's systems
RIGHT, TOLERATED, STRAY = "right", "tolerated", "stray"


@dataclass(frozen=True)
class Case:
    """One case: its group, its job, the answer, and a judge of a name: RIGHT, TOLERATED or STRAY.

    `wanted`: for each effect that is to be named, whether a name is it; none of them: a trap, where every
    name is wrong."""

    group: str
    job: Job
    answer: Mapping[str, Any]
    wanted: tuple[Callable[[Named], bool], ...]
    tolerates: Callable[[Named], bool] = lambda name: False

    def judge(self, name: Named) -> str:
        """Say what a name is worth."""
        if any(is_it(name) for is_it in self.wanted):
            return RIGHT
        return TOLERATED if self.tolerates(name) else STRAY


def generated(
    folder: Path,
    numbers: Mapping[str, int],
    workers: int,
    say: Callable[[str], None],
    seed: int | None = None,
    form: str | None = None,
) -> list[Case]:
    """Return the first cases of each world in `numbers`, of its frozen seed or of `seed`, in a form of FORMS.

    Those that are not there are made."""
    root = folder / (_generator() if seed is None else f"{_generator()}-{seed}")
    asked = [(world, n) for world, number in numbers.items() for n in range(number)]
    todo = [
        (world, n)
        for world, n in asked
        if not (root / world / f"{n + 1:04d}" / "answer.yaml").exists()
        and not (root / world / f"{n + 1:04d}.gap").exists()
    ]
    if todo:
        say(f"{len(todo)} cases to make")
        with ProcessPoolExecutor(min(workers, len(todo))) as pool:
            for done in as_completed(
                [
                    pool.submit(_make, root / world, SEEDS[world] if seed is None else seed, world, n)
                    for world, n in todo
                ]
            ):
                say(done.result())
    found = []
    mark = "".join(f"-{x}" for x in (seed, form) if x is not None)
    for world, n in asked:
        case = root / world / f"{n + 1:04d}"
        if (case / "answer.yaml").exists():
            name = f"{world}{mark}-{case.name}"
            found.append(_generated(world, name, changed(case, form) if form else case))
    return found


def _generator() -> str:
    """Hash everything that can change a generated case."""
    code = sorted(Path(generate.__file__).parent.glob("*.py*"))
    kept = [p for p in code if not p.name.startswith(("test_", "same_cases", "demo", "left"))]
    return hashlib.sha256(b"".join(p.read_bytes() for p in kept)).hexdigest()[:12]


def _make(folder: Path, seed: int, world: str, number: int) -> str:
    name = f"{number + 1:04d}"
    kind = "--kind crowded" if world == "crowded" else f"--world {world}"
    words = f"--seed {seed} {kind} --first {number} --number 1 --answers inside".split()
    generate.main(["--out", str(folder), *words])
    if not (folder / name / "answer.yaml").exists():  # no rig shows the effect at that size
        (folder / f"{name}.gap").touch()
    return f"{world}/{name} made"


def _generated(world: str, name: str, folder: Path) -> Case:
    answer = load(folder / "answer.yaml").plain()
    truth = Truth.of(folder.name, answer)
    known = truth.effects if truth.kind not in ("none", "unknown") else []

    def is_it(true: Named) -> Callable[[Named], bool]:
        """Return the test of a name for being this true effect, or one that the data cannot tell from it, at its place."""
        return lambda name: truth.names(name, true) and truth.at(name)

    wanted = tuple(map(is_it, known))
    if "each" in answer:  # of each effect, all names that the data cannot tell from it
        wanted = tuple(_one_of([(e, w) for e, w in names]) for names in answer["each"])
    wanted += tuple(
        _one_of([(e, w)]) for e, w in answer.get("late", ())
    )  # a fault of the recording (forms.py)
    return Case(world, _job(name, folder), answer, wanted, truth.of_misfit)


def _one_of(names: Sequence[Named]) -> Callable[[Named], bool]:
    """Return the test of a name for being one of these effects at its place."""
    return lambda name: any(name[0] == e and same_place(e, name[1], where) for e, where in names)


def _job(name: str, folder: Path, held_out: tuple[str, ...] = ()) -> Job:
    runs = sorted(str(p) for p in folder.glob("run_*.csv"))
    apart = tuple(str(folder / x) for x in held_out)
    return Job(name, str(folder / "plant.yaml"), tuple(r for r in runs if r not in apart), held_out=apart)


def home(say: Callable[[str], None]) -> list[Case]:
    """Return the real rigs that are here, one case each diagnosis."""
    folder = _folder(VARIABLE, "real rigs", say)
    if folder is None:
        return []
    return [_home(folder, r) for r in RIGS if (folder / r.folder / r.plant).is_file()]


def _home(folder: Path, rig: Rig) -> Case:
    def is_it(options: frozenset[str]) -> Callable[[Named], bool]:
        """Return the test of a name for being one of these effects, wherever."""
        return lambda name: name[0] in options

    tolerated = frozenset(rig.tolerated)
    return Case("home", rig_job(folder, rig), {}, tuple(map(is_it, rig.accepted)), is_it(tolerated))


def foreign(say: Callable[[str], None]) -> list[Case]:
    """Return other people's systems that are here."""
    folder = _folder(FOREIGN, "other people's systems", say)
    if folder is None:
        return []
    return [_foreign(p.parent) for p in sorted(folder.glob("*/answer.yaml"))]


def _foreign(folder: Path) -> Case:
    answer = load(folder / "answer.yaml").plain()

    wanted = tuple(_one_of([(e, where) for e in _list(effects)]) for effects, where in answer["named"])
    return Case(
        "foreign", _job(folder.name, folder, tuple(_list(answer.get("held_out", [])))), answer, wanted
    )


def _list(x: Any) -> list[str]:
    return [x] if isinstance(x, str) else list(x)


def _folder(variable: str, what: str, say: Callable[[str], None]) -> Path | None:
    """Return the folder that a variable of the environment names; None, with a word, where there is none."""
    name = os.environ.get(variable)
    if name and Path(name).is_dir():
        return Path(name)
    say(f"without {what}: {variable} names {f'{name}, which is no folder' if name else 'no folder'}")
    return None
