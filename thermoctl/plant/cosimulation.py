"""Runs of an FMU of co-simulation (FMI 2 and 3) that go on from row to row of its arguments.

The FMU keeps its states and its solver to itself. So an output belongs to the arguments' whole course a:

    y(t) = F[a](t),   dy/dq (t) = (F[a + h da/dq](t) - F[a - h da/dq](t)) / 2h

A run begins at the FMU's start values. Within a step an input has the mean of the samples at its ends, or is
held at the first of them. A run begins anew where time goes back or a parameter changes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

STEP = 1e-3  # of a difference, over an argument's size: far above a solver's tolerance, small beside a bend


_P, _N, _D, _B = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_double, ctypes.c_bool
_VALUES = {  # fmiXSetReal and fmiXGetReal by version, and fmiXDoStep; a status from 3 on is an error
    2: (("SetReal", "GetReal"), ctypes.CFUNCTYPE(ctypes.c_int, _P, _P, _N, _P)),
    3: (("SetFloat64", "GetFloat64"), ctypes.CFUNCTYPE(ctypes.c_int, _P, _P, _N, _P, _N)),
}
_DO_STEP = {
    2: ctypes.CFUNCTYPE(ctypes.c_int, _P, _D, _D, ctypes.c_int),
    3: ctypes.CFUNCTYPE(ctypes.c_int, _P, _D, _D, _B, _P, _P, _P, _P),
}
_ERROR = 3
References = ctypes.Array[ctypes.c_uint]


@dataclass(frozen=True)
class Layout:
    """References of an FMU's variables; start values and sizes of its inputs, then parameters.

    `types`: of the inputs, as FMI names them. `refused` is called with the time and length of a refused step.
    A row of arguments: time, inputs, held inputs, parameters. NaN stands for the start value."""

    version: int
    inputs: References
    parameters: References
    outputs: References
    start: np.ndarray
    scale: np.ndarray
    types: tuple[str, ...] = ()
    refused: Callable[[float, float], None] = lambda t, seconds: None

    @property
    def fixed(self) -> int:
        """The place of the first parameter in a row."""
        return 1 + 2 * len(self.inputs)


class Instance:
    """The calls that a step needs, on arrays that stay; the rest of FMI is FMPy's."""

    def __init__(self, layout: Layout, fmu: Any) -> None:
        version = layout.version
        (put, get), values = _VALUES[version]
        self.fmu, self._component = fmu, fmu.component
        self._put, self._get, self._step = (
            kind(ctypes.cast(getattr(fmu.dll, f"fmi{version}{name}"), _P).value or 0)
            for kind, name in ((values, put), (values, get), (_DO_STEP[version], "DoStep"))
        )
        self._more = ctypes.create_string_buffer(32)  # results of a step of FMI 3: three flags and a time
        at = ctypes.addressof(self._more)
        self._after: tuple[Any, ...] = (1,) if version == 2 else (True, at, at + 1, at + 2, at + 8)
        self._version = version

    def _call(self, function: Any, references: References, values: np.ndarray) -> None:
        n = len(references)
        size = (n,) if self._version == 3 else ()
        if n and function(self._component, references, n, values.ctypes.data, *size) >= _ERROR:
            raise OSError("the FMU refused a value")

    def put(self, references: References, values: np.ndarray) -> None:
        """Set variables. Raises OSError."""
        self._call(self._put, references, values)

    def drive(self, layout: Layout, values: np.ndarray) -> None:
        """Set the inputs, each by the function of its type. Raises OSError, and what FMPy raises."""
        if not set(layout.types) - {"Real", "Float64"}:
            self.put(layout.inputs, values)
            return
        for reference, kind, value in zip(layout.inputs, layout.types, values, strict=True):
            number = float(value)
            one = (
                number
                if kind in ("Real", "Float64")
                else number >= 0.5
                if kind == "Boolean"
                else round(number)
            )
            getattr(self.fmu, f"set{kind}")([reference], [one])

    def get(self, references: References) -> np.ndarray:
        """Return variables. Raises OSError."""
        values = np.empty(len(references))
        self._call(self._get, references, values)
        return values

    def step(self, t: float, seconds: float) -> None:
        """Advance. Raises OSError."""
        if self._step(self._component, t, seconds, *self._after) >= _ERROR:
            raise OSError("the FMU failed")

    def initialize(self, t: float, layout: Layout, parameters: np.ndarray) -> None:
        """Begin at a time with these parameters. Raises what FMPy raises."""
        if self._version == 2:
            self.fmu.setupExperiment(startTime=t)
        self.put(layout.parameters, parameters)
        self.fmu.enterInitializationMode(**({"startTime": t} if self._version == 3 else {}))
        self.fmu.exitInitializationMode()


