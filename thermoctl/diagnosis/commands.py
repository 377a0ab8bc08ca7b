"""The commands `diagnose` and `effects save`: progress, a summary for a person, JSON for a program."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from thermoctl.checks.commands import checked, report
from thermoctl.diagnosis import run
from thermoctl.diagnosis.experiment.file import peaks
from thermoctl.diagnosis.experiment.resolve import resolve, worth_running
from thermoctl.diagnosis.law.result import save_effect
from thermoctl.diagnosis.report import figures
from thermoctl.diagnosis.report.words import sentences, what_next
from thermoctl.diagnosis.show import read
from thermoctl.files.kept import reading
from thermoctl.files.yamlfile import InputError
from thermoctl.interrupt import Interrupted
from thermoctl.plant import load
from thermoctl.plant.language import Plant
from thermoctl.plant.recordings import read_recordings
from thermoctl.recording.table import Table as Recording

QUIET_S = 5.0  # seconds between two lines on the same stage


class StageReporter:
    """Writes each stage with the time gone; inside a stage at most one line in QUIET_S.

    As a context, it writes a line every QUIET_S while nothing is reported: a sign of life."""

    def __init__(self) -> None:
        self.started, self.stage, self.last, self.written = time.monotonic(), "", "", 0.0
        self.ended = threading.Event()
        self.beat = threading.Thread(target=self._live, daemon=True)

    def __call__(self, text: str) -> None:
        gone, stage = time.monotonic() - self.started, text.partition(":")[0]
        self.last = text
        if stage != self.stage or gone - self.written >= QUIET_S:
            self.stage, self.written = stage, gone
            print(f"{gone:6.1f} s: {text}", file=sys.stderr, flush=True)

    def __enter__(self) -> StageReporter:
        self.beat.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()

    def _live(self) -> None:
        while not self.ended.wait(1.0):
            if self.last and time.monotonic() - self.started - self.written >= QUIET_S:
                self(self.last)


@contextlib.contextmanager
def on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield whether Ctrl-C was pressed; the second one raises KeyboardInterrupt, as usual.

    A process in the background that ignores Ctrl-C goes on doing so."""
    asked = threading.Event()
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored or threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def ask(*_: object) -> None:
        """Let the search end after the present refit; the next Ctrl-C ends the program."""
        asked.set()
        signal.signal(signal.SIGINT, before)
        print(
            "thermoctl: the search ends after this refit, with the result so far; Ctrl-C again gives up",
            file=sys.stderr,
            flush=True,
        )

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def diagnose(args: argparse.Namespace) -> int:
    """`thermoctl diagnose`: run the diagnosis and print its summary.

    Raises InputError for unusable inputs."""
    if not args.recordings:
        raise InputError("no recording was given; one or more were expected, or --live")

    run.writable(Path(args.out))
    plant = load(args.plant, args.map)
    given, found_before = checked(plant, args.recordings, args)
    held_out, found_held = checked(plant, args.held_out or (), args)
    report(list(dict.fromkeys([*found_before, *found_held])), sys.stderr)
    if any(f.severe for f in (*found_before, *found_held)) and not args.anyway:
        raise InputError(
            f"{args.plant}: not diagnosed: the checks above would make any name doubtful; correct the data or the "
            "plant, or diagnose with --anyway"
        )

    def diagnosed(recordings: Sequence[str]) -> dict[str, Any]:
        """Diagnose the recordings of the command line, and those that --resolve has recorded since."""
        added = read_recordings(plant, recordings[len(args.recordings) :])  # recordings that --resolve made
        return _run(args, plant, [*given, *added], held_out)

    try:
        if args.resolve:
            say = functools.partial(print, file=sys.stderr, flush=True)
            result = resolve(diagnosed, args.recordings, Path(args.out), args.record, args.rounds, say)
        else:
            result = diagnosed(args.recordings)
    except KeyboardInterrupt as e:
        raise Interrupted(f"{e or 'stopped'}; {args.out} holds nothing of this diagnosis") from None
    if args.json:
        print(json.dumps(result, indent=1, allow_nan=False))
    elif not args.quiet:
        summary(result, args.out)
    return 0


