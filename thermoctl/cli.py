"""The command line. Each command is declared here and done in its room; rooms are imported when a command is called.

Exit status: 0 done; 1 the answer is no (a check failed, the daemon is not running, a fault stands); 2 unusable input
(one line on stderr says what, where, what was expected); 3 the hardware or the system refused; 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from thermoctl import __version__, which_rig
from thermoctl.yamlfile import InputError

for _name in (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
):  # before numpy is: two BLAS threads on busy cores wait for each other
    os.environ.setdefault(_name, "1")

DESCRIPTION = """\
Holds the output of a precision linear actuator where it belongs while its coil heats up, and says what physics a
simulation left out when it disagrees with a recording.

Exit status: 0 done; 1 the answer is no (a check failed, the daemon is not running, a fault stands); 2 unusable input (one
line on stderr says what, where, what was expected); 3 the hardware or the system refused; 130 interrupted."""


YES = (
    "--yes",
    {"action": "store_true", "help": "start without asking; without a terminal a rig moves only with it"},
)


def _add(
    sub: argparse._SubParsersAction,
    name: str,
    help: str,
    run: Callable[[argparse.Namespace], int | None],
    *arguments: tuple,
) -> argparse.ArgumentParser:
    """One command: `arguments` are (flags..., options) as add_argument takes them; `run` gets the parsed namespace."""
    parser = sub.add_parser(name, help=help, description=help)
    for *flags, options in arguments:
        parser.add_argument(*flags, **options)
    parser.set_defaults(run=run)
    return parser


CONFIG = (
    "--config",
    {
        "metavar": "FILE",
        "help": "configuration (else $THERMOCTL_CONFIG, config/simulated.yaml, /etc/thermoctl/rig.yaml)",
    },
)
"""The option of every command that means a rig; `main` puts the file found by `which_rig.find_config` into it."""


def _with(
    run: Callable[[argparse.Namespace, str], int | None], name: str
) -> Callable[[argparse.Namespace], int | None]:
    """A handler that is told its command's name."""
    return lambda args: run(args, name)


def _plant_commands(sub: argparse._SubParsersAction) -> None:
    """simulate, refit, plant show, plant linearise, plant check."""

    def to(name: str) -> Callable[[argparse.Namespace], int | None]:
        def run(args: argparse.Namespace) -> int | None:
            from thermoctl.plant import commands

            return getattr(commands, name)(args)

        return run

    def linearise(args: argparse.Namespace) -> int | None:
        from thermoctl.identify import commands

        return commands.linearise(args)

    plant = ("--plant", {"required": True, "metavar": "PLANT", "help": "the plant file"})
    recordings = (
        "recordings",
        {"nargs": "+", "metavar": "REC", "help": "recordings (.csv, .parquet, .arrow, .mf4, .tdms)"},
    )
    _add(
        sub,
        "simulate",
        "run a plant on recorded inputs and compare",
        to("simulate"),
        plant,
        recordings,
        (
            "--horizon",
            {
                "type": float,
                "metavar": "S",
                "help": "predict at most S seconds ahead, re-initialised from the data",
            },
        ),
        ("--out", {"metavar": "FILE", "help": "write time series (.csv, .parquet, .arrow)"}),
        ("--plot", {"metavar": "FILE", "help": "draw measured and simulated outputs (.png, .svg)"}),
    )
    _add(
        sub,
        "refit",
        "fit a plant's parameters to recordings, inside their ranges",
        to("refit"),
        plant,
        recordings,
        ("--out", {"metavar": "PLANT2", "help": "write the refitted plant"}),
        ("--held-out", {"nargs": "+", "metavar": "REC", "help": "recordings that take no part, to judge by"}),
        (
            "--noise",
            {
                "choices": ["white", "ar1"],
                "default": "white",
                "help": "the noise's colour (white); ar1 is measured",
            },
        ),
        (
            "--tries",
            {"type": int, "default": 0, "metavar": "N", "help": "further starts drawn over the ranges (0)"},
        ),
    )
    own = sub.add_parser("plant", help="check, show or linearise a plant file").add_subparsers(
        metavar="WHAT", required=True
    )
    _add(
        own,
        "check",
        "read plant files with every check",
        to("check"),
        ("plants", {"nargs": "+", "metavar": "PLANT"}),
    )
    _add(
        own,
        "show",
        "print a plant as tables, or draw its network",
        to("show"),
        ("plant", {"metavar": "PLANT"}),
        ("--out", {"metavar": "FILE", "help": "draw to FILE.svg or FILE.png instead"}),
    )
    _add(
        own,
        "linearise",
        "make the compensator's model from a thermal plant",
        linearise,
        ("plant", {"metavar": "PLANT"}),
        ("--out", {"metavar": "MODEL", "help": "the model file"}),
        ("--replace", {"action": "store_true", "help": "overwrite MODEL"}),
        ("--rig", {"default": "simulated", "metavar": "NAME", "help": "the rig that it is for (simulated)"}),
        ("--period", {"type": float, "default": 0.001, "metavar": "S", "help": "the loop's period (0.001)"}),
        (
            "--sensor-period",
            {"type": float, "default": 0.1, "metavar": "S", "help": "the thermocouple's period (0.1)"},
        ),
        (
            "--kind",
            {
                "choices": ["kalman", "mkf"],
                "default": "kalman",
                "help": "steady Kalman gain, or the paper's MKF",
            },
        ),
        (
            "--heat-density",
            {"type": float, "default": 0.05, "metavar": "Q", "help": "unknown heat of a body, W^2 s (0.05)"},
        ),
        ("--gains", {"metavar": "FILE", "help": "also write the time-varying gain to the coil's innovation"}),
        ("--samples", {"type": int, "default": 2000, "metavar": "N", "help": "how many of them (2000)"}),
    )


