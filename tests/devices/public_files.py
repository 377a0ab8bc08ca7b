"""Which DBC and EDS files of a folder can be used: `python -m tests.devices.public_files FOLDER` prints a table.

`make device-files FOLDER=...` does the same. A signal is used when a profile can name it; an object when it is a
whole number of up to 4 bytes. Files of others are not part of this repository.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.profile import Cia402, Object
from thermoctl_hal.can.dbc_file import load_dbc
from thermoctl_hal.can.eds import read_eds
from thermoctl_hal.can.set_up import Objects

STATUS_WORD, CONTROL_WORD = Object(0x6041), Object(0x6040)


class Row(NamedTuple):
    """A file: how many of its signals or objects a profile can name, its warning, and what is refused."""

    name: str
    usable: str
    warning: str
    refused: str


def dbc_row(path: Path, name: str) -> Row:
    """Return the row of a DBC file."""
    try:
        file = load_dbc(path)
    except (OSError, ValueError) as e:
        return Row(name, "no", "", str(e))
    count = sum(
        f"{m.name}.{s.name}" not in file.faults and m.name not in file.faults
        for m in file.database.messages
        for s in m.signals
    )
    first = next((f"{k}: {v}" for k, v in file.faults.items()), "")
    more = f" (and {len(file.faults) - 1} more)" if len(file.faults) > 1 else ""
    return Row(
        name,
        f"{count} signals of {len(file.database.messages)} messages",
        file.warning.removeprefix(f"{path}:"),
        first + more,
    )


def eds_row(path: Path, name: str) -> Row:
    """Return the row of an EDS file."""
    try:
        file = read_eds(path)
        objects = Objects(Cia402(path, 1, 10, CONTROL_WORD, (STATUS_WORD,)), "", 1)
    except (OSError, ValueError, InputError) as e:
        return Row(name, "no", "", str(e))
    count, refused = 0, ""
    for item in file.entries:
        try:
            objects.format(item, "transmit")
            count += 1
        except InputError:
            pass
    for item in (CONTROL_WORD, STATUS_WORD):
        try:
            objects.format(item, "transmit")
        except InputError as e:
            refused = refused or str(e).split(": ")[-1]
    return Row(
        name, f"{count} of {len(file.entries)} objects", file.warning.removeprefix(f"{path}:"), refused
    )


def table(folder: Path) -> str:
    """Return the table of every .dbc and .eds file below a folder, and the sums."""
    rows = [
        (dbc_row if path.suffix.lower() == ".dbc" else eds_row)(path, str(path.relative_to(folder)))
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in (".dbc", ".eds")
    ]
    lines = ["| file | usable | warned (line: message) | refused when named |", "|---|---|---|---|"]
    lines += ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows]
    used = [r for r in rows if r.usable != "no"]
    warned = sum(bool(r.warning) for r in used)
    lines.append("")
    lines.append(
        f"{len(rows)} files: {len(used)} usable, {warned} of them with a warning, "
        f"{sum(bool(r.refused) for r in used)} with parts that are refused when a profile names them; "
        f"{len(rows) - len(used)} refused"
    )
    return "\n".join(lines)


def main() -> None:
    """Print the table of a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    print(table(parser.parse_args().folder))


if __name__ == "__main__":
    main()
