"""Rows of the command table: the diagnosis' score."""

from __future__ import annotations

from thermoctl.command import MANY_RIGS, Table, argument, command

TABLE: Table = {
    MANY_RIGS: (
        command(
            "prove",
            "diagnose a folder of cases, compare with the answers, score",
            "thermoctl.proof.commands:prove",
            "",
            argument(
                "cases",
                nargs="?",
                metavar="CASES",
                help="folder of cases: plant.yaml and recordings each (with --real: of real recordings)",
            ),
            argument("--out", required=True, metavar="DIR", help="folder of the results"),
            argument(
                "--answers",
                metavar="DIR",
                help="folder of NAME.yaml files (default: answer.yaml of each case)",
            ),
            argument("--number", type=int, metavar="N", help="only the first N cases"),
            argument("--workers", type=int, metavar="N", help="local processes (default: one a core)"),
            argument(
                "--scheduler", metavar="ADDRESS", help="a Dask scheduler (tcp://...) that sees the same files"
            ),
            argument(
                "--real",
                action="store_true",
                help="real recordings: effects found, strays, held-out error (default folder: $THERMOCTL_RECORDINGS)",
            ),
        ),
    )
}
