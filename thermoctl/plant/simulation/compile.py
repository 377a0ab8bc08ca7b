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

import ctypes
import hashlib
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from thermoctl.plant import expression as ex
from thermoctl.plant.expression import ZERO, Expr, add, derivative, mul, name
from thermoctl.plant.language import Plant
from thermoctl.plant.native.build import library
from thermoctl.plant.native.fmu import opened
from thermoctl.plant.simulation.equations import ARGUMENTS, PRELUDE, Equations, ints, sparse_lu

_HEADERS = tuple(Path(__file__).with_name(h) for h in ("compiled.h", "esdirk.h", "integrator.h"))
_LOCK = threading.Lock()
_LOADED: dict[str, Code] = {}


class Code(Equations):
    """A compiled plant: its equations with sensitivities to `active`, and the library that computes them.

    `stepper`: with the functions that advance by one period."""

    def __init__(self, plant: Plant, active: tuple[str, ...], stepper: bool = False):
        super().__init__(plant)
        self.active = active
        self.source = self._source()
        integrator = f"#define NX {len(self.states)}\n#define LINEAR {int(self.linear)}\n"
        integrator += "#define STEPPER\n" * stepper + '#include "integrator.h"\n'
        headers = "".join(path.read_text() for path in _HEADERS)
        self.library = _typed(library(self.source, [_HEADERS[0].parent], headers, integrator))
        for number, path in enumerate(self.fmus):
            opened(path).link(self.library, number)

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
        nx = len(self.states)
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
        lu, lu_lanes, nm = sparse_lu(nx, [(i, k) for i, k, _ in jac], "")
        args = ARGUMENTS
        sizes = {
            "NU": len(self.inputs),
            "NY": len(self.outputs),
            "ND": len(delays),
            "NJ": len(jac),
            "NV": len(sens),
            "NM": nm,
            "NO0": len(lists[0][1]),
            "NO1": len(lists[1][1]),
        }
        parts = [
            PRELUDE,
            *self._declared(),
            '#include "compiled.h"',
            f"const int {', '.join(f'{k} = {v}' for k, v in sizes.items())};",
            ints("J_ROW", [i for i, _, _ in jac], ""),
            ints("J_COL", [k for _, k, _ in jac], ""),
            ints("V_ROW", [i for i, _, _ in sens], ""),
            ints("V_COL", [c for _, c, _ in sens], ""),
            *(
                ints(f"O{o}_{what}", [e[:3][at] for e in lists[o][1]], "")
                for o in (0, 1)
                for at, what in enumerate(("ROW", "KIND", "COL"))
            ),
            f"void rhs_{args}, double *out) {{\n{self.emit(self.slopes)}}}\n",
            f"void jac_{args}, double *out) {{\n{self.emit([d for *_, d in jac])}}}\n",
            ""
            if self.linear
            else f"void rhs_jac_{args}, double *out) {{\n{self.emit([*self.slopes, *(d for *_, d in jac)])}}}\n",
            f"void sens_{args}, double *out) {{\n{self.emit([d for *_, d in ([] if self.linear else jac) + sens])}}}\n",
        ]
        for (values, entries), fn in zip(lists, ("outputs_", "delayed_"), strict=True):
            parts += [
                f"void {fn}{args}, const double *d, double *out) {{\n{self.emit(values)}}}\n",
                f"void {fn[:-1]}_slopes_{args}, const double *d, double *out) {{\n"
                f"{self.emit([e[3] for e in entries])}}}\n",
            ]
        return "\n".join([*parts, lu, lu_lanes, _product(jac)])

    def _declared(self) -> list[str]:
        """Return the C that declares the functions of FMUs; their contents are part of the source's key."""
        if not self.fmus:
            return []
        contents = "".join(f"/* {opened(path).digest} */\n" for path in self.fmus)
        return [
            f"{contents}double (*fmu_value_)(void *, int, const double *), "
            f"(*fmu_slope_)(void *, int, int, const double *);\nvoid *fmus_[{len(self.fmus)}];\n"
        ]


def _product(jac: Sequence[tuple[int, int, Expr]]) -> str:
    """Return C that adds J R to k for eight columns, a statement for each row: sums stay in registers."""
    rows: dict[int, list[str]] = {}
    for q, (i, k, _) in enumerate(jac):
        rows.setdefault(i, []).append(f"J[{q}] * R[{k}]")
    text = "".join(f"k[{i}] += {' + '.join(terms)};\n" for i, terms in rows.items())
    return f"void multiply_lanes_(const double *J, const lanes *R, lanes *restrict k) {{ (void)J; (void)R; (void)k;\n{text}}}\n"


# ------------------------------------------------------------------------------------------------------
# loading


_P, _I, _D = ctypes.c_void_p, ctypes.c_int, ctypes.c_double


def _typed(library: ctypes.CDLL) -> ctypes.CDLL:
    library.integrate.argtypes = [_I, *[_P] * 7, _I, _D, _P, _I, *[_P] * 6, _I]
    library.observe.argtypes = [_I, _I, _P, _P, _P, _P, _P, _P, _I, _P, _P, _P, _P, _I]
    library.observe.restype = None
    library.slopes.argtypes = [_I, _P, _P, _P, _P, _P, _P]
    library.slopes.restype = None
    if hasattr(library, "advance_period"):
        library.advance_period.argtypes = [_D, _D, _P, _P, _P, _D, _P, _P, _P, _P, _P]
    return library


def machine_code(plant: Plant, active: tuple[str, ...], stepper: bool = False) -> Code:
    """Return a plant's machine code with sensitivities to `active`. Plants of one structure share it.

    `stepper`: with the functions that advance by one period, which take a fifth of the compiler's time."""
    identity = hashlib.sha256(repr((active, stepper, _structure(plant))).encode()).hexdigest()
    with _LOCK:
        code = _LOADED.get(identity)
    if code is None:
        code = Code(plant, active, stepper)
        with _LOCK:
            _LOADED[identity] = code
            if len(_LOADED) > 256:
                _LOADED.pop(next(iter(_LOADED)))
    return code


def _structure(plant: Plant) -> Mapping[str, object]:
    """Return everything that the code depends on: not values, ranges, units or noise."""
    return {
        "i": list(plant.inputs),
        "p": list(plant.parameters),
        "n": [(n.name, str(n.storage), bool(n.initial_sigma)) for n in plant.nodes.values()],
        "f": [(f.name, f.source, f.target, str(f.rate)) for f in plant.flows.values()],
        "o": [(o.name, str(o.value)) for o in plant.outputs.values()],
    }


__all__ = ["Code", "machine_code"]
