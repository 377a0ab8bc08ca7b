"""Rows of the command table: the paper's tests."""

from __future__ import annotations

from thermoctl.command import CALIBRATE, Table, argument, command

TABLE: Table = {
    CALIBRATE: (
        command(
            "reproduce",
            "run the paper's tests on simulated rigs; report the paper's numbers, ours by its method, and ours by the better "
            "method",
            "thermoctl.reproduction.commands:reproduce",
            "config plant out seeds quick",
            argument(
                "--config",
                metavar="FILE",
                default="config/simulated.yaml",
                help="the simulated rig (default config/simulated.yaml)",
            ),
            argument(
                "--plant",
                metavar="FILE",
                default="config/plants/actuator_truth.yaml",
                help="plant file of the simulated hardware (default config/plants/actuator_truth.yaml)",
            ),
            argument(
                "--out",
                metavar="DIR",
                default="out/reproduce",
                help="folder of the report (default out/reproduce)",
            ),
            argument("--seeds", type=int, default=12, help="number of simulated rigs (default 12)"),
            argument("--quick", action="store_true", help="leave out the full run at the loop's period"),
        ),
    )
}