def _virtual_rig(config: str, line: str) -> int:
    from hal.virtual.rig import main
    from thermoctl.settings import load_settings

    settings = load_settings(config)
    if settings.hal.backend != "devices":
        raise InputError(
            f"{config}: no devices to play: hal.backend is '{settings.hal.backend}'; give --config config/wire.yaml"
        )
    return main(settings, line)


def _daemon_commands(sub: argparse._SubParsersAction) -> None:
    """run, demo, start, stop, restart, status, arm, disarm, setpoint, reload, check, doctor, latency, virtual-rig."""
    as_json = ("--json", {"action": "store_true", "help": "one JSON object, for programs"})
    file = ("file", {"nargs": "?", "metavar": "CONFIG", "help": "the same as --config CONFIG"})

    def room():
        from thermoctl.daemon import client

        return client

    def service(args: argparse.Namespace) -> int:
        from thermoctl import manual
        from thermoctl.daemon.service import units

        done = room().service_files(args.action, args.config, args.root)
        if done or (args.action == "uninstall" and units(Path(args.root))):
            return done  # manual page and completions go with the last unit
        return manual.manual(parser(), args.action, args.root)

    run = _add(
        sub,
        "run",
        "the daemon in the foreground (what systemd starts), or its tick in simulated time",
        lambda a: (
            room().run(a.config)
            if a.hours is None
            else room().run_simulated_time(a.config, a.hours, a.no_compensation, a.out)
        ),
        CONFIG,
    )
    run.add_argument(
        "--simulated-time", action="store_true", help="no clock: run the simulated rig as fast as it goes"
    )
    run.add_argument("--hours", type=float, metavar="H", help="hours of rig time (with --simulated-time)")
    run.add_argument("--no-compensation", action="store_true", help="for comparison (with --simulated-time)")
    run.add_argument(
        "--out", metavar="FILE", help="write the rows, 10 a second, as Parquet (with --simulated-time)"
    )
    _add(
        sub,
        "demo",
        "the closed loop on the simulated rig with a live view; Ctrl-C stops safely",
        lambda a: room().demo(a.config, a.seconds),
        CONFIG,
        ("--seconds", {"type": float, "metavar": "S", "help": "stop by itself after S seconds"}),
    )
    for action, help in (
        ("start", "start the daemon: by systemd where its unit is installed, else in the background"),
        ("stop", "stop it; the amplifier is disabled first"),
        ("restart", "stop, then start"),
    ):
        _add(sub, action, help, _with(lambda a, name: room().service(a.config, name), action), CONFIG)
    _add(
        sub,
        "status",
        "state, position, compensation, temperatures, faults with remedies; exit 1 when a fault stands",
        lambda a: room().status(a.config, a.json),
        CONFIG,
        as_json,
    )
    for command, help in (
        ("arm", "enable the amplifier, holding the measured position"),
        ("disarm", "disable the amplifier; in FAULT: acknowledge"),
        ("reload", "validate the configuration and apply it between two ticks"),
    ):
        _add(
            sub,
            command,
            help,
            _with(lambda a, name: room().request(a.config, name, None, a.json), command),
            CONFIG,
            as_json,
        )
    _add(
        sub,
        "setpoint",
        "move the output to VALUE_UM at the limited rate",
        lambda a: room().request(a.config, "setpoint", a.value, a.json),
        ("value", {"type": float, "metavar": "VALUE_UM"}),
        CONFIG,
        as_json,
    )
    _add(
        sub,
        "check",
        "validate a configuration with its model, plant and profiles; touches no hardware",
        lambda a: room().check(a.config),
        file,
        CONFIG,
    )
    _add(
        sub,
        "doctor",
        "connect, read every channel, show values with units and rates; drives nothing",
        lambda a: room().doctor(a.config, a.seconds),
        file,
        CONFIG,
        ("--seconds", {"type": float, "default": 2.0, "help": "how long to read (default 2)"}),
    )
    _add(
        sub,
        "latency",
        "histogram of lateness and busy time, slips, and an idle loop's beside it",
        lambda a: room().latency(a.config, a.json),
        CONFIG,
        as_json,
    )
    _add(
        sub,
        "replay",
        "run a recording's inputs through the law; exit 1 when one output bit differs",
        lambda a: room().replay(a.recording),
        ("recording", {"metavar": "RECORDING"}),
    )
    _add(
        sub,
        "virtual-rig",
        "play the devices of a configuration at the other end of their wires, in real time",
        lambda a: _virtual_rig(a.config, a.tell),
        CONFIG,
        (
            "--tell",
            {
                "metavar": "LINE",
                "default": "",
                "help": "tell a running one to break or mend something, as "
                "'encoder unplug' ('help' lists all)",
            },
        ),
    )
    _add(
        sub,
        "service",
        "install or remove the systemd unit, its user, its device rules, the manual page and the shells' completions",
        service,
        ("action", {"choices": ["install", "uninstall"]}),
        CONFIG,
        ("--root", {"default": "/", "metavar": "DIR", "help": "install below this directory"}),
    )


