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
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path

from thermoctl.plant import expression as ex
from thermoctl.plant.expression import ZERO, Expr, add, derivative, div, mul, name, neg
from thermoctl.plant.language import Plant
from thermoctl.yamlfile import InputError

_JUMPS = ("step", "sign", ">", ">=", "<", "<=", "bump")
_TEMPLATE = Path(__file__).with_name("integrator.h")
_LOCK = threading.Lock()
_LOADED: dict[str, Code] = {}


def argument(jump: Expr) -> Expr:
    """Return the expression whose sign decides a jump."""
    a = jump.args
    if jump.op in (">", ">="):
        return add(a[0], neg(a[1]))
    return add(a[1], neg(a[0])) if jump.op in ("<", "<=") else a[0]


class Code:
    """A compiled plant: its equations and the library that computes them."""

    def __init__(self, plant: Plant, active: tuple[str, ...]):
        self.plant = plant
        self.parameters = tuple(plant.parameters)
        self.active = active
        self.states = tuple(plant.nodes)
        self.outputs = tuple(plant.outputs)
        self.uncertain = tuple(n.name for n in plant.nodes.values() if n.initial_sigma)
        self._take_out_delays()
        self.inputs = (*plant.inputs, *self.input_delays, *(f"{d}_slope" for d in self.input_delays))
        net: dict[str, Expr] = {n: ZERO for n in self.states}
        for f in plant.flows.values():
            rate = self.rates[f.name]
            if f.source:
                net[f.source] = add(net[f.source], neg(rate))
            if f.target:
                net[f.target] = add(net[f.target], rate)
        self.slopes = [div(net[n.name], n.storage) for n in plant.nodes.values()]
        self._widths()
        self.source = self._source()
        self.key = hashlib.sha256(
            (self.source + _TEMPLATE.read_text() + _compiler()[1]).encode()
        ).hexdigest()[:32]
        self.library = _library(self.key, self.source)

    def _take_out_delays(self) -> None:
        """Replace delays by names: of derived inputs in rates, of delayed values in outputs."""
        self.input_delays: dict[str, tuple[Expr, Expr]] = {}
        self.output_delays: dict[str, tuple[Expr, Expr]] = {}

        def named(table: dict[str, tuple[Expr, Expr]], prefix: str) -> Callable[[Expr], Expr | None]:
            def change(e: Expr) -> Expr | None:
                if e.op != "delay":
                    return None
                for key, pair in table.items():
                    if pair[0] is e.args[0] and pair[1] is e.args[1]:
                        return name(key)
                key = f"{prefix}{len(table)}"
                table[key] = (e.args[0], e.args[1])
                return name(key)

            return change

        self.rates = {
            f.name: ex.substitute(f.rate, named(self.input_delays, "delayed_input_"))
            for f in self.plant.flows.values()
        }
        for signal, _ in self.input_delays.values():
            if not ex.names(signal) <= set(self.plant.inputs):
                raise InputError(f"{self.plant.file}: delay() in a rate may read inputs only, not '{signal}'")
        self.values = [
            ex.substitute(o.value, named(self.output_delays, "delayed_")) for o in self.plant.outputs.values()
        ]
        # A file cannot contain a nested delay (language.py), but an effect added to a plant can.
        for signal, _ in self.output_delays.values():
            if ex.names(signal) & self.output_delays.keys():
                raise InputError(
                    f"{self.plant.file}: a delay() within a delay() is not part of the language; add the seconds"
                )

    def _widths(self) -> None:
        """Return the jumps that are smoothed: by argument, 'state' or 'time'."""
        self.jumps: list[tuple[Expr, str]] = []
        roots = [*self.slopes, *self.values, *(d[0] for d in self.output_delays.values())]
        seen: set[int] = set()
        for root in roots:
            for e in ex.walk(root):
                if e.op not in _JUMPS:
                    continue
                z = argument(e)
                used = ex.names(z)
                kind = "state" if used & set(self.states) else "time" if "t" in used else ""
                if kind and id(z) not in seen:
                    seen.add(id(z))
                    self.jumps.append((z, kind))
        self.jump_index = {id(z): i for i, (z, _) in enumerate(self.jumps)}

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
        jac = [
            (i, k, d)
            for i, f in enumerate(self.slopes)
            for k, s in enumerate(self.states)
            if (d := derivative(f, s)) is not ZERO
        ]
        sens = [
            (i, c, d)
            for i, f in enumerate(self.slopes)
            for c, q in enumerate(self.active)
            if (d := self._by_parameter(f, q)) is not ZERO
        ]
        moving = set(self.states) | set(self.inputs) | {"t"}
        self.linear = not any(ex.names(d) & moving for _, _, d in jac)
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
        lu, nm = _sparse_lu(nx, [(i, k) for i, k, _ in jac])
        args = "(double t, const double *x, const double *u, const double *p, const double *w"
        parts = [
            f"#define NX {nx}\n#define NU {len(self.inputs)}\n#define NA {na}\n#define NY {len(self.outputs)}\n"
            f"#define ND {len(delays)}\n#define NJ {len(jac)}\n#define NV {len(sens)}\n#define NM {nm}\n"
            f"#define NO0 {len(lists[0][1])}\n#define NO1 {len(lists[1][1])}\n"
            f"#define NO {max(len(lists[0][1]), len(lists[1][1]))}\n#define LINEAR {int(self.linear)}\n",
            _PRELUDE,
            _ints("J_ROW", [i for i, _, _ in jac]),
            _ints("J_COL", [k for _, k, _ in jac]),
            _ints("V_ROW", [i for i, _, _ in sens]),
            _ints("V_COL", [c for _, c, _ in sens]),
            *(
                _ints(f"O{o}_ROW", [e[0] for e in lists[o][1]])
                + _ints(f"O{o}_KIND", [e[1] for e in lists[o][1]])
                + _ints(f"O{o}_COL", [e[2] for e in lists[o][1]])
                for o in (0, 1)
            ),
            f"static void rhs_{args}, double *out) {{\n{self._emit(self.slopes)}}}\n",
            f"static void jac_{args}, double *out) {{\n{self._emit([d for *_, d in jac])}}}\n",
            f"static void sens_{args}, double *out) {{\n{self._emit([d for *_, d in sens])}}}\n",
        ]
        for (values, entries), fn in zip(lists, ("outputs_", "delayed_"), strict=True):
            parts += [
                f"static void {fn}{args}, const double *d, double *out) {{\n{self._emit(values)}}}\n",
                f"static void {fn[:-1]}_slopes_{args}, const double *d, double *out) {{\n"
                f"{self._emit([e[3] for e in entries])}}}\n",
            ]
        return "\n".join([*parts, lu, '#include "integrator.h"\n'])

    def _emit(self, exprs: list[Expr]) -> str:
        """Return the statements that compute each expression into out[]; shared parts once."""
        place = {
            **{s: f"x[{i}]" for i, s in enumerate(self.states)},
            **{s: f"u[{i}]" for i, s in enumerate(self.inputs)},
            **{s: f"p[{i}]" for i, s in enumerate(self.parameters)},
            **{s: f"d[{i}]" for i, s in enumerate(self.output_delays)},
            "t": "t",
        }
        lines: list[str] = ["(void)t; (void)x; (void)u; (void)p; (void)w;\n"]
        done: dict[int, str] = {}
        for root in exprs:
            for e in ex.walk(root):
                if id(e) in done:
                    continue
                a = [done[id(q)] for q in e.args]
                if e.op == "num":
                    done[id(e)] = f"({e.value!r})"
                elif e.op == "name":
                    done[id(e)] = place[e.value]
                else:
                    text = self._statement(e, a, lines)
                    done[id(e)] = f"c{len(lines)}"
                    lines.append(f"const double c{len(lines)} = {text};\n")
        return "".join(lines) + "".join(f"out[{i}] = {done[id(e)]};\n" for i, e in enumerate(exprs))

    def _statement(self, e: Expr, a: list[str], lines: list[str]) -> str:
        op = e.op
        if op in ("+", "*", "/"):
            return f"{a[0]} {op} {a[1]}"
        if op == "neg":
            return f"-{a[0]}"
        if op == "**":
            k = e.args[1]
            if k.op == "num" and k.value in (2.0, 3.0, 4.0):
                return " * ".join([a[0]] * int(k.value))
            return f"pow({a[0]}, {a[1]})"
        if op in _JUMPS:
            z = (
                a[0]
                if op in ("step", "sign", "bump")
                else f"({a[0]} - {a[1]})"
                if op in (">", ">=")
                else f"({a[1]} - {a[0]})"
            )
            site = self.jump_index.get(id(argument(e)))
            width = "0.0" if site is None else f"w[{site}]"
            kind = {"sign": "sign_", "bump": "bump_"}.get(op, "strict_" if op in (">", "<") else "step_")
            return f"{kind}({z}, {width})"
        if op in ("==", "!="):
            return f"{a[0]} {op} {a[1]} ? 1.0 : 0.0"
        if op == "le":
            return f"{a[0]} <= {a[1]} ? 1.0 : 0.0"
        if op == "side":
            return f"{a[0]} >= 0 ? 1.0 : -1.0"
        if op in ("table", "table_slope"):
            lines.append(f"const double c{len(lines)}[] = {{{', '.join(a[1:])}}};\n")
            return f"{op}_({a[0]}, {e.value}, c{len(lines) - 1})"
        function = {"abs": "fabs", "min": "min_", "max": "max_", "dpow": "dpow_"}.get(op, op)
        return f"{function}({', '.join(a)})"


