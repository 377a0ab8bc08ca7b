"""Rows of the command table: help before a diagnosis."""

from __future__ import annotations

from thermoctl.command import DIAGNOSE, EFFECTS, JSON, MAP, MODEL, PLANT, READING, Table, argument, command

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
                help="recordings to check with the plant; exit 1 on a severe fault",
            ),
            *READING,
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