def _recording_commands(sub: argparse._SubParsersAction) -> None:
    """recordings list, info, export, recover."""

    def to(name: str) -> Callable[[argparse.Namespace], int | None]:
        def run(args: argparse.Namespace) -> int | None:
            from thermoctl.recording import commands

            return getattr(commands, name)(args)

        return run

    top = sub.add_parser("recordings", help="list, look into, export or mend recordings")
    own = top.add_subparsers(metavar="WHAT", required=True)
    json_too = ("--json", {"action": "store_true", "help": "for programs"})
    _add(
        own,
        "list",
        "the recordings of a folder",
        to("list_recordings"),
        ("directory", {"nargs": "?", "default": "recordings", "help": "the folder (recordings)"}),
        json_too,
    )
    _add(
        own,
        "info",
        "what a recording holds: span, signals, configuration, model",
        to("show_info"),
        ("file", {"help": "an .arrows file"}),
        json_too,
    )
    _add(
        own,
        "export",
        "write a recording as Parquet, CSV, MDF4 or MCAP; the suffix of OUT decides",
        to("export_recording"),
        ("file", {"help": "any recording"}),
        ("out", {"help": "OUT.parquet, .csv, .mf4, .mcap"}),
        ("--columns", {"help": "only these signals, separated by commas"}),
        (
            "--from",
            {"dest": "begin", "type": float, "default": float("-inf"), "metavar": "S", "help": "from this t"},
        ),
        (
            "--to",
            {"dest": "end", "type": float, "default": float("inf"), "metavar": "S", "help": "before this t"},
        ),
    )
    _add(
        own,
        "recover",
        "write a closed copy of a recording that was cut",
        to("recover_recording"),
        ("file", {"help": "the .arrows file"}),
        ("--out", {"help": "the copy (FILE.recovered.arrows)"}),
    )


