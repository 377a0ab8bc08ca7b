"""The equations of a plant, and their C.

    dx/dt = (flows in - flows out) / storage = f(t, x, u, p),    y = g(t, x, u, p)

Delays become names: of derived inputs in rates, of delayed values in outputs. A jump (sign, step, a
comparison) of a state or of time has a half width w. It is smoothed to tanh(z / w), so it has a slope.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import ZERO, Expr, add, derivative, div, name, neg
from thermoctl.plant.language import Plant
from thermoctl.plant.native.fmu import opened, used

_JUMPS = ("step", "sign", ">", ">=", "<", "<=", "bump")
_NONE: Mapping[str, str] = {}
ARGUMENTS = "(double t, const double *x, const double *u, const double *p, const double *w"
"""The arguments of every generated function, before its results."""


def argument(jump: Expr) -> Expr:
    """Return the expression whose sign decides a jump."""
    a = jump.args
    if jump.op in (">", ">="):
        return add(a[0], neg(a[1]))
    return add(a[1], neg(a[0])) if jump.op in ("<", "<=") else a[0]


class Equations:
    """The equations of a plant: `slopes` of its states, `values` of its outputs, and the jumps in them."""

    def __init__(self, plant: Plant):
        self.plant = plant
        self.parameters = tuple(plant.parameters)
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
        self.fmus = used(e for root in self._roots() for e in ex.walk(root))

    def _take_out_delays(self) -> None:
        """Replace delays by names: of derived inputs in rates, of delayed values in outputs."""
        self.input_delays: dict[str, tuple[Expr, Expr]] = {}
        self.output_delays: dict[str, tuple[Expr, Expr]] = {}

        def named(table: dict[str, tuple[Expr, Expr]], prefix: str) -> Callable[[Expr], Expr | None]:
            """Return a change for `substitute` that puts names for delays and enters them in `table`."""

            def change(e: Expr) -> Expr | None:
                """Return the name of a delay, one name for equal delays. None for another operation."""
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
        seen: set[int] = set()
        for root in self._roots():
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

    def _roots(self) -> list[Expr]:
        return [*self.slopes, *self.values, *(d[0] for d in self.output_delays.values())]

    def jacobian(self) -> list[tuple[int, int, Expr]]:
        """Return (row, column, slope) of each entry of df/dx that is not zero; set `linear`."""
        entries = [
            (i, k, d)
            for i, f in enumerate(self.slopes)
            for k, s in enumerate(self.states)
            if (d := derivative(f, s)) is not ZERO
        ]
        moving = set(self.states) | set(self.inputs) | {"t"}
        self.linear = not any(ex.names(d) & moving for _, _, d in entries)
        return entries

    def emit(
        self, exprs: Sequence[Expr], arguments: str = "t x u p w", more: Mapping[str, str] = _NONE
    ) -> str:
        """Return the statements that compute each expression into out[]; shared parts once.

        `arguments`: those of the function that no expression may read; `more`: C of further names."""
        place = {
            **{s: f"x[{i}]" for i, s in enumerate(self.states)},
            **{s: f"u[{i}]" for i, s in enumerate(self.inputs)},
            **{s: f"p[{i}]" for i, s in enumerate(self.parameters)},
            **{s: f"d[{i}]" for i, s in enumerate(self.output_delays)},
            "t": "t",
            **more,
        }
        lines = [" ".join(f"(void){a};" for a in arguments.split()) + "\n"]
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
                    text = self._foreign(e, a) if e.op.startswith("fmu") else self._statement(e, a, lines)
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

    def _foreign(self, e: Expr, a: list[str]) -> str:
        """Return the call of an FMU; a missing argument is NaN and keeps its value."""
        path, result, names, *by = e.value
        fmu = opened(path)
        number, at = self.fmus.index(path), [0, *map(fmu.argument, names)]

        known = dict(zip(at, a, strict=True))
        values = (
            f"(const double[]){{{', '.join(known.get(j, 'NAN') for j in range(1 + len(fmu.arguments)))}}}"
        )
        places = ", ".join(str(k) for k in (fmu.result(result), *map(fmu.argument, by)))
        function = "fmu_slope_" if by else "fmu_value_"
        return f"{function}(fmus_[{number}], {places}, {values})"


PRELUDE = """#include <math.h>
/* Half width w of a jump: 0 none; -1 and -2: latched before and after it, between the events of an FMU. */
static inline double smooth_(double q) { return fabs(q) < 20 ? tanh(q) : q > 0 ? 1 : q < 0 ? -1 : q; }
static inline double sign_(double z, double w) { return w > 0 ? smooth_(z / w) : w < 0 ? (w < -1.5) - (w > -1.5) : (z > 0) - (z < 0); }
static inline double step_(double z, double w) { return w > 0 ? 0.5 * (1 + smooth_(z / w)) : w < 0 ? w < -1.5 : z >= 0; }
static inline double strict_(double z, double w) { return w > 0 ? 0.5 * (1 + smooth_(z / w)) : w < 0 ? w < -1.5 : z > 0; }
static inline double bump_(double z, double w) { if (!(w > 0)) return 0; double q = smooth_(z / w); return 0.5 / w * (1 - q * q); }
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


