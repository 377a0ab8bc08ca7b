"""The commands that may act on a rig: what each does, asks and returns, for its page and for tests/daemon/test_acts.py."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Act:
    """Describe how a command may act on a rig; one row of docs/reference/commands-that-act.md.

    question: asked before it acts; beside: its behaviour when another process holds the rig.
    """

    command: str
    does: str
    question: str
    beside: str
    status: str


_OWN = "none: a person gives this command"
_MOVES = (
    "prints what moves, how far, for how long and how warm it gets, and asks for `go`, unless `--yes` is given; without "
    "a terminal and without `--yes`: status 2"
)
_THROUGH = (
    "drives through that daemon with its law and protection, from READY only, and disarms at its end; a rig that is "
    "ARMED or in FAULT is not touched"
)
_MOVED = "0; 1 the answer was not `go`; 2 nobody can be asked; 3 the rig refuses, or it ended early; 130 the user ended it"
ACTS = (
    Act(
        "run",
        "starts the daemon in the foreground; drives nothing until it is armed",
        "none",
        "refused",
        "2 held",
    ),
    Act(
        "demo",
        "starts a copy of a simulated rig with its own lock, socket, log and recordings, arms and moves it",
        "none: it refuses every back end but the simulated one",
        "runs beside it without touching it",
        "0 stopped; 1 a fault was active; 2 no simulated rig, or another demo runs; 3 not started",
    ),
    Act(
        "start",
        "starts the daemon: the unit that runs this configuration, else in the background; drives nothing",
        "none",
        "says `already running` with its state; changes nothing",
        "0; 3 with the daemon's own error",
    ),
    Act(
        "stop",
        "disarms, then ends whoever holds the rig, by its unit where systemd started it",
        "none: it is the safe direction",
        "stops it: its purpose; never the rig of another configuration",
        "0, also where nobody holds the rig; 3 it does not end",
    ),
    Act(
        "restart",
        "stop, then start",
        "none",
        "as stop, then start",
        "0; 3 it does not end, or the daemon's own error",
    ),
    Act(
        "arm",
        "enables the amplifier and holds the measured position",
        _OWN,
        "its purpose; refused in FAULT",
        "1 refused; 2 no daemon",
    ),
    Act(
        "disarm",
        "disables the amplifier; in FAULT acknowledges",
        "none: it is the safe direction",
        "its purpose",
        "1 a fault is still active; 2 no daemon",
    ),
    Act(
        "setpoint",
        "moves the output at the limited rate",
        _OWN,
        "its purpose; refused unless ARMED",
        "1 refused; 2 no daemon or no number",
    ),
    Act(
        "reload",
        "applies changed limits and gains between two ticks, none that vanished; while ARMED none by which the output jumps or leaves its setpoint",
        _OWN,
        "its purpose",
        "1 refused, or the file is not valid; 2 no daemon",
    ),
    Act("tune", "moves the stage by short setpoint ramps", _MOVES, _THROUGH, _MOVED),
    Act("experiment", "moves the stage by a schedule of setpoints", _MOVES, _THROUGH, _MOVED),
    Act("calibrate", "tune, then the tests of experiments.yaml", _MOVES, _THROUGH, _MOVED),
    Act(
        "diagnose",
        "with --resolve: runs the proposed experiment",
        _MOVES,
        _THROUGH,
        "0; 2 the answer was not `go`, or nobody can be asked; 3 the rig refuses, or it ended early; 130 the user ended it",
    ),
    Act(
        "dashboard",
        "with --commands: takes arm, disarm and setpoint from the page",
        "the token, and a question on the page before arming",
        "its purpose",
        "2 the address is taken",
    ),
    Act(
        "virtual-rig",
        "plays the devices of a configuration; drives no amplifier. `--tell` injects a fault into a virtual device, or clears it",
        "none",
        "does not touch it: a virtual rig that runs already is not replaced",
        "2 another virtual rig runs, or no back end `devices`",
    ),
    Act(
        "service",
        "install writes the unit of this configuration and starts nothing; uninstall stops and removes it",
        "none",
        "install does not touch it; uninstall stops the rig of its own unit",
        "0; 1 no such unit; 2 it cannot be written, or two rigs collide",
    ),
)