def _identify_commands(sub: argparse._SubParsersAction) -> None:
    """experiment, identify, model, tune, evaluate, reproduce."""

    def package():
        from thermoctl.calibration import commands

        return commands

    def reproduce(args: argparse.Namespace) -> int:
        from thermoctl.reproduction import commands

        return commands.reproduce(args.config, args.plant, args.out, args.seeds, args.quick)

    _add(
        sub,
        "experiment",
        "run a test of experiments.yaml, or an experiment file such as a diagnosis proposes, and record it",
        lambda a: package().run_experiment(a.name, a.config, a.out, a.dry_run, a.resume, a.plant, a.yes),
        (
            "name",
            {
                "metavar": "NAME|FILE",
                "help": "a test of experiments.yaml, or a file of experiments with one in it",
            },
        ),
        CONFIG,
        (
            "--plant",
            {
                "metavar": "PLANT",
                "help": "a plant file in the rig's place, for inputs that the daemon does not command",
            },
        ),
        ("--out", {"metavar": "FILE", "help": "recording (.parquet, .csv, .arrow); default NAME.parquet"}),
        (
            "--dry-run",
            {"action": "store_true", "help": "show schedule, power and spectrum figures; drive nothing"},
        ),
        ("--resume", {"action": "store_true", "help": "go on where an aborted recording ends"}),
        YES,
    )
    _add(
        sub,
        "identify",
        "calibrate from the recordings of tests 2, 3 and 4A; the calibration goes into the machine's own folder",
        lambda a: package().identify(a.test_2, a.test_3, a.test_4a, a.config, a.models, a.method, a.order),
        ("test_2", {"metavar": "TEST_2"}),
        ("test_3", {"metavar": "TEST_3"}),
        ("test_4a", {"metavar": "TEST_4A"}),
        CONFIG,
        (
            "--models",
            {"metavar": "DIR", "default": "models", "help": "folder of calibrations (default models)"},
        ),
        (
            "--method",
            {
                "choices": ("better", "paper"),
                "default": "better",
                "help": "which compensator (default better)",
            },
        ),
        ("--order", {"type": int, "default": 0, "help": "number of real poles (0, the default: by BIC)"}),
    )
    model = _add(
        sub,
        "model",
        "list, show or roll back calibrations",
        lambda a: package().model(a.action, a.models, a.name),
        ("action", {"choices": ("list", "show", "rollback")}),
        ("name", {"nargs": "?", "metavar": "NAME"}),
    )
    model.add_argument(
        "--models", metavar="DIR", default="models", help="folder of calibrations (default models)"
    )
    _add(
        sub,
        "tune",
        "propose PID gains from the closed loop's answer to setpoint ramps of a few um; arms the rig, with all protections, after a "
        "question",
        lambda a: package().tune(a.config, a.method, a.write, a.yes),
        CONFIG,
        (
            "--method",
            {
                "choices": ("imc", "zn"),
                "default": "imc",
                "help": "imc: lambda tuning with a phase margin of 45 deg and a gain margin of 2 (default); "
                "zn: Ziegler-Nichols, Table I of the paper",
            },
        ),
        ("--write", {"action": "store_true", "help": "write the proposal into the configuration"}),
        YES,
    )
    _add(
        sub,
        "evaluate",
        "ISO 230-2 figures of recordings with a reference encoder",
        lambda a: package().evaluate(a.recordings),
        ("recordings", {"nargs": "+", "metavar": "RECORDING"}),
    )
    _add(
        sub,
        "reproduce",
        "the paper's tests on simulated rigs: one report with the paper's numbers, ours by its method, ours by the better one",
        reproduce,
        (
            "--config",
            {
                "metavar": "FILE",
                "default": "config/simulated.yaml",
                "help": "the simulated rig (config/simulated.yaml)",
            },
        ),
        ("--plant", {"metavar": "FILE", "default": "config/plants/actuator_truth.yaml", "help": "the truth"}),
        ("--out", {"metavar": "DIR", "default": "out/reproduce", "help": "default out/reproduce"}),
        ("--seeds", {"type": int, "default": 12, "help": "rigs (default 12)"}),
        ("--quick", {"action": "store_true", "help": "without the full run at the loop's period"}),
    )


