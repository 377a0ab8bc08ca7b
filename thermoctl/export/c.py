"""A plant as one C file on the C library alone: equations, integrator, delays, and a program around them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from thermoctl.export.values import Values, first_outputs
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation import compile as plant_compile
from thermoctl.plant.simulation.equations import ARGUMENTS, PRELUDE, Equations, ints, sparse_lu

_ESDIRK = Path(plant_compile.__file__).with_name("esdirk.h")
_HERE = Path(__file__).parent


def c_source(plant: Plant, numbers: Values) -> str:
    """Return a C file; with -DMAIN a program that reads inputs as CSV and writes outputs."""
    return core(plant, Equations(plant), numbers) + f"\n#ifdef MAIN\n{_text('main.h')}#endif\n"


def core(plant: Plant, e: Equations, numbers: Values) -> str:
    """Return the equations, the integrator and one run (model.h), without a program or an interface."""
    jacobian = e.jacobian()
    lu, _, entries = sparse_lu(len(e.states), [(i, k) for i, k, _ in jacobian])
    delayed, late = list(e.input_delays.values()), list(e.output_delays.values())
    sizes = {
        "NX": len(e.states),
        "NI": len(plant.inputs),
        "NID": len(delayed),
        "NU": len(plant.inputs) + len(delayed),
        "NP": len(e.parameters),
        "NW": len(e.jumps),
        "NF": len(first_outputs(plant)),
        "ND": len(late),
        "NY": len(e.outputs),
        "NJ": len(jacobian),
        "NM": entries,
        "LINEAR": int(e.linear),
    }
    lines = [i.linear for i in plant.inputs.values()]
    lines += [all(plant.inputs[i].linear for i in ex.names(signal)) for signal, _ in delayed]
    slopes = e.emit([d for *_, d in jacobian])
    parts = [
        f"/* {plant.title or plant.file}, written by `thermoctl plant export`. */\n#include <math.h>\n",
        "".join(f"#define {k} {v}\n" for k, v in sizes.items()),
        PRELUDE,
        _numbers("PARAMETERS", numbers.parameters.values()),
        _numbers("WIDTHS", numbers.width),
        _numbers("FIRST", numbers.first.values()),
        _numbers("SCALES", numbers.scale or [0.0] * len(e.states)),
        ints("LINE", map(int, lines)),
        f'#define INPUTS "{",".join(plant.inputs)}"\n#define OUTPUTS "{",".join(e.outputs)}"',
        f"static void rhs_{ARGUMENTS}, double *out) {{\n{e.emit(e.slopes)}}}",
        f"static void jac_{ARGUMENTS}, double *out) {{\n{slopes}}}",
        f"static void rhs_jac_{ARGUMENTS}, double *out) {{ rhs_(t, x, u, p, w, out); jac_(t, x, u, p, w, out + NX); }}",
        f"static void outputs_{ARGUMENTS}, const double *d, double *out) {{\n{e.emit(e.values, 't x u p w d')}}}",
        f"static void delayed_{ARGUMENTS}, const double *d, double *out) {{\n"
        f"{e.emit([g for g, _ in late], 't x u p w d out')}}}",
        f"static void signals_(const double *u, double *out) {{\n{e.emit([g for g, _ in delayed], 'u out')}}}",
        f"static void seconds_(const double *p, double *out) {{\n"
        f"{e.emit([s for _, s in (*delayed, *late)], 'p out')}}}",
        "static void initial_(const double *u, const double *p, const double *f, double *out) {\n"
        f"{_initial(plant, e)}}}",
        lu,
        _ESDIRK.read_text(),
        _text("model.h"),
    ]
    return "\n".join(parts)


def time_jumps(e: Equations) -> str:
    """Return C of the jumps that are events in time: TIMED marks them, time_jump_ gives their arguments."""
    marked = [timed(e, z) for z, _ in e.jumps]
    exprs = [z if is_marked else num(0.0) for (z, _), is_marked in zip(e.jumps, marked, strict=True)]
    return (
        f"{ints('TIMED', map(int, marked))}\nstatic double time_jump_(int i, double t, const double *p) {{\n"
        f"double out[NW + 1] = {{0}};\n{e.emit(exprs, 't p')}return out[i];\n}}\n"
    )


def timed(e: Equations, jump: Expr) -> bool:
    """Return True where a jump happens at a time that the parameters alone give."""
    slope = ex.derivative(jump, "t")
    return "t" in ex.names(jump) and ex.names(jump) <= {"t", *e.parameters} and "t" not in ex.names(slope)


def _initial(plant: Plant, e: Equations) -> str:
    """Return the statements of the initial states; first(INPUT) is the input at the start."""
    asked = {o: f"f[{k}]" for k, o in enumerate(first_outputs(plant))}

    def read(part: Expr) -> Expr | None:
        """Return the name for first(NAME): a first reading or an input. None for another operation."""
        return (
            name(f"first {part.value}" if part.value in asked else part.value) if part.op == "first" else None
        )

    exprs: Sequence[Expr] = [ex.substitute(n.initial, read) for n in plant.nodes.values()]
    return e.emit(exprs, "u p f out", {f"first {o}": text for o, text in asked.items()})


def _numbers(label: str, values: Iterable[float]) -> str:
    return f"static const double {label}[] = {{{', '.join(repr(float(v)) for v in values) or '0'}}};"


def _text(header: str) -> str:
    return (_HERE / header).read_text()
