"""Whole cases by the compiled loops and by the loops in Python: the same text, and the same numbers but for rounding.

    python -m tests.concealed.same_cases [--number 30] [--families heater,tanks] [--world both] [--smoke]

Compiled code may round otherwise: on some processors the last digit of a recording differs, and the size of an effect
that a refit gives. Making a case by the loops in Python takes up to a minute.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.concealed import generate, rigs_motion, rigs_tanks, sensors, thermal

# Relative difference that a number may have: of an answer, which a refit gives, and of the other files.
ANSWER, DIGITS = 5e-3, 1e-6
_NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")


@contextmanager
def loops_in_python() -> Iterator[None]:
    """Truths by the loops in Python, meanwhile."""
    kept = thermal.march, rigs_motion.march, rigs_tanks.rate_of, sensors.lagged
    thermal.march, rigs_motion.march = thermal.march_in_python, rigs_motion.march_in_python
    rigs_tanks.rate_of, sensors.lagged = rigs_tanks.rate_in_python, sensors.lag_in_python
    try:
        yield
    finally:
        thermal.march, rigs_motion.march, rigs_tanks.rate_of, sensors.lagged = kept


def difference(one: Path, other: Path) -> str | None:
    """Say what differs between two folders of the same case, None where nothing does."""
    names = sorted(p.name for p in one.iterdir())
    if names != sorted(p.name for p in other.iterdir()):
        return f"other files: {one}, {other}"
    for name in names:
        a, b = (one / name).read_text(), (other / name).read_text()
        may = ANSWER if name == "answer.yaml" else DIGITS
        for i, (x, y) in enumerate(zip(a.splitlines(), b.splitlines(), strict=True), 1):
            numbers = zip(map(float, _NUMBER.findall(x)), map(float, _NUMBER.findall(y)), strict=False)
            if _NUMBER.sub("#", x) != _NUMBER.sub("#", y) or any(
                abs(u - v) > may * abs(u) for u, v in numbers
            ):
                return f"{name}:{i}: {x} | {y}"
    return None


def differences(argv: Sequence[str]) -> Iterator[tuple[str, str | None]]:
    """Each case that generate.main makes of these arguments, with what differs between the two ways."""
    with tempfile.TemporaryDirectory() as folder:
        ways = [Path(folder) / way for way in ("compiled", "python")]
        generate.main([*argv, "--out", str(ways[0]), "--answers", "inside"])
        with loops_in_python():
            generate.main([*argv, "--out", str(ways[1]), "--answers", "inside"])
        made = [sorted(p.name for p in way.iterdir()) for way in ways]
        assert made[0] == made[1], made
        for name in made[0]:
            yield name, difference(ways[0] / name, ways[1] / name)


def main(argv: Sequence[str] | None = None) -> int:
    """The command: 1 when a case differs."""
    p = argparse.ArgumentParser(prog="python -m tests.concealed.same_cases", description=__doc__)
    p.add_argument("--number", type=int, default=30)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--families", default=",".join(generate.FAMILIES))
    p.add_argument("--world", choices=["closed", "open", "both"], default="both")
    p.add_argument("--smoke", action="store_true", help="short records")
    a = p.parse_args(argv)
    bad = 0
    for family in a.families.split(","):
        words = f"--number {a.number} --seed {a.seed} --families {family} --world {a.world}".split()
        found = list(differences([*words, *(["--smoke"] if a.smoke else [])]))
        wrong = [f"{name} {what}" for name, what in found if what]
        print(f"{family}: {len(found)} cases, {len(wrong)} differ", *wrong, sep="\n  ", flush=True)
        bad += len(wrong)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
