"""The commands: one row each, with its arguments and the function that does the work.

A row names its function as text, "module:function". `call` imports the module when the command is given, so
that `thermoctl --help` and `thermoctl status` load nothing that they do not need.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple


class Argument(NamedTuple):
    """One argument, as argparse's add_argument takes it."""

    flags: tuple[str, ...]
    options: Mapping[str, Any]


class Command(NamedTuple):
    """One command; a name of two words is a command below a group.

    takes: the arguments that the function gets, in order, by the names that argparse gives them. `settings`
    stands for the configuration read from --config, `parser` for the whole command line. Without any the
    function gets the namespace of all arguments."""

    name: str
    help: str
    function: str
    takes: str
    arguments: tuple[Argument, ...]


def _arg(*flags: str, **options: Any) -> Argument:
    return Argument(flags, options)


def _command(name: str, help: str, function: str, takes: str, *arguments: Argument) -> Command:
    return Command(name, help, function, takes, arguments)


CONFIG = _arg(
    "--config",
    metavar="FILE",
    help="configuration (else $THERMOCTL_CONFIG, config/simulated.yaml, /etc/thermoctl/rig.yaml)",
)
"""The option of every command that needs a rig; `which_rig.choose` stores the path that it found."""
AXIS = _arg("--axis", metavar="NAME", help="the axis of a rig with several")
"""Goes with CONFIG, except for ALL_AXES (see `takes_axis`)."""
_FILE = _arg("file", nargs="?", metavar="CONFIG", help="the same as --config CONFIG")
_YES = _arg(
    "--yes", action="store_true", help="start without asking; without a terminal, required to move a rig"
)
_JSON = _arg("--json", action="store_true", help="print one JSON object, for programs")
_PLANT = _arg("--plant", required=True, metavar="PLANT", help="the plant file, or an FMU")
_MAP = _arg(
    "--map",
    metavar="FILE",
    help="with an FMU as the plant: columns, roles, units, noise and ranges of its variables",
)
_RECORDINGS = _arg(
    "recordings",
    nargs="+",
    metavar="REC",
    help="recordings (.csv, .txt, .xlsx, .parquet, .arrow, .mf4, .tdms)",
)
_TIME = _arg(
    "--time",
    metavar="COLUMN",
    help="the column of times (default: by its name, else the first that increases)",
)
_COLUMNS = _arg(
    "--columns",
    metavar="NAME=COLUMN,...",
    help="names that the plant reads, and the recordings' columns that they stand for",
)
_EFFECTS = _arg(
    "--effects", action="append", metavar="DIR", help="a further folder of effect files (repeatable)"
)
_MODELS = _arg(
    "--models", metavar="DIR", help="folder of calibrations (default models; of an axis models/AXIS)"
)
_ORDER = _arg("--order", type=int, default=0, help="number of real poles (default 0: chosen by BIC)")
_ROOT = _arg("--root", default="/", metavar="DIR", help="install below this directory")

GROUPS = {
    "devices": "device profiles: list, show, search, write, try",
    "recordings": "list, inspect, import, export or recover recordings",
    "plant": "start, check, show, export or linearise a plant file",
}
"""Groups of commands, such as `plant`, with their help."""

