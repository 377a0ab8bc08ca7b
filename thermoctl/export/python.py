"""A plant as one Python file on NumPy and SciPy."""

from __future__ import annotations

import keyword
from collections.abc import Sequence

from thermoctl import __version__
from thermoctl.export.text import Notation, net_flow, unique, written
from thermoctl.export.values import Values, first_outputs
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.equations import Equations

_FUNCTIONS = {f: f"np.{f}({{0}})" for f in ("abs", "sqrt", "exp", "log", "sin", "cos", "tanh")}


def _jump(op: str, z: str, width: str) -> str:
    if op == "sign":
        return f"sign_({z}, {width})"
    return f"step_({z}, {width}{', strict=True' if op in ('<', '>') else ''})"


NOTATION = Notation(
    "{0} ** {1}",
    {**_FUNCTIONS, "min": "np.minimum({0}, {1})", "max": "np.maximum({0}, {1})"},
    _jump,
    {"==": "1.0 * ({0} == {1})", "!=": "1.0 * ({0} != {1})"},
    lambda x, xs, ys: f"np.interp({x}, [{', '.join(xs)}], [{', '.join(ys)}])",
)
_RESERVED = {*keyword.kwlist, *keyword.softkwlist, "np", "solve_ivp", "sign_", "step_", *"txupwd", "first"}


def python_source(plant: Plant, numbers: Values) -> str:
    """Return a Python file with the plant's equations and `simulate(t, inputs, parameters)`."""
    e = Equations(plant)
    known = unique(plant, _RESERVED)
    names = {**known, **{d: d for d in (*e.input_delays, *e.output_delays)}, "t": "t"}
    site = {id(z): k for k, (z, _) in enumerate(e.jumps)}

    def text(expr: Expr) -> str:
        """Return an expression as Python text."""
        return written(
            expr,
            NOTATION,
            names.__getitem__,
            lambda z: f"w[{site[id(z)]}]" if id(z) in site else "0.0",
            lambda o: f"first[{o!r}]",
        )

    def unpack(keys: Sequence[str], array: str) -> str:
        """Return the line that unpacks `array` into the names of `keys`; no line without keys."""
        return f"    ({', '.join(names[k] for k in keys)},) = {array}\n" if keys else ""

    def pairs(delays: dict[str, tuple[Expr, Expr]]) -> str:
        """Return the text of the list of (signal, seconds) of each delay."""
        return "[" + ", ".join(f"({text(g)}, {text(s)})" for g, s in delays.values()) + "]"

    inputs = tuple(plant.inputs)
    get_p, get_x = unpack(e.parameters, "p"), unpack(e.states, "x")
    get_u, get_recorded = unpack((*inputs, *e.input_delays), "u"), unpack(inputs, "u[: len(INPUTS)]")
    flows = "".join(
        f"    {known[f'flow {f.name}']} = {text(e.rates[f.name])}{_unit(f.unit)}\n"
        for f in plant.flows.values()
    )
    slopes = []
    for n in plant.nodes.values():
        net, storage = net_flow(plant, n.name, known), text(n.storage)
        slopes.append(f"({net}) / ({storage})" if storage != "1" else net)
    arrays = {
        "slopes": _rows(slopes, list(e.states), ""),
        "outputs": _rows([text(v) for v in e.values], list(e.outputs), " + 0.0 * t"),
    }
    straight = [all(plant.inputs[i].linear for i in ex.names(g)) for g, _ in e.input_delays.values()]
    numbers_first = ", ".join(f"{o!r}: {numbers.first[o]!r}" for o in first_outputs(plant))
    return f'''"""{(plant.title or plant.file).replace(chr(34), "'")}

Written by `thermoctl plant export --to python` (thermoctl {__version__}). Needs NumPy and SciPy.
    storage * d(node)/dt = sum(flows into the node) - sum(flows from it)
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import Akima1DInterpolator

PARAMETERS = {{{_parameters(plant, numbers)}}}
INPUTS = {list(inputs)!r}
LINEAR = {[i.linear for i in plant.inputs.values()]!r}  # straight lines between samples, else held
DELAYED_LINEAR = {straight!r}  # the same of delayed inputs
STATES = {list(e.states)!r}
OUTPUTS = {list(e.outputs)!r}
WIDTHS = {list(numbers.width)!r}  # half widths over which jumps are smoothed; 0: not smoothed
SCALES = {list(numbers.scale)!r}  # ranges of the states, for the tolerance
FIRST = {{{numbers_first}}}  # first readings, for initial values


def sign_(z, w):
    return np.tanh(z / w) if w > 0 else np.sign(z)


def step_(z, w, strict=False):
    return 0.5 * (1 + np.tanh(z / w)) if w > 0 else 1.0 * (z > 0 if strict else z >= 0)


def initial(u, p, first):
    """Return the states at the start, from the inputs at the start."""
{get_recorded}{get_p}    return np.array([{", ".join(text(n.initial) for n in plant.nodes.values())}], float)


def slopes(t, x, u, p, w):
    """Return dx/dt."""
{get_x}{get_u}{get_p}{flows}    return np.array([{arrays["slopes"]}])


def outputs(t, x, u, p, w, d):
    """Return the readings of perfect sensors over time; d: values of their delays."""
{get_x}{get_u}{get_p}{unpack(tuple(e.output_delays), "d")}    return np.array([{arrays["outputs"]}])


def input_delays(u, p):
    """Return (signal, seconds) of each delay of inputs."""
{get_recorded}{get_p}    return {pairs(e.input_delays)}


def output_delays(t, x, u, p, w):
    """Return (argument, seconds) of each delay in the outputs."""
{get_x}{get_u}{get_p}    return {pairs(e.output_delays)}
{_RUN}'''


