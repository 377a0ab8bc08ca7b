"""FMUs (FMI 2 and 3) as functions in a plant's expressions.

    fmu("model.fmu", "der(T)", "T", block, "heater.P", power)

is the derivative that the FMU computes with its variables T and heater.P at these values; the name of an
output gives that output. Time is passed on. Other variables keep the FMU's start values.
Slopes are directional derivatives where the FMU gives them, else central differences (fmu.h).

An FMU is a program: opening one runs it.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant.native.build import compiler, library

if TYPE_CHECKING:
    from fmpy.model_description import ModelDescription, ModelVariable

_TIME, _STATE, _CONTINUOUS, _DISCRETE, _FIXED = range(5)  # as in fmu.h
_FUNCTIONS = {  # in the order of fmu.h
    2: "SetTime SetContinuousStates GetDerivatives SetReal GetReal EnterEventMode NewDiscreteStates "
    "EnterContinuousTimeMode Reset SetupExperiment EnterInitializationMode ExitInitializationMode "
    "GetDirectionalDerivative SetBoolean SetInteger SetInteger",
    3: "SetTime SetContinuousStates GetContinuousStateDerivatives SetFloat64 GetFloat64 EnterEventMode "
    "UpdateDiscreteStates EnterContinuousTimeMode Reset Reset EnterInitializationMode ExitInitializationMode "
    "GetDirectionalDerivative SetBoolean SetInt32 SetInt64",
}
_TYPES = {  # types of variables that a recording may drive: number in fmu.h, getter of FMPy
    "Real": (0, "getReal"),
    "Float64": (0, "getFloat64"),
    "Boolean": (1, "getBoolean"),
    "Integer": (2, "getInteger"),
    "Int32": (2, "getInt32"),
    "Int64": (3, "getInt64"),
}


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU. `start`: its value after initialization; `range` and `unit` if declared."""

    name: str
    unit: str | None
    start: float
    range: tuple[float, float] | None = None
    discrete: bool = False


class Fmu:
    """An opened FMU of model exchange: its variables by kind, and its results as functions.

    `depends`: the states and inputs that a result (a state's derivative, an output) depends on."""

    def __init__(self, path: Path, d: ModelDescription):
        self.path = path
        self.digest = hashlib.sha256(path.read_bytes()).hexdigest()
        self._description = d
        self._library = _shim()
        self._instance = _instance(path, d)
        derivatives = [u.variable for u in d.derivatives]
        states = [v.derivative for v in derivatives]
        variables = [v for v in d.modelVariables if v.type in ("Real", "Float64") and not v.dimensions]
        settable = [v for v in variables if v not in states]
        inputs = _inputs(d)
        parameters = [v for v in settable if v.causality == "parameter" and v.variability != "constant"]
        results = [*derivatives, *(u.variable for u in d.outputs if u.variable in variables)]
        self._kinds = [
            _TIME,
            *[_STATE] * len(states),
            *(_DISCRETE if _discrete(v) else _CONTINUOUS for v in inputs),
            *(_FIXED if v.variability == "fixed" else _DISCRETE for v in parameters),
        ]
        arguments = [*states, *inputs, *parameters]
        now = self._values(arguments)
        self.states, self.inputs, self.parameters = (
            {v.name: _variable(v, now) for v in group} for group in (states, inputs, parameters)
        )
        self.derivatives = {s.name: f"der({s.name})" for s in states}
        self.outputs = {v.name: _variable(v, {}) for v in results[len(states) :]}
        self.arguments = {v.name: 1 + j for j, v in enumerate(arguments)}
        self.results = {q: k for k, q in enumerate([*self.derivatives.values(), *self.outputs])}
        free = {*self.states, *self.inputs}
        self.depends = {
            q: free if u.dependencies is None else {v.name for v in u.dependencies} & free
            for q, u in zip(
                self.results,
                [*d.derivatives, *(u for u in d.outputs if u.variable in variables)],
                strict=True,
            )
        }
        self._make(arguments, results, now)

    def _values(self, variables: Sequence[ModelVariable]) -> dict[str, float]:
        return {
            v.name: float(getattr(self._instance, _TYPES[v.type][1])([v.valueReference])[0])
            for v in variables
        }

    @property
    def _version(self) -> int:
        return int(self._description.fmiVersion[0])

    def _make(
        self, arguments: Sequence[ModelVariable], results: Sequence[ModelVariable], now: Mapping[str, float]
    ) -> None:
        d = self._description
        prefix = f"fmi{self._version}"
        functions = [
            ctypes.cast(getattr(self._instance.dll, prefix + f), ctypes.c_void_p).value
            for f in _FUNCTIONS[self._version].split()
        ]
        exchange = d.modelExchange
        exact = getattr(exchange, "providesDirectionalDerivative", False) or getattr(
            exchange, "providesDirectionalDerivatives", False
        )
        sizes = [
            self._version,
            len(self.states),
            1 + len(arguments),
            len(results),
            int(d.numberOfEventIndicators > 0),
            int(bool(exact)),
        ]
        scale = [1.0, *(float(getattr(v, "nominal", 0) or 0) or abs(now[v.name]) or 1.0 for v in arguments)]
        self._handle = self._library.fmu_make(
            self._instance.component,
            (ctypes.c_void_p * len(functions))(*functions),
            (ctypes.c_int * 6)(*sizes),
            (ctypes.c_uint * (1 + len(arguments)))(0, *(v.valueReference for v in arguments)),
            (ctypes.c_int * (1 + len(arguments)))(*self._kinds),
            (ctypes.c_int * (1 + len(arguments)))(0, *(_TYPES[v.type][0] for v in arguments)),
            (ctypes.c_double * len(scale))(*scale),
            (ctypes.c_uint * (len(results) + 1))(*(v.valueReference for v in results)),
            (ctypes.c_double * len(scale))(0.0, *(now[v.name] for v in arguments)),
        )

    def link(self, library: ctypes.CDLL, index: int) -> None:
        """Give a plant's machine code this FMU under its number."""
        for name in ("fmu_value", "fmu_slope"):
            address = ctypes.cast(getattr(self._library, name), ctypes.c_void_p).value
            ctypes.c_void_p.in_dll(library, f"{name}_").value = address
        (ctypes.c_void_p * (index + 1)).in_dll(library, "fmus_")[index] = self._handle

    def evaluate(
        self, result: str, names: Sequence[str], values: Sequence[Any], by: str | None = None
    ) -> Any:
        """Return a result, or its slope `by` an argument, at values that broadcast together; [0]: time."""
        shaped = np.broadcast_arrays(*(np.asarray(v, float) for v in values))
        rows = self._rows(names, shaped, np.nan)
        out = np.empty(len(rows))
        j = -1 if by is None else self.argument(by)
        self._library.fmu_rows(
            self._handle, self.result(result), j, len(rows), rows.ctypes.data, out.ctypes.data
        )
        return out.reshape(shaped[0].shape)[()]

    def _rows(self, names: Sequence[str], values: Sequence[np.ndarray], missing: float) -> np.ndarray:
        """Return rows of all arguments (N, 1 + arguments) from the values (N,) of some, such as time."""
        rows = np.full((values[0].size, 1 + len(self.arguments)), missing)
        for name, value in zip((None, *names), values, strict=True):
            rows[:, 0 if name is None else self.argument(name)] = value.ravel()
        return rows

    def argument(self, name: str) -> int:
        """Return the place of an argument. Raises InputError for another name."""
        if name not in self.arguments:
            raise InputError(
                f"{self.path}: no state, input or parameter '{name}'{suggest(name, self.arguments)}"
            )
        return self.arguments[name]

    def result(self, name: str) -> int:
        """Return the place of a result. Raises InputError for another name."""
        if name not in self.results:
            raise InputError(
                f"{self.path}: no derivative and no output '{name}'{suggest(name, self.results)}; "
                f"there are {', '.join(self.results)}"[:600]
            )
        return self.results[name]


