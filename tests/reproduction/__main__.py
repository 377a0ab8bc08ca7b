"""Run the paper's tests on simulated rigs; report the paper's numbers, ours by its method, and ours by the better method.

python -m tests.reproduction [--quick]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.reproduction.study import reproduce


def main(argv: Sequence[str] | None = None) -> int:
    """Write the whole report; 1 when a goal is missed."""
    top = argparse.ArgumentParser(prog="python -m tests.reproduction", description=__doc__.splitlines()[0])
    for name, default, what in (
        ("config", "config/simulated.yaml", "the simulated rig"),
        ("plant", "config/plants/actuator_truth.yaml", "plant file of the simulated hardware"),
        ("out", "out/reproduce", "folder of the report"),
    ):
        top.add_argument(f"--{name}", metavar="PATH", default=default, help=f"{what} (default %(default)s)")
    top.add_argument("--seeds", type=int, default=12, help="number of simulated rigs (default %(default)s)")
    top.add_argument("--quick", action="store_true", help="leave out the full run at the loop's period")
    args = top.parse_args(argv)
    return 0 if reproduce(args.plant, args.config, Path(args.out), args.seeds, not args.quick) else 1


if __name__ == "__main__":
    sys.exit(main())
