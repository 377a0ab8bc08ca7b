"""A plant as one Modelica model (language version 3.4, without the standard library)."""

from __future__ import annotations

import re

from thermoctl import __version__
from thermoctl.export.text import Notation, net_flow, unique, written
from thermoctl.export.values import Values, first_outputs
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.equations import Equations

_FUNCTIONS = {f: f"{f}({{0}})" for f in ("abs", "sqrt", "exp", "log", "sin", "cos", "tanh")}


def _jump(op: str, z: str, width: str) -> str:
    """Return a smooth jump; of width 0 a relation, which is an event."""
    if op == "sign":
        return (
            f"tanh({z} / {width})"
            if width != "0"
            else f"(if {z} > 0 then 1.0 elseif {z} < 0 then -1.0 else 0.0)"
        )
    if width != "0":
        return f"(0.5 * (1 + tanh({z} / {width})))"
    return f"(if {z} {'>' if op in ('<', '>') else '>='} 0 then 1.0 else 0.0)"


NOTATION = Notation(
    "{0} ^ {1}",
    {**_FUNCTIONS, "min": "min({0}, {1})", "max": "max({0}, {1})"},
    _jump,
    {"==": "(if abs({0} - {1}) <= 0 then 1.0 else 0.0)", "!=": "(if abs({0} - {1}) > 0 then 1.0 else 0.0)"},
    lambda x, xs, ys: f"straightLines({x}, {{{', '.join(xs)}}}, {{{', '.join(ys)}}})",
    "delay({0}, {1})",
)
_WORDS = """
algorithm and annotation block break class connect connector constant constrainedby der discrete each else
elseif elsewhen encapsulated end enumeration equation expandable extends external false final flow for
function if import impure in initial inner input loop model not operator or outer output package parameter
partial protected public pure record redeclare replaceable return stream then true type when while within time
abs sqrt exp log sin cos tanh min max delay sign sample pre edge change reinit smooth noEvent straightLines
Real Integer Boolean String
"""
_RESERVED = set(_WORDS.split())
_TABLE = """
  function straightLines "straight lines between points, constant outside"
    input Real x;
    input Real xs[:];
    input Real ys[:];
    output Real y;
  algorithm
    y := if x <= xs[1] then ys[1] else ys[size(ys, 1)];
    for i in 2:size(xs, 1) loop
      if x > xs[i - 1] and x <= xs[i] then
        y := ys[i - 1] + (x - xs[i - 1]) / (xs[i] - xs[i - 1]) * (ys[i] - ys[i - 1]);
      end if;
    end for;
  end straightLines;
"""


def modelica_source(plant: Plant, numbers: Values, model: str) -> str:
    """Return a model called `model`: inputs and outputs are connectors, parameters have their units."""
    e = Equations(plant)
    model = re.sub(r"\W", "_", model)
    names = {**unique(plant, _RESERVED | {model}), "t": "time"}
    site = {id(z): k for k, (z, _) in enumerate(e.jumps)}
    jumps = [k for k, w in enumerate(numbers.width) if w > 0]

    def width(z: Expr) -> str:
        """Return the half width of the jump at z = 0: a parameter's name, or "0" for a true jump."""
        k = site.get(id(z), -1)
        return f"jump_width_{k}" if k in jumps else "0"

    first = names | {o: f"first_{o}" for o in plant.outputs}

    def text(expr: Expr) -> str:
        """Return an expression in Modelica."""
        return written(expr, NOTATION, names.__getitem__, width, first.__getitem__)

    lines = []
    for p in plant.parameters.values():
        ends = f"min={p.range[0]!r}, max={p.range[1]!r}" if p.range else ""
        lines.append(
            f"  parameter Real {names[p.name]}{_with(p.unit, ends)} = {numbers.parameters[p.name]!r};"
        )
    lines += [
        f'  parameter Real jump_width_{k} = {numbers.width[k]!r} "half width of the jump at {e.jumps[k][0]} = 0";'
        for k in jumps
    ]
    lines += [
        f'  parameter Real first_{o} = {numbers.first[o]!r} "first reading of {o}";'
        for o in first_outputs(plant)
    ]
    for i in plant.inputs.values():
        between = "straight lines" if i.linear else "held"
        lines.append(f'  input Real {names[i.name]}{_with(i.unit)} "{between} between samples";')
    lines += [f"  Real {names[n.name]}{_with(n.unit)};" for n in plant.nodes.values()]
    lines += [f"  Real {names[f'flow {f.name}']}{_with(f.unit)};" for f in plant.flows.values()]
    lines += [f"  output Real {names[f'output {o.name}']}{_with(o.unit)};" for o in plant.outputs.values()]
    start = [f"  {names[n.name]} = {text(n.initial)};" for n in plant.nodes.values()]
    equations = [f"  {names[f'flow {f.name}']} = {text(f.rate)};" for f in plant.flows.values()]
    for n in plant.nodes.values():
        net = net_flow(plant, n.name, names)
        equations.append(f"  ({text(n.storage)}) * der({names[n.name]}) = {net};")
    equations += [f"  {names[f'output {o.name}']} = {text(o.value)};" for o in plant.outputs.values()]
    body = "\n".join(equations)
    title = (plant.title or plant.file).replace('"', "'")
    return (
        f'model {model} "{title}"\n  // Written by `thermoctl plant export --to modelica` (thermoctl {__version__}).\n'
        + (_TABLE if "straightLines(" in body else "")
        + "\n".join(lines)
        + ("\ninitial equation\n" + "\n".join(start) if start else "")
        + f"\nequation\n{body}\nend {model};\n"
    )


def _with(unit: str | None, *more: str) -> str:
    items = ([f'unit="{unit}"'] if unit else []) + [m for m in more if m]
    return f"({', '.join(items)})" if items else ""