_DAEMON = (
    _command(
        "run",
        "run the daemon in the foreground (as systemd does), or its tick in simulated time",
        "thermoctl.commands:run",
        "",
        CONFIG,
        _arg("--simulated-time", action="store_true", help="run the simulated rig as fast as possible"),
        _arg("--hours", type=float, metavar="H", help="hours of rig time (with --simulated-time)"),
        _arg(
            "--no-compensation", action="store_true", help="switch compensation off (with --simulated-time)"
        ),
        _arg("--out", metavar="FILE", help="write 10 rows a second as Parquet (with --simulated-time)"),
    ),
    _command(
        "demo",
        "run the closed loop on a simulated rig with a live view; Ctrl-C stops it safely",
        "thermoctl.daemon.views.demo:demo",
        "settings seconds",
        CONFIG,
        _arg("--seconds", type=float, metavar="S", help="stop after S seconds"),
    ),
    _command(
        "start",
        "start the daemon: by its systemd unit where one is installed, else in the background",
        "thermoctl.daemon.service:start",
        "settings",
        CONFIG,
    ),
    _command(
        "stop",
        "disable the amplifier and stop the daemon",
        "thermoctl.daemon.service:stop",
        "settings",
        CONFIG,
    ),
    _command("restart", "stop, then start", "thermoctl.daemon.service:restart", "settings", CONFIG),
    _command(
        "status",
        "show state, position, compensation, temperatures, and faults with remedies; exit 1 when a fault is active",
        "thermoctl.daemon.commands:status",
        "settings json",
        CONFIG,
        _JSON,
    ),
    _command(
        "arm",
        "enable the amplifier and hold the measured position",
        "thermoctl.daemon.commands:request",
        "settings command json",
        CONFIG,
        _JSON,
    ),
    _command(
        "disarm",
        "disable the amplifier; in state FAULT: acknowledge",
        "thermoctl.daemon.commands:request",
        "settings command json",
        CONFIG,
        _JSON,
    ),
    _command(
        "reload",
        "check the configuration again and apply changed limits and gains between two ticks",
        "thermoctl.daemon.commands:request",
        "settings command json",
        CONFIG,
        _JSON,
    ),
    _command(
        "setpoint",
        "move the output to VALUE_UM at the limited rate",
        "thermoctl.daemon.commands:request",
        "settings command json value",
        _arg("value", type=float, metavar="VALUE_UM"),
        CONFIG,
        _JSON,
    ),
    _command(
        "check",
        "check a configuration with its model, plant and profiles; touches no hardware",
        "thermoctl.daemon.offline.doctor:check",
        "settings",
        _FILE,
        CONFIG,
    ),
    _command(
        "doctor",
        "connect to the devices and show every channel with value, unit and rate; drives nothing",
        "thermoctl.daemon.offline.doctor:doctor",
        "settings seconds",
        _FILE,
        CONFIG,
        _arg("--seconds", type=float, default=2.0, help="time to read for (default 2)"),
    ),
    _command(
        "devices list",
        "list the device profiles that come with the program",
        "thermoctl.devices.library:list_all",
        "",
    ),
    _command(
        "devices show",
        "show a device profile: its channels, where its facts come from, its text",
        "thermoctl.devices.library:show",
        "name",
        _arg("name", metavar="NAME"),
    ),
    _command(
        "devices search",
        "find device profiles by words: vendor, model, bus, channel; exit 1 when there is none",
        "thermoctl.devices.library:search",
        "words",
        _arg("words", nargs="+", metavar="WORD"),
    ),
    _command(
        "devices new",
        "ask for the facts of a device's manual and write its profile",
        "thermoctl.devices.new:new",
        "file",
        _arg("file", metavar="FILE"),
    ),
    _command(
        "devices probe",
        "read a device and show raw numbers, or the raw traffic of a port; drives nothing",
        "thermoctl.devices.probe:probe",
        "port profile address seconds baud",
        _arg("port", metavar="PORT"),
        _arg("--profile", default="", metavar="NAME", help="profile: a file, or a name of the library"),
        _arg("--address", type=int, metavar="N", help="unit, node id or address (default: the profile's)"),
        _arg("--seconds", type=float, default=3.0, help="longest time to read for (default 3)"),
        _arg("--baud", type=int, default=9600, help="baud rate without a profile (default 9600)"),
    ),
    _command(
        "latency",
        "show histograms of lateness and busy time, skipped ticks, and the lateness of an idle loop",
        "thermoctl.daemon.commands:latency",
        "settings json",
        CONFIG,
        _JSON,
    ),
    _command(
        "replay",
        "run a recording's inputs through the control law; exit 1 when one output bit differs",
        "thermoctl.daemon.offline.replay:command",
        "recording",
        _arg("recording", metavar="RECORDING"),
    ),
    _command(
        "virtual-rig",
        "simulate the devices of a configuration at the other end of their wires, in real time",
        "thermoctl.commands:virtual_rig",
        "settings tell",
        CONFIG,
        _arg(
            "--tell",
            metavar="LINE",
            default="",
            help="inject a fault into the running virtual rig, or clear it, as 'encoder unplug' ('help' lists all)",
        ),
    ),
    _command(
        "service",
        "install or remove the systemd unit, its user, its device rules, the manual page and the shell completions",
        "thermoctl.commands:service",
        "",
        _arg("action", choices=["install", "uninstall"]),
        CONFIG,
        _ROOT,
    ),
)

