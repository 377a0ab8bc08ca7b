"""The command `thermoctl`: from its first line on a signal ends it by one line and one exit status."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from thermoctl.interrupt import STATUS, raise_on_signals


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status. `argv`: its words, instead of the program's own."""
    try:
        if argv is None:
            raise_on_signals()
        from thermoctl.cli.command_line import run

        return run(argv)
    except KeyboardInterrupt as e:
        print(f"thermoctl: {e or 'interrupted'}", file=sys.stderr)
        return STATUS
