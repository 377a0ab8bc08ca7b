"""Expressions of the plant language in the notation of another language."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from thermoctl.files.yamlfile import InputError
from thermoctl.plant.expression import Expr, num
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.equations import argument


@dataclass(frozen=True)
class Notation:
    """How a language writes an expression.

    - `functions`: format of a function, by the plant language's name, such as "np.abs({0})"
    - `jump`: writes a jump (operation, argument, half width; "0": a true jump)
    - `table`: writes a table of its argument and its points
    - `delay`: format of delay({0}, {1}), None where the language has none"""

    power: str
    functions: Mapping[str, str]
    jump: Callable[[str, str, str], str]
    equal: Mapping[str, str]
    table: Callable[[str, list[str], list[str]], str]
    delay: str | None = None


_JUMPS = ("step", "sign", ">", ">=", "<", "<=")
_LEVEL = {"+": 1, "*": 2, "/": 2, "neg": 1}


def written(
    e: Expr,
    notation: Notation,
    name: Callable[[str], str],
    width: Callable[[Expr], str] = lambda jump: "0",
    first: Callable[[str], str] = str,
) -> str:
    """Return an expression as text; `name` and `first` give the text of a name and of first(NAME).

    `width(argument)` is the text of a jump's half width.
    Raises InputError for a delay that the language lacks."""

    def text(e: Expr, outer: int) -> str:
        """Return `e` as text, in brackets where `outer`, the level of the operator around it, needs them."""
        if e.op == "num":
            number = repr(e.value).removesuffix(".0")
            return f"({number})" if e.value < 0 else number
        if e.op == "name":
            return name(str(e.value))
        if e.op == "first":
            return first(str(e.value))
        a = e.args
        if e.op == "table":
            points = [text(q, 0) for q in a[1:]]
            return notation.table(text(a[0], 0), points[: e.value], points[e.value :])
        if e.op in _JUMPS:
            return notation.jump(e.op, f"({text(argument(e), 0)})", width(argument(e)))
        if e.op in notation.equal:
            return notation.equal[e.op].format(text(a[0], 3), text(a[1], 3))
        if e.op == "delay":
            if notation.delay is None:
                raise InputError("delay() cannot be written in this language; `--to fmu`, python or c can")
            return notation.delay.format(text(a[0], 0), text(a[1], 0))
        if e.op == "**":
            return notation.power.format(text(a[0], 3), text(a[1], 3))
        if e.op in _LEVEL:
            level = _LEVEL[e.op]
            if e.op == "neg":
                out = f"-{text(a[0], 2)}"
            elif e.op == "+" and a[1].op == "neg":
                out = f"{text(a[0], 1)} - {text(a[1].args[0], 2)}"
            elif e.op == "+" and a[1].op == "num" and a[1].value < 0:
                out = f"{text(a[0], 1)} - {text(num(-a[1].value), 2)}"
            else:
                out = f"{text(a[0], level)} {e.op} {text(a[1], level + (e.op != '+'))}"
            return f"({out})" if outer > level or (outer == level and e.op == "neg") else out
        return notation.functions[e.op].format(*(text(q, 0) for q in a))

    return text(e, 0)


def net_flow(plant: Plant, node: str, names: Mapping[str, str]) -> str:
    """Return the sum of the flows into a node less those from it; `names`: those of `unique`."""
    parts = [f"+ {names[f'flow {f.name}']}" for f in plant.flows.values() if f.target == node]
    parts += [f"- {names[f'flow {f.name}']}" for f in plant.flows.values() if f.source == node]
    return " ".join(parts).removeprefix("+ ")


def unique(plant: Plant, reserved: Collection[str], flow: str = "flow_{}") -> dict[str, str]:
    """Return a name of each quantity and flow that no keyword and no other name is.

    Flows have keys "flow NAME", outputs "output NAME": they may be called as another quantity."""
    taken, found = set(reserved), {}

    def take(key: str, wanted: str) -> None:
        """Keep a name for `key`: the wanted one, with `_` added until it is free."""
        while wanted in taken:
            wanted += "_"
        taken.add(wanted)
        found[key] = wanted

    for name in (*plant.inputs, *plant.parameters, *plant.nodes):
        take(name, name)
    for name in plant.outputs:
        take(f"output {name}", name)
    for name in plant.flows:
        take(f"flow {name}", name if name not in taken else flow.format(name))
    return found
