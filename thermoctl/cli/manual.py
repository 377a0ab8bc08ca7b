"""The manual page and the shell completions, made from the argument parser, and their installation."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import shtab

from thermoctl import __version__
from thermoctl.files import safe_file
from thermoctl.files.yamlfile import InputError

PLACES = {  # places below the root where man and the shells look for local files
    "man": "usr/local/share/man/man1/thermoctl.1",
    "bash": "usr/local/share/bash-completion/completions/thermoctl",
    "zsh": "usr/local/share/zsh/site-functions/_thermoctl",
}
REMEDY = "run it as root, or give --root"
_FILES = (
    ("$THERMOCTL_CONFIG", "configuration, when --config is not given"),
    ("config/simulated.yaml", "the one of the simulated rig, used where neither is given"),
    ("/etc/thermoctl/rig.yaml", "the one of a rig, used when there is no other"),
    ("/var/lib/thermoctl/recordings", "a service's recordings"),
)
_STATUS = (
    (0, "done"),
    (1, "the answer is no: a check failed, the daemon is not running, a fault stands"),
    (2, "unusable input; one line says what, where and what was expected"),
    (3, "the hardware or the system refused"),
    (130, "interrupted"),
)


def manual_page(parser: argparse.ArgumentParser) -> str:
    """Return thermoctl(1) in roff (man macros): every command with its options."""
    first = (parser.description or "").split("\n\n")[0]
    lines = [
        f'.TH {parser.prog.upper()} 1 "" "{parser.prog} {__version__}" "User Commands"',
        ".SH NAME",
        f"{parser.prog} \\- thermal compensation of a precision linear actuator, and the diagnosis of left-out physics",
        ".SH SYNOPSIS",
        f".B {parser.prog}",
        ".I COMMAND",
        "[\\fIOPTIONS\\fR]",
        ".SH DESCRIPTION",
        _text(first),
        ".SH COMMANDS",
    ]
    for command, help in _commands(parser):
        lines += [
            ".SS " + _text(" ".join(command.prog.split()[1:])),
            _text(help or command.description or ""),
        ]
        for action in command._actions:
            if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
                lines += [
                    ".TP",
                    _option(action),
                    _text((action.help or "").replace("%(default)s", str(action.default))),
                ]
    lines += [".SH FILES"] + [x for path, what in _FILES for x in (".TP", f".I {_text(path)}", _text(what))]
    lines += [".SH EXIT STATUS"] + [x for code, what in _STATUS for x in (".TP", f".B {code}", _text(what))]
    return "\n".join(line for line in lines if line) + "\n"


def _commands(parser: argparse.ArgumentParser) -> list[tuple[argparse.ArgumentParser, str]]:
    """Return every command that is no group, with its line of help."""
    listed: list[tuple[argparse.ArgumentParser, str]] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            said = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, command in action.choices.items():
                below = _commands(command)
                listed += below or [(command, said.get(name, ""))]
    return listed


def _text(words: str) -> str:
    words = " ".join(words.split()).replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{words}" if words[:1] in (".", "'") else words


def _option(action: argparse.Action) -> str:
    value = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    takes = f" \\fI{_text(str(value))}\\fR" if action.nargs != 0 else ""
    if not action.option_strings:
        return f"\\fI{_text(str(value))}\\fR"
    return ", ".join(f"\\fB{_text(flag)}\\fR" for flag in action.option_strings) + takes


def install(parser: argparse.ArgumentParser, root: str | Path = "/") -> list[Path]:
    """Write the manual page and the completions of bash and zsh below `root`; return their paths.

    Raises InputError when one cannot be written.
    """
    texts = {
        "man": manual_page(parser),
        "bash": shtab.complete(parser, "bash"),
        "zsh": shtab.complete(parser, "zsh"),
    }
    written = []
    for kind, place in PLACES.items():
        path = Path(root, place)
        safe_file.make_folder(path.parent, REMEDY)
        safe_file.write_text(path, texts[kind], REMEDY)
        written.append(path)
    return written


def uninstall(root: str | Path = "/") -> list[Path]:
    """Remove the files of `install`; return their paths. Raises InputError when one cannot be removed."""
    there = [p for p in (Path(root, place) for place in PLACES.values()) if p.exists()]
    for path in there:
        try:
            path.unlink()
        except OSError as e:
            raise InputError(f"{path}: cannot be removed: {e.strerror}; run it as root") from None
    return there


def command(parser: argparse.ArgumentParser, action: str, root: str) -> int:
    """Show, install or uninstall the manual page."""
    if action == "show":
        os.write(1, manual_page(parser).encode())
        return 0
    for path in install(parser, root) if action == "install" else uninstall(root):
        print(("wrote " if action == "install" else "removed ") + str(path))
    return 0


def completion(parser: argparse.ArgumentParser, shell: str) -> None:
    """Print a shell's completion script."""
    print(shtab.complete(parser, shell))
