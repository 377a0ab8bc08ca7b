"""Rows of the command table: the compensator's model of a plant."""

from __future__ import annotations

from thermoctl.command import MODEL, Table, argument, command

TABLE: Table = {
    MODEL: (
        command(
            "plant linearise",
            "make the compensator's model from a thermal plant",
            "thermoctl.identify.commands:linearise",
            "",
            argument("plant", metavar="PLANT"),
            argument("--out", metavar="MODEL", help="the model file"),
            argument("--replace", action="store_true", help="overwrite MODEL"),
            argument(
                "--rig", default="simulated", metavar="NAME", help="name of the rig (default simulated)"
            ),
            argument(
                "--points",
                metavar="FILE",
                help="rig file or points file with the points (default: the paper's)",
            ),
            argument(
                "--period", type=float, default=0.001, metavar="S", help="the loop's period (default 0.001)"
            ),
            argument(
                "--sensor-period",
                type=float,
                default=0.1,
                metavar="S",
                help="the thermocouple's sampling period (default 0.1)",
            ),
            argument(
                "--kind",
                choices=["kalman", "mkf"],
                default="kalman",
                help="steady Kalman gain (default), or the paper's modified Kalman filter",
            ),
            argument(
                "--heat-density",
                type=float,
                default=0.05,
                metavar="Q",
                help="spectral density of each body's unknown heat, W^2 s (default 0.05)",
            ),
        ),
    )
}
