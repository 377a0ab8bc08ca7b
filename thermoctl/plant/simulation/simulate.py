"""Simulate a compiled plant on a recording's inputs: a whole run, or one fixed period at a time."""

from __future__ import annotations

import ctypes
import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant import expression as ex
from thermoctl.plant.lacking import lacking
from thermoctl.plant.language import Plant
from thermoctl.plant.parts import RESTARTED, direct_outputs
from thermoctl.plant.simulation.compile import Code, machine_code
from thermoctl.plant.simulation.earlier import earlier
from thermoctl.plant.simulation.sensor import error
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.table import Table

RTOL = 1e-7  # local error a step, as a share of each state's range
JUMP_WIDTH = 1e-5  # half width of a smoothed jump, as a share of the range of its argument
MAX_STEPS = 2_000  # steps within one sampling interval


class SimulationError(Exception):
    """Integration failed (unstable states, a division by zero); the message gives the place."""


@dataclass
class Excitation:
    """The inputs and measured outputs of one recording, in a plant's order.

    - `t` (N,): seconds from the first sample
    - `u` (N, inputs): gaps filled, held or linear as the input
    - `y` (N, outputs): measured, NaN where missing
    - `first`: first recorded value of each input and output
    - `rtol`: local error a step of a run, as a share of each state's range
    - `x0` (nx,): initial states in place of the plant's; NaN: the plant's"""

    name: str
    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    first: dict[str, float]
    linear: np.ndarray
    scale: np.ndarray | None = None  # (nx,) range of each state
    width: np.ndarray | None = None  # (jumps,) half width of each smoothed jump
    rtol: float = RTOL
    x0: np.ndarray | None = None

    def part(self, start: int, stop: int) -> Excitation:
        """Return the samples start..stop-1 (scales kept). Time still counts from the recording's start."""
        return dataclasses.replace(self, t=self.t[start:stop], u=self.u[start:stop], y=self.y[start:stop])


@dataclass
class Simulation:
    """`x` (N, nx), `y` (N, ny) noise-free.

    With sensitivities `dx` (N, nx, nq) and `dy` (N, ny, nq) by q = (active parameters, uncertain initial
    states)."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    dx: np.ndarray | None = None
    dy: np.ndarray | None = None
    steps: int = 0

    @property
    def sensitivities(self) -> np.ndarray:
        """Return `dy` of a run that computed it."""
        assert self.dy is not None
        return self.dy


class _Forces(ctypes.Structure):
    _fields_ = [
        ("count", ctypes.c_int),
        ("row", ctypes.c_void_p),
        ("col", ctypes.c_void_p),
        ("q", ctypes.c_void_p),
    ]


def _buffer(kept: dict[str, np.ndarray] | None, key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array to fill.

    Touching new memory pages costs more than the arithmetic on them, so a caller may keep the array."""
    if kept is None:
        return np.empty(shape)
    size = int(np.prod(shape))
    if key not in kept or kept[key].size < size:
        kept[key] = np.empty(size)
    return kept[key][:size].reshape(shape)


def _own(key: str) -> str:
    """Return the key of a buffer that each thread has for itself."""
    return f"{key} {threading.get_ident()}"


def _call(function: Callable[..., int], *arguments: object) -> int:
    """Call a function of a plant's library; an array is passed as a pointer to its numbers."""
    return function(*(a.ctypes.data if isinstance(a, np.ndarray) else a for a in arguments))


