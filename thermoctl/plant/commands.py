"""The commands simulate, refit, plant show and plant check."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table as Grid

from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError, dumps
from thermoctl.plant import Plant, load, save
from thermoctl.plant import expression as ex
from thermoctl.plant import show as drawing
from thermoctl.plant.fitting.estimate import Estimate, report, starts, updated
from thermoctl.plant.fitting.noise import coloured
from thermoctl.plant.fitting.refit import Fit, fit, fit_by_first_parts
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.ahead import ahead, all_uncertain
from thermoctl.plant.simulation.initial import last_state, with_start
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.plant.units import as_recorded
from thermoctl.recording.files import write_table
from thermoctl.recording.foreign.logger import options, print_notes
from thermoctl.recording.table import Table

Reader = Callable[[Plant, Sequence[str], argparse.Namespace], list[Table]]


def ends_of_tables(plant: Plant) -> dict[str, float]:
    """Return the last time, s, of every table over time, by the flow, output or node that reads it."""
    ends: dict[str, float] = {}
    holders = {f.name: f.rate for f in plant.flows.values()} | {
        o.name: o.value for o in plant.outputs.values()
    }
    holders |= {n.name: n.storage for n in plant.nodes.values()}
    values = {p.name: p.value for p in plant.parameters.values()}
    for name, expr in holders.items():
        for e in ex.walk(expr):
            if e.op == "table" and e.args[0].op == "name" and e.args[0].value == "t":
                last = float(ex.evaluate(e.args[int(e.value or 0)], values))
                ends[name] = min(ends.get(name, last), last)
    return ends


def _warn_of_tables(plant: Plant, recording: str, last: float) -> None:
    for name, end in ends_of_tables(plant).items():
        if last > end:
            print(
                f"warning: {recording}: '{name}' holds a table over time that ends at {end:g} s; from there to {last:g} s "
                "its last value is taken",
                file=sys.stderr,
            )


def simulate(args: argparse.Namespace, read: Reader | None = None) -> int:
    """Simulate freely, or predict `--horizon` seconds ahead, on one recording or several.

    `read`: reads recordings. Prints figures; writes a file and a plot on request."""
    plant = load(args.plant, args.map)
    initial = _initial(plant, args)
    runs: list[tuple[Table, Excitation, np.ndarray, np.ndarray]] = []
    model = compile_plant(all_uncertain(plant), ()) if args.horizon else compile_plant(plant)
    for table in (read or _read)(plant, args.recordings, args):
        path = table.path
        excitation = model.excitation(table)
        if note := with_start(model, excitation, initial):
            print(f"note: {path}: {note}", file=sys.stderr)
        _warn_of_tables(plant, path, float(excitation.t[-1]))
        try:
            if args.horizon:
                x, y, _ = ahead(model, excitation, args.horizon)
            else:
                run = model.run(excitation)
                x, y = run.x, run.y
        except SimulationError as e:
            raise InputError(f"{path}: {e}") from None
        runs.append((table, excitation, x, y))
        title = f"{path}: " + (f"up to {args.horizon:g} s ahead" if args.horizon else "free run")
        measured = bool(np.isfinite(excitation.y).any())
        if measured and not args.horizon and (note := _unread_starts(model, excitation)):
            print(f"note: {path}: {note}", file=sys.stderr)
        Console().print(_compared(plant, title, excitation, y) if measured else _courses(plant, title, y))
    for file, write in ((args.out, _write), (args.plot, _plot)):
        for table, excitation, x, y in runs if file else ():
            name = Path(file) if len(runs) == 1 else Path(file).with_stem(f"{Path(file).stem}_{table.name}")
            write(name, model, table, excitation, x, y)
            print(name)
    return 0


def _unread_starts(model: Model, excitation: Excitation) -> str:
    """Return a note on the nodes that start at a guess of the plant file, not at a reading; or ""."""
    given = np.full(len(model.states), np.nan) if excitation.x0 is None else excitation.x0
    starts = model.start(excitation, model.vector(None, excitation.name))[0]
    guessed = [
        f"{n} = {start:.4g} ± {node.initial_sigma:.2g} {node.unit or ''}".strip()
        for n, start, own in zip(model.states, starts, given, strict=True)
        if (node := model.plant.nodes[n]).initial_sigma
        and np.isnan(own)
        and not any(e.op == "first" for e in ex.walk(node.initial))
    ]
    if not guessed:
        return ""
    return (
        f"starts at {', '.join(guessed)}, as the plant file says; a refit or a diagnosis fits this to the readings, "
        "a free run does not (--initial NODE=VALUE)"
    )


def _initial(plant: Plant, args: argparse.Namespace) -> Mapping[str, float] | str | None:
    """Return the option --initial: values by node, "steady", or the last state of a recording."""
    if args.initial is None or args.initial == "steady":
        return None if args.initial is None else "steady"
    if "=" not in args.initial or Path(args.initial).exists():
        state = last_state(plant, _read(plant, [args.initial], args)[-1])
        print(f"start: {', '.join(f'{n} = {v:.5g}' for n, v in state.items())} (the end of {args.initial})")
        return state
    values = {}
    for part in args.initial.split(","):
        node, _, text = (x.strip() for x in part.partition("="))
        try:
            values[node] = float(text)
        except ValueError:
            raise InputError(
                f"--initial {part}: NODE=VALUE, such as winding=22, 'steady' or a recording was expected"
            ) from None
    return values


def _compared(plant: Plant, title: str, excitation: Excitation, y: np.ndarray) -> Grid:
    """Return the table of errors by output."""
    grid = Grid(title=title, title_justify="left")
    for head in ("output", "samples", "rms error", "largest", "share of the range"):
        grid.add_column(head, justify="left" if head == "output" else "right")
    for j, o in enumerate(plant.outputs.values()):
        error = (excitation.y[:, j] - y[:, j])[np.isfinite(excitation.y[:, j])]
        if len(error):
            spread = np.ptp(excitation.y[np.isfinite(excitation.y[:, j]), j])
            rms = float(np.sqrt(np.mean(error**2)))
            grid.add_row(
                o.name,
                str(len(error)),
                f"{rms:.4g} {o.unit or ''}",
                f"{np.max(np.abs(error)):.4g}",
                f"{100 * rms / spread:.2f} %" if spread > 0 else "",
            )
        else:
            grid.add_row(o.name, "0", "not measured", "", "")
    return grid


def _courses(plant: Plant, title: str, y: np.ndarray) -> Grid:
    """Return the table of outputs that nothing measured: their start, end and range."""
    grid = Grid(title=title, title_justify="left")
    for head in ("output", "start", "end", "lowest", "highest"):
        grid.add_column(head, justify="left" if head == "output" else "right")
    for o, v in zip(plant.outputs.values(), y.T, strict=True):
        grid.add_row(o.name, *(f"{x:.5g} {o.unit or ''}" for x in (v[0], v[-1], v.min(), v.max())))
    return grid


def _read(plant: Plant, paths: Sequence[str], args: argparse.Namespace) -> list[Table]:
    """Read recordings with the options --time and --columns; print their notes."""
    tables = read_recordings(plant, paths, **options(args))
    print_notes(tables)
    return tables


def _write(
    name: Path, model: Model, table: Table, excitation: Excitation, x: np.ndarray, y: np.ndarray
) -> None:
    columns = {f"{o.column}_simulated": y[:, j] for j, o in enumerate(model.plant.outputs.values())}
    measured = {
        o.column: excitation.y[:, j]
        for j, o in enumerate(model.plant.outputs.values())
        if o.column in table.columns
    }
    columns |= as_recorded(model.plant, measured)
    columns |= {f"{s}_state": x[:, i] for i, s in enumerate(model.states)}
    write_table(name, Table(name.stem, str(name), table.t, columns))


def _plot(
    name: Path, model: Model, table: Table, excitation: Excitation, x: np.ndarray, y: np.ndarray
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, max(3.0, 1.9 * len(model.outputs))), layout="constrained")
    FigureCanvasAgg(figure)
    panels = drawing.over_time(figure, model.plant, excitation, {"simulated": y})
    panels[0].set_title(f"{model.plant.title}: {table.name}", fontsize=10)
    with whole_file(name) as part:
        try:
            figure.savefig(part, dpi=120, format=name.suffix[1:] or None)
        except ValueError as e:  # no such format
            raise InputError(f"{name}: cannot be written: {e}") from None


def refit(args: argparse.Namespace, read: Reader | None = None) -> int:
    """Refit a plant's parameters; write the plant; report estimates and the fit before and after.

    `read`: reads recordings."""
    plant = load(args.plant, args.map)
    model = compile_plant(plant)
    if not any(p.range for p in plant.parameters.values()):
        raise InputError(f"{plant.file}: no parameter has a 'range', so there is nothing to refit")
    trained = (read or _read)(plant, args.recordings, args)
    excitations = [model.excitation(t) for t in trained]
    held = (read or _read)(plant, args.held_out or [], args)
    try:
        found = fit_by_first_parts(model, excitations, tries=args.tries)
        if args.noise == "ar1":
            found = fit(model, excitations, coloured(found, excitations), start=found.z)
        for d in excitations:
            d.scale = None
        fitted = updated(plant, found, excitations)
        if args.out:
            save(
                fitted,
                args.out,
                f"refitted by thermoctl to {', '.join(Path(r).name for r in args.recordings)}",
            )
        Console().print(_estimates(plant, report(found, excitations)))
        Console().print(_ended(found), end="")
        grid = Grid(title="rms error", title_justify="left")
        for head in ("recording", "took part", "output", "before", "after"):
            grid.add_column(head, justify="right" if head in ("before", "after") else "left")
        for part, tables in (("yes", trained), ("no", held)):
            for table in tables:
                before, after = _errors(plant, table), _errors(fitted, table)
                for o in plant.outputs:
                    grid.add_row(table.name, part, o, f"{before[o]:.4g}", f"{after[o]:.4g}")
        Console().print(grid)
        print(_starts(found, excitations), end="")
    except SimulationError as e:
        raise InputError(f"{plant.file}: {e}") from None
    return 0


def _ended(found: Fit) -> str:
    """Return a line about a refit that its limit ended; nothing about any other."""
    if found.converged:
        return ""
    return f"the refit ended by its limit of steps or time: its cost, {found.cost:.4g}, may fall by {found.left:.2g} more\n"


def _starts(found: Fit, excitations: list[Excitation]) -> str:
    """Return the starts that were fitted, a line for each recording; nothing if none was uncertain."""
    lines = [
        f"  {name}  {','.join(f'{n}={v:.6g}' for n, v in values.items())}\n"
        for name, values in starts(found, excitations).items()
    ]
    return "".join(["fitted starts, as thermoctl simulate --initial takes them:\n", *lines]) if lines else ""


def _estimates(plant: Plant, rows: list[Estimate]) -> Grid:
    grid = Grid(title="parameters", title_justify="left")
    for head in ("name", "before", "value", "standard error", "unit", "remark"):
        grid.add_column(head, justify="right" if head in ("before", "value", "standard error") else "left")
    words = {
        "ok": "",
        "dead": "dead: the data do not feel it",
        "flat": "flat: only a combination with others is felt",
    }
    for e in rows:
        p = plant.parameters[e.name]
        remark = words.get(e.state, f"at a bound of its range {list(p.range or ())}")
        if e.trades_with:
            remark = (remark + "; " if remark else "") + f"trades with {', '.join(e.trades_with[:4])}"
        grid.add_row(
            f"{e.name} ({e.recording})" if e.recording else e.name,
            f"{p.value:.6g}",
            f"{e.value:.6g}",
            f"{e.sd:.2g}",
            e.unit or "",
            remark,
        )
    return grid


def _errors(plant: Plant, table: Table) -> dict[str, float]:
    """Return the free-run rms error per output; uncertain initial states fitted, parameters held."""
    model = compile_plant(plant, ())
    excitation = model.excitation(table)
    if not np.isfinite(excitation.y).any():
        return {o: float("nan") for o in plant.outputs}
    if model.uncertain:
        return fit(model, [excitation]).rms()
    e = excitation.y - model.run(excitation).y
    return {
        o: float(np.sqrt(np.nanmean(e[:, j] ** 2))) if np.isfinite(e[:, j]).any() else float("nan")
        for j, o in enumerate(plant.outputs)
    }


def show(args: argparse.Namespace) -> int:
    """Print the plant as a plant file, or with --out draw it."""
    plant = load(args.plant)
    if args.out:
        drawing.draw(plant, args.out)
        print(args.out)
    else:
        print(dumps(plant.plain()), end="")
    return 0
