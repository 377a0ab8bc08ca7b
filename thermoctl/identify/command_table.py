"""Rows of the command table: the compensator's model of a plant."""

from __future__ import annotations

from thermoctl.command import MODEL, Table, argument, command, option, switch

TABLE: Table = {
    MODEL: (
        command(
            "plant linearise",
            "make the compensator's model from a thermal plant",
            "thermoctl.identify.commands:linearise",
            "",
            argument("plant", metavar="PLANT"),
            option("--out", "MODEL", "the model file"),
            switch("--replace", "overwrite MODEL"),
            option("--rig", "NAME", "name of the rig (default simulated)", default="simulated"),
            option("--points", "FILE", "rig file or points file with the points (default: the paper's)"),
            option("--period", "S", "the loop's period (default 0.001)", type=float, default=0.001),
            option(
                "--sensor-period",
                "S",
                "the thermocouple's sampling period (default 0.1)",
                type=float,
                default=0.1,
            ),
            argument(
                "--kind",
                choices=["kalman", "mkf"],
                default="kalman",
                help="steady Kalman gain (default), or the paper's modified Kalman filter",
            ),
            option(
                "--heat-density",
                "Q",
                "spectral density of each body's unknown heat, W^2 s (default 0.05)",
                type=float,
                default=0.05,
            ),
        ),
    )
}