def _diagnose_commands(sub: argparse._SubParsersAction) -> None:
    """diagnose, prove, demo-concealed, effects."""

    def diagnose(args: argparse.Namespace) -> int:
        from thermoctl.diagnose import commands

        if args.live:
            from thermoctl.fleet.commands import live_recordings

            args.recordings = live_recordings(args)
            if not args.recordings:
                return 0
        if any(Path(r).is_dir() for r in args.recordings):
            from thermoctl.fleet.commands import diagnose_folders

            return diagnose_folders(args)

        def record(experiment: Path, recording: Path) -> None:  # the rig is another package's business
            from thermoctl.calibration.commands import record

            record(experiment, recording, args.config, args.rig, args.yes)

        args.record = record
        return commands.diagnose(args)

    def effects(args: argparse.Namespace) -> int:
        from thermoctl.diagnose import commands

        return commands.effects(args)

    folder = (
        "--effects",
        {"action": "append", "metavar": "DIR", "help": "a further folder of effect files (repeatable)"},
    )
    _add(
        sub,
        "diagnose",
        "where simulation and recordings differ, which physics was left out, what adding it is worth",
        diagnose,
        (
            "recordings",
            {
                "nargs": "*",
                "metavar": "REC",
                "help": "recordings: .csv, .parquet or .arrow; or folders of many rigs' "
                "recordings: each rig by itself",
            },
        ),
        ("--plant", {"required": True, "metavar": "FILE"}),
        (
            "--out",
            {
                "required": True,
                "metavar": "DIR",
                "help": "for diagnosis.json, plant.yaml and report.html (of folders: DIR/RIG)",
            },
        ),
        (
            "--last",
            {
                "type": int,
                "default": 2,
                "metavar": "N",
                "help": "of folders: each rig's newest N recordings (default 2)",
            },
        ),
        (
            "--workers",
            {"type": int, "metavar": "N", "help": "of folders: local processes (default: one a core)"},
        ),
        (
            "--scheduler",
            {
                "metavar": "ADDRESS",
                "help": "of folders: a Dask scheduler (tcp://...) that sees the same files",
            },
        ),
        folder,
        (
            "--drive",
            {
                "action": "append",
                "metavar": "INPUT",
                "help": "an input that the next experiment may drive (repeatable; "
                "default: what moved and is not the surroundings)",
            },
        ),
        (
            "--limit",
            {
                "action": "append",
                "metavar": "NAME=LOW:HIGH",
                "help": "what an input or output of the rig may reach in the next "
                "experiment (repeatable; default: not beyond what was recorded)",
            },
        ),
        (
            "--live",
            {
                "action": "store_true",
                "help": "the daemon's own recordings (--config), where its model no longer fits",
            },
        ),
        ("--hours", {"type": float, "default": 4.0, "metavar": "H", "help": "with --live: how far back (4)"}),
        (
            "--resolve",
            {
                "action": "store_true",
                "help": "run the next experiment on the rig, add its data and decide again",
            },
        ),
        YES,
        (
            "--rounds",
            {"type": int, "default": 3, "metavar": "N", "help": "with --resolve: at most N experiments (3)"},
        ),
        ("--rig", {"metavar": "PLANT", "help": "with --resolve: a plant file in the rig's place"}),
        CONFIG,
        ("--json", {"action": "store_true", "help": "print the result as JSON"}),
        ("--quiet", {"action": "store_true", "help": "no progress, no summary"}),
    )
    _add(
        sub,
        "effects",
        "list the catalogue of effects, or `effects show NAME`",
        effects,
        ("action", {"nargs": "?", "metavar": "show"}),
        ("name", {"nargs": "?", "metavar": "NAME"}),
        folder,
    )

    def prove(args: argparse.Namespace) -> int:
        from thermoctl.proof import commands

        return commands.prove(args)

    _add(
        sub,
        "prove",
        "diagnose a folder of cases, open the answers, score",
        prove,
        ("cases", {"metavar": "CASES", "help": "folder of cases: plant.yaml and recordings each"}),
        ("--out", {"required": True, "metavar": "DIR"}),
        ("--answers", {"metavar": "DIR", "help": "NAME.yaml each (default: answer.yaml inside the case)"}),
        ("--number", {"type": int, "metavar": "N", "help": "only the first N cases"}),
        ("--workers", {"type": int, "metavar": "N", "help": "local processes (default: one a core)"}),
        (
            "--scheduler",
            {
                "metavar": "ADDRESS",
                "help": "a Dask scheduler (tcp://...) instead; it must see the same files",
            },
        ),
        (
            "--real",
            {"action": "store_true", "help": "real recordings without answers: name, place, held-out error"},
        ),
        (
            "--apart",
            {"metavar": "NAMES", "help": "with --real: folders whose recordings are of different rigs"},
        ),
    )


