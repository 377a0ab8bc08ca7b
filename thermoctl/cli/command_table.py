"""Rows of the command table: commands that join packages (their functions are in joined.py), and help."""

from __future__ import annotations

from thermoctl.command import (
    CONFIG,
    DIAGNOSE,
    EFFECTS,
    FORMATS,
    HELP,
    MAP,
    READING,
    ROOT,
    RUN,
    YES,
    Table,
    argument,
    command,
    option,
    switch,
)

TABLE: Table = {
    RUN: (
        command(
            "run",
            "run the daemon in the foreground (as systemd does), or its tick in simulated time",
            "thermoctl.cli.joined:run",
            "",
            CONFIG,
            switch("--simulated-time", "run the simulated rig as fast as possible"),
            option("--hours", "H", "hours of rig time (with --simulated-time)", type=float),
            switch("--no-compensation", "switch compensation off (with --simulated-time)"),
            option("--out", "FILE", "write 10 rows a second as Parquet (with --simulated-time)"),
        ),
        command(
            "virtual-rig",
            "simulate the devices of a configuration at the other end of their wires, in real time",
            "thermoctl.cli.joined:virtual_rig",
            "settings tell",
            CONFIG,
            option(
                "--tell",
                "LINE",
                "inject a fault into the running virtual rig, or clear it, as 'encoder unplug' ('help' lists all)",
                default="",
            ),
        ),
        command(
            "service",
            "install or remove the systemd unit, its user, its device rules and the shell completions",
            "thermoctl.cli.joined:service",
            "",
            argument("action", choices=["install", "uninstall"]),
            CONFIG,
            ROOT,
        ),
    ),
    DIAGNOSE: (
        command(
            "diagnose",
            "find where simulation and recordings differ, which physics is missing, and what adding it gains",
            "thermoctl.cli.joined:diagnose",
            "",
            argument(
                "recordings",
                nargs="*",
                metavar="REC",
                help=f"recordings ({FORMATS}) or patterns of them ('runs/*.csv'), or folders of many rigs' "
                "recordings: one diagnosis a rig",
            ),
            switch("--together", "with folders: all recordings in them are of one rig, for one diagnosis"),
            option("--plant", "FILE", "the plant file, or an FMU"),
            MAP,
            option(
                "--held-out",
                "REC",
                "recording that takes no part in any choice and measures what the findings are worth (repeatable; "
                "default: the last of three or more)",
                action="append",
            ),
            *READING,
            switch("--anyway", "diagnose although the checks of the data found a severe fault"),
            option(
                "--out", "DIR", "folder of diagnosis.json, plant.yaml and report.html (with folders: DIR/RIG)"
            ),
            option(
                "--continue",
                "DIR",
                "go on from the diagnosis in DIR with recordings that it has not seen, without its old ones",
                dest="continued",
            ),
            option("--explain", "DIR", "print the reasons of the diagnosis in DIR"),
            option(
                "--why",
                "EFFECT",
                "with --explain: in one line why this effect (NAME, or 'NAME at PLACE') is a finding or none",
            ),
            option(
                "--last", "N", "with folders: each rig's newest N recordings (default 2)", type=int, default=2
            ),
            option("--workers", "N", "with folders: local processes (default one a core)", type=int),
            option(
                "--scheduler",
                "ADDRESS",
                "with folders: a Dask scheduler (tcp://...) whose workers see the same files",
            ),
            EFFECTS,
            option(
                "--drive",
                "INPUT",
                "an input that the next experiment may drive (repeatable; default: inputs that changed in the "
                "recordings, except the surroundings)",
                action="append",
            ),
            option(
                "--limit",
                "NAME=LOW:HIGH",
                "range of an input or output in the next experiment (repeatable; default: the recorded range)",
                action="append",
            ),
            switch(
                "--live",
                "use the daemon's own recordings (--config) from the time when its model no longer fits",
            ),
            option("--hours", "H", "with --live: how far back (default 4)", type=float, default=4.0),
            switch("--resolve", "run the next experiment on the rig, then diagnose with its data"),
            YES,
            option("--rounds", "N", "with --resolve: at most N experiments (default 3)", type=int, default=3),
            option("--rig", "PLANT", "with --resolve: simulate this plant file instead of the rig"),
            CONFIG,
            switch("--json", "print the result as JSON"),
            switch("--quiet", "print neither progress nor summary"),
        ),
        command(
            "effects",
            "list the catalogue of effects, show one (`effects show NAME`), check files of your own (`effects check FILE`), "
            "or save the law of a diagnosis as one (`effects save DIR NAME`)",
            "thermoctl.cli.joined:effects",
            "",
            argument("action", nargs="?", metavar="show|check|save"),
            argument(
                "files",
                nargs="*",
                metavar="NAME|FILE|DIR",
                help="an effect's name; files or folders of effects; a diagnosis and a name",
            ),
            option(
                "--plant", "PLANT", "with check: a plant to put the effects into (default: the shipped ones)"
            ),
            EFFECTS,
        ),
    ),
    HELP: (
        command(
            "init",
            "copy configurations, device profiles, plants and examples into a folder, to start from",
            "thermoctl.files.shipped:init",
            "folder",
            argument("folder", nargs="?", default=".", metavar="DIR", help="the folder (default: this one)"),
        ),
        command(
            "report",
            "write one archive for a question to others: versions, configuration, log, the end of the newest recording",
            "thermoctl.cli.support:report",
            "settings out seconds",
            CONFIG,
            option(
                "--out", "FILE", "the archive (default thermoctl-report.zip)", default="thermoctl-report.zip"
            ),
            option("--seconds", "S", "of the newest recording (default 60)", type=float, default=60.0),
        ),
        command(
            "completion",
            "print the shell's completion script; source it",
            "thermoctl.cli.completion:completion",
            "parser shell",
            argument("shell", choices=["bash", "zsh", "tcsh"]),
        ),
    ),
}