def _run(
    args: argparse.Namespace, plant: Plant, tables: Sequence[Recording], held_out: Sequence[Recording]
) -> dict[str, Any]:
    """Diagnose with progress, Ctrl-C and the options of the command line."""
    with contextlib.nullcontext() if args.quiet else StageReporter() as progress, on_interrupt() as stopped:
        return run.diagnose(
            plant,
            tables,
            args.out,
            [Path(e) for e in args.effects or ()],
            held_out,
            progress,
            args.drive or (),
            parsed_limits(args.limit or ()),
            stopped,
            Path(args.continued) if args.continued else None,
            anyway=args.anyway,
        )


def parsed_limits(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the range of each NAME=LOW:HIGH. Raises InputError."""
    out = {}
    for text in texts:
        name, _, span = text.partition("=")
        low, _, high = span.partition(":")
        try:
            out[name] = (float(low), float(high))
        except ValueError:
            raise InputError(
                f"--limit {text}: NAME=LOW:HIGH was expected, such as block_temperature=15:90"
            ) from None
        if not out[name][0] < out[name][1]:
            raise InputError(f"--limit {text}: the first number must be the smaller one")
    return out


def save_law(args: argparse.Namespace) -> int:
    """`thermoctl effects save DIR NAME`: save the law of a diagnosis as an effect file. Raises InputError."""
    if len(args.files) != 2:
        raise InputError(
            "effects save: the folder of a diagnosis and a name were expected: effects save DIR NAME"
        )
    folder, label = args.files
    result, own = read(Path(folder)), Path((args.effects or ["effects"])[0])
    with reading(Path(folder) / "diagnosis.json", "the result of a diagnosis", "diagnose again"):
        paths = save_effect(result, label, own)
    for path in paths:
        print(f"written: {path}; `thermoctl diagnose --effects {path.parent}` finds it by name")
    return 0


def summary(result: dict[str, Any], out: str | Path) -> None:
    """Print a result for a person."""
    console = Console() if sys.stdout.isatty() else Console(width=160)
    console.print(f"[bold]{result['verdict'].replace('_', ' ')}[/].", end=" ")
    console.print(" ".join(sentences(result)), markup=False)
    if result["findings"]:
        rows = []
        for f in result["findings"]:
            first = (f["effect"], f["where"], figures.equation(f))
            for row in figures.parameter_rows(f)[1]:
                rows.append((*first, *row))
                first = ("", "", "")
        _print(console, (("effect", "where", "equation", "parameter", "value, 95 %", "unit"), rows))
    _print(console, figures.alternative_rows(result))
    _print(console, figures.error_rows(result))
    lines = [f"note: {note}" for note in figures.merged(result["notes"])]
    if result["next_experiment"]:
        lines += _next_experiment(result["next_experiment"], Path(out))
    lines += [
        f"round {k}: was {r['verdict']}; ran {r['experiment']} -> {r['recording']}"
        for k, r in enumerate(result.get("resolved", ()), 1)
    ]
    lines.append(f"what next: {what_next(result)}")
    lines.append(
        f"written: {Path(out) / 'report.html'}, plant.yaml, diagnosis.json ({result['seconds']:.0f} s)"
    )
    for line in lines:
        console.print(line, markup=False)


def _print(console: Console, rows: figures.Rows) -> None:
    if rows[1]:
        table = Table(*rows[0], box=None, header_style="bold")
        for row in rows[1]:
            table.add_row(*map(escape, row))
        console.print(table)


def _next_experiment(entry: Mapping[str, Any], out: Path) -> list[str]:
    lines = [
        f"next experiment: {entry['profile']}. {entry['why']}",
        *(f"    {line}" for line in peaks(entry)),
    ]
    if worth_running(entry):
        by_hand = f"run it: thermoctl experiment {out / entry['file']}  (or by hand: next_experiment.csv), "
        lines.append(by_hand + "or let `thermoctl diagnose --resolve` do it")
    return lines