_PRELUDE = """#include <math.h>
typedef double lanes __attribute__((vector_size(64), aligned(8)));       /* columns of sensitivities, eight at a time */
static inline double sign_(double z, double w) { return w > 0 ? tanh(z / w) : (z > 0) - (z < 0); }
static inline double step_(double z, double w) { return w > 0 ? 0.5 * (1 + tanh(z / w)) : z >= 0; }
static inline double strict_(double z, double w) { return w > 0 ? 0.5 * (1 + tanh(z / w)) : z > 0; }
static inline double bump_(double z, double w) { if (!(w > 0)) return 0; double q = tanh(z / w); return 0.5 / w * (1 - q * q); }
static inline double min_(double a, double b) { return a < b ? a : b; }
static inline double max_(double a, double b) { return a > b ? a : b; }
static inline double dpow_(double a, double b) { return a > 0 ? pow(a > 1e-8 ? a : 1e-8, b - 1) : 0; }
static inline double table_(double x, int k, const double *q) {
  if (x <= q[0]) return q[k];
  for (int i = 1; i < k; i++) if (x <= q[i]) return q[k + i - 1] + (x - q[i - 1]) / (q[i] - q[i - 1]) * (q[k + i] - q[k + i - 1]);
  return q[2 * k - 1];
}
static inline double table_slope_(double x, int k, const double *q) {
  if (x <= q[0]) return 0;
  for (int i = 1; i < k; i++) if (x <= q[i]) return (q[k + i] - q[k + i - 1]) / (q[i] - q[i - 1]);
  return 0;
}
"""


