"""The command line. Each command is declared here and done in its room; rooms are imported when a command is called.

Exit status: 0 done; 1 the answer is no (a check failed, the daemon is not running, a fault stands); 2 unusable input
(one line on stderr says what, where, what was expected); 3 the hardware or the system refused; 130 interrupted.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

from thermoctl import __version__
from thermoctl.yamlfile import InputError


def _add(sub: argparse._SubParsersAction, name: str, help: str, run: Callable[[argparse.Namespace], int | None],
         *arguments: tuple) -> argparse.ArgumentParser:
    """One command: `arguments` are (flags..., options) as add_argument takes them; `run` gets the parsed namespace."""
    parser = sub.add_parser(name, help=help, description=help)
    for *flags, options in arguments:
        parser.add_argument(*flags, **options)
    parser.set_defaults(run=run)
    return parser


def _plant_commands(sub: argparse._SubParsersAction) -> None:
    """simulate, refit, plant show, plant linearise, plant check."""


def _daemon_commands(sub: argparse._SubParsersAction) -> None:
    """run, demo, start, stop, restart, status, arm, disarm, setpoint, reload, check, doctor, latency, virtual-rig."""


def _recording_commands(sub: argparse._SubParsersAction) -> None:
    """recordings list, info, export, recover."""


def _identify_commands(sub: argparse._SubParsersAction) -> None:
    """experiment, identify, model, tune, evaluate, reproduce."""


def _diagnose_commands(sub: argparse._SubParsersAction) -> None:
    """diagnose, prove, demo-concealed, effects."""


def _people_commands(sub: argparse._SubParsersAction) -> None:
    """dashboard, monitor, calibrate, fleet, completion."""


def parser() -> argparse.ArgumentParser:
    """The whole command line (also read by the completion and by the reference page)."""
    top = argparse.ArgumentParser(prog="thermoctl", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=f"thermoctl {__version__}")
    sub = top.add_subparsers(metavar="COMMAND", required=True)
    for declare in (_daemon_commands, _recording_commands, _plant_commands, _identify_commands, _diagnose_commands,
                    _people_commands):
        declare(sub)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    args = parser().parse_args(argv)
    try:
        return args.run(args) or 0
    except InputError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