_RECORDING = (
    _command(
        "recordings list",
        "list the recordings of a folder",
        "thermoctl.recording.commands:list_recordings",
        "",
        _arg("directory", nargs="?", default="recordings", help="the folder (default recordings)"),
        _JSON,
    ),
    _command(
        "recordings info",
        "show what a recording holds: time span, signals, configuration, model",
        "thermoctl.recording.commands:show_info",
        "",
        _arg("file", help="an .arrows file"),
        _JSON,
    ),
    _command(
        "recordings export",
        "write a recording as Parquet, CSV, MDF4 or MCAP; the suffix of OUT decides",
        "thermoctl.recording.commands:export_recording",
        "",
        _arg("file", help="any recording"),
        _arg("out", help="OUT.parquet, .csv, .mf4, .mcap"),
        _arg("--columns", help="only these signals, separated by commas"),
        _arg("--from", dest="begin", type=float, default=float("-inf"), metavar="S", help="from this t"),
        _arg("--to", dest="end", type=float, default=float("inf"), metavar="S", help="before this t"),
    ),
    _command(
        "recordings import",
        "read the files of any logger and write Parquet with units; several files are parts of one recording",
        "thermoctl.recording.commands:import_recordings",
        "",
        _arg("files", nargs="+", metavar="FILE", help="CSV of any dialect, .xlsx, .mf4, .tdms, .parquet"),
        _arg("--out", required=True, metavar="OUT", help="OUT.parquet (or .csv, .arrow: without units)"),
        _TIME,
        _COLUMNS,
    ),
    _command(
        "recordings recover",
        "write a complete copy of a recording that was cut off",
        "thermoctl.recording.commands:recover_recording",
        "",
        _arg("file", help="the .arrows file"),
        _arg("--out", help="the copy (default FILE.recovered.arrows)"),
    ),
)

