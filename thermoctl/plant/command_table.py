"""Rows of the command table: plant files."""

from __future__ import annotations

from thermoctl.command import MAP, MODEL, PLANT, READING, RECORDINGS, Table, argument, command

TABLE: Table = {
    MODEL: (
        command(
            "plant new",
            "write a first plant file: from a recording, from a template, or a template that reads a recording",
            "thermoctl.plant.new:new",
            "",
            argument("file", metavar="FILE", help="the plant file to write"),
            argument(
                "--from-csv",
                metavar="REC",
                help="a recording: of a thermal rig, an axis or tanks; guesses are marked `# confirm`",
            ),
            argument(
                "--inputs",
                metavar="A,B",
                help="columns of inputs, with units where the file has none: 'P [W],air [degC]' (default: by kind)",
            ),
            argument(
                "--outputs", metavar="A,B", help="columns of sensors, in the same way (default: by kind)"
            ),
            *READING,
            argument(
                "--template",
                metavar="NAME",
                help="block, motor, hot-end, room, tank, stage, flexure or actuator",
            ),
        ),
        command(
            "plant show",
            "print a plant as tables, or draw its network",
            "thermoctl.plant.commands:show",
            "",
            argument("plant", metavar="PLANT"),
            argument("--out", metavar="FILE", help="draw to FILE.svg or FILE.png instead"),
        ),
        command(
            "simulate",
            "run a plant on inputs, and compare where outputs were recorded",
            "thermoctl.plant.commands:simulate",
            "",
            PLANT,
            MAP,
            RECORDINGS,
            *READING,
            argument(
                "--initial",
                metavar="NODE=VALUE,...",
                help="initial values of nodes; or `steady`, the steady state of the first inputs; or a recording: its last "
                "state (default: the plant file's; without first readings the steady state)",
            ),
            argument(
                "--horizon",
                type=float,
                metavar="S",
                help="predict at most S seconds ahead, re-initialised from the data",
            ),
            argument("--out", metavar="FILE", help="write time series (.csv, .parquet, .arrow)"),
            argument("--plot", metavar="FILE", help="draw measured and simulated outputs (.png, .svg)"),
        ),
        command(
            "refit",
            "fit a plant's parameters to recordings, inside their ranges",
            "thermoctl.plant.commands:refit",
            "",
            PLANT,
            MAP,
            RECORDINGS,
            *READING,
            argument("--out", metavar="PLANT2", help="write the refitted plant"),
            argument(
                "--held-out", nargs="+", metavar="REC", help="recordings for validation; not used in the fit"
            ),
            argument(
                "--noise",
                choices=["white", "ar1"],
                default="white",
                help="noise model (default white; ar1 is estimated)",
            ),
            argument(
                "--tries",
                type=int,
                default=0,
                metavar="N",
                help="random starting points in the ranges (default 0)",
            ),
        ),
    )
}
