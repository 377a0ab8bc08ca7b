"""Rows of the command table: plant files."""

from __future__ import annotations

from thermoctl.command import MODEL, READING, Table, argument, command, option

TABLE: Table = {
    MODEL: (
        command(
            "plant new",
            "write a first plant file: from a recording, from a template, or a template that reads a recording",
            "thermoctl.plant.first.new:new",
            "",
            argument("file", metavar="FILE", help="the plant file to write"),
            option(
                "--from-csv",
                "REC",
                "a recording: of a thermal rig, an axis or tanks; guesses are marked `# confirm`",
            ),
            option(
                "--inputs",
                "A,B",
                "columns of inputs, with units where the file has none: 'P [W],air [degC]'; '' for none (default: by kind)",
            ),
            option("--outputs", "A,B", "columns of sensors, in the same way (default: by kind)"),
            *READING,
            option("--template", "NAME", "block, motor, hot-end, room, tank, stage, flexure or actuator"),
        ),
        command(
            "plant show",
            "print a plant, also an FMU, as a plant file, or draw its network",
            "thermoctl.plant.commands:show",
            "",
            argument("plant", metavar="PLANT"),
            option("--out", "FILE", "draw to FILE.svg or FILE.png instead"),
        ),
    )
}
