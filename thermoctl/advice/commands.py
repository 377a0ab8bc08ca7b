"""The command `effects check`."""

from __future__ import annotations

import argparse
import sys

from thermoctl.advice.effect_files import check_file, files_of, own_plants
from thermoctl.plant import load
from thermoctl.yamlfile import InputError


def check_effects(args: argparse.Namespace) -> int:
    """Check effect files one by one; return 1 where one has a mistake."""
    plants = [load(args.plant)] if args.plant else own_plants()
    wrong = 0
    for path in files_of(args.files):
        try:
            name, places = check_file(path, plants)
        except InputError as e:
            print(f"thermoctl: {e}", file=sys.stderr)
            wrong += 1
            continue
        shown = ", ".join(places[:4]) + (", ..." if len(places) > 4 else "")
        where = (
            f"sits at {len(places)} places ({shown})"
            if places
            else "sits nowhere in these plants: try --plant"
        )
        print(f"{path}: good; {name} {where}")
    return int(wrong > 0)