_PLANTS = (
    _command(
        "simulate",
        "run a plant on recorded inputs and compare",
        "thermoctl.plant.commands:simulate",
        "",
        _PLANT,
        _MAP,
        _RECORDINGS,
        _TIME,
        _COLUMNS,
        _arg(
            "--horizon",
            type=float,
            metavar="S",
            help="predict at most S seconds ahead, re-initialised from the data",
        ),
        _arg("--out", metavar="FILE", help="write time series (.csv, .parquet, .arrow)"),
        _arg("--plot", metavar="FILE", help="draw measured and simulated outputs (.png, .svg)"),
    ),
    _command(
        "refit",
        "fit a plant's parameters to recordings, inside their ranges",
        "thermoctl.plant.commands:refit",
        "",
        _PLANT,
        _MAP,
        _RECORDINGS,
        _TIME,
        _COLUMNS,
        _arg("--out", metavar="PLANT2", help="write the refitted plant"),
        _arg("--held-out", nargs="+", metavar="REC", help="recordings for validation; not used in the fit"),
        _arg(
            "--noise",
            choices=["white", "ar1"],
            default="white",
            help="noise model (default white; ar1 is estimated)",
        ),
        _arg(
            "--tries",
            type=int,
            default=0,
            metavar="N",
            help="random starting points in the ranges (default 0)",
        ),
    ),
    _command(
        "plant check",
        "read plant files with every check; with --data compare one with recordings, in seconds",
        "thermoctl.checks.commands:check",
        "",
        _arg("plants", nargs="+", metavar="PLANT"),
        _MAP,
        _arg(
            "--data",
            nargs="+",
            metavar="REC",
            help="recordings to check with the plant; exit 1 on a severe fault",
        ),
        _TIME,
        _COLUMNS,
    ),
    _command(
        "plant new",
        "write a first plant file: from a recording of temperatures, or from a template",
        "thermoctl.plant.new:new",
        "",
        _arg("file", metavar="FILE", help="the plant file to write"),
        _arg(
            "--from-csv",
            metavar="REC",
            help="a recording: one body for each thermometer, links to be confirmed",
        ),
        _arg(
            "--inputs", metavar="A,B", help="columns of inputs (default: powers, and the air's temperature)"
        ),
        _arg("--outputs", metavar="A,B", help="columns of sensors (default: the other temperatures)"),
        _TIME,
        _COLUMNS,
        _arg(
            "--template", metavar="NAME", help="block, motor, hot-end, room, tank, stage, flexure or actuator"
        ),
    ),
    _command(
        "plant show",
        "print a plant as tables, or draw its network",
        "thermoctl.plant.commands:show",
        "",
        _arg("plant", metavar="PLANT"),
        _arg("--out", metavar="FILE", help="draw to FILE.svg or FILE.png instead"),
    ),
    _command(
        "plant export",
        "write a plant for other programs: FMU, Modelica, Python, C, Simulink",
        "thermoctl.export.commands:export",
        "",
        _arg("plant", metavar="PLANT"),
        _arg(
            "--to",
            required=True,
            choices=["fmu", "modelica", "python", "c", "simulink-m"],
            help="the language",
        ),
        _arg("--out", metavar="FILE", help="the file (default: the plant's name with the language's ending)"),
        _arg(
            "--data",
            metavar="REC",
            help="a recording: first readings, this recording's parameters, and the widths of jumps",
        ),
        _TIME,
        _COLUMNS,
    ),
    _command(
        "plant linearise",
        "make the compensator's model from a thermal plant",
        "thermoctl.identify.commands:linearise",
        "",
        _arg("plant", metavar="PLANT"),
        _arg("--out", metavar="MODEL", help="the model file"),
        _arg("--replace", action="store_true", help="overwrite MODEL"),
        _arg("--rig", default="simulated", metavar="NAME", help="name of the rig (default simulated)"),
        _arg(
            "--points", metavar="FILE", help="rig file or points file with the points (default: the paper's)"
        ),
        _arg("--period", type=float, default=0.001, metavar="S", help="the loop's period (default 0.001)"),
        _arg(
            "--sensor-period",
            type=float,
            default=0.1,
            metavar="S",
            help="the thermocouple's sampling period (default 0.1)",
        ),
        _arg(
            "--kind",
            choices=["kalman", "mkf"],
            default="kalman",
            help="steady Kalman gain (default), or the paper's modified Kalman filter",
        ),
        _arg(
            "--heat-density",
            type=float,
            default=0.05,
            metavar="Q",
            help="spectral density of each body's unknown heat, W^2 s (default 0.05)",
        ),
        _arg("--gains", metavar="FILE", help="also write the time-varying gain on the coil's innovation"),
        _arg("--samples", type=int, default=2000, metavar="N", help="rows of --gains (default 2000)"),
    ),
)

