"""Diagnose a folder of cases, compare with the answers, score.

python -m tests.proof CASES --answers DIR --out DIR
python -m tests.proof --real [RECORDINGS] --out DIR
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from tests.proof import tables
from tests.proof.prove import prove
from tests.proof.recordings import VARIABLE, real, recordings_folder, totals
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.batch import Reporter


def _parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(prog="python -m tests.proof", description=__doc__.splitlines()[0])
    top.add_argument(
        "cases",
        nargs="?",
        metavar="CASES",
        help="folder of cases: plant.yaml and recordings each (with --real: of real recordings)",
    )
    top.add_argument("--out", required=True, metavar="DIR", help="folder of the results")
    top.add_argument(
        "--answers", metavar="DIR", help="folder of NAME.yaml files (default: answer.yaml of each case)"
    )
    top.add_argument("--number", type=int, metavar="N", help="only the first N cases")
    top.add_argument("--workers", type=int, metavar="N", help="local processes (default: one a core)")
    top.add_argument(
        "--scheduler", metavar="ADDRESS", help="a Dask scheduler (tcp://...) that sees the same files"
    )
    top.add_argument(
        "--real",
        action="store_true",
        help=f"real recordings: effects found, strays, held-out error (default folder: ${VARIABLE})",
    )
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run and score the cases: 0 when every goal that could be measured is reached, else 1; 2 for bad input."""
    args = _parser().parse_args(argv)
    console = Console()
    where = {"scheduler": args.scheduler, "workers": args.workers, "number": args.number}
    try:
        if args.real:
            entries = real(recordings_folder(args.cases), args.out, progress=Reporter(), **where)
            console.print(tables.real_table(entries))
            console.print(totals(entries))
            return int(any(e.error for e in entries))
        if not args.cases:
            raise InputError("a folder of cases was expected, or --real")
        content = prove(args.cases, args.out, args.answers, progress=Reporter(), **where)
    except InputError as e:
        print(f"prove: {e}", file=sys.stderr)
        return 2
    console.print(tables.table(content))
    console.print(f"written: {Path(args.out) / 'proof.json'}")
    goals = [*content["goals"].values(), *content["open_world"].get("goals", {}).values()]
    return int(any(g["reached"] is False for g in goals))


if __name__ == "__main__":
    sys.exit(main())
