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
)

TABLE: Table = {
    RUN: (
        command(
            "run",
            "run the daemon in the foreground (as systemd does), or its tick in simulated time",
            "thermoctl.cli.joined:run",
            "",
            CONFIG,
            argument(
                "--simulated-time", action="store_true", help="run the simulated rig as fast as possible"
            ),
            argument("--hours", type=float, metavar="H", help="hours of rig time (with --simulated-time)"),
            argument(
                "--no-compensation",
                action="store_true",
                help="switch compensation off (with --simulated-time)",
            ),
            argument(
                "--out", metavar="FILE", help="write 10 rows a second as Parquet (with --simulated-time)"
            ),
        ),
        command(
            "virtual-rig",
            "simulate the devices of a configuration at the other end of their wires, in real time",
            "thermoctl.cli.joined:virtual_rig",
            "settings tell",
            CONFIG,
            argument(
                "--tell",
                metavar="LINE",
                default="",
                help="inject a fault into the running virtual rig, or clear it, as 'encoder unplug' ('help' lists all)",
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
            argument(
                "--together",
                action="store_true",
                help="with folders: all recordings in them are of one rig, for one diagnosis",
            ),
            argument("--plant", metavar="FILE", help="the plant file, or an FMU"),
            MAP,
            argument(
                "--held-out",
                action="append",
                metavar="REC",
                help="recording that takes no part in any choice and measures what the findings are worth (repeatable; "
                "default: the last of three or more)",
            ),
            *READING,
            argument(
                "--anyway",
                action="store_true",
                help="diagnose although the checks of the data found a severe fault",
            ),
            argument(
                "--out",
                metavar="DIR",
                help="folder of diagnosis.json, plant.yaml and report.html (with folders: DIR/RIG)",
            ),
            argument(
                "--continue",
                dest="continued",
                metavar="DIR",
                help="go on from the diagnosis in DIR with recordings that it has not seen, without its old ones",
            ),
            argument("--explain", metavar="DIR", help="print the reasons of the diagnosis in DIR"),
            argument(
                "--why",
                metavar="EFFECT",
                help="with --explain: in one line why this effect (NAME, or 'NAME at PLACE') is a finding or none",
            ),
            argument(
                "--last",
                type=int,
                default=2,
                metavar="N",
                help="with folders: use each rig's newest N recordings (default 2)",
            ),
            argument(
                "--workers", type=int, metavar="N", help="with folders: local processes (default one a core)"
            ),
            argument(
                "--scheduler",
                metavar="ADDRESS",
                help="a Dask scheduler (tcp://...): its workers compute by recording; with folders by rig, from the same files",
            ),
            EFFECTS,
            argument(
                "--drive",
                action="append",
                metavar="INPUT",
                help="an input that the next experiment may drive (repeatable; default: inputs that changed in the "
                "recordings, except the surroundings)",
            ),
            argument(
                "--limit",
                action="append",
                metavar="NAME=LOW:HIGH",
                help="range of an input or output in the next experiment (repeatable; default: the recorded range)",
            ),
            argument(
                "--live",
                action="store_true",
                help="use the daemon's own recordings (--config) from the time when its model no longer fits",
            ),
            argument(
                "--hours", type=float, default=4.0, metavar="H", help="with --live: how far back (default 4)"
            ),
            argument(
                "--resolve",
                action="store_true",
                help="run the next experiment on the rig, then diagnose with its data",
            ),
            YES,
            argument(
                "--rounds",
                type=int,
                default=3,
                metavar="N",
                help="with --resolve: at most N experiments (default 3)",
            ),
            argument(
                "--rig", metavar="PLANT", help="with --resolve: simulate this plant file instead of the rig"
            ),
            CONFIG,
            argument("--json", action="store_true", help="print the result as JSON"),
            argument("--quiet", action="store_true", help="print neither progress nor summary"),
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
            argument(
                "--plant",
                metavar="PLANT",
                help="with check: a plant to put the effects into (default: the shipped ones)",
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
            argument(
                "--out",
                default="thermoctl-report.zip",
                metavar="FILE",
                help="the archive (default thermoctl-report.zip)",
            ),
            argument(
                "--seconds",
                type=float,
                default=60.0,
                metavar="S",
                help="of the newest recording (default 60)",
            ),
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