_CALIBRATION = (
    _command(
        "experiment",
        "run and record a test of experiments.yaml, or an experiment file such as a diagnosis proposes",
        "thermoctl.calibration.commands:run_experiment",
        "name config out dry_run resume plant yes",
        _arg("name", metavar="NAME|FILE", help="a test of experiments.yaml, or a file with one experiment"),
        CONFIG,
        _arg(
            "--plant",
            metavar="PLANT",
            help="simulate this plant file instead of the rig, for inputs that the daemon cannot drive",
        ),
        _arg("--out", metavar="FILE", help="recording (.parquet, .csv, .arrow; default NAME.parquet)"),
        _arg("--dry-run", action="store_true", help="show schedule, power and spectrum; drive nothing"),
        _arg("--resume", action="store_true", help="continue an aborted recording"),
        _YES,
    ),
    _command(
        "identify",
        "make a calibration from the recordings of tests 2, 3 and 4A, in the folder of calibrations",
        "thermoctl.calibration.commands:identify",
        "test_2 test_3 test_4a config models method order",
        _arg("test_2", metavar="TEST_2"),
        _arg("test_3", metavar="TEST_3"),
        _arg("test_4a", metavar="TEST_4A"),
        CONFIG,
        _MODELS,
        _arg(
            "--method",
            choices=("better", "paper"),
            default="better",
            help="compensator: ours, or the paper's (default better)",
        ),
        _ORDER,
    ),
    _command(
        "model",
        "list, show or roll back calibrations",
        "thermoctl.calibration.commands:model",
        "action models name",
        _arg("action", choices=("list", "show", "rollback")),
        _arg("name", nargs="?", metavar="NAME"),
        _MODELS,
    ),
    _command(
        "tune",
        "propose PID gains from the closed loop's response to setpoint ramps of a few um; asks, then arms the rig with "
        "all protections",
        "thermoctl.calibration.commands:tune",
        "config method write yes",
        CONFIG,
        _arg(
            "--method",
            choices=("imc", "zn"),
            default="imc",
            help="imc: lambda tuning with a phase margin of 45 deg and a gain margin of 2 (default); "
            "zn: Ziegler-Nichols, Table I of the paper",
        ),
        _arg("--write", action="store_true", help="write the proposal into the configuration"),
        _YES,
    ),
    _command(
        "evaluate",
        "compute the ISO 230-2 figures of recordings with a reference encoder",
        "thermoctl.calibration.commands:evaluate",
        "recordings",
        _arg("recordings", nargs="+", metavar="RECORDING"),
    ),
    _command(
        "reproduce",
        "run the paper's tests on simulated rigs; report the paper's numbers, ours by its method, and ours by the better "
        "method",
        "thermoctl.reproduction.commands:reproduce",
        "config plant out seeds quick",
        _arg(
            "--config",
            metavar="FILE",
            default="config/simulated.yaml",
            help="the simulated rig (default config/simulated.yaml)",
        ),
        _arg(
            "--plant",
            metavar="FILE",
            default="config/plants/actuator_truth.yaml",
            help="plant file of the simulated hardware (default config/plants/actuator_truth.yaml)",
        ),
        _arg(
            "--out",
            metavar="DIR",
            default="out/reproduce",
            help="folder of the report (default out/reproduce)",
        ),
        _arg("--seeds", type=int, default=12, help="number of simulated rigs (default 12)"),
        _arg("--quick", action="store_true", help="leave out the full run at the loop's period"),
    ),
)

