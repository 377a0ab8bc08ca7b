"""Rows of the command table for commands of this package alone; cli/command_table.py has the others."""

from __future__ import annotations

from thermoctl.command import DIAGNOSE, PLANT, RECORDINGS, Table, argument, command

TABLE: Table = {
    DIAGNOSE: (
        command(
            "noise",
            "learn each sensor's own noise from quiet recordings; write the plant file with it",
            "thermoctl.diagnosis.data.sensor_noise:command",
            "",
            PLANT,
            RECORDINGS,
            argument("--out", required=True, metavar="PLANT2", help="the plant file to write"),
        ),
    )
}