def _inputs(d: ModelDescription) -> list[ModelVariable]:
    """Return the inputs that a recording can drive: real, Boolean and integer scalars."""
    return [v for v in d.modelVariables if v.causality == "input" and v.type in _TYPES and not v.dimensions]


def _discrete(v: ModelVariable) -> bool:
    return v.variability == "discrete" or _TYPES[v.type][0] > 0


def _variable(v: ModelVariable, now: Mapping[str, float]) -> Variable:
    limits = (float(v.min), float(v.max)) if v.min is not None and v.max is not None else None
    value = now.get(v.name, 0.0)
    unit = v.unit or (v.declaredType.unit if v.declaredType else None)
    return Variable(v.name, unit, value, limits, v.causality == "input" and _discrete(v))


def opened(path: str) -> Fmu:
    """Return the FMU, opened once a process. Raises InputError where it cannot be used."""
    resolved = Path(path).resolve()
    try:
        changed = resolved.stat().st_mtime_ns
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from None
    return _opened(resolved, changed)


@cache
def _opened(path: Path, changed: int) -> Fmu:
    try:
        return Fmu(path, _description(path))
    except InputError:
        raise
    except Exception as e:  # FMPy raises bare Exceptions
        said = " ".join(str(e).split())[:300]
        raise InputError(f"{path}: no usable FMU ({type(e).__name__}: {said}); export it anew") from None


def _description(path: Path) -> ModelDescription:
    fmpy = load("fmpy", path)
    try:
        description = fmpy.read_model_description(str(path), validate=False)
    except Exception as e:  # FMPy raises bare Exceptions
        raise InputError(f"{path}: no usable FMU: {' '.join(str(e).split())[:300]}") from None
    if description.fmiVersion[0] not in "23":
        raise InputError(f"{path}: FMI {description.fmiVersion}; FMI 2.0 or 3.0 was expected; export it anew")
    if description.modelExchange is None:
        other = ", found one of co-simulation only, whose inside nobody can ask" * bool(
            description.coSimulation
        )
        raise InputError(
            f"{path}: an FMU of model exchange was expected{other}; export it for model exchange"
        )
    return description