def _parameters(plant: Plant, numbers: Values) -> str:
    lines = [f"    {q!r}: {numbers.parameters[q]!r},{_unit(p.unit)}\n" for q, p in plant.parameters.items()]
    return "\n" + "".join(lines) if lines else ""


def _rows(expressions: Sequence[str], labels: Sequence[str], more: str) -> str:
    rows = "".join(f"        {e}{more},  # {q}\n" for e, q in zip(expressions, labels, strict=True))
    return f"\n{rows}    " if rows else ""


def _unit(unit: str | None) -> str:
    return f"  # {unit}" if unit else ""


_RUN = '''

def simulate(t, inputs, parameters=None, first=None, rtol=1e-10):
    """Simulate freely over the times t (N,) in seconds; return a dict of states and outputs (N,).

    inputs: (N,) by name; parameters: values that replace PARAMETERS; first: first readings."""
    t = np.asarray(t, float) - t[0]
    p = list({**PARAMETERS, **(parameters or {})}.values())
    u = [np.broadcast_to(np.asarray(inputs[i], float), t.shape) for i in INPUTS]
    start = {**FIRST, **{i: float(v[0]) for i, v in zip(INPUTS, u)}, **(first or {})}
    for (signal, seconds), straight in zip(input_delays(u, p), DELAYED_LINEAR):
        at, s = t - seconds, np.broadcast_to(signal, t.shape)
        if straight:
            u.append(np.interp(at, t, s))
            continue
        area = np.concatenate([[0.0], np.cumsum(s[:-1] * np.diff(t))])
        # before the start: the first value, and after the end: the last one
        area = np.interp(at, t, area) + np.minimum(at, 0.0) * s[0] + np.maximum(at - t[-1], 0.0) * s[-1]
        mean = np.diff(area) / np.diff(t)
        u.append(np.append(mean, mean[-1]))
    u = np.array(u).reshape(len(u), len(t))
    x = _integrate(t, u, np.array(LINEAR + DELAYED_LINEAR, bool), initial(u[:, 0], p, start), p, rtol)
    past = [(np.broadcast_to(g, t.shape), np.clip(t - s, 0.0, t[-1])) for g, s in output_delays(t, x, u, p, WIDTHS)]
    d = [Akima1DInterpolator(t, g)(at) for g, at in past]
    y = outputs(t, x, u, p, WIDTHS, d)
    return {**dict(zip(STATES, x)), **dict(zip(OUTPUTS, y))}


def _integrate(t, u, linear, x0, p, rtol):
    """Integrate from one change of a held input to the next."""
    x = np.empty((len(x0), len(t)))
    x[:, 0] = x0
    if not len(x0):
        return x
    changes = 1 + np.flatnonzero(np.any(np.diff(u[~linear]) != 0, axis=0))
    edges = sorted({0, *changes.tolist(), len(t) - 1})
    scale = np.array(SCALES) if SCALES else np.abs(x0) + 1e-3
    for a, b in zip(edges[:-1], edges[1:]):

        def slope(s, z):
            now = u[:, a].copy()
            k = min(max(int(np.searchsorted(t, s, side="right")) - 1, a), b - 1)
            now[linear] += (s - t[k]) / (t[k + 1] - t[k]) * (u[linear, k + 1] - u[linear, k]) + u[linear, k] - now[linear]
            return slopes(s, z, now, p, WIDTHS)

        run = solve_ivp(slope, (t[a], t[b]), x[:, a], "LSODA", t[a : b + 1], rtol=rtol, atol=rtol * scale)
        if not run.success or run.y.shape[1] != b + 1 - a:
            raise RuntimeError(f"the plant cannot be integrated beyond t = {t[a]:g} s: {run.message}")
        x[:, a : b + 1] = run.y
    return x
'''
