"""Commands that join the work of two packages; each imports only what it needs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def run(args: argparse.Namespace) -> int:
    """Run the daemon in the foreground, or its tick in simulated time."""
    from thermoctl.configuration.settings import load_rig, load_settings

    if args.hours is None:
        from thermoctl.daemon import supervisor
        from thermoctl.files.yamlfile import InputError

        if args.axis:
            raise InputError(
                "run: --axis goes with --simulated-time and --hours; the daemon runs all axes of a rig"
            )

        return supervisor.run(load_rig(args.config))
    from thermoctl.daemon.offline.simulate import trapezoids

    return trapezoids(load_settings(args.config), args.hours, not args.no_compensation, args.out)


def virtual_rig(settings: Any, line: str) -> int:
    """Simulate the devices of a configuration, or send `line` to a running virtual rig."""
    from thermoctl.files.yamlfile import InputError
    from thermoctl_hal.virtual.rig import main

    if settings.hal.backend != "devices":
        raise InputError(
            f"{settings.path}: no devices to simulate: hal.backend is '{settings.hal.backend}'; "
            "give --config config/wire.yaml"
        )
    return int(main(settings, line))


def service(args: argparse.Namespace) -> int:
    """Install or remove the unit. Removing the last unit removes the shell completions, too."""
    from thermoctl.cli import completion
    from thermoctl.daemon.service import install, uninstall, units

    root, config = Path(args.root), Path(args.config) if args.config else None
    if args.action == "install":
        if status := install(config or Path(), root):
            return status
        verb, paths = "wrote", completion.install(args.parser, root)
    else:
        if (status := uninstall(config, root)) or units(root):
            return status
        verb, paths = "removed", completion.uninstall(root)
    for path in paths:
        print(f"{verb} {path}")
    return 0


def effects(args: argparse.Namespace) -> int:
    """List the catalogue of effects, show one, or check effect files."""
    if args.action == "check":
        from thermoctl.advice.commands import check_effects

        return check_effects(args)
    if args.action == "save":
        from thermoctl.diagnosis.commands import save_law

        return save_law(args)
    from thermoctl.diagnosis import show

    args.name = args.files[0] if args.files else None
    return show.effects(args)


def diagnose(args: argparse.Namespace) -> int:
    """Diagnose recordings, folders of rigs or a live rig; with --resolve the experiments run on the rig."""
    from thermoctl.files.yamlfile import InputError

    if args.explain:
        from thermoctl.diagnosis.show import explained

        return explained(args.explain, args.why, args.effects or ())
    for value, option in ((args.plant, "--plant FILE"), (args.out, "--out DIR")):
        if not value:
            plant = None if args.plant else next((r for r in args.recordings if r.endswith(".yaml")), None)
            meant = f" (--plant {plant} was meant?)" if plant else ""
            raise InputError(
                f"diagnose: {option} is missing{meant}; --plant, --out and recordings were expected"
            )
    if args.live:
        from thermoctl.fleet.commands import live_recordings

        args.recordings = live_recordings(args)
        if not args.recordings:
            return 0
    from thermoctl.fleet.recordings import expanded

    args.recordings = expanded(args.recordings, args.together)
    if any(Path(r).is_dir() for r in args.recordings):
        if args.time or args.columns or args.held_out:
            raise InputError(
                "diagnose: --time, --columns and --held-out go with recordings, not with folders; make the folder's files with "
                "`thermoctl recordings import`"
            )
        from thermoctl.fleet.commands import diagnose_folders

        return diagnose_folders(args)

    def record(experiment: Path, recording: Path) -> None:
        """Run an experiment file on the rig for --resolve and write its recording.

        Raises HardwareError where it ends early, InputError where the user does not confirm it."""
        from thermoctl.calibration.commands import record

        record(experiment, recording, args.config, args.rig, args.yes)

    from thermoctl.diagnosis import commands

    args.record = record
    return commands.diagnose(args)