def _people_commands(sub: argparse._SubParsersAction) -> None:
    """dashboard, monitor, mqtt, calibrate, fleet, completion, manual."""

    def dashboard(args: argparse.Namespace) -> int:
        from thermoctl.daemon.dashboard import dashboard
        from thermoctl.settings import load_settings

        return dashboard(
            load_settings(args.config),
            args.listen,
            args.commands,
            args.metrics,
            args.token_file,
            args.rate,
            tuple(args.name),
        )

    _add(
        sub,
        "dashboard",
        "the rig in the browser: read-only and on this machine only, unless told otherwise",
        dashboard,
        CONFIG,
        (
            "--listen",
            {
                "metavar": "ADDRESS:PORT",
                "default": "127.0.0.1:8765",
                "help": "where (default %(default)s); beyond this machine the token is needed to look",
            },
        ),
        ("--commands", {"action": "store_true", "help": "take arm, disarm and setpoint, with the token"}),
        ("--metrics", {"action": "store_true", "help": "Prometheus' metrics at /metrics"}),
        (
            "--token-file",
            {
                "metavar": "FILE",
                "help": "the token (else $THERMOCTL_DASHBOARD_TOKEN, else a new one is printed)",
            },
        ),
        (
            "--rate",
            {
                "type": float,
                "default": 20.0,
                "metavar": "HZ",
                "help": "frames a second, 1 to 50 (default 20)",
            },
        ),
        (
            "--name",
            {"action": "append", "default": [], "metavar": "HOST", "help": "a host name it is asked for by"},
        ),
    )

    def monitor(args: argparse.Namespace) -> int:
        from thermoctl.daemon.monitor import monitor
        from thermoctl.settings import load_settings

        return monitor(load_settings(args.config), args.interval, args.once)

    _add(
        sub,
        "monitor",
        "the rig in the terminal, as over ssh; commands nothing",
        monitor,
        CONFIG,
        (
            "--interval",
            {
                "type": float,
                "default": 0.5,
                "metavar": "S",
                "help": "seconds between two looks (default 0.5)",
            },
        ),
        (
            "--once",
            {"action": "store_true", "help": "one screen; exit 1 when no daemon runs or a fault stands"},
        ),
    )

    def mqtt(args: argparse.Namespace) -> int:
        from thermoctl.daemon.mqtt import mqtt
        from thermoctl.settings import load_settings

        return mqtt(
            load_settings(args.config),
            args.broker,
            args.topic,
            args.rate,
            args.user,
            args.password_file,
            args.tls,
        )

    _add(
        sub,
        "mqtt",
        "publish state, faults and availability to an MQTT broker; takes no commands",
        mqtt,
        CONFIG,
        ("--broker", {"required": True, "metavar": "HOST[:PORT]"}),
        ("--topic", {"default": "", "metavar": "TOPIC", "help": "below this (thermoctl/RIG)"}),
        ("--rate", {"type": float, "default": 1.0, "metavar": "HZ", "help": "messages a second (1)"}),
        ("--user", {"default": "", "metavar": "NAME"}),
        ("--password-file", {"metavar": "FILE"}),
        ("--tls", {"action": "store_true", "help": "encrypted, with the system's certificates"}),
    )

    def calibrate(args: argparse.Namespace) -> int:
        from thermoctl.calibration import commands

        return commands.calibrate(
            args.config, args.out, args.models, args.order, args.gains, args.accept, args.again, args.yes
        )

    _add(
        sub,
        "calibrate",
        "doctor, step, PID, tests, model, proof, one after the other; goes on where it was ended; writes nothing "
        "outside its folder before it is accepted",
        calibrate,
        CONFIG,
        ("--out", {"metavar": "DIR", "help": "the calibration's folder (calibration/RIG)"}),
        (
            "--models",
            {"metavar": "DIR", "default": "models", "help": "where an accepted model goes (models)"},
        ),
        ("--order", {"type": int, "default": 0, "help": "number of real poles (0, the default: by BIC)"}),
        ("--gains", {"action": "store_true", "help": "an acceptance also writes the proposed PID gains"}),
        ("--accept", {"action": "store_true", "help": "install the model when the proof is done"}),
        ("--again", {"action": "store_true", "help": "forget an earlier run in the folder"}),
        YES,
    )

    def fleet(args: argparse.Namespace) -> int:
        from thermoctl.fleet import commands

        return commands.fleet(
            args.folder, args.plant, args.parameters, args.workers, args.scheduler, args.json
        )

    _add(
        sub,
        "fleet",
        "many rigs' recordings: health, drift of parameters, which model no longer fits; exit 1 when one needs "
        "attention",
        fleet,
        ("folder", {"metavar": "FOLDER", "help": "a folder, or an object store's path as s3://BUCKET/RIGS"}),
        ("--plant", {"metavar": "FILE", "help": "the plant that the recordings are held against"}),
        ("--parameters", {"default": "", "metavar": "A,B", "help": "its parameters to follow over time"}),
        (
            "--workers",
            {"type": int, "default": 0, "metavar": "N", "help": "Dask processes here (default: this one)"},
        ),
        ("--scheduler", {"metavar": "ADDRESS", "help": "a Dask cluster"}),
        ("--json", {"action": "store_true"}),
    )

    def completion(args: argparse.Namespace) -> None:
        import shtab

        print(shtab.complete(parser(), args.shell))

    _add(
        sub,
        "completion",
        "print the shell completion; source it",
        completion,
        ("shell", {"choices": ["bash", "zsh", "tcsh"]}),
    )

    def manual(args: argparse.Namespace) -> int:
        from thermoctl.manual import manual

        return manual(parser(), args.action, args.root)

    _add(
        sub,
        "manual",
        "the manual page, written from these very commands: show it, or install it with the shells' completions",
        manual,
        ("action", {"nargs": "?", "choices": ["show", "install", "uninstall"], "default": "show"}),
        ("--root", {"default": "/", "metavar": "DIR", "help": "install below this directory"}),
    )


def parser() -> argparse.ArgumentParser:
    """The whole command line (also read by the completion and by the reference page)."""
    top = argparse.ArgumentParser(
        prog="thermoctl", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--version", action="version", version=f"thermoctl {__version__}")
    sub = top.add_subparsers(metavar="COMMAND", dest="command", required=True)
    for declare in (
        _daemon_commands,
        _recording_commands,
        _plant_commands,
        _identify_commands,
        _diagnose_commands,
        _people_commands,
    ):
        declare(sub)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    args = parser().parse_args(argv)
    try:
        which_rig.choose(args)
        return args.run(args) or 0
    except InputError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return 130
    except Exception as e:
        from hal.backend import HardwareError

        if not isinstance(e, HardwareError):
            raise
        print(f"thermoctl: {e}", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