# Updates of a factorisation, up to which each is a statement of its own. A compiler needs 2 s for 2 700 of
# them; a loop over a table takes as long as they do where a factorisation serves many right-hand sides.
WRITTEN_OUT = 500

_ELIMINATION = """for (const int *f = FACTORS, *end = f + sizeof FACTORS / sizeof *f; f < end;) {
    const int p = *f++, below = *f++;
    if (!(fabs(M[p]) > 1e-9)) return 0;
    M[p] = 1 / M[p];
    for (int i = 0; i < below; i++) {
      const double m = M[*f] *= M[p];
      for (const int *row = f + 2, *stop = f = f + 2 + 2 * f[1]; row < stop; row += 2) M[row[0]] -= m * M[row[1]];
    }
  }
"""


def ints(label: str, values: Iterable[int], linkage: str = "static ") -> str:
    """Return a C array of integers; an empty one holds a 0, as C wants at least one."""
    values = list(values)
    return f"{linkage}const int {label}[] = {{{', '.join(map(str, values or [0]))}}};"


Pivots = list[tuple[int, list[tuple[int, list[tuple[int, int]]]]]]


def _factors(pivots: Pivots) -> tuple[str, str]:
    """Write C that eliminates with each pivot (entry, rows below): a table of entries, and the statements.

    A row below is (entry, updates (entry, entry of the pivot's row)). Few updates are written out."""
    if sum(len(updates) for _, below in pivots for _, updates in below) <= WRITTEN_OUT:
        text = ""
        for p, below in pivots:
            text += f"if (!(fabs(M[{p}]) > 1e-9)) return 0;\nM[{p}] = 1 / M[{p}];\n"
            for m, updates in below:
                text += f"M[{m}] *= M[{p}];\n"
                text += "".join(f"M[{i}] -= M[{m}] * M[{j}];\n" for i, j in updates)
        return "", text
    numbers: list[int] = []
    for p, below in pivots:
        numbers += [p, len(below)]
        for m, updates in below:
            numbers += [m, len(updates), *(q for pair in updates for q in pair)]
    return ints("FACTORS", numbers) + "\n", _ELIMINATION


def sparse_lu(n: int, pattern: list[tuple[int, int]], linkage: str = "static ") -> tuple[str, str, int]:
    """Write C that factors M = I - a J and solves for one and for eight right-hand sides.

    No pivoting, minimum-degree order (Markowitz). A small pivot is refused; the integrator then takes a
    smaller step. Returns (text, text for eight right-hand sides, entries of M)."""
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
    pivots: Pivots = []
    for k in order:
        below = [i for i in sorted(columns[k], key=position.__getitem__) if position[i] > position[k]]
        right = [j for j in sorted(fill[k]) if position[j] > position[k]]
        rows_below = [(index[i, k], [(index[i, j], index[k, j]) for j in right]) for i in below]
        pivots.append((index[k, k], rows_below))
        forward += [(i, k, index[i, k]) for i in below]
    for k in reversed(order):
        backward += [(k, j, index[k, j]) for j in sorted(fill[k]) if position[j] > position[k]]
        backward.append((k, -1, index[k, k]))
    single = "".join(f"r[{i}] -= M[{m}] * r[{k}];\n" for i, k, m in forward)
    single += "".join(
        f"r[{k}] *= M[{m}];\n" if j < 0 else f"r[{k}] -= M[{m}] * r[{j}];\n" for k, j, m in backward
    )
    table, factors = _factors(pivots)
    lanes = f"{linkage}void solve_lanes_(const double *restrict M, lanes *restrict r) {{ (void)M; (void)r;\n{single}}}\n"
    return (
        f"{table}{linkage}int factor_(double a, const double *J, double *M) {{ (void)a; (void)J;\n{''.join(put)}"
        f"{factors}return 1; }}\n"
        f"{linkage}void solve_(const double *M, double *r) {{ (void)M; (void)r;\n{single}}}\n",
        lanes,
        len(index),
    )