class Run:
    """One run of one instance. `make` returns a new instance, not initialized."""

    def __init__(self, layout: Layout, make: Callable[[], Any]) -> None:
        self._layout, self._make = layout, make
        self._at: Instance | None = None
        self._t, self._known = np.nan, b""
        self._inputs = np.zeros(0)
        self._failed = False

    def at(self, row: np.ndarray) -> np.ndarray:
        """Return the outputs (m,) at the next row; NaN from a failure of the FMU on."""
        layout, t = self._layout, float(row[0])
        parameters, at = row[layout.fixed :].tobytes(), self._at
        begins = at is None or not t >= self._t or parameters != self._known
        try:
            if at is None or begins:
                at, self._failed = self._begin(t, row), False
            inputs = np.append(row, layout.start)[self._take]
            if self._failed:
                return np.full(len(layout.outputs), np.nan)
            if t > self._t and not begins:
                at.drive(layout, self._before * self._inputs + (1 - self._before) * inputs)
                self._step(at, t)
            at.drive(layout, inputs)
            self._inputs = inputs
            return at.get(layout.outputs)
        except Exception:  # FMPy raises bare Exceptions
            self._failed = True
            return np.full(len(layout.outputs), np.nan)
        finally:
            self._t, self._known = t, parameters

    def _step(self, at: Instance, t: float) -> None:
        """Advance to t. Raises OSError, and reports the step where the FMU refuses it."""
        try:
            at.step(self._t, t - self._t)
        except OSError:
            self._layout.refused(self._t, t - self._t)
            raise

    def _begin(self, t: float, row: np.ndarray) -> Instance:
        layout, n = self._layout, len(self._layout.inputs)
        given = ~np.isnan(row)
        held, free = np.arange(1 + n, 1 + 2 * n), np.arange(1, 1 + n)
        start = len(row) + np.arange(n)
        self._take = np.where(given[held], held, np.where(given[free], free, start))
        self._before = np.where(given[held], 1.0, 0.5)  # weight of the sample before a step
        at = self._at
        if at is not None:
            try:
                at.fmu.reset()
            except Exception:  # an FMU that cannot begin anew is made anew
                at = None
        self._at = at = at or Instance(layout, self._make())
        parameters = row[layout.fixed :]
        at.initialize(t, layout, np.where(np.isnan(parameters), layout.start[n:], parameters))
        return at


class Course:
    """The runs of one course of arguments: one for the value, or two for its slope."""

    def __init__(self, layout: Layout, make: Callable[[], Any]) -> None:
        self._layout, self._make = layout, make
        self._runs: tuple[Run, ...] = ()
        self._key, self._last = b"", np.zeros(0)
        self._t, self._h = np.nan, 0.0

    def value(self, row: np.ndarray) -> np.ndarray:
        """Return the outputs (m,) at the next row of arguments."""
        if (key := row.tobytes()) != self._key:
            self._runs = self._runs or (Run(self._layout, self._make),)
            self._key, self._last = key, self._runs[0].at(row)
        return self._last

    def slope(self, row: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return d outputs / dq (m,) at the next row. `change`: d row / dq, 0 for missing arguments."""
        if (key := row.tobytes() + change.tobytes()) != self._key:
            self._runs = self._runs or tuple(Run(self._layout, self._make) for _ in range(2))
            if not row[0] >= self._t:
                self._h = 0.0
            if not self._h and change.any():  # until now both runs were the same
                moved = change != 0
                self._h = STEP * float(np.min(self._scale(row)[moved] / np.abs(change[moved])))
            up, down = (
                run.at(row + side * self._h * change) for run, side in zip(self._runs, (1, -1), strict=True)
            )
            self._key, self._t = key, float(row[0])
            self._last = (up - down) / (2 * self._h) if self._h else np.zeros_like(up)
        return self._last

    def _scale(self, row: np.ndarray) -> np.ndarray:
        n = len(self._layout.inputs)
        scale = np.concatenate([[1.0], self._layout.scale[:n], self._layout.scale])
        return np.fmax(scale, np.abs(row))
