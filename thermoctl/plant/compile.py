"""Plants as machine code: C from the expressions, compiled, and cached on disk.

    dx/dt = (flows in - flows out) / storage = f(t, x, u, p),    y = g(t, x, u, p)
    S = d x / d q,  dS/dt = f_x S + f_q,  S(0) = d initial / d q
    q = (active parameters, uncertain initial states)

C was chosen by measurement (`make bench`): a plant compiles in some tenths of a second, with numba in
seconds.

A jump (sign, step, a comparison) of a state or of time is smoothed to tanh(z / width), so that it has a
slope. For a state the width is 1e-5 of the range of z, for time half a sampling interval. A jump of an input
that is held between samples is not smoothed.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from thermoctl.plant import expression as ex
from thermoctl.plant.equations import ARGUMENTS, PRELUDE, Equations, ints, sparse_lu
from thermoctl.plant.expression import ZERO, Expr, add, derivative, mul, name
from thermoctl.plant.language import Plant
from thermoctl.yamlfile import InputError

_HEADERS = tuple(Path(__file__).with_name(h) for h in ("esdirk.h", "integrator.h"))
LARGE = 400_000  # characters of a source that is compiled with -O1
_LOCK = threading.Lock()
_LOADED: dict[str, Code] = {}
_LANES = """/* Columns of sensitivities, eight at a time. */
typedef double lanes __attribute__((vector_size(64), aligned(8)));
"""


class Code(Equations):
    """A compiled plant: its equations with sensitivities to `active`, and the library that computes them.

    `stepper`: with the functions that advance by one period."""

    def __init__(self, plant: Plant, active: tuple[str, ...], stepper: bool = False):
        super().__init__(plant)
        self.active = active
        self.source = "#define STEPPER\n" * stepper + self._source()
        headers = "".join(path.read_text() for path in _HEADERS)
        self.key = hashlib.sha256((self.source + headers + _compiler()[1]).encode()).hexdigest()[:32]
        self.library = _library(self.key, self.source)

    # --------------------------------------------------------------------------------------------- writing C

    def _by_parameter(self, e: Expr, q: str) -> Expr:
        """Return de/dq of parameter q, including its effect on the delay times of inputs."""
        total = derivative(e, q)
        used = ex.names(e)
        for d, (_, seconds) in self.input_delays.items():
            if d in used and q in ex.names(seconds):
                total = add(total, mul(mul(derivative(e, d), name(f"{d}_slope")), derivative(seconds, q)))
        return total

    def _source(self) -> str:
        nx, na = len(self.states), len(self.active)
        jac = self.jacobian()
        sens = [
            (i, c, d)
            for i, f in enumerate(self.slopes)
            for c, q in enumerate(self.active)
            if (d := self._by_parameter(f, q)) is not ZERO
        ]
        delays = list(self.output_delays)
        lists = []
        for values, extra in ((self.values, delays), ([a for a, _ in self.output_delays.values()], [])):
            entries: list[tuple[int, int, int, Expr]] = []
            for r, g in enumerate(values):
                entries += [
                    (r, 0, k, d) for k, s in enumerate(self.states) if (d := derivative(g, s)) is not ZERO
                ]
                entries += [
                    (r, 1, c, d)
                    for c, q in enumerate(self.active)
                    if (d := self._by_parameter(g, q)) is not ZERO
                ]
                entries += [(r, 2, k, d) for k, s in enumerate(extra) if (d := derivative(g, s)) is not ZERO]
            lists.append((values, entries))
        lu, lu_lanes, nm = sparse_lu(nx, [(i, k) for i, k, _ in jac])
        args = ARGUMENTS
        parts = [
            f"#define NX {nx}\n#define NU {len(self.inputs)}\n#define NA {na}\n#define NY {len(self.outputs)}\n"
            f"#define ND {len(delays)}\n#define NJ {len(jac)}\n#define NV {len(sens)}\n#define NM {nm}\n"
            f"#define NO0 {len(lists[0][1])}\n#define NO1 {len(lists[1][1])}\n"
            f"#define NO {max(len(lists[0][1]), len(lists[1][1]))}\n#define LINEAR {int(self.linear)}\n",
            PRELUDE,
            _LANES,
            ints("J_ROW", [i for i, _, _ in jac]),
            ints("J_COL", [k for _, k, _ in jac]),
            ints("V_ROW", [i for i, _, _ in sens]),
            ints("V_COL", [c for _, c, _ in sens]),
            *(
                ints(f"O{o}_ROW", [e[0] for e in lists[o][1]])
                + ints(f"O{o}_KIND", [e[1] for e in lists[o][1]])
                + ints(f"O{o}_COL", [e[2] for e in lists[o][1]])
                for o in (0, 1)
            ),
            f"static void rhs_{args}, double *out) {{\n{self.emit(self.slopes)}}}\n",
            f"static void jac_{args}, double *out) {{\n{self.emit([d for *_, d in jac])}}}\n",
            f"static void sens_{args}, double *out) {{\n{self.emit([d for *_, d in sens])}}}\n",
        ]
        for (values, entries), fn in zip(lists, ("outputs_", "delayed_"), strict=True):
            parts += [
                f"static void {fn}{args}, const double *d, double *out) {{\n{self.emit(values)}}}\n",
                f"static void {fn[:-1]}_slopes_{args}, const double *d, double *out) {{\n"
                f"{self.emit([e[3] for e in entries])}}}\n",
            ]
        return "\n".join([*parts, lu, lu_lanes, '#include "integrator.h"\n'])


# -------------------------------------------------------------------------------------- building and loading


@cache
def _compiler() -> tuple[list[str], str]:
    """Return the C compiler's command and a text that identifies its result (version, processor)."""
    for candidate in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if candidate and (path := shutil.which(candidate.split()[0])):
            version = subprocess.run([path, "--version"], capture_output=True, text=True).stdout.splitlines()[
                :1
            ]
            try:
                flags = next(
                    (
                        line
                        for line in Path("/proc/cpuinfo").read_text().splitlines()
                        if line.startswith("flags")
                    ),
                    "",
                )
            except OSError:
                flags = ""
            command = [
                *candidate.split(),
                "-O2",
                "-march=native",
                "-fno-math-errno",
                "-fno-trapping-math",
                "-fPIC",
                "-shared",
                "-w",
            ]
            return command, f"{version}{flags}{command}"
    raise InputError(
        "no C compiler (cc, gcc or clang) was found; install one (Debian: apt-get install gcc) or set CC"
    )


