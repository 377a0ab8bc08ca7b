"""Rows of the command table: calibrations."""

from __future__ import annotations

from thermoctl.command import CALIBRATE, CONFIG, MODELS, ORDER, YES, Table, argument, command, option, switch

TABLE: Table = {
    CALIBRATE: (
        command(
            "calibrate",
            "doctor, step, PID, tests, model and proof in one guided run; continues where it was ended; writes only into its "
            "folder until it is accepted",
            "thermoctl.calibration.commands:calibrate",
            "config out models order gains accept again yes",
            CONFIG,
            option("--out", "DIR", "the calibration's folder (default calibration/RIG)"),
            MODELS,
            ORDER,
            switch("--gains", "on acceptance also write the proven PID gains"),
            switch("--accept", "install the model when the proof is done"),
            switch("--again", "discard an earlier run in the folder"),
            YES,
        ),
        command(
            "tune",
            "propose PID gains from the closed loop's response to setpoint ramps of a few um; asks, then arms the rig with "
            "all protections",
            "thermoctl.calibration.commands:tune",
            "config write yes",
            CONFIG,
            switch(
                "--write",
                "prove each step towards the proposal on the rig, then write it into the configuration",
            ),
            YES,
        ),
        command(
            "experiment",
            "run and record a test of experiments.yaml, or an experiment file such as a diagnosis proposes",
            "thermoctl.calibration.commands:run_experiment",
            "name config out dry_run resume plant yes",
            argument(
                "name", metavar="NAME|FILE", help="a test of experiments.yaml, or a file with one experiment"
            ),
            CONFIG,
            option(
                "--plant",
                "PLANT",
                "simulate this plant file instead of the rig, for inputs that the daemon cannot drive",
            ),
            option("--out", "FILE", "recording (.parquet, .csv, .arrow; default NAME.parquet)"),
            switch("--dry-run", "show schedule, power and spectrum; drive nothing"),
            switch("--resume", "continue an aborted recording"),
            YES,
        ),
        command(
            "identify",
            "make a calibration from the recordings of tests 2, 3 and 4A, in the folder of calibrations",
            "thermoctl.calibration.commands:identify",
            "test_2 test_3 test_4a config models order",
            argument("test_2", metavar="TEST_2"),
            argument("test_3", metavar="TEST_3"),
            argument("test_4a", metavar="TEST_4A"),
            CONFIG,
            MODELS,
            ORDER,
        ),
        command(
            "model",
            "list, show or roll back calibrations",
            "thermoctl.calibration.commands:model",
            "action models name",
            argument("action", choices=("list", "show", "rollback")),
            argument("name", nargs="?", metavar="NAME"),
            MODELS,
        ),
        command(
            "evaluate",
            "compute the ISO 230-2 figures of recordings with a reference encoder",
            "thermoctl.calibration.commands:evaluate",
            "recordings",
            argument("recordings", nargs="+", metavar="RECORDING"),
        ),
    )
}
