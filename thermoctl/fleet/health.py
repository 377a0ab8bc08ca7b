"""Many rigs' recordings over months: how each rig is, which parameters drift, which rig's model no longer fits.

Each recording is judged by itself, so that they can be spread over processes or a Dask cluster:
- health: share of time armed, faults, slipped ticks, mean innovation, error at the proof encoder;
- fit: the plant with its written values against the recording, residual / (noise of the output), worst output;
- parameters: a refit of the named ones, with standard errors.
A rig's parameter drifts when the straight line through its estimates has a slope of more than DRIFT_SIGMA standard
errors and changes it by more than DRIFT_SHARE over the time seen. A model no longer fits when the newest recording's
residual is above FIT_LIMIT; the residual after the refit says whether values (identify again) or physics (diagnose).
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.control import faults
from thermoctl.plant import load
from thermoctl.plant.refit import fit, report
from thermoctl.plant.simulate import SimulationError, compile_plant
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.recording.writer import NAME, TIER
from thermoctl.yamlfile import InputError, suggest

DRIFT_SIGMA, DRIFT_SHARE, FIT_LIMIT = 4.0, 0.05, 3.0
ROWS = 4000  # a recording is thinned to about so many
SUFFIXES = (".parquet", ".csv", ".arrow", TIER)
ARMED = 3.0


@dataclass(frozen=True)
class Summary:
    """One recording in numbers; NaN where it does not say. estimates: parameter -> (value, standard error)."""

    path: str
    rig: str
    begin_s: float
    hours: float
    armed: float = math.nan
    faults: tuple[str, ...] = ()
    slips: float = math.nan
    innovation_c: float = math.nan
    proof_um: float = math.nan
    misfit: float = math.nan
    worst: str = ""
    misfit_refitted: float = math.nan
    estimates: dict[str, tuple[float, float]] = field(default_factory=dict)
    error: str = ""


def find_recordings(folder: str | Path) -> list[str]:
    """All recordings below a folder, or below an object store's path (s3://BUCKET/RIGS; whatever fsspec knows): our 10 Hz
    tiers, Parquet, CSV and Arrow files. Raises InputError without one."""
    if "://" in str(folder):
        fs, root = _store(str(folder))
        try:
            found = sorted(fs.unstrip_protocol(p) for p in fs.find(root) if p.endswith(SUFFIXES))
        except Exception as e:  # each store raises what its own library raises
            raise InputError(f"{folder}: cannot be listed: {e}") from None
    elif not Path(folder).is_dir():
        raise InputError(f"{folder}: not a folder; one with the rigs' recordings was expected")
    else:
        found = sorted(str(p) for p in Path(folder).rglob("*") if p.is_file() and p.name.endswith(SUFFIXES))
    if not found:
        raise InputError(
            f"{folder}: no recordings in it; files ending in {', '.join(SUFFIXES)} were expected"
        )
    return found


def _store(url: str) -> tuple[Any, str]:
    """(file system, path in it) of an address; its credentials are those that its own library finds."""
    try:
        import fsspec
    except ImportError:
        raise InputError(f"{url}: needs the package 'fsspec': pip install 'thermoctl[fleet]'") from None
    try:
        return fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as e:
        raise InputError(f"{url}: {e}") from None


@contextmanager
def _local(path: str) -> Iterator[str]:
    """A path that can be read here: itself, or a copy of what lies in an object store."""
    if "://" not in path:
        yield path
        return
    fs, inside = _store(path)
    with tempfile.TemporaryDirectory(prefix="thermoctl-fleet") as folder:
        copy = f"{folder}/{Path(inside).name}"
        try:
            fs.get_file(inside, copy)
        except Exception as e:  # as above
            raise InputError(f"{path}: cannot be fetched: {e}") from None
        yield copy


def rig_of(path: str) -> str:
    """The rig that a recording is of: by the name that the program gives its recordings, else by its folder."""
    match = NAME.match(Path(path).name)
    return match["rig"] if match else Path(path).parent.name


def summarise(path: str, plant_path: str | None, names: tuple[str, ...]) -> Summary:
    """One recording. A file that cannot be read or simulated gives a Summary with `error`: the others go on."""
    rig = rig_of(path)
    try:
        with _local(path) as here:
            table = read_table(here)
        summary = _health(table, path, table.meta.get("rig", rig))
        return summary if plant_path is None else _model(summary, _thinned(table), plant_path, names)
    except (InputError, SimulationError) as e:
        return Summary(path, rig, math.nan, math.nan, error=str(e))


def _health(table: Table, path: str, rig: str) -> Summary:
    column = table.columns.get
    missing = np.full(len(table), np.nan)
    wall, state = column("wall_s", missing), column("state", missing)
    armed = state == ARMED
    bits = int(np.bitwise_or.reduce(np.nan_to_num(column("fault_bits", missing)).astype(np.int64)))
    error = (column("output_reference_um", missing) - column("reference_um", missing))[armed]
    slips = column("slips", missing)
    return Summary(
        path,
        rig,
        float(wall[0]) if math.isfinite(wall[0]) else float(table.t[0]),
        float(table.t[-1] - table.t[0]) / 3600.0,
        float(armed.mean()) if np.isfinite(state).any() else math.nan,
        tuple(f.name for f in faults.decode(bits)),
        float(slips[-1] - slips[0]),
        _mean(column("innovation_c", missing)),
        math.sqrt(_mean(error**2)),
    )


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _thinned(table: Table) -> Table:
    step = max(1, len(table) // ROWS)
    return Table(
        table.name, table.path, table.t[::step], {k: v[::step] for k, v in table.columns.items()}, table.meta
    )


def _model(summary: Summary, table: Table, plant_path: str, names: tuple[str, ...]) -> Summary:
    plant = load(plant_path)
    asis = fit(compile_plant(plant, ()), [compile_plant(plant, ()).excitation(table)])
    noise = dict(zip(asis.model.outputs, asis.noise, strict=True))
    ratios = {o: r / noise[o].sigma for o, r in asis.rms().items() if math.isfinite(r)}
    if not ratios:
        raise InputError(f"{summary.path}: none of the plant's outputs is recorded")
    worst = max(ratios, key=lambda o: ratios[o])
    estimates, after = {}, math.nan
    if names:
        model = compile_plant(plant, names)
        drive = model.excitation(table)
        found = fit(model, [drive])
        estimates = {e.name: (e.value, e.sd) for e in report(found, [drive])}
        after = max(r / noise[o].sigma for o, r in found.rms().items() if math.isfinite(r))
    return Summary(
        **{
            **vars(summary),
            "misfit": ratios[worst],
            "worst": worst,
            "misfit_refitted": after,
            "estimates": estimates,
        }
    )


@dataclass(frozen=True)
class Drift:
    """A straight line through a parameter's estimates: change per 30 days, its standard error, share of the mean."""

    per_month: float
    sigma: float
    share: float
    drifts: bool


