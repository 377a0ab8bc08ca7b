"""The commands `effects check` and `plan`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from thermoctl.advice.effect_files import check_file, files_of, own_plants
from thermoctl.advice.plan import Planned, contract, plan
from thermoctl.checks.commands import report
from thermoctl.diagnosis.commands import parsed_limits
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings
from thermoctl.recording.foreign.logger import options
from thermoctl.units import readable_time


def check_effects(args: argparse.Namespace) -> int:
    """Check effect files one by one; return 1 where one has a mistake."""
    plants = [load(args.plant)] if args.plant else own_plants()
    wrong = 0
    for path in files_of(args.files):
        try:
            name, places = check_file(path, plants)
        except InputError as e:
            print(f"thermoctl: {e}", file=sys.stderr)
            wrong += 1
            continue
        shown = ", ".join(places[:4]) + (", ..." if len(places) > 4 else "")
        where = (
            f"sits at {len(places)} places ({shown})"
            if places
            else "sits nowhere in these plants: try --plant"
        )
        print(f"{path}: good; {name} {where}")
    return int(wrong > 0)


def plan_experiment(args: argparse.Namespace) -> int:
    """`thermoctl plan`: print which effects and parameters recordings like these show. Raises InputError."""
    plant = load(args.plant, args.map)
    tables = read_recordings(plant, args.like or (), **options(args))
    entries = catalogue((CATALOGUE, *map(Path, args.effects or ())))
    planned = plan(plant, tables, entries, parsed_limits(args.limit or ()))
    if args.json:
        print(json.dumps(contract(planned), indent=1))
    else:
        _show(planned)
    return 0


def _show(planned: Planned) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=120)
    report(planned.checks, sys.stdout)
    span = f"{readable_time(planned.duration_s)}, a sample every {readable_time(planned.interval_s)}"
    if planned.slowest_s:
        share = planned.duration_s / planned.slowest_s
        span += f"; the plant's slowest time constant, {readable_time(planned.slowest_s)}, fits in {share:.1f} times"
    console.print(f"[bold]experiment[/] {span}")
    if planned.parameters:
        console.print(_parameters(planned))
    console.print(_effects(planned))
    for reason in sorted({v.reason for v in planned.effects if v.reason}):
        hidden = [v.candidate for v in planned.effects if v.reason == reason]
        console.print(
            f"not seen, {reason}: {_listed(f'{c.effect.name} at {c.place.where}' for c in hidden)}",
            markup=False,
        )
        helps = dict.fromkeys(c.effect.excited_by for c in hidden if c.effect.excited_by)
        console.print(f"    would show with: {_listed(helps)}", markup=False)
    if planned.better:
        console.print(
            f"better for the parameters: {planned.better.title} (last column of standard errors)",
            markup=False,
        )


def _effects(planned: Planned) -> Table:
    """Return the table of effects, those with the largest smallest visible size first."""
    heads = ["effect", "where", "seen from", "which moves, before a refit"]
    shown = Table(*heads, box=None, header_style="bold", title="seen, the worst first", title_justify="left")
    seen = [v for v in planned.effects if v.reason is None]
    for v in sorted(seen, key=lambda v: -(v.moves[2] if v.moves else 0.0)):
        unit = f" {'K' if v.unit == 'degC' else v.unit}" if v.unit and v.unit != "1" else ""
        moved = ""
        if v.moves:
            name, rms, share = v.moves
            reading = planned.units.get(name) or ""
            moved = f"{name} by {rms:.2g} {'K' if reading == 'degC' else reading}, {100 * share:.2g} % of its span"
        shown.add_row(
            v.candidate.effect.name, v.candidate.place.where, f"{v.parameter} = {v.smallest:.3g}{unit}", moved
        )
    return shown


def _listed(texts: Iterable[str]) -> str:
    return "; ".join(texts)


def _parameters(planned: Planned) -> Table:
    heads = ["parameter", "value", "± standard error", "the recording gives it"]
    shown = Table(*heads, *(["better course: ±"] if planned.better else []), box=None, header_style="bold")
    for p in planned.parameters:
        answer = "yes" if p.identified else "no" + (f": tied to {p.tied}" if p.tied else "")
        row = [p.name, f"{p.value:.4g} {p.unit or ''}", f"{p.sd:.2g}", answer]
        shown.add_row(*row, *([f"{planned.better.sd[p.name]:.2g}"] if planned.better else []))
    return shown
