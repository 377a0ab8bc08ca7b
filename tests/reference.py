"""The reference pages in docs/, written from the tables in the code.

`python -m tests.reference [--check]`.

They are configuration, device-profiles, signals, faults, effects, cli and commands-that-act in
docs/reference, and one page a fault in docs/faults.
With --check nothing is written; exit status 1 if a page is stale, and its name on stderr.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, cast

from tests.acts import ACTS
from thermoctl.cli.command_line import parser
from thermoctl.configuration.settings import SECTIONS, options
from thermoctl.control import causes
from thermoctl.control.faults import FAULTS, Fault
from thermoctl.daemon.reload import IN_STEPS
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.rig.channels import DEFAULT
from thermoctl.rig.option import LIVE_STEP
from thermoctl.rig.signals import FAULT_WORD_BITS, SIGNALS
from thermoctl_hal.base.key import REQUIRED, Key
from thermoctl_hal.profiles.keys import TABLES

DOCS = Path(__file__).resolve().parent.parent / "docs"
_HEAD = "<!-- Written by `python -m tests.reference`; change the table in the code, not this page. -->\n"
_HELP_WIDTH = 108  # columns of a command's help: argparse's own for a terminal of 110
_SEVERITY = {
    "warning": "a warning: shown and recorded, drives nothing off.",
    "fault": "a fault: disables the amplifier when armed, and keeps the rig from being armed.",
    "critical": "critical: disables the amplifier and latches FAULT from every state.",
}


def _table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    lines = [list(header)]
    lines += [
        ["---"] * len(lines[0]),
        *([str(c).replace("|", "\\|").replace("\n", " ") for c in row] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _range(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return ""
    if math.isinf(high):
        return f"{low:g} or more"
    return f"up to {high:g}" if math.isinf(low) else f"{low:g} to {high:g}"


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "must be given"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if value is None or value == "" or value == () or value == {}:
        return "none"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def configuration() -> str:
    """Return the page of options: unit, range, default, whether a change needs a restart, meaning."""
    text = (
        _HEAD + "# Configuration\n\nOne YAML file describes a rig. `thermoctl check FILE` says whether it is "
        "right; `thermoctl reload` applies the options that need no restart between two ticks. In steps: while ARMED "
        f"a reload changes it by a factor of {LIVE_STEP:g} at most, so that the output does not jump. An option in "
        "force that the file has no longer refuses the reload.\n"
    )
    for section, cls in SECTIONS.items():
        rows = [
            (
                f"`{key.split('.')[1]}`",
                o.unit,
                ", ".join(o.choices) or _range(o.low, o.high),
                _default(f),
                "restart" if o.restart else "live, in steps" if key in IN_STEPS else "live",
                o.meaning,
            )
            for key, f, o in options()
            if key.startswith(section + ".")
        ]
        text += f"\n## {section}\n{(cls.__doc__ or '').strip()}\n\n"
        text += _table(("option", "unit", "range", "default", "a change", "meaning"), rows)
    return text


def signals() -> str:
    """Return the page of signals, the columns of a recording."""
    return (
        _HEAD
        + "# Signals\n\nOne record row a tick, in this order, float64. The temperature points are those of the rig file's `points`; here the "
        "paper's twelve. More points take more words of bits: `fresh_bits` holds 52 channels a word, `status_bits` 26, "
        "`delay_bits` 13. A recording's 10 Hz tier holds the "
        "mean under the same name and `_min` and `_max` beside it; words of bits are or-ed.\n\n"
        + _table(
            ("signal", "unit", "plausible", "meaning"),
            ((f"`{s.name}`", s.unit, _range(s.low, s.high), s.meaning) for s in SIGNALS),
        )
    )


def faults() -> str:
    """Return the table of faults."""
    return (
        _HEAD
        + "# Faults\n\n"
        + "".join(f"- {t}\n" for t in _SEVERITY.values())
        + "\n"
        + _table(
            ("bit", "fault", "severity", "meaning"),
            ((f.bit, f"[`{f.name}`](../faults/{f.name}.md)", f.severity, f.meaning) for f in FAULTS),
        )
    )


def device_profiles() -> str:
    """Return the page of device profiles: every key of every bus."""
    text = (
        _HEAD + "# Device profiles\n\nEvery key of a profile (`format: thermoctl-device/1`). "
        "[How to write one](../how-to/devices.md); `thermoctl devices new` asks for them.\n"
    )
    for table, keys in TABLES.items():
        rows = (
            (
                f"`{k.name}`",
                k.kind,
                k.unit,
                ", ".join(c for c in k.choices if c) or _range(k.low, k.high),
                _key_default(k),
                f"`{k.example}`" if k.example else "",
                k.meaning,
            )
            for k in keys
        )
        text += f"\n## {table}\n\n"
        text += _table(("key", "kind", "unit", "range", "default", "example", "meaning"), rows)
    return text


def _key_default(key: Key) -> str:
    if key.default is REQUIRED:
        return "must be given"
    if key.default is None or key.default == "" or isinstance(key.default, tuple):
        return "none"
    if isinstance(key.default, bool):
        return str(key.default).lower()
    return f"{key.default:g}" if isinstance(key.default, int | float) else str(key.default)


def commands_that_act() -> str:
    """Return the page of commands that can move, arm, disarm or stop a rig."""
    return (
        _HEAD + "# Commands that act on a rig\n\nEvery command that can move, arm, disarm or stop a rig.\n\n"
        "**Which rig.** `--config FILE`, else `$THERMOCTL_CONFIG`, else `config/simulated.yaml` in the current folder, else "
        "`/etc/thermoctl/rig.yaml`. A command below prints the file that it chose by itself, on stderr. Whoever drives a rig holds the "
        "lock beside its socket; a command finds the daemon there, whether `thermoctl run`, `thermoctl start` or systemd started it.\n\n"
        "**Which question.** Stopping and disarming never ask, and work while the file has a mistake. "
        "`arm` and `setpoint` are a person's own act. A command that decides "
        "by itself how the rig moves says so and asks first.\n\n"
        + _table(
            ("command", "what it does", "question", "where another process holds the rig", "exit status"),
            ((f"`{a.command}`", a.does, a.question, a.beside, a.status) for a in ACTS),
        )
        + "\nOtherwise 0; 2 is unusable input, 3 the hardware or the system refused, 130 interrupted "
        "([all commands](cli.md)).\n"
    )


def fault(f: Fault) -> str:
    """Return the page of one fault."""
    channels = causes.channels_of(f.name, DEFAULT)
    second, place = divmod(f.bit, FAULT_WORD_BITS)
    word = "fault_bits_2" if second else "fault_bits"
    cause_of = sorted(n for n, after in causes.FOLLOWS.items() if f.name in after)
    return (
        f"{_HEAD}# {f.name}\n\n{_sentence(f.meaning)}\n\nThis is {_SEVERITY[f.severity]} Bit {place} "
        f"of `{word}` (value {1 << place})."
        + (
            f" Channels: {', '.join(f'`{c}`' for c in channels)}; a warning where none of those at fault is in "
            "`protection.required`."
            if channels
            else ""
        )
        + f"\n\n## Cause\n\n{_sentence(f.cause)}\n\n## How to check\n\n{_sentence(f.check)}\n\n"
        f"## How to cure\n\n{_sentence(f.cure)}\n\n"
        "Then `thermoctl disarm` acknowledges a latched fault, and `thermoctl arm` starts again from the measured "
        "position.\n\n"
        + (
            f"It may follow from {', '.join(f'[{n}]({n}.md)' for n in cause_of)}: `thermoctl status` then names that first.\n\n"
            if cause_of
            else ""
        )
        + "All faults: [reference](../reference/faults.md).\n"
    )


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:].rstrip(".") + "."


def effects() -> str:
    """Return the catalogue of physics that a plant may lack."""
    entries = catalogue().values()
    text = (
        _HEAD + "# Catalogue of left-out physics\n\nWhat `thermoctl diagnose` can name; one file each in "
        "config/effects/. A file of your own beside them is an entry like any other.\n\n"
    )
    text += _table(
        ("effect", "what it is", "where", "excited by", "hard to tell from", "source"),
        (
            (f"`{e.name}`", e.title, e.where.replace("_", " "), e.excited_by, ", ".join(e.mimics), e.source)
            for e in entries
        ),
    )
    for e in entries:
        rows = (
            (
                f"`{p.name}`",
                p.unit or "",
                f"{p.low:g} to {p.high:g}{' of the largest jump' if p.of == 'jump' else ''}"
                if _numbers(p.low, p.high)
                else "",
            )
            for p in e.parameters
        )
        text += f"\n## {e.name}\n{e.title}.\n\n" + _table(("parameter", "unit", "bounds"), rows)
    return text


def _numbers(*values: object) -> bool:
    return all(isinstance(v, int | float) for v in values)


def cli() -> str:
    """Every command's help."""
    top = parser()
    pages: list[str] = []

    def walk(p: argparse.ArgumentParser) -> None:
        """Add the help of a command and of its subcommands to `pages`."""
        kind = cast(type[argparse.HelpFormatter], p.formatter_class)
        p.formatter_class = partial(kind, width=_HELP_WIDTH)  # not the terminal's
        pages.append(f"## {p.prog}\n```text\n{p.format_help().rstrip()}\n```\n")
        for action in p._actions:
            if isinstance(action, argparse._SubParsersAction):
                for below in dict.fromkeys(action.choices.values()):
                    walk(below)

    walk(top)
    return _HEAD + "# Commands\n\n" + "\n".join(pages)