_DIAGNOSIS = (
    _command(
        "noise",
        "learn each sensor's own noise from quiet recordings; write the plant file with it",
        "thermoctl.diagnose.sensor_noise:command",
        "",
        _PLANT,
        _RECORDINGS,
        _arg("--out", required=True, metavar="PLANT2", help="the plant file to write"),
    ),
    _command(
        "diagnose",
        "find where simulation and recordings differ, which physics is missing, and what adding it gains",
        "thermoctl.commands:diagnose",
        "",
        _arg(
            "recordings",
            nargs="*",
            metavar="REC",
            help="recordings (.csv, .xlsx, .parquet, .arrow) or patterns of them ('runs/*.csv'), or folders of many rigs' "
            "recordings: one diagnosis a rig",
        ),
        _arg(
            "--together",
            action="store_true",
            help="with folders: all recordings in them are of one rig, for one diagnosis",
        ),
        _arg("--plant", metavar="FILE", help="the plant file, or an FMU"),
        _MAP,
        _arg(
            "--held-out",
            action="append",
            metavar="REC",
            help="recording that takes no part in any choice and measures what the findings are worth (repeatable; "
            "default: the last of three or more)",
        ),
        _TIME,
        _COLUMNS,
        _arg(
            "--anyway",
            action="store_true",
            help="diagnose although the checks of the data found a severe fault",
        ),
        _arg(
            "--out",
            metavar="DIR",
            help="folder of diagnosis.json, plant.yaml and report.html (with folders: DIR/RIG)",
        ),
        _arg(
            "--continue",
            dest="continued",
            metavar="DIR",
            help="go on from the diagnosis in DIR with recordings that it has not seen, without its old ones",
        ),
        _arg("--explain", metavar="DIR", help="print in ten lines the reasons of the diagnosis in DIR"),
        _arg(
            "--last",
            type=int,
            default=2,
            metavar="N",
            help="with folders: use each rig's newest N recordings (default 2)",
        ),
        _arg("--workers", type=int, metavar="N", help="with folders: local processes (default one a core)"),
        _arg(
            "--scheduler",
            metavar="ADDRESS",
            help="a Dask scheduler (tcp://...): its workers compute by recording; with folders by rig, from the same files",
        ),
        _EFFECTS,
        _arg(
            "--drive",
            action="append",
            metavar="INPUT",
            help="an input that the next experiment may drive (repeatable; default: inputs that changed in the "
            "recordings, except the surroundings)",
        ),
        _arg(
            "--limit",
            action="append",
            metavar="NAME=LOW:HIGH",
            help="range of an input or output in the next experiment (repeatable; default: the recorded range)",
        ),
        _arg(
            "--live",
            action="store_true",
            help="use the daemon's own recordings (--config) from the time when its model no longer fits",
        ),
        _arg("--hours", type=float, default=4.0, metavar="H", help="with --live: how far back (default 4)"),
        _arg(
            "--resolve",
            action="store_true",
            help="run the next experiment on the rig, then diagnose with its data",
        ),
        _YES,
        _arg(
            "--rounds",
            type=int,
            default=3,
            metavar="N",
            help="with --resolve: at most N experiments (default 3)",
        ),
        _arg("--rig", metavar="PLANT", help="with --resolve: simulate this plant file instead of the rig"),
        CONFIG,
        _arg("--json", action="store_true", help="print the result as JSON"),
        _arg("--quiet", action="store_true", help="print neither progress nor summary"),
    ),
    _command(
        "plan",
        "say what a diagnosis could see with a plant, its sensors and an experiment: effects, parameters, a better course",
        "thermoctl.advice.commands:plan_experiment",
        "",
        _PLANT,
        _MAP,
        _arg(
            "--like",
            action="append",
            metavar="REC",
            help="a recording with the inputs and times of the experiment (repeatable); its readings do not count",
        ),
        _arg(
            "--limit",
            action="append",
            metavar="NAME=LOW:HIGH",
            help="range of an input that can be driven; without --like it goes through levels (repeatable)",
        ),
        _TIME,
        _COLUMNS,
        _EFFECTS,
        _JSON,
    ),
    _command(
        "effects",
        "list the catalogue of effects, show one (`effects show NAME`), check files of your own (`effects check FILE`), "
        "or save the law of a diagnosis as one (`effects save DIR NAME`)",
        "thermoctl.commands:effects",
        "",
        _arg("action", nargs="?", metavar="show|check|save"),
        _arg(
            "files",
            nargs="*",
            metavar="NAME|FILE|DIR",
            help="an effect's name; files or folders of effects; a diagnosis and a name",
        ),
        _arg(
            "--plant",
            metavar="PLANT",
            help="with check: a plant to put the effects into (default: the shipped ones)",
        ),
        _EFFECTS,
    ),
    _command(
        "prove",
        "diagnose a folder of cases, compare with the answers, score",
        "thermoctl.proof.commands:prove",
        "",
        _arg(
            "cases",
            nargs="?",
            metavar="CASES",
            help="folder of cases: plant.yaml and recordings each (with --real: of real recordings)",
        ),
        _arg("--out", required=True, metavar="DIR", help="folder of the results"),
        _arg(
            "--answers", metavar="DIR", help="folder of NAME.yaml files (default: answer.yaml of each case)"
        ),
        _arg("--number", type=int, metavar="N", help="only the first N cases"),
        _arg("--workers", type=int, metavar="N", help="local processes (default: one a core)"),
        _arg("--scheduler", metavar="ADDRESS", help="a Dask scheduler (tcp://...) that sees the same files"),
        _arg(
            "--real",
            action="store_true",
            help="real recordings: effects found, strays, held-out error (default folder: $THERMOCTL_RECORDINGS)",
        ),
    ),
)

