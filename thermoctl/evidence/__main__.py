"""`python -m thermoctl.evidence`: diagnose with the evidence engine; it will replace `diagnose`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from thermoctl.evidence.explain import explain
from thermoctl.evidence.result import words
from thermoctl.evidence.run import write
from thermoctl.yamlfile import InputError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one diagnosis, or with --explain print the reasons of an earlier one; return the exit status."""
    p = argparse.ArgumentParser(prog="python -m thermoctl.evidence", description=__doc__)
    p.add_argument("--plant", metavar="FILE", help="plant file")
    p.add_argument("--out", metavar="DIR", help="for diagnosis.json and plant.yaml")
    p.add_argument(
        "--held-out",
        metavar="REC",
        action="append",
        default=[],
        help="recording that takes no part in any choice",
    )
    p.add_argument(
        "--effects", metavar="DIR", action="append", default=[], help="further folder of catalogue entries"
    )
    p.add_argument(
        "--explain", metavar="DIR", help="print in ten lines why the diagnosis in DIR came out as it did"
    )
    p.add_argument("recordings", metavar="REC", nargs="*")
    args = p.parse_args(argv)
    try:
        if args.explain:
            print(explain(json.loads((Path(args.explain) / "diagnosis.json").read_text())))
            return 0
        if not (args.plant and args.out and args.recordings):
            raise InputError(
                "--plant FILE, --out DIR and at least one recording were expected (or --explain DIR)"
            )
        print(
            words(
                write(args.plant, args.recordings, args.out, [Path(e) for e in args.effects], args.held_out)
            )
        )
    except InputError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
