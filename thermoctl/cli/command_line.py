"""The command line: make the parser, run one command, turn errors into exit statuses."""

from __future__ import annotations

import argparse
import difflib
import os
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from thermoctl import __version__
from thermoctl.cli.commands import BY_PURPOSE, COMMANDS, GROUPS, call, takes_axis
from thermoctl.command import AXIS
from thermoctl.configuration import which_rig
from thermoctl.extras import lacking
from thermoctl.files.yamlfile import InputError
from thermoctl.interrupt import STATUS

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    # Set before numpy is loaded: BLAS threads on busy cores wait for each other.
    os.environ.setdefault(_name, "1")

DESCRIPTION = """\
Holds the output of a precision linear actuator in place while its coil heats up. Finds the physics that a simulation
lacks when it disagrees with a recording.

Exit status: 0 done; 1 the answer is no (a check failed, the daemon is not running, a fault is active); 2 unusable input
(one line on stderr says what, where, what was expected); 3 the hardware or the system refused; 130 ended by Ctrl-C or a
signal."""
_NAME_WIDTH = 14  # columns of a command's name in `thermoctl --help`
_WIDTH = 110


class _Top(argparse.ArgumentParser):
    """The parser of the whole command line: its help lists the commands by purpose."""

    def format_help(self) -> str:
        """Return the help: usage, description, and the commands by what a user wants."""
        parts = [
            self.format_usage(),
            DESCRIPTION,
            "  --version  show the version\n  -h, --help  show this help",
        ]
        for purpose, rows in BY_PURPOSE.items():
            helps = {group: GROUPS.get(group, row.help) for row in rows for group in (row.name.split()[0],)}
            lines = "\n".join(_listed(name, text) for name, text in helps.items())
            parts.append(f"{purpose}:\n{lines}")
        return "\n\n".join(p.rstrip() for p in parts) + "\n\n`thermoctl COMMAND --help` shows its options.\n"


def _listed(name: str, text: str) -> str:
    return textwrap.fill(
        text, _WIDTH, initial_indent=f"  {name:<{_NAME_WIDTH}}", subsequent_indent=" " * (_NAME_WIDTH + 2)
    )


def parser() -> argparse.ArgumentParser:
    """Return the whole command line (also read by the completions and by the reference page)."""
    top = _Top(
        prog="thermoctl",
        usage="thermoctl COMMAND ...",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"thermoctl {__version__}")
    kind = argparse.ArgumentParser
    levels = {"": top.add_subparsers(metavar="COMMAND", dest="command", required=True, parser_class=kind)}
    for command in COMMANDS:
        group, _, name = command.name.rpartition(" ")
        if group not in levels:
            below = levels[""].add_parser(group, help=GROUPS[group], prog=f"thermoctl {group}")
            levels[group] = below.add_subparsers(metavar="WHAT", required=True)
        own = levels[group].add_parser(
            name, help=command.help, description=command.help, prog=f"thermoctl {command.name}"
        )
        for argument in (*command.arguments, *((AXIS,) if takes_axis(command) else ())):
            own.add_argument(*argument.flags, **argument.options)
        own.set_defaults(row=command, own=own)
    return top


def _below(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of the commands below a parser, by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices
    return {}


def _similar(word: str, named: Mapping[str, str]) -> str:
    """Return "; did you mean 'NAME'?" for the names whose value is nearest to `word`, or nothing."""
    near = difflib.get_close_matches(word, set(named.values()), 1, 0.6)
    meant = [f"'{name}'" for name, last in named.items() if last in near]
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


def _parsed(top: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Return the parsed arguments.

    Raises SystemExit(2) for a mistake, with the usage of the command in which it was made."""
    command_parser, rest = top, list(words)
    while rest and (below := _below(command_parser)) and not rest[0].startswith("-"):
        if rest[0] not in below:
            named = {below[name].prog: name for name in below}
            if not _similar(rest[0], named) or command_parser is top:
                named |= {f"thermoctl {row.name}": row.name.split()[-1] for row in COMMANDS}
            command_parser.error(f"unknown command '{rest[0]}'{_similar(rest[0], named)}")
        command_parser = below[rest.pop(0)]
    if not rest and (below := _below(command_parser)):
        command_parser.error(
            f"a command was expected: {', '.join(below)} (see `{command_parser.prog} --help`)"
        )
    args, more = top.parse_known_args(words, argparse.Namespace(parser=top))
    if more:
        flags = {flag: flag for action in args.own._actions for flag in action.option_strings}
        args.own.error(f"unrecognized arguments: {' '.join(more)}{_similar(more[0].split('=')[0], flags)}")
    return args


def _spare_inputs(args: argparse.Namespace) -> None:
    """Raise InputError where a command would write its result over a file that it reads."""
    for option in ("out", "plot"):
        target = getattr(args, option, None)
        if not isinstance(target, str) or not Path(target).is_file():
            continue
        others = (v if isinstance(v, list) else [v] for k, v in vars(args).items() if k != option)
        for given in (g for group in others for g in group if isinstance(g, str) and Path(g).is_file()):
            if Path(given).samefile(target):
                raise InputError(f"{target}: is a file that the command reads; name another one to write")


def _words() -> list[str]:
    """Return the words of the command line.

    In a locale that is not UTF-8 start again in UTF-8 mode: our files are UTF-8 in every locale."""
    if sys.getfilesystemencoding() != "utf-8":
        os.execv(sys.executable, [sys.executable, "-P", "-X", "utf8", "-m", "thermoctl", *sys.argv[1:]])
    return sys.argv[1:]


def run(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    args = _parsed(parser(), _words() if argv is None else argv)
    try:
        which_rig.choose(args)
        _spare_inputs(args)
        code = call(args.row, args)
        print(end="", flush=True)  # a full disk behind `> FILE` shows here
        return code
    except InputError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except OSError as e:
        print(f"thermoctl: {e.filename or args.row.name}: {e.strerror or e}", file=sys.stderr)
        if e.filename is None:  # stdout: the rest of its buffer must not fail once more at the end
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 3
    except KeyboardInterrupt as e:
        print(f"thermoctl: {args.row.name}: {e or 'interrupted'}", file=sys.stderr)
        return STATUS
    except ModuleNotFoundError as e:
        if (line := lacking(e)) is None:
            raise
        print(f"thermoctl: {args.row.name}: {line}", file=sys.stderr)
        return 2
    except Exception as e:
        from thermoctl_hal.base.backend import HardwareError

        if not isinstance(e, HardwareError):
            raise
        print(f"thermoctl: {e}", file=sys.stderr)
        return 3