def compiler() -> list[str]:
    """Return the command of the C compiler, without options. Raises InputError where there is none."""
    command = _compiler()[0]
    return command[: command.index("-O2")]


def cache_directory() -> Path:
    """Return the folder of compiled plants: $THERMOCTL_CACHE, else thermoctl/plants in the user's cache."""
    own = os.environ.get("THERMOCTL_CACHE")
    return (
        Path(own)
        if own
        else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thermoctl" / "plants"
    )


def _library(key: str, source: str) -> ctypes.CDLL:
    folder = cache_directory()
    path = folder / f"{key}.so"
    if not path.exists():
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryDirectory(dir=folder) as work:
                _build(Path(work), source)
                os.replace(Path(work) / "plant.so", path)
        except OSError:  # a read-only home: build for this process only
            with tempfile.TemporaryDirectory() as work:
                _build(Path(work), source)
                return _typed(ctypes.CDLL(str(Path(work) / "plant.so")))
        if key[0] == "0":  # only one build in sixteen: listing a full folder takes half a second
            _trim(folder)
    return _typed(ctypes.CDLL(str(path)))


def _build(work: Path, source: str) -> None:
    (work / "plant.c").write_text(source)
    # -O2 compiles in 0.7 of the time of -O3, and its code is a tenth slower. With -O1 the lanes of the
    # sensitivities are not kept in registers: 3 to 10 times slower. It is for files that -O2 takes minutes for.
    command = _compiler()[0]
    if len(source) >= LARGE:
        command = ["-O1" if a == "-O2" else a for a in command]
    done = subprocess.run(
        [*command, f"-I{_HEADERS[0].parent}", "-o", str(work / "plant.so"), str(work / "plant.c"), "-lm"],
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise InputError(f"the C compiler failed on the plant: {done.stderr.strip()[:500]}")


def _trim(folder: Path, keep: int = 2000, age_s: float = 86_400.0) -> None:
    """Delete the oldest beyond `keep`, but none made within a day: a process may be about to load it."""
    made = []
    for path in folder.glob("*.so"):
        with contextlib.suppress(OSError):  # another process trims, too
            made.append((path.stat().st_mtime, path))
    for mtime, path in sorted(made)[:-keep]:
        if time.time() - mtime > age_s:
            path.unlink(missing_ok=True)


_P, _I, _D = ctypes.c_void_p, ctypes.c_int, ctypes.c_double


def _typed(library: ctypes.CDLL) -> ctypes.CDLL:
    library.integrate.argtypes = [_I, _P, _P, _P, _P, _P, _P, _P, _I, _D, _P, _I, _P, _P, _P, _P]
    library.observe.argtypes = [_I, _I, _P, _P, _P, _P, _P, _P, _I, _P, _P, _P, _P, _I]
    library.observe.restype = None
    library.slopes.argtypes = [_I, _P, _P, _P, _P, _P, _P]
    library.slopes.restype = None
    if hasattr(library, "advance_period"):
        library.advance_period.argtypes = [_D, _D, _P, _P, _P, _D, _P, _P, _P, _P, _P]
    return library


def machine_code(plant: Plant, active: tuple[str, ...], stepper: bool = False) -> Code:
    """Return the plant's machine code with sensitivities to `active`; plants of one structure share it.

    `stepper`: with the functions that advance by one period, which take a fifth of the compiler's time."""
    identity = hashlib.sha256(repr((active, stepper, _structure(plant))).encode()).hexdigest()
    with _LOCK:
        found = _LOADED.get(identity)
    if found is None:
        found = Code(plant, active, stepper)
        with _LOCK:
            _LOADED[identity] = found
            if len(_LOADED) > 256:
                _LOADED.pop(next(iter(_LOADED)))
    return found


def _structure(plant: Plant) -> Mapping[str, object]:
    """Return everything that the code depends on: not values, ranges, units or noise."""
    return {
        "i": list(plant.inputs),
        "p": list(plant.parameters),
        "n": [(n.name, str(n.storage), bool(n.initial_sigma)) for n in plant.nodes.values()],
        "f": [(f.name, f.source, f.target, str(f.rate)) for f in plant.flows.values()],
        "o": [(o.name, str(o.value)) for o in plant.outputs.values()],
    }


__all__ = ["Code", "cache_directory", "compiler", "machine_code"]