def pages() -> dict[Path, str]:
    """Return every generated page by its path below docs/."""
    made = {
        Path("reference", f"{make.__name__.replace('_', '-')}.md"): make()
        for make in (configuration, device_profiles, signals, faults, effects, cli, commands_that_act)
    }
    return made | {Path("faults", f"{f.name}.md"): fault(f) for f in FAULTS}


def stale(docs: Path = DOCS) -> list[str]:
    """Return the pages that differ from the code, and pages of faults that no longer exist."""
    wanted = pages()
    wrong = [
        str(p) for p, text in wanted.items() if not (docs / p).is_file() or (docs / p).read_text() != text
    ]
    return wrong + [
        f"faults/{p.name}" for p in (docs / "faults").glob("*.md") if Path("faults", p.name) not in wanted
    ]


def main(argv: list[str] | None = None) -> int:
    """Write the pages, or with --check list the stale ones (exit status 1)."""
    parser = argparse.ArgumentParser(prog="python -m tests.reference", description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit status 1 when a page is stale"
    )
    if parser.parse_args(argv).check:
        wrong = stale()
        for page in wrong:
            print(f"docs/{page} is stale: run python -m tests.reference", file=sys.stderr)
        return 1 if wrong else 0
    for path, text in pages().items():
        (DOCS / path).parent.mkdir(parents=True, exist_ok=True)
        (DOCS / path).write_text(text)
    for page in stale():
        (DOCS / page).unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
