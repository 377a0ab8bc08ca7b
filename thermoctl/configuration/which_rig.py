"""Find the configuration of a command; every command uses this rule.

`--config FILE`; else `$THERMOCTL_CONFIG`; else `config/simulated.yaml` in the current folder; else
`/etc/thermoctl/rig.yaml`; else, for `demo`, the simulated rig that comes with the program.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError

FALLBACKS = ("config/simulated.yaml", "/etc/thermoctl/rig.yaml")


_START_OR_STOP = ("run", "demo", "start", "stop", "restart", "virtual-rig", "service")
_COMMAND = ("arm", "disarm", "setpoint", "reload", "dashboard", "tune", "experiment", "calibrate", "diagnose")
ACTING = frozenset((*_START_OR_STOP, *_COMMAND))
"""Commands that can move, arm, disarm or stop a rig: each prints the file that it chose by itself.

docs/reference/commands-that-act.md describes them."""


def find_config(given: str | None) -> tuple[str, str]:
    """Return (the configuration's path, how it was found). Raises InputError when there is none.

    A file that is named but missing is returned: reading it gives the error. Another rig never takes its
    place."""
    if given:
        return given, "--config"
    if named := os.environ.get("THERMOCTL_CONFIG"):
        return named, "THERMOCTL_CONFIG"
    for path in FALLBACKS:
        if Path(path).exists():
            return path, "no --config, no THERMOCTL_CONFIG"
    raise InputError(
        f"no configuration: neither {FALLBACKS[0]} in this folder nor {FALLBACKS[1]} exists; "
        "give --config FILE or set THERMOCTL_CONFIG; `thermoctl init` copies configurations to start from"
    )


def choose(args: argparse.Namespace) -> None:
    """Put the configuration's path into `args.config` of a command that needs a rig; print the choice."""
    if "config" not in args or not _means_a_rig(args):
        return
    given = args.config or getattr(args, "file", None)
    try:
        args.config, how = find_config(given)
    except InputError:
        if args.command != "demo":
            raise
        args.config, how = str(shipped("config") / "simulated.yaml"), "the simulated rig of the program"
    if not given and _acts(args):
        print(f"thermoctl: configuration {args.config} ({how})", file=sys.stderr)
    if getattr(args, "axis", None):
        args.config = f"{args.config}#{args.axis}"


def _means_a_rig(args: argparse.Namespace) -> bool:
    if args.command == "diagnose":
        return args.live or (args.resolve and not args.rig)
    if args.command == "experiment":  # a test lies beside the configuration; a file of inputs may need no rig
        return not (args.plant or (args.dry_run and Path(args.name).suffix in (".yaml", ".yml")))
    return args.command != "service" or args.action == "install"


def _acts(args: argparse.Namespace) -> bool:
    if args.command == "diagnose":
        return args.resolve
    if args.command == "experiment":
        return not args.dry_run
    return args.command in ACTING and (args.command != "dashboard" or args.commands)