@dataclass(frozen=True)
class Rig:
    """One rig over all its recordings, oldest first, and what to do about it."""

    name: str
    summaries: tuple[Summary, ...]
    drifts: dict[str, Drift]
    advice: tuple[str, ...]


def judge(summaries: Iterable[Summary]) -> list[Rig]:
    """Summaries of any rigs in any order -> rigs by name."""
    by_rig: dict[str, list[Summary]] = {}
    for s in summaries:
        by_rig.setdefault(s.rig, []).append(s)
    return [
        _judge(name, sorted(group, key=lambda s: (math.isnan(s.begin_s), s.begin_s, s.path)))
        for name, group in sorted(by_rig.items())
    ]


def _judge(name: str, group: list[Summary]) -> Rig:
    good = [s for s in group if not s.error]
    names = list(dict.fromkeys(p for s in good for p in s.estimates))
    drifts = {
        p: drift(
            [s.begin_s for s in good if p in s.estimates], [s.estimates[p] for s in good if p in s.estimates]
        )
        for p in names
    }
    advice = [f"{Path(s.path).name}: {s.error}" for s in group if s.error]
    if good:
        newest = good[-1]
        if newest.misfit > FIT_LIMIT:
            cured = newest.misfit_refitted <= FIT_LIMIT
            advice.append(
                f"the model no longer fits ({newest.worst}: {newest.misfit:.1f} times its noise): "
                + (
                    "new values fit, identify again"
                    if cured
                    else f"look for what is missing: thermoctl diagnose {newest.path}"
                )
            )
        advice += [
            f"{p} drifts by {d.per_month:+.3g} a month ({100 * d.share:+.1f} % in the time seen)"
            for p, d in drifts.items()
            if d.drifts
        ]
        trips = [f for f in newest.faults if faults.BY_NAME[f].severity != "warning"]
        advice += [f"fault {f}: {faults.BY_NAME[f].remedy}" for f in trips]
    return Rig(name, tuple(group), drifts, tuple(advice))


