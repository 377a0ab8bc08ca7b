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
            argument(
                "--data",
                nargs="+",
                metavar="REC",
                help=f"recordings to check with the plant ({FORMATS}); exit 1 on a severe fault",
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
            "thermoctl.checks.commands:refit",
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
            argument(
                "--anyway", action="store_true", help="refit in spite of a severe finding of the checks"
            ),
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
            argument(
                "--like",
                action="append",
                metavar="REC",
                help="a recording with the inputs and times of the experiment (repeatable); its readings do not count",
            ),
            argument(
                "--limit",
                action="append",
                metavar="NAME=LOW:HIGH",
                help="range of an input that can be driven; without --like it goes through levels (repeatable)",
            ),
            *READING,
            EFFECTS,
            JSON,
        ),
    ),
}
