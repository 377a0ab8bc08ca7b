"""All commands: the tables of the packages joined, and the call of the function that a row names."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import sys
from pathlib import Path
from typing import Any

from thermoctl.advice import command_table as advice
from thermoctl.calibration import command_table as calibration
from thermoctl.cli import command_table as joined
from thermoctl.command import CONFIG, PURPOSES, Command
from thermoctl.daemon import command_table as daemon
from thermoctl.devices import command_table as devices
from thermoctl.diagnosis import command_table as diagnose
from thermoctl.export import command_table as export
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet import command_table as fleet
from thermoctl.identify import command_table as identify
from thermoctl.plant import command_table as plant
from thermoctl.recording import command_table as recording

_TABLES = (daemon, joined, devices, recording, calibration, plant, advice, export, identify, diagnose, fleet)
BY_PURPOSE: dict[str, tuple[Command, ...]] = {
    purpose: tuple(row for table in _TABLES for row in table.TABLE.get(purpose, ())) for purpose in PURPOSES
}
"""Every command by its purpose; `thermoctl --help` lists them so."""
COMMANDS = tuple(row for rows in BY_PURPOSE.values() for row in rows)
GROUPS = {
    "devices": "device profiles: list, show, search, write, try",
    "recordings": "list, inspect, import, export or recover recordings",
    "plant": "start, check, show, export or linearise a plant file",
}
"""Groups of commands, such as `plant`, with their help."""


def call(command: Command, args: argparse.Namespace) -> int:
    """Run a command with its parsed arguments; return its exit status."""
    module, _, name = command.function.partition(":")
    function = getattr(importlib.import_module(module), name)
    takes = command.takes.split()
    if "settings" in takes:
        from thermoctl.configuration.settings import for_stopping, load_rig, load_settings
        from thermoctl.daemon.lock import started

        each = command.name in EACH_AXIS and "#" not in args.config
        whole = each or command.name in WHOLE_RIG and "#" not in args.config
        try:
            args.settings = load_rig(args.config) if whole else load_settings(args.config)
        except InputError as e:
            if command.name not in SAFE:
                raise
            args.settings = for_stopping(args.config)
            if started(args.settings) is args.settings and not Path(args.settings.path).exists():
                raise
            print(f"thermoctl: {e}; {command.name} needs the rig's socket only", file=sys.stderr)
        if command.name in SAFE:
            args.settings = started(args.settings)
        if each and args.settings.axes:
            return _each_axis(command.name, function, takes, args)
    return (function(*(getattr(args, t) for t in takes)) if takes else function(args)) or 0


SAFE = frozenset({"disarm", "stop"})
"""Commands of the safe direction: they work with a configuration that has mistakes, too."""
EACH_AXIS = frozenset({"status", "disarm", "reload", "latency"})
"""Commands that, without --axis, do their work for every axis of a rig, one after the other."""
ALL_AXES = frozenset({"start", "stop", "restart", "virtual-rig", "service"})
"""Commands that act on the whole rig: they take no --axis."""
WHOLE_RIG = ALL_AXES | {"check", "doctor"}
"""Commands that take a whole rig; --axis names one for `check` and `doctor`."""


def takes_axis(command: Command) -> bool:
    """Return whether a command takes --axis."""
    return CONFIG in command.arguments and command.name not in ALL_AXES


def _each_axis(name: str, function: Any, takes: list[str], args: argparse.Namespace) -> int:
    """Run a command for every axis; return the largest exit status.

    A `disarm` reaches every axis before the first answer. A `reload` that one axis refuses is none."""
    from thermoctl.daemon.control_socket import refused_reload, tell

    statuses, axes = [], args.settings.axes
    for part in axes if name == "disarm" else ():
        with contextlib.suppress(InputError):  # the command itself says it
            tell(part.socket.path, {"command": "disarm"})
    if name == "reload" and (why := refused_reload(part.socket.path for part in axes)):
        raise InputError(why)
    for part in axes:
        args.settings = part
        if not getattr(args, "json", False):
            print(f"axis {part.axis}:", flush=True)
        try:
            statuses.append(function(*(getattr(args, t) for t in takes)) or 0)
        except InputError as e:  # the other axes have to be disarmed all the same
            print(f"thermoctl: {e}", file=sys.stderr)
            statuses.append(2)
    return max(statuses)
