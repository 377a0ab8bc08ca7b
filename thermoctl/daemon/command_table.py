"""Rows of the command table: the daemon: run it, command it, look at it."""

from __future__ import annotations

from thermoctl.command import CONFIG, FILE, JSON, LOOK, RUN, Table, argument, command

TABLE: Table = {
    RUN: (
        command(
            "demo",
            "run the closed loop on a simulated rig with a live view; Ctrl-C stops it safely",
            "thermoctl.daemon.views.demo:demo",
            "settings seconds",
            CONFIG,
            argument("--seconds", type=float, metavar="S", help="stop after S seconds"),
        ),
        command(
            "start",
            "start the daemon: by its systemd unit where one is installed, else in the background",
            "thermoctl.daemon.service:start",
            "settings",
            CONFIG,
        ),
        command(
            "stop",
            "disable the amplifier and stop the daemon",
            "thermoctl.daemon.service:stop",
            "settings",
            CONFIG,
        ),
        command("restart", "stop, then start", "thermoctl.daemon.service:restart", "settings", CONFIG),
        command(
            "arm",
            "enable the amplifier and hold the measured position",
            "thermoctl.daemon.commands:request",
            "settings command json",
            CONFIG,
            JSON,
        ),
        command(
            "disarm",
            "disable the amplifier; in state FAULT: acknowledge",
            "thermoctl.daemon.commands:request",
            "settings command json",
            CONFIG,
            JSON,
        ),
        command(
            "setpoint",
            "move the output to VALUE_UM at the limited rate",
            "thermoctl.daemon.commands:request",
            "settings command json value",
            argument("value", type=float, metavar="VALUE_UM"),
            CONFIG,
            JSON,
        ),
        command(
            "reload",
            "check the configuration again and apply changed limits and gains between two ticks",
            "thermoctl.daemon.commands:request",
            "settings command json",
            CONFIG,
            JSON,
        ),
        command(
            "check",
            "check a configuration with its model, plant and profiles; touches no hardware",
            "thermoctl.daemon.offline.doctor:check",
            "settings",
            FILE,
            CONFIG,
        ),
        command(
            "doctor",
            "connect to the devices and show every channel with value, unit and rate; drives nothing",
            "thermoctl.daemon.offline.doctor:doctor",
            "settings seconds",
            FILE,
            CONFIG,
            argument("--seconds", type=float, default=2.0, help="time to read for (default 2)"),
        ),
    ),
    LOOK: (
        command(
            "status",
            "show state, position, compensation, temperatures, and faults with remedies; exit 1 when a fault is active",
            "thermoctl.daemon.commands:status",
            "settings json",
            CONFIG,
            JSON,
        ),
        command(
            "monitor",
            "show the rig in the terminal, for instance over ssh; gives no commands",
            "thermoctl.daemon.views.monitor:show",
            "settings interval once",
            CONFIG,
            argument(
                "--interval",
                type=float,
                default=0.5,
                metavar="S",
                help="seconds between two updates (default 0.5)",
            ),
            argument(
                "--once",
                action="store_true",
                help="print one screen; exit 1 when no daemon runs or a fault is active",
            ),
        ),
        command(
            "dashboard",
            "serve the rig's page for the browser: read-only and on this machine only, unless options say otherwise",
            "thermoctl.daemon.views.dashboard:serve",
            "settings listen commands metrics token_file rate name",
            CONFIG,
            argument(
                "--listen",
                metavar="ADDRESS:PORT",
                default="127.0.0.1:8765",
                help="address to serve on (default %(default)s); beyond this machine reading needs the token, too",
            ),
            argument(
                "--commands", action="store_true", help="accept arm, disarm and setpoint, with the token"
            ),
            argument("--metrics", action="store_true", help="serve Prometheus metrics at /metrics"),
            argument(
                "--token-file",
                metavar="FILE",
                help="file of the token (else $THERMOCTL_DASHBOARD_TOKEN, else a new one is printed)",
            ),
            argument(
                "--rate", type=float, default=20.0, metavar="HZ", help="frames a second, 1 to 50 (default 20)"
            ),
            argument(
                "--name",
                action="append",
                default=[],
                metavar="HOST",
                help="accepted host name in requests (repeatable)",
            ),
        ),
        command(
            "mqtt",
            "publish state, faults and availability to an MQTT broker; accepts no commands",
            "thermoctl.daemon.views.mqtt:publish",
            "settings broker topic rate user password_file tls",
            CONFIG,
            argument("--broker", required=True, metavar="HOST[:PORT]", help="the broker"),
            argument(
                "--topic",
                default="",
                metavar="TOPIC",
                help="first part of every topic (default thermoctl/RIG)",
            ),
            argument("--rate", type=float, default=1.0, metavar="HZ", help="messages a second (default 1)"),
            argument("--user", default="", metavar="NAME", help="the broker's user name"),
            argument("--password-file", metavar="FILE", help="file of the user's password"),
            argument("--tls", action="store_true", help="encrypt, with the system's certificates"),
        ),
        command(
            "latency",
            "show histograms of lateness and busy time, skipped ticks, and the lateness of an idle loop",
            "thermoctl.daemon.commands:latency",
            "settings json",
            CONFIG,
            JSON,
        ),
        command(
            "replay",
            "run a recording's inputs through the control law; exit 1 when one output bit differs",
            "thermoctl.daemon.offline.replay:command",
            "recording",
            argument("recording", metavar="RECORDING"),
        ),
    ),
}