class Model:
    """A plant and its machine code."""

    def __init__(self, plant: Plant, code: Code):
        self.plant, self.code = plant, code
        self.inputs = tuple(plant.inputs)
        self.parameters, self.active = code.parameters, code.active
        self.states, self.outputs, self.uncertain = code.states, code.outputs, code.uncertain
        self.unknowns = (*self.active, *(f"{n} at the start" for n in self.uncertain))
        self._initial = [n.initial for n in plant.nodes.values()]
        self._initial_slopes = [
            (i, c, ex.derivative(e, q))
            for i, e in enumerate(self._initial)
            for c, q in enumerate(self.active)
            if q in ex.names(e)
        ]
        self._slots = [self.states.index(n) for n in self.uncertain]

    def __reduce__(self) -> tuple[Any, ...]:  # another process compiles the plant itself
        return compile_plant, (self.plant, self.active)

    # ------------------------------------------------------------------------------------------------ inputs

    def excitation(self, table: Table) -> Excitation:
        """Return the recording as this plant reads it.

        Raises InputError where an input's column is missing or empty."""
        table = in_plant_units(self.plant, table)
        t = np.ascontiguousarray(table.t - table.t[0], float)
        u = np.empty((len(t), len(self.code.inputs)))
        linear = np.zeros(len(self.code.inputs), np.intc)
        first: dict[str, float] = {}
        if missing := [i for i in self.plant.inputs.values() if i.column not in table.columns]:
            text = lacking(self.plant, table, "input", missing)
            raise InputError(f"{text}; a constant input can be a parameter of the plant")
        for j, i in enumerate(self.plant.inputs.values()):
            column = table.columns[i.column]
            u[:, j] = filled(t, column, i.linear, f"{table.path}: column '{i.column}' (input '{i.name}')")
            linear[j] = i.linear
            first[i.name] = float(column[np.isfinite(column)][0])
        y = np.full((len(t), len(self.outputs)), np.nan)
        for j, o in enumerate(self.plant.outputs.values()):
            if o.column in table.columns:
                y[:, j] = table.columns[o.column]
                known = y[np.isfinite(y[:, j]), j]
                if len(known):
                    first.setdefault(o.name, float(known[0]))
        x0 = None
        if RESTARTED in table.meta:
            read = direct_outputs(self.plant)
            x0 = np.array([first.get(read.get(n, ""), np.nan) for n in self.states])
        return Excitation(table.name, t, u, y, first, linear, x0=x0)

    def vector(
        self, parameters: Mapping[str, float] | np.ndarray | None, recording: str | None = None
    ) -> np.ndarray:
        """Return the values of all parameters in the model's order; an array is returned as it is.

        Values in `parameters` replace those of `recording`, which replace the plant's."""
        if isinstance(parameters, np.ndarray):
            return np.ascontiguousarray(parameters, float)
        out = np.array(
            [p.value_in(recording) if recording else p.value for p in self.plant.parameters.values()]
        )
        for key, value in (parameters or {}).items():
            if key not in self.parameters:
                raise InputError(
                    f"'{key}' is not a parameter of {self.plant.file}{suggest(key, self.parameters)}"
                )
            out[self.parameters.index(key)] = value
        return out

    def _delayed_inputs(self, excitation: Excitation, p: np.ndarray) -> np.ndarray:
        """Return u with the derived columns of delayed inputs.

        They are the mean of the held signal over each interval, delayed, and its derivative by the delay."""
        if not self.code.input_delays:
            return excitation.u
        u = excitation.u.copy()
        known = dict(zip(self.parameters, p, strict=True))
        n = len(self.plant.inputs)
        columns = {i: u[:, j] for j, i in enumerate(self.plant.inputs)}
        for j, (signal, seconds) in enumerate(self.code.input_delays.values()):
            s = np.broadcast_to(np.asarray(ex.evaluate(signal, columns), float), excitation.t.shape)
            td = float(ex.evaluate(seconds, known))
            if all(self.plant.inputs[i].linear for i in ex.names(signal)):
                u[:, n + j] = np.interp(excitation.t - td, excitation.t, s)
                slope = np.interp(excitation.t - td + 1e-9, excitation.t, s) - u[:, n + j]
                u[:, n + len(self.code.input_delays) + j] = -slope / 1e-9
                excitation.linear[[n + j, n + len(self.code.input_delays) + j]] = 1
            else:
                area = np.concatenate([[0.0], np.cumsum(s[:-1] * np.diff(excitation.t))])
                at = excitation.t - td

                def integral(
                    z: np.ndarray, area: np.ndarray = area, s: np.ndarray = s
                ) -> np.ndarray:  # before the start: the first value, and after the end: the last one
                    """Return the integral of the held signal from the start to the times z, s."""
                    before, after = (
                        np.minimum(z - excitation.t[0], 0.0),
                        np.maximum(z - excitation.t[-1], 0.0),
                    )
                    return np.interp(z, excitation.t, area) + before * s[0] + after * s[-1]

                dt = np.diff(excitation.t)
                u[:-1, n + j] = np.diff(integral(at)) / dt
                u[-1, n + j] = u[-2, n + j]
                k = np.clip(np.searchsorted(excitation.t, at, side="right") - 1, 0, len(s) - 1)
                u[:-1, n + len(self.code.input_delays) + j] = -np.diff(s[k]) / dt
                u[-1, n + len(self.code.input_delays) + j] = 0.0
        return np.ascontiguousarray(u)

    def start(
        self, excitation: Excitation, p: np.ndarray, dx0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return initial states (nx,) and their sensitivities (nx, nq).

        `dx0`: shifts of the uncertain initial states."""
        values = {
            **dict(zip(self.plant.inputs, excitation.u[0], strict=False)),
            **dict(zip(self.parameters, p, strict=True)),
        }

        def first(key: str) -> float:
            """Return the first recorded value of `key`. Raises InputError where the recording has none."""
            if key not in excitation.first:
                column = next(r.column for r in self.plant.readings() if r.name == key)
                raise InputError(
                    f"recording {excitation.name}: first({key}) is asked for, but the recording has no value of it "
                    f"(column '{column}'; another one: --columns {column}=COLUMN)"
                )
            return excitation.first[key]

        given = np.full(len(self.states), np.nan) if excitation.x0 is None else excitation.x0
        x0 = np.array(
            [
                float(ex.evaluate(e, values, first)) if np.isnan(x) else x
                for e, x in zip(self._initial, given, strict=True)
            ]
        )
        s0 = np.zeros((len(self.states), len(self.unknowns)))
        for i, c, slope in self._initial_slopes:
            s0[i, c] = float(ex.evaluate(slope, values, first))
        for c, slot in enumerate(self._slots):
            s0[slot, len(self.active) + c] = 1.0
            if dx0 is not None:
                x0[slot] += dx0[c]
        return x0, s0

    # -------------------------------------------------------------------------------------------- simulating

    def prepare(
        self, excitation: Excitation, parameters: Mapping[str, float] | np.ndarray | None = None
    ) -> Excitation:
        """Set the scales of an excitation (ranges of states, widths of jumps) by trial runs."""
        p = self.vector(parameters, excitation.name)
        jumps = self.code.jumps
        dt = float(np.median(np.diff(excitation.t))) if len(excitation.t) > 1 else 1.0
        width = np.ones(max(len(jumps), 1))
        for i, (z, kind) in enumerate(jumps):
            if kind == "time":
                slope = (
                    ex.evaluate(ex.derivative(z, "t"), dict(zip(self.parameters, p, strict=True)))
                    if ex.names(ex.derivative(z, "t")) <= set(self.parameters)
                    else 1.0
                )
                width[i] = 0.5 * dt * max(abs(float(slope)), 1e-12)
        excitation.width = width
        excitation.scale = np.full(len(self.states), np.nan)
        moving = any(kind == "state" for _, kind in jumps)
        for share in (1e-2, JUMP_WIDTH) if moving else (1.0,):
            try:
                run = self._run(excitation, p, None, False, 1e-5 if moving else 1e-4)
                x = run.x
            except SimulationError:
                x = np.zeros((len(excitation.t), len(self.states)))
            finite = np.where(np.isfinite(x), x, 0.0)
            excitation.scale = (
                np.ptp(finite, axis=0) + 1e-6 * np.max(np.abs(finite), axis=0, initial=0.0) + 1e-12
            )
            if moving:
                values = self._signals(excitation, p, finite)
                for i, (z, kind) in enumerate(jumps):
                    if kind == "state":
                        reach = float(
                            np.max(np.abs(np.broadcast_to(ex.evaluate(z, values), excitation.t.shape)))
                        )
                        width[i] = max(share * reach, 1e-15)
        return excitation

    def _signals(self, excitation: Excitation, p: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray | float]:
        u = self._delayed_inputs(excitation, p)
        values = {
            **dict(zip(self.code.inputs, u.T, strict=True)),
            **dict(zip(self.parameters, p, strict=True)),
            **dict(zip(self.states, x.T, strict=True)),
            "t": excitation.t,
        }
        # without its delay a signal visits the same values
        undelayed = {k: ex.evaluate(signal, values) for k, (signal, _) in self.code.output_delays.items()}
        return values | undelayed

    def run(
        self,
        excitation: Excitation,
        parameters: Mapping[str, float] | np.ndarray | None = None,
        dx0: np.ndarray | None = None,
        sensitivities: bool = False,
        rtol: float | None = None,
        buffers: dict[str, np.ndarray] | None = None,
        states: bool = True,
    ) -> Simulation:
        """Simulate freely on an excitation. Raises SimulationError.

        `rtol`: in place of the excitation's. `buffers` keeps the large arrays between runs. A later run with
        the same dict overwrites the sensitivities that an earlier one returned. Without `states` only the
        outputs' sensitivities are computed: a plant of many states needs far less memory and time."""
        if excitation.scale is None:
            self.prepare(excitation, parameters)
        return self._run(
            excitation,
            self.vector(parameters, excitation.name),
            dx0,
            sensitivities,
            rtol or excitation.rtol,
            buffers,
            states,
        )

    def simulate(
        self,
        table: Table,
        parameters: Mapping[str, float] | None = None,
        sensitivities: bool = False,
        rtol: float = RTOL,
    ) -> Simulation:
        """Simulate freely on a recording's inputs. Raises InputError, SimulationError."""
        return self.run(self.excitation(table), parameters, None, sensitivities, rtol)

    def measure(self, table: Table, seed: int = 0) -> Table:
        """Return a simulated recording: the inputs of `table` and the readings of the sensors.

        Draws noise and uncertain initial values, and rounds to the resolution. All in the plant's units.
        Raises InputError and SimulationError."""
        table = in_plant_units(self.plant, table)
        rng, excitation = np.random.default_rng(seed), self.excitation(table)
        dx0 = np.array([self.plant.nodes[n].initial_sigma or 0.0 for n in self.uncertain]) * rng.normal(
            size=len(self.uncertain)
        )
        y = self.run(excitation, None, dx0).y
        columns = {i.column: table.columns[i.column] for i in self.plant.inputs.values()}
        for j, o in enumerate(self.plant.outputs.values()):
            read = y[:, j] + error(o.noise, excitation.t, rng)
            columns[o.column] = np.round(read / o.resolution) * o.resolution if o.resolution else read
        return dataclasses.replace(table, columns=columns)

    def _run(
        self,
        excitation: Excitation,
        p: np.ndarray,
        dx0: np.ndarray | None,
        sensitivities: bool,
        rtol: float,
        buffers: dict[str, np.ndarray] | None = None,
        states: bool = True,
    ) -> Simulation:
        lib, n, nx, nq = self.code.library, len(excitation.t), len(self.states), len(self.unknowns)
        u = self._delayed_inputs(excitation, p)
        width = excitation.width if excitation.width is not None else np.ones(1)
        x0, s0 = self.start(excitation, p, dx0)
        x = np.empty((n, nx))
        at_once = sensitivities and not states and self._at_once
        dx = _buffer(buffers, _own("dx"), (n, nx, nq)) if sensitivities and not at_once else None
        y, dy = self._outputs(excitation, nq, buffers) if at_once else (None, None)
        info = np.zeros(2)
        if nx:
            if not np.all(np.isfinite(x0)):
                raise SimulationError(
                    f"{excitation.name}: the start of '{self.states[int(np.argmin(np.isfinite(x0)))]}' is not finite"
                )
            scale = (
                excitation.scale
                if excitation.scale is not None and np.all(np.isfinite(excitation.scale))
                else np.abs(x0) + 1e-3
            )
            atol = rtol * scale
            start = (n, excitation.t, u, excitation.linear, p, width, x0, s0)
            failed = _call(
                lib.integrate, *start, nq * sensitivities, rtol, atol, MAX_STEPS, x, dx, info, None, y, dy, 1
            )
            if failed:
                at = max(failed - 1, 0)
                raise SimulationError(
                    f"{excitation.name}: the simulation does not get beyond t = {excitation.t[at]:.6g} s; states "
                    + ", ".join(f"{s} = {v:.3g}" for s, v in zip(self.states, x[at], strict=True))
                )
        if y is None:
            y, dy = self._observe(excitation, u, p, width, x, dx, nq, sensitivities, buffers)
        if self.code.fmus and not np.isfinite(y).all():
            row = int(np.argmin(np.isfinite(y).all(axis=1)))
            raise SimulationError(f"{excitation.name}: the FMU has no output at t = {excitation.t[row]:g} s")
        return Simulation(excitation.t, x, y, dx, dy, int(info[0]))

    @property
    def _at_once(self) -> bool:
        """Whether outputs can be observed during the integration: a delay of an output needs all samples."""
        return bool(self.states) and not self.code.output_delays

    def _outputs(
        self, excitation: Excitation, columns: int, buffers: dict[str, np.ndarray] | None, key: str = ""
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return arrays for outputs (N, ny) and their sensitivities (N, ny, columns)."""
        n, ny = len(excitation.t), len(self.outputs)
        return np.empty((n, ny)), _buffer(buffers, key or f"dy {id(excitation)}", (n, ny, columns))

    def respond(
        self,
        excitation: Excitation,
        parameters: Mapping[str, float] | np.ndarray | None,
        dx0: np.ndarray | None,
        forces: Sequence[tuple[int, int]],
        q: np.ndarray,
        columns: int,
        rtol: float = 1e-5,
        buffers: dict[str, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the outputs' first-order response (N, ny, columns) to additional forces on dx/dt.

        Entry e of `forces` is (state, column); its values, per second, are q[:, e] of q (N, entries).
        `buffers`: as of `run`; the next response in the same thread overwrites this one."""
        lib, n, nx = self.code.library, len(excitation.t), len(self.states)
        p = self.vector(parameters, excitation.name)
        if excitation.scale is None or excitation.width is None:
            self.prepare(excitation, p)
        assert excitation.scale is not None and excitation.width is not None
        u = self._delayed_inputs(excitation, p)
        x0, _ = self.start(excitation, p, dx0)
        rows = np.array([f[0] for f in forces], np.intc)
        cols = np.array([f[1] for f in forces], np.intc)
        q = np.ascontiguousarray(q, float)
        force = _Forces(len(rows), rows.ctypes.data, cols.ctypes.data, q.ctypes.data)
        x, s0, info = np.empty((n, nx)), np.zeros((nx, columns)), np.zeros(2)
        at_once = self._at_once
        dx = None if at_once else _buffer(buffers, _own("dx"), (n, nx, columns))
        y, dy = self._outputs(excitation, columns, buffers, _own("dy")) if at_once else (None, None)
        atol = rtol * excitation.scale
        start = (n, excitation.t, u, excitation.linear, p, excitation.width, x0, s0)
        limits = (rtol, atol, MAX_STEPS, x, dx, info, ctypes.addressof(force), y, dy, 0)
        if nx and _call(lib.integrate, *start, columns, *limits):
            raise SimulationError(f"{excitation.name}: the plant cannot be simulated")
        if dy is not None:
            return dy
        _, dy = self._observe(excitation, u, p, excitation.width, x, dx, columns, True, buffers, 0)
        assert dy is not None
        return dy

    def _observe(
        self,
        excitation: Excitation,
        u: np.ndarray,
        p: np.ndarray,
        width: np.ndarray,
        x: np.ndarray,
        dx: np.ndarray | None,
        nq: int,
        sensitivities: bool,
        buffers: dict[str, np.ndarray] | None = None,
        own: int = 1,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        lib, n, ny, nd = self.code.library, len(excitation.t), len(self.outputs), len(self.code.output_delays)
        known = (n, excitation.t, u, p, width, x, dx, nq)
        delayed = slopes = None
        if nd:
            g = np.empty((n, nd))
            dg = np.empty((n, nd, nq)) if sensitivities else None
            _call(lib.observe, 1, *known, None, None, g, dg, own)
            delayed, slopes = self._shift(excitation.t, g, dg, p, own)
        y, dy = np.empty((n, ny)), None
        if sensitivities:
            y, dy = self._outputs(excitation, nq, buffers, "" if own else _own("dy"))
        _call(lib.observe, 0, *known, delayed, slopes, y, dy, own)
        return y, dy

    def _shift(
        self, t: np.ndarray, g: np.ndarray, dg: np.ndarray | None, p: np.ndarray, own: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the arguments of delays, seconds earlier, and their changes."""
        known = dict(zip(self.parameters, p, strict=True))
        out, dout = np.empty_like(g), None if dg is None else np.empty_like(dg)
        for j, (_, seconds) in enumerate(self.code.output_delays.values()):
            td = float(ex.evaluate(seconds, known))
            out[:, j], slope, changes = earlier(t, g[:, j], td, None if dg is None else dg[:, j])
            if dout is not None:
                dout[:, j] = changes
                for c, q in enumerate(self.active if own else ()):
                    if q in ex.names(seconds):
                        dout[:, j, c] -= slope * float(ex.evaluate(ex.derivative(seconds, q), known))
        return out, dout

    def stepper(
        self,
        period_s: float,
        u0: np.ndarray,
        parameters: Mapping[str, float] | None = None,
        rtol: float = 1e-5,
    ) -> Stepper:
        """Return a Stepper for a simulated rig: one fixed period at a time; `u0` (inputs,) at the start."""
        return Stepper(self, period_s, np.asarray(u0, float), parameters, rtol)


def compile_plant(plant: Plant, active: tuple[str, ...] | None = None) -> Model:
    """Compile a plant to machine code, ready to simulate.

    `active`: parameters to compute sensitivities for; by default all that have a range.
    Raises InputError for an unknown name or a missing C compiler."""
    if active is None:
        active = tuple(p.name for p in plant.parameters.values() if p.range)
    for q in active:
        if q not in plant.parameters:
            raise InputError(f"{plant.file}: '{q}' is not a parameter")
    return Model(plant, machine_code(plant, tuple(active)))


def filled(t: np.ndarray, column: np.ndarray, linear: bool, what: str) -> np.ndarray:
    """Return a column with its gaps filled: on straight lines, or each by the value before it.

    Raises InputError with the name `what` where there is no value at all."""
    good = np.isfinite(column)
    if good.all():
        return column
    if not good.any():
        raise InputError(f"{what} has no value at all; a driving signal was expected")
    if linear:
        return np.interp(t, t[good], column[good])
    index = np.maximum.accumulate(np.where(good, np.arange(len(t)), -1))
    return column[np.where(index < 0, int(np.argmax(good)), index)]


@dataclass
class Stepper:
    """A plant that advances in steps of one period, its inputs held over each; deterministic."""

    model: Model
    period_s: float
    u0: np.ndarray
    parameters: Mapping[str, float] | None = None
    rtol: float = 1e-5

    def __post_init__(self) -> None:
        m, u0 = self.model, self.u0
        if m.code.input_delays or m.code.output_delays:
            raise InputError(f"{m.plant.file}: a plant with delay() cannot run as a simulated rig")
        self._library = machine_code(m.plant, (), stepper=True).library
        self._p = m.vector(self.parameters)
        excitation = Excitation(
            "start",
            np.zeros(1),
            np.array([u0], float),
            np.empty((1, 0)),
            dict(zip(m.inputs, u0, strict=True)),
            np.zeros(len(m.inputs), np.intc),
        )
        self.x, _ = m.start(excitation, self._p)
        self.t = 0.0
        self._u = np.array(u0, float)
        self._y = np.empty(len(m.outputs))
        self._want = np.zeros(1)
        self._width = np.full(max(len(m.code.jumps), 1), 1e-6)
        self._atol = self.rtol * (np.abs(self.x) * 1e-2 + 1e-3)
        # The matrix of the exponential method, see integrator.h.
        self._memory = np.zeros(self._library.memory_size())
        tail = (self._atol, self.x, self._y, self._want, self._memory)
        self._pointers = tuple(
            [a.ctypes.data for a in part] for part in ((self._u, self._p, self._width), tail)
        )

    def step(self, u: np.ndarray) -> np.ndarray:
        """Advance one period with inputs `u` (nu,) held.

        Returns the outputs (ny,), a view that the next step changes."""
        self._u[:] = u
        head, tail = self._pointers
        if self._library.advance_period(self.t, self.period_s, *head, self.rtol, *tail):
            raise SimulationError(f"the simulated rig cannot be integrated at t = {self.t:.6g} s")
        self.t += self.period_s
        return self._y


__all__ = ["Excitation", "Model", "Simulation", "SimulationError", "Stepper", "compile_plant"]