_PEOPLE = (
    _command(
        "dashboard",
        "serve the rig's page for the browser: read-only and on this machine only, unless options say otherwise",
        "thermoctl.daemon.views.dashboard:serve",
        "settings listen commands metrics token_file rate name",
        CONFIG,
        _arg(
            "--listen",
            metavar="ADDRESS:PORT",
            default="127.0.0.1:8765",
            help="address to serve on (default %(default)s); beyond this machine reading needs the token, too",
        ),
        _arg("--commands", action="store_true", help="accept arm, disarm and setpoint, with the token"),
        _arg("--metrics", action="store_true", help="serve Prometheus metrics at /metrics"),
        _arg(
            "--token-file",
            metavar="FILE",
            help="file of the token (else $THERMOCTL_DASHBOARD_TOKEN, else a new one is printed)",
        ),
        _arg("--rate", type=float, default=20.0, metavar="HZ", help="frames a second, 1 to 50 (default 20)"),
        _arg(
            "--name",
            action="append",
            default=[],
            metavar="HOST",
            help="accepted host name in requests (repeatable)",
        ),
    ),
    _command(
        "monitor",
        "show the rig in the terminal, for instance over ssh; gives no commands",
        "thermoctl.daemon.views.monitor:show",
        "settings interval once",
        CONFIG,
        _arg(
            "--interval",
            type=float,
            default=0.5,
            metavar="S",
            help="seconds between two updates (default 0.5)",
        ),
        _arg(
            "--once",
            action="store_true",
            help="print one screen; exit 1 when no daemon runs or a fault is active",
        ),
    ),
    _command(
        "mqtt",
        "publish state, faults and availability to an MQTT broker; accepts no commands",
        "thermoctl.daemon.views.mqtt:publish",
        "settings broker topic rate user password_file tls",
        CONFIG,
        _arg("--broker", required=True, metavar="HOST[:PORT]", help="the broker"),
        _arg(
            "--topic", default="", metavar="TOPIC", help="first part of every topic (default thermoctl/RIG)"
        ),
        _arg("--rate", type=float, default=1.0, metavar="HZ", help="messages a second (default 1)"),
        _arg("--user", default="", metavar="NAME", help="the broker's user name"),
        _arg("--password-file", metavar="FILE", help="file of the user's password"),
        _arg("--tls", action="store_true", help="encrypt, with the system's certificates"),
    ),
    _command(
        "calibrate",
        "doctor, step, PID, tests, model and proof in one guided run; continues where it was ended; writes only into its "
        "folder until it is accepted",
        "thermoctl.calibration.commands:calibrate",
        "config out models order gains accept again yes",
        CONFIG,
        _arg("--out", metavar="DIR", help="the calibration's folder (default calibration/RIG)"),
        _MODELS,
        _ORDER,
        _arg("--gains", action="store_true", help="on acceptance also write the proposed PID gains"),
        _arg("--accept", action="store_true", help="install the model when the proof is done"),
        _arg("--again", action="store_true", help="discard an earlier run in the folder"),
        _YES,
    ),
    _command(
        "fleet",
        "summarise many rigs' recordings: health, drift of parameters, models that no longer fit; exit 1 when one needs "
        "attention",
        "thermoctl.fleet.commands:fleet",
        "folder plant parameters workers scheduler json",
        _arg("folder", metavar="FOLDER", help="a folder, or a path in an object store as s3://BUCKET/RIGS"),
        _arg("--plant", metavar="FILE", help="plant file to compare the recordings with"),
        _arg("--parameters", default="", metavar="A,B", help="the plant's parameters to follow over time"),
        _arg(
            "--workers",
            type=int,
            default=0,
            metavar="N",
            help="local Dask processes (default 0: this process)",
        ),
        _arg("--scheduler", metavar="ADDRESS", help="a Dask cluster"),
        _JSON,
    ),
    _command(
        "report",
        "write one archive for a question to others: versions, configuration, log, the end of the newest recording",
        "thermoctl.support:report",
        "settings out seconds",
        CONFIG,
        _arg(
            "--out",
            default="thermoctl-report.zip",
            metavar="FILE",
            help="the archive (default thermoctl-report.zip)",
        ),
        _arg("--seconds", type=float, default=60.0, metavar="S", help="of the newest recording (default 60)"),
    ),
    _command(
        "init",
        "copy configurations, device profiles, plants and examples into a folder, to start from",
        "thermoctl.shipped:init",
        "folder",
        _arg("folder", nargs="?", default=".", metavar="DIR", help="the folder (default: this one)"),
    ),
    _command(
        "completion",
        "print the shell's completion script; source it",
        "thermoctl.manual:completion",
        "parser shell",
        _arg("shell", choices=["bash", "zsh", "tcsh"]),
    ),
    _command(
        "manual",
        "show the manual page, or install it with the shell completions",
        "thermoctl.manual:command",
        "parser action root",
        _arg("action", nargs="?", choices=["show", "install", "uninstall"], default="show"),
        _ROOT,
    ),
)

COMMANDS = (*_DAEMON, *_RECORDING, *_PLANTS, *_CALIBRATION, *_DIAGNOSIS, *_PEOPLE)


