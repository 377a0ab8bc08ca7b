"""Rows of the command table: many rigs."""

from __future__ import annotations

from thermoctl.command import JSON, MANY_RIGS, Table, argument, command, option

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
            option("--plant", "FILE", "plant file to compare the recordings with"),
            option("--parameters", "A,B", "the plant's parameters to follow over time", default=""),
            option("--workers", "N", "local Dask processes (default 0: this process)", type=int, default=0),
            option("--scheduler", "ADDRESS", "a Dask cluster"),
            JSON,
        ),
    )
}
