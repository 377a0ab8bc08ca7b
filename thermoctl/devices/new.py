"""`thermoctl devices new`: ask for the facts of a device's manual and write its profile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.key import REQUIRED, Key
from thermoctl_hal.profiles.buses import BUSES
from thermoctl_hal.profiles.keys import TABLES
from thermoctl_hal.profiles.read import FORMAT, load_profile

EXIT_OK, EXIT_INPUT = 0, 2
_TOP = ("vendor", "model", "manual", "edition", "place")


def new(path: str, ask: Callable[[str], str] = input) -> int:
    """Ask for every key and write the profile; an empty answer takes the default.

    Raises InputError where the file exists or the answers make no profile; then nothing is written."""
    target = Path(path)
    if target.exists():
        raise InputError(f"{target}: exists; choose another name")
    try:
        text = _text(ask)
    except EOFError:
        raise InputError(f"{target}: not written, the answers ended early") from None
    with whole_file(target) as part:
        Path(part).write_text(text, encoding="utf-8")
        try:
            load_profile(Path(part))
        except InputError as e:
            raise InputError(f"{str(e).replace(part, path)}; nothing was written") from None
    print(f"{target}: written. Compare it with the device: thermoctl devices probe PORT --profile {target}")
    return EXIT_OK


def _text(ask: Callable[[str], str]) -> str:
    answers = [f"format: {FORMAT}"]
    for key in TABLES["profile"]:
        if key.name in _TOP:
            answers.append(f"{key.name}: {_quoted(_answer(ask, key))}")
    bus = ""
    while bus not in BUSES:
        bus = ask(f"bus ({', '.join(BUSES)}): ").strip()
    answers.append(f"bus: {bus}")
    if BUSES[bus].has_line:
        answers += ["line:", *_keys(ask, "line", 2)]
    section, table = BUSES[bus].section, BUSES[bus].table
    answers += [f"{section}:", *_keys(ask, table, 2)] if section else _keys(ask, table, 0)
    answers.append("channels:")
    while name := ask("name of a channel (empty: no more): ").strip():
        answers += [f"  {name}:", *_keys(ask, "channel", 4), *_keys(ask, f"channel of {bus}", 4)]
    return "\n".join(answers) + "\n"


def _keys(ask: Callable[[str], str], table: str, indent: int) -> list[str]:
    """Return the lines of a section; lists and mappings are typed as YAML: [a, b], {key: value}."""
    lines = []
    for key in TABLES[table]:
        answer = _answer(ask, key)
        if answer:
            text = _quoted(answer) if key.kind == "text" else answer
            lines.append(f"{' ' * indent}{key.name}: {text}")
    return lines or ([f"{' ' * indent}{{}}"] if indent else [])


def _answer(ask: Callable[[str], str], key: Key) -> str:
    """Return an answer, '' for the default; asks again where a required one is empty."""
    unit = f", {key.unit}" if key.unit else ""
    example = f", as {key.example}" if key.example else ""
    default = "" if key.default is REQUIRED else f" [{key.default}]"
    while True:
        answer = ask(f"{key.name} ({key.meaning}{unit}{example}){default}: ").strip()
        if answer or key.default is not REQUIRED:
            return answer


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