def drift(times_s: Sequence[float], estimates: Sequence[tuple[float, float]]) -> Drift:
    """Weighted straight line through (value, standard error) over time. The standard error of the slope is widened by the
    scatter about the line where that is larger than the estimates' own; fewer than three estimates never drift."""
    t = np.asarray(times_s) / (30 * 86400.0)
    value, sd = np.array(estimates, dtype=float).reshape(-1, 2).T
    if len(t) < 3 or np.ptp(t) == 0.0:
        return Drift(0.0, math.inf, 0.0, False)
    weight = 1.0 / np.maximum(sd, 1e-9 * np.abs(value) + 1e-300) ** 2
    middle = np.average(t, weights=weight)
    mean = np.average(value, weights=weight)
    spread = np.sum(weight * (t - middle) ** 2)
    slope = np.sum(weight * (t - middle) * (value - mean)) / spread
    scatter = np.sum(weight * (value - mean - slope * (t - middle)) ** 2) / (len(t) - 2)
    sigma = math.sqrt(max(scatter, 1.0) / spread)
    share = float(slope * np.ptp(t) / abs(mean)) if mean else 0.0
    return Drift(
        float(slope), sigma, share, bool(abs(slope) > DRIFT_SIGMA * sigma and abs(share) > DRIFT_SHARE)
    )


def fleet(
    folder: str,
    plant: str | None = None,
    parameters: str = "",
    workers: int = 0,
    scheduler: str | None = None,
    as_json: bool = False,
) -> int:
    """Print the rigs of a folder; 1 when one needs attention. workers 0: in this process; scheduler: a Dask address."""
    names = tuple(n.strip() for n in parameters.split(",") if n.strip())
    if names and plant is None:
        raise InputError("--parameters: a plant was expected with --plant FILE")
    ranged = [n for n, p in load(plant).parameters.items() if p.range is not None] if plant else []
    for name in names:
        if name not in ranged:
            raise InputError(
                f"{plant}: no parameter '{name}' with a range{suggest(name, ranged)}; expected some of "
                f"{', '.join(ranged)}"
            )
    paths = find_recordings(folder)
    if workers or scheduler:
        from thermoctl.proof.run import cluster

        with cluster(scheduler, workers) as client:
            summaries = client.gather([client.submit(summarise, p, plant, names, pure=False) for p in paths])
    else:
        summaries = [summarise(p, plant, names) for p in paths]
    rigs = judge(summaries)
    if as_json:
        print(json.dumps([_plain(asdict(r)) for r in rigs]))
    else:
        _show(rigs, names)
    return int(any(r.advice for r in rigs))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _show(rigs: Sequence[Rig], names: Sequence[str]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table as Grid

    console = Console()
    grid = Grid(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    grid.add_column("rig", no_wrap=True)
    for title in ("files", "hours", "armed", "slips", "innov. K", "proof um", "misfit", *names):
        grid.add_column(title, justify="right", min_width=5, overflow="fold")
    for r in rigs:
        good = [s for s in r.summaries if not s.error]
        newest = good[-1] if good else Summary("", r.name, math.nan, math.nan)
        grid.add_row(
            r.name,
            str(len(r.summaries)),
            f"{sum(s.hours for s in good):.1f}",
            _number(100 * newest.armed, "{:.0f} %"),
            _number(newest.slips, "{:.0f}"),
            _number(newest.innovation_c, "{:+.3f}"),
            _number(newest.proof_um, "{:.3f}"),
            _number(newest.misfit, "{:.1f}"),
            *(_number(newest.estimates.get(p, (math.nan,))[0], "{:.3g}") for p in names),
        )
    console.print(grid)
    for r in rigs:
        for line in r.advice:
            console.print(f"{r.name}: {line}", highlight=False, markup=False)


def _number(value: float, text: str) -> str:
    return text.format(value) if math.isfinite(value) else "-"
