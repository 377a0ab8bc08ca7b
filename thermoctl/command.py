"""A row of the command table: a command's name, help and arguments, and the function that does its work.

Each package holds the rows of its own commands in `command_table.py`: `TABLE`, rows by purpose. A table
imports nothing but this module, so that `thermoctl --help` loads no package. `commands` joins the tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

RUN, LOOK, CALIBRATE = "run a rig", "look at a rig and its recordings", "calibrate a rig"
MODEL, DIAGNOSE, MANY_RIGS, HELP = "model", "diagnose", "many rigs", "help"
PURPOSES = (RUN, LOOK, CALIBRATE, MODEL, DIAGNOSE, MANY_RIGS, HELP)
"""The purposes of commands, in the order of `thermoctl --help`."""


class Argument(NamedTuple):
    """One argument, as argparse's add_argument takes it."""

    flags: tuple[str, ...]
    options: Mapping[str, Any]


class Command(NamedTuple):
    """One command; a name of two words is a command below a group.

    function: "module:function", imported when the command is given. takes: the arguments that the function
    gets, in order, by the names that argparse gives them. `settings` stands for the configuration read from
    --config, `parser` for the whole command line. Without any the function gets the namespace of all
    arguments."""

    name: str
    help: str
    function: str
    takes: str
    arguments: tuple[Argument, ...]


Table = Mapping[str, tuple[Command, ...]]
"""The rows of a package by purpose."""


def argument(*flags: str, **options: Any) -> Argument:
    """Return an argument with the flags and options of argparse's add_argument."""
    return Argument(flags, options)


def option(flag: str, metavar: str, help: str, **more: Any) -> Argument:
    """Return an option with a value, which the help shows as `metavar`."""
    return argument(flag, metavar=metavar, help=help, **more)


def switch(flag: str, help: str) -> Argument:
    """Return an option without a value."""
    return argument(flag, action="store_true", help=help)


def command(name: str, help: str, function: str, takes: str, *arguments: Argument) -> Command:
    """Return a command's row."""
    return Command(name, help, function, takes, arguments)


CONFIG = option(
    "--config",
    "FILE",
    "configuration (else $THERMOCTL_CONFIG, config/simulated.yaml, /etc/thermoctl/rig.yaml)",
)
"""The option of every command that needs a rig; `which_rig.choose` stores the path that it found."""
AXIS = option("--axis", "NAME", "the axis of a rig with several")
"""Goes with CONFIG, except for ALL_AXES (see `takes_axis`)."""
FILE = argument("file", nargs="?", metavar="CONFIG", help="the same as --config CONFIG")
YES = switch("--yes", "start without asking; without a terminal, required to move a rig")
JSON = switch("--json", "print one JSON object, for programs")
PLANT = option("--plant", "PLANT", "the plant file, or an FMU", required=True)
MAP = option(
    "--map", "FILE", "with an FMU as the plant: columns, roles, units, noise and ranges of its variables"
)
FORMATS = "text of any dialect, .xlsx, .mat, .mf4, .tdms, .json, .parquet, .arrow"
"""The formats of recordings that every command reads, for help texts."""
RECORDINGS = argument("recordings", nargs="+", metavar="REC", help=f"recordings ({FORMATS})")
TIME = option(
    "--time",
    "COLUMN|STEP",
    "the column of times (default: found by its cells, its name and unit, and that it increases); or the time from "
    "row to row, such as 0.1s or '10 ms'",
)
COLUMNS = option(
    "--columns", "NAME=COLUMN,...", "names that the plant reads, and the recordings' columns for them"
)
READING = (
    TIME,
    COLUMNS,
    option("--sheet", "NAME", "the sheet (Excel), group (TDMS) or variable (MATLAB) to read"),
    option(
        "--missing", "WORD,...", "further words or numbers for 'no value', as in --missing=-9999,'not ready'"
    ),
    argument("--decimal", choices=(".", ","), help="the decimal sign, where numbers can be read in two ways"),
    option("--run", "N", "of several runs in a file, the one to read, from 1", type=int),
    argument(
        "--equal-times",
        choices=("spread", "mean", "first", "last"),
        help="rows of one time: spread them to the next time, or take one row",
    ),
)
"""How a recording of any logger is read."""
EFFECTS = option("--effects", "DIR", "a further folder of effect files (repeatable)", action="append")
MODELS = option("--models", "DIR", "folder of calibrations (default models; of an axis models/AXIS)")
ORDER = argument("--order", type=int, default=0, help="number of real poles (default 0: chosen by BIC)")
ROOT = option("--root", "DIR", "install below this directory", default="/")