def _extracted(path: Path, d: ModelDescription) -> str:
    import fmpy

    folder = tempfile.mkdtemp(prefix="thermoctl-fmu")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    try:
        fmpy.extract(str(path), folder)
    except Exception as e:
        raise InputError(f"{path}: cannot be unpacked: {' '.join(str(e).split())[:300]}") from None
    _compiled(path, d, Path(folder))
    for file in Path(folder, "binaries").glob(f"*/*{fmpy.sharedLibraryExtension}"):
        if not _is_whole(file.read_bytes()):
            raise InputError(f"{path}: {file.name} in it is cut short; export it anew")
    return folder


def _is_whole(elf: bytes) -> bool:
    """Return whether a library has all its segments and sections; loading a cut one ends the program."""
    if elf[:5] != b"\x7fELF\x02":  # another kind is left to the loader
        return True
    try:
        first, sections = struct.unpack_from("<QQ", elf, 32)
        size, count, section_size, section_count = struct.unpack_from("<4H", elf, 54)
        ends = [sections + section_size * section_count]
        for at in range(first, first + size * count, size):
            begin, length = struct.unpack_from("<8xQ16xQ", elf, at)
            ends.append(begin + length)
    except struct.error:
        return False
    return max(ends) <= len(elf)


def _compiled(path: Path, d: ModelDescription, folder: Path) -> None:
    """Compile an unpacked FMU's C sources where it has no library for this machine. Raises InputError."""
    import fmpy

    name = d.modelExchange.modelIdentifier
    names = (fmpy.platform, fmpy.platform_tuple)  # names of the platform in FMI 2 and in FMI 3
    if any((folder / "binaries" / n / f"{name}{fmpy.sharedLibraryExtension}").exists() for n in names):
        return
    there = sorted(p.name for p in (folder / "binaries").glob("*")) or ["none"]
    said = f"{path}: no library for this machine ({', '.join(names)}; it has {', '.join(there)})"
    sources = folder / "sources"
    sets = [s for c in d.buildConfigurations if c.modelIdentifier == name for s in c.sourceFileSets]
    listed = [f for s in sets for f in s.sourceFiles]
    files = [sources / f for f in listed] or sorted(sources.glob("*.c"))
    if not files or not all(f.is_file() for f in files):
        raise InputError(f"{said} and no C sources; export it for this machine, or with its sources")
    target = folder / "binaries" / names[d.fmiVersion[0] == "3"] / f"{name}{fmpy.sharedLibraryExtension}"
    target.parent.mkdir(parents=True, exist_ok=True)
    headers = [sources, *{f.parent for f in files}, Path(fmpy.__file__).parent / "c-code"]
    prefix = (
        f"FMI{d.fmiVersion[0]}_OVERRIDE_FUNCTION_PREFIX"
        if d.fmiVersion[0] == "3"
        else "FMI2_OVERRIDE_FUNCTION_PREFIX"
    )
    command = [*compiler(), "-O2", "-fPIC", "-shared", "-w", f"-D{prefix}", *(f"-I{h}" for h in headers)]
    done = subprocess.run(
        [*command, *map(str, files), "-o", str(target), "-lm"], capture_output=True, text=True
    )
    if done.returncode:
        raise InputError(f"{said}, and its C sources do not compile: {' '.join(done.stderr.split())[:400]}")


def _instance(path: Path, d: ModelDescription) -> Any:
    """Return a new instance in continuous time. Raises InputError."""
    import fmpy

    folder = _extracted(path, d)
    model = fmpy.fmi2.FMU2Model if d.fmiVersion[0] == "2" else fmpy.fmi3.FMU3Model
    try:
        instance = model(
            guid=d.guid,
            unzipDirectory=folder,
            modelIdentifier=d.modelExchange.modelIdentifier,
            instanceName="thermoctl",
        )
        instance.instantiate()
        if d.fmiVersion[0] == "2":
            instance.setupExperiment(startTime=0.0)
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        update = instance.newDiscreteStates if d.fmiVersion[0] == "2" else instance.updateDiscreteStates
        for _ in range(100):
            if not update()[0]:
                break
        instance.enterContinuousTimeMode()
    except Exception as e:
        raise InputError(f"{path}: cannot be started: {' '.join(str(e).split())[:300]}") from None
    return instance


@cache
def _shim() -> ctypes.CDLL:
    shim = library(Path(__file__).with_name("fmu.h").read_text())
    p, i = ctypes.c_void_p, ctypes.c_int
    shim.fmu_make.argtypes, shim.fmu_make.restype = [p] * 9, p
    shim.fmu_rows.argtypes, shim.fmu_rows.restype = [p, i, i, i, p, p], None
    return shim


def used(expressions: Iterator[Any]) -> list[str]:
    """Return the paths of the FMUs in expression nodes, in the order of their first use."""
    return list(dict.fromkeys(e.value[0] for e in expressions if e.op in ("fmu", "fmu_slope")))


__all__ = ["Fmu", "Variable", "opened", "used"]
