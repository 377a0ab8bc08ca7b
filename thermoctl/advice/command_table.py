"""Rows of the command table: checks, commands that make them first, and help before a diagnosis."""

from __future__ import annotations

from thermoctl.command import (
    DIAGNOSE,
    EFFECTS,
    FORMATS,
    JSON,
    MAP,
    MODEL,
    PLANT,
    READING,
    RECORDINGS,
    Table,
    argument,
    command,
    option,
    switch,
)

TABLE: Table = {
    MODEL: (
        command(
            "plant check",
            "read plant files with every check; with --data compare one with recordings, in seconds",
            "thermoctl.checks.commands:check",
            "",
            argument("plants", nargs="+", metavar="PLANT"),
            MAP,
            option(
                "--data",
                "REC",
                f"recordings to check with the plant ({FORMATS}); exit 1 on a severe fault",
                nargs="+",
            ),
            *READING,
        ),
        command(
            "simulate",
            "run a plant on inputs, and compare where outputs were recorded",
            "thermoctl.checks.commands:simulate",
            "",
            PLANT,
            MAP,
            RECORDINGS,
            *READING,
            option(
                "--initial",
                "NODE=VALUE,...",
                "initial values of nodes; or `steady`, the steady state of the first inputs; or a recording: its last "
                "state (default: the plant file's; without first readings the steady state)",
            ),
            option(
                "--horizon", "S", "predict at most S seconds ahead, re-initialised from the data", type=float
            ),
            option("--out", "FILE", "write time series (.csv, .parquet, .arrow)"),
            option("--plot", "FILE", "draw measured and simulated outputs (.png, .svg)"),
        ),
        command(
            "refit",
            "fit a plant's parameters to recordings, inside their ranges",
            "thermoctl.checks.commands:refit",
            "",
            PLANT,
            MAP,
            RECORDINGS,
            *READING,
            option("--out", "PLANT2", "write the refitted plant"),
            option("--held-out", "REC", "recordings for validation; not used in the fit", nargs="+"),
            argument(
                "--noise",
                choices=["white", "ar1"],
                default="white",
                help="noise model (default white; ar1 is estimated)",
            ),
            option("--tries", "N", "random starting points in the ranges (default 0)", type=int, default=0),
            switch("--anyway", "refit in spite of a severe finding of the checks"),
        ),
    ),
    DIAGNOSE: (
        command(
            "plan",
            "say what a diagnosis could see with a plant, its sensors and an experiment: effects, parameters, a better course",
            "thermoctl.advice.commands:plan_experiment",
            "",
            PLANT,
            MAP,
            option(
                "--like",
                "REC",
                "a recording with the inputs and times of the experiment (repeatable); its readings do not count",
                action="append",
            ),
            option(
                "--limit",
                "NAME=LOW:HIGH",
                "range of an input that can be driven; without --like it goes through levels (repeatable)",
                action="append",
            ),
            *READING,
            EFFECTS,
            JSON,
        ),
    ),
}
