"""Rows of the command table: plants for other programs."""

from __future__ import annotations

from thermoctl.command import MODEL, READING, Table, argument, command, option

TABLE: Table = {
    MODEL: (
        command(
            "plant export",
            "write a plant for other programs: FMU, Modelica, Python, C",
            "thermoctl.export.commands:export",
            "",
            argument("plant", metavar="PLANT"),
            argument("--to", required=True, choices=["fmu", "modelica", "python", "c"], help="the language"),
            option("--out", "FILE", "the file (default: the plant's name with the language's ending)"),
            option(
                "--data",
                "REC",
                "a recording: first readings, this recording's parameters, and the widths of jumps",
            ),
            *READING,
        ),
    )
}
