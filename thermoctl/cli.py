"""The command line: make the parser, run one command, turn errors into exit statuses."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from thermoctl import __version__
from thermoctl.commands import AXIS, COMMANDS, GROUPS, call, takes_axis
from thermoctl.configuration import which_rig
from thermoctl.extras import lacking
from thermoctl.yamlfile import InputError

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(
        _name, "1"
    )  # set before numpy is loaded: BLAS threads on busy cores wait for each other

DESCRIPTION = """\
Holds the output of a precision linear actuator in place while its coil heats up. Finds the physics that a simulation
lacks when it disagrees with a recording.

Exit status: 0 done; 1 the answer is no (a check failed, the daemon is not running, a fault is active); 2 unusable input
(one line on stderr says what, where, what was expected); 3 the hardware or the system refused; 130 interrupted."""


def parser() -> argparse.ArgumentParser:
    """Return the whole command line (also read by the completions and by the reference page)."""
    top = argparse.ArgumentParser(
        prog="thermoctl", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--version", action="version", version=f"thermoctl {__version__}")
    levels = {"": top.add_subparsers(metavar="COMMAND", dest="command", required=True)}
    for command in COMMANDS:
        group, _, name = command.name.rpartition(" ")
        if group not in levels:
            below = levels[""].add_parser(group, help=GROUPS[group])
            levels[group] = below.add_subparsers(metavar="WHAT", required=True)
        own = levels[group].add_parser(name, help=command.help, description=command.help)
        for argument in (*command.arguments, *((AXIS,) if takes_axis(command) else ())):
            own.add_argument(*argument.flags, **argument.options)
        own.set_defaults(row=command)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    top = parser()
    args = top.parse_args(argv, argparse.Namespace(parser=top))
    try:
        which_rig.choose(args)
        return call(args.row, args)
    except InputError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return 130
    except ModuleNotFoundError as e:
        if (line := lacking(e)) is None:
            raise
        print(f"thermoctl: {args.row.name}: {line}", file=sys.stderr)
        return 2
    except Exception as e:
        from thermoctl_hal.backend import HardwareError

        if not isinstance(e, HardwareError):
            raise
        print(f"thermoctl: {e}", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
