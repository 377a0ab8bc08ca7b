"""Rows of the command table: many rigs."""

from __future__ import annotations

from thermoctl.command import JSON, MANY_RIGS, Table, argument, command

TABLE: Table = {
    MANY_RIGS: (
        command(
            "fleet",
            "summarise many rigs' recordings: health, drift of parameters, models that no longer fit; exit 1 when one needs "
            "attention",
            "thermoctl.fleet.commands:fleet",
            "folder plant parameters workers scheduler json",
            argument(
                "folder", metavar="FOLDER", help="a folder, or a path in an object store as s3://BUCKET/RIGS"
            ),
            argument("--plant", metavar="FILE", help="plant file to compare the recordings with"),
            argument(
                "--parameters", default="", metavar="A,B", help="the plant's parameters to follow over time"
            ),
            argument(
                "--workers",
                type=int,
                default=0,
                metavar="N",
                help="local Dask processes (default 0: this process)",
            ),
            argument("--scheduler", metavar="ADDRESS", help="a Dask cluster"),
            JSON,
        ),
    )
}