def call(command: Command, args: argparse.Namespace) -> int:
    """Run a command with its parsed arguments; return its exit status."""
    module, _, name = command.function.partition(":")
    function = getattr(importlib.import_module(module), name)
    takes = command.takes.split()
    if "settings" in takes:
        from thermoctl.configuration.settings import load_rig, load_settings

        each = command.name in EACH_AXIS and "#" not in args.config
        whole = each or command.name in WHOLE_RIG and "#" not in args.config
        args.settings = load_rig(args.config) if whole else load_settings(args.config)
        if each and args.settings.axes:
            return _each_axis(function, takes, args)
    return (function(*(getattr(args, t) for t in takes)) if takes else function(args)) or 0


EACH_AXIS = frozenset({"status", "disarm", "reload", "latency"})
"""Commands that, without --axis, do their work for every axis of a rig, one after the other."""
ALL_AXES = frozenset({"start", "stop", "restart", "virtual-rig", "service"})
"""Commands that act on the whole rig: they take no --axis."""
WHOLE_RIG = ALL_AXES | {"check", "doctor"}
"""Commands that take a whole rig; --axis names one for `check` and `doctor`."""


def takes_axis(command: Command) -> bool:
    """Return whether a command takes --axis."""
    return CONFIG in command.arguments and command.name not in ALL_AXES


def _each_axis(function: Any, takes: list[str], args: argparse.Namespace) -> int:
    """Run a command for every axis; return the largest exit status."""
    found = []
    for part in args.settings.axes:
        args.settings = part
        if not getattr(args, "json", False):
            print(f"axis {part.axis}:", flush=True)
        found.append(function(*(getattr(args, t) for t in takes)) or 0)
    return max(found)


# Commands that join the work of two packages.


def run(args: argparse.Namespace) -> int:
    """Run the daemon in the foreground, or its tick in simulated time."""
    from thermoctl.configuration.settings import load_rig, load_settings

    if args.hours is None:
        from thermoctl.daemon import supervisor
        from thermoctl.yamlfile import InputError

        if args.axis:
            raise InputError(
                "run: --axis goes with --simulated-time and --hours; the daemon runs all axes of a rig"
            )

        return supervisor.run(load_rig(args.config))
    from thermoctl.daemon.offline.simulate import trapezoids

    return trapezoids(load_settings(args.config), args.hours, not args.no_compensation, args.out)


def virtual_rig(settings: Any, line: str) -> int:
    """Simulate the devices of a configuration, or send `line` to a running virtual rig."""
    from thermoctl.yamlfile import InputError
    from thermoctl_hal.virtual.rig import main

    if settings.hal.backend != "devices":
        raise InputError(
            f"{settings.path}: no devices to simulate: hal.backend is '{settings.hal.backend}'; "
            "give --config config/wire.yaml"
        )
    return int(main(settings, line))


def service(args: argparse.Namespace) -> int:
    """Install or remove the unit. Removing the last unit removes manual page and completions, too."""
    from thermoctl import manual
    from thermoctl.daemon.service import install, uninstall, units

    root, config = Path(args.root), Path(args.config) if args.config else None
    if args.action == "install":
        return install(config or Path(), root) or manual.command(args.parser, "install", args.root)
    if (done := uninstall(config, root)) or units(root):
        return done
    return manual.command(args.parser, "uninstall", args.root)


def effects(args: argparse.Namespace) -> int:
    """List the catalogue of effects, show one, or check effect files."""
    if args.action == "check":
        from thermoctl.advice.commands import check_effects

        return check_effects(args)
    from thermoctl.diagnose import commands

    args.name = args.files[0] if args.files else None
    return commands.effects(args)


def diagnose(args: argparse.Namespace) -> int:
    """Diagnose recordings, folders of rigs or a live rig; with --resolve the experiments run on the rig."""
    from thermoctl.diagnose import commands
    from thermoctl.yamlfile import InputError

    if args.explain:
        return commands.diagnose(args)
    for value, option in ((args.plant, "--plant FILE"), (args.out, "--out DIR")):
        if not value:
            raise InputError(f"diagnose: {option} is missing; --plant, --out and recordings were expected")
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

    args.record = record
    return commands.diagnose(args)