def _ints(label: str, values: Iterable[int]) -> str:
    values = list(values)
    return f"static const int {label}[] = {{{', '.join(map(str, values or [0]))}}};"


def _sparse_lu(n: int, pattern: list[tuple[int, int]]) -> tuple[str, int]:
    """Write C that factors M = I - a J and solves for one and for eight right-hand sides.

    No pivoting, minimum-degree order (Markowitz). A small pivot is refused; the integrator then takes a
    smaller step. Returns (text, entries of M)."""
    rows: list[set[int]] = [{i} for i in range(n)]
    for i, k in pattern:
        rows[i].add(k)
    columns = [{i for i in range(n) if k in rows[i]} for k in range(n)]
    left, order = set(range(n)), []
    fill = [set(r) for r in rows]
    while left:
        k = min(left, key=lambda q: ((len(fill[q] & left) - 1) * (len(columns[q] & left) - 1), q))
        left.remove(k)
        order.append(k)
        for i in columns[k] & left:
            for j in fill[k] & left:
                fill[i].add(j)
                columns[j].add(i)
    index = {(i, j): q for q, (i, j) in enumerate((i, j) for i in range(n) for j in sorted(fill[i]))}
    position = {k: q for q, k in enumerate(order)}
    put = [f"for (int q = 0; q < {len(index)}; q++) M[q] = 0;\n"]
    put += [f"M[{index[i, i]}] = 1;\n" for i in range(n)]
    put += [f"M[{index[i, k]}] -= a * J[{q}];\n" for q, (i, k) in enumerate(pattern)]
    forward, backward = [], []
    for k in order:
        put.append(
            f"if (!(fabs(M[{index[k, k]}]) > 1e-9)) return 0;\nM[{index[k, k]}] = 1 / M[{index[k, k]}];\n"
        )
        for i in sorted(columns[k], key=position.__getitem__):
            if position[i] <= position[k]:
                continue
            put.append(f"M[{index[i, k]}] *= M[{index[k, k]}];\n")
            put += [
                f"M[{index[i, j]}] -= M[{index[i, k]}] * M[{index[k, j]}];\n"
                for j in sorted(fill[k])
                if position[j] > position[k]
            ]
            forward.append((i, k, index[i, k]))
    for k in reversed(order):
        backward += [(k, j, index[k, j]) for j in sorted(fill[k]) if position[j] > position[k]]
        backward.append((k, -1, index[k, k]))
    single = "".join(f"r[{i}] -= M[{m}] * r[{k}];\n" for i, k, m in forward)
    single += "".join(
        f"r[{k}] *= M[{m}];\n" if j < 0 else f"r[{k}] -= M[{m}] * r[{j}];\n" for k, j, m in backward
    )
    return (
        f"static int factor_(double a, const double *J, double *M) {{ (void)a; (void)J;\n{''.join(put)}return 1; }}\n"
        f"static void solve_(const double *M, double *r) {{ (void)M; (void)r;\n{single}}}\n"
        f"static inline void solve_lanes_(const double *restrict M, lanes *restrict r) {{ (void)M; (void)r;\n{single}}}\n",
        len(index),
    )


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
                "-O3",
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
    # -O1 compiles a large file's straight-line code as well as -O3, in a fraction of the time. A small plant
    # runs a tenth slower with -O1, and compiles in less than half of the time. A diagnosis compiles many
    # plants.
    command = [("-O1" if a == "-O3" and not 10_000 < len(source) < 400_000 else a) for a in _compiler()[0]]
    done = subprocess.run(
        [*command, f"-I{_TEMPLATE.parent}", "-o", str(work / "plant.so"), str(work / "plant.c"), "-lm"],
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
    library.advance_period.argtypes = [_D, _D, _P, _P, _P, _D, _P, _P, _P, _P, _P]
    return library


def machine_code(plant: Plant, active: tuple[str, ...]) -> Code:
    """Return the plant's machine code with sensitivities to `active`; plants of one structure share it."""
    identity = hashlib.sha256(repr((active, _structure(plant))).encode()).hexdigest()
    with _LOCK:
        found = _LOADED.get(identity)
    if found is None:
        found = Code(plant, active)
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


__all__ = ["Code", "argument", "cache_directory", "machine_code"]
