"""Rows of the command table: recordings."""

from __future__ import annotations

from thermoctl.command import FORMATS, JSON, LOOK, READING, Table, argument, command, option, switch

TABLE: Table = {
    LOOK: (
        command(
            "recordings list",
            "list the recordings of a folder",
            "thermoctl.recording.commands:list_recordings",
            "",
            argument("directory", nargs="?", default="recordings", help="the folder (default recordings)"),
            JSON,
        ),
        command(
            "recordings info",
            "show what a recording holds: time span, signals, configuration, model",
            "thermoctl.recording.commands:show_info",
            "",
            argument("file", help="an .arrows file"),
            JSON,
        ),
        command(
            "recordings export",
            "write a recording as Parquet, CSV, MDF4 or MCAP; the suffix of OUT decides",
            "thermoctl.recording.commands:export_recording",
            "",
            argument("file", help="any recording"),
            argument("out", help="OUT.parquet, .csv, .mf4, .mcap"),
            argument("--columns", help="only these signals, separated by commas"),
            option("--from", "S", "from this t", dest="begin", type=float, default=float("-inf")),
            option("--to", "S", "before this t", dest="end", type=float, default=float("inf")),
        ),
        command(
            "recordings import",
            "read the files of any logger and write Parquet with units; several files are parts of one recording",
            "thermoctl.recording.commands:import_recordings",
            "",
            argument("files", nargs="+", metavar="FILE", help=FORMATS),
            option("--out", "OUT", "OUT.parquet (or .csv, .arrow: without units)"),
            switch("--explain", "say how each file is read, and why"),
            *READING,
        ),
        command(
            "recordings recover",
            "write a complete copy of a recording that was cut off",
            "thermoctl.recording.commands:recover_recording",
            "",
            argument("file", help="the .arrows file"),
            argument("--out", help="the copy (default FILE.recovered.arrows)"),
        ),
    )
}
