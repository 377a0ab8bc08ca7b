"""Expressions of the plant language.

Read without eval, differentiated exactly, evaluated with numpy or written as C.

An expression is a graph of interned nodes: equal sub-expressions are one object. So derivatives share their
parts, and the generated C computes each part once.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from thermoctl.plant.native.fmu import opened

_NAMES = "abs sign sqrt exp log sin cos tanh min max step"
FUNCTIONS = {f: 2 if f in ("min", "max") else 1 for f in _NAMES.split()}  # number of arguments by name
SPECIAL = ("table", "delay", "first", "fmu")
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
MAX_LENGTH, MAX_DEPTH, MAX_TOKENS = 20_000, 80, 5_000
MAX_LEVELS = 250  # deepest tree: levels of brackets, and of terms and factors in a row
ALLOWED = (
    "+ - * / **, comparisons, numbers, pi, t, the names of the file, and "
    + " ".join(FUNCTIONS)
    + " table delay first fmu"
)

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r'|(?P<text>"[^"]*")'
    r"|(?P<op>\*\*|<=|>=|==|!=|[-+*/()<>,\[\]]))"
)


class ExpressionError(ValueError):
    """An error in an expression, in words; the caller adds file and line."""


@dataclass(frozen=True, eq=False, slots=True)
class Expr:
    """One node of an expression. `op` is one of:

    - 'num' and 'name', with `value`; '+', '*', '/', '**', 'neg'; a comparison; a function's name;
    - 'table': args are x, the x points and the y points; value is the number of points;
    - 'delay': args are an expression and seconds; 'first': value is a name;
    - 'fmu': args are time and the values given; value is the file, its result, and the names of the values
    - only in derivatives: 'fmu_slope', an 'fmu' whose value ends in the name that it is differentiated by
    - only in derivatives: 'dpow' (a**(b-1), 0 where a <= 0), 'table_slope', 'bump' (slope of a smoothed
      step);
    - only in derivatives: 'side' (1 or -1) and 'le' (1 where a <= b, never smoothed)."""

    op: str
    args: tuple[Expr, ...] = ()
    value: Any = None

    def __str__(self) -> str:
        return _text(self, 0)

    def __reduce__(self) -> tuple[Any, ...]:  # in another process, too, an expression is one object
        return _remade, (self.op, self.args, self.value)


_INTERNED: dict[tuple[str, tuple[int, ...], Any], Expr] = {}


def make(op: str, *args: Expr, value: Any = None) -> Expr:
    """Return the one node of this operation and these arguments."""
    key = (op, tuple(map(id, args)), value)
    node = _INTERNED.get(key)
    if node is None:
        if len(_INTERNED) > 2_000_000:  # only a process that reads very many plants gets here
            _INTERNED.clear()
            _INTERNED.update({("num", (), 0.0): ZERO, ("num", (), 1.0): ONE})
        node = _INTERNED[key] = Expr(op, args, value)
    return node


def _remade(op: str, args: tuple[Expr, ...], value: Any) -> Expr:
    return make(op, *args, value=value)


def num(value: float) -> Expr:
    """Return the expression of a constant."""
    return make("num", value=float(value))


def name(value: str) -> Expr:
    """Return the expression of a parameter, input, node or `t`."""
    return make("name", value=value)


ZERO, ONE = num(0.0), num(1.0)


def add(a: Expr, b: Expr) -> Expr:
    """Return a + b, simplified."""
    if a is ZERO:
        return b
    if b is ZERO:
        return a
    if a.op == b.op == "num":
        return num(a.value + b.value)
    return make("+", a, b)


def neg(a: Expr) -> Expr:
    """Return -a, simplified."""
    if a.op == "num":
        return num(-a.value)
    return a.args[0] if a.op == "neg" else make("neg", a)


def mul(a: Expr, b: Expr) -> Expr:
    """Return a * b, simplified."""
    if a is ZERO or b is ZERO:
        return ZERO
    if a is ONE:
        return b
    if b is ONE:
        return a
    if a.op == b.op == "num":
        return num(a.value * b.value)
    return make("*", a, b)


def div(a: Expr, b: Expr) -> Expr:
    """Return a / b, simplified."""
    if a is ZERO and not (b.op == "num" and b.value == 0):
        return ZERO
    if b is ONE:
        return a
    if a.op == b.op == "num" and b.value != 0:
        return num(a.value / b.value)
    return make("/", a, b)


def _product(op: str, a: Expr, b: Expr, by_one: bool) -> Expr:
    """Return a * b or a / b. `by_one`: one is written as a factor; it stays, as it may have a unit."""
    if by_one and not a.op == b.op == "num":
        return make(op, a, b)
    return mul(a, b) if op == "*" else div(a, b)


def power(a: Expr, b: Expr) -> Expr:
    """Return a ** b, simplified."""
    if b is ONE:
        return a
    if b is ZERO:
        return ONE
    if a.op == b.op == "num":
        try:
            value = a.value**b.value
            if isinstance(value, float) and math.isfinite(value):
                return num(value)
        except (OverflowError, ZeroDivisionError):
            pass
    return make("**", a, b)


# --------------------------------------------------------------------------------------------------- reading


def parse(text: str | int | float) -> Expr:
    """Read an expression. Raises ExpressionError with the faulty text and the allowed alternatives."""
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise ExpressionError(f"an expression was expected, not {text!r}")
    if not isinstance(text, str):
        if not abs(text) <= sys.float_info.max:
            raise ExpressionError(f"the number {str(text)[:12]} is too large or not a number")
        return num(text)
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"an expression of {len(text)} characters; at most {MAX_LENGTH} are read")
    tokens: list[tuple[str, str]] = []
    position = 0
    text = text.rstrip()
    while position < len(text):
        match = _TOKEN.match(text, position)
        if not match:
            power = "; a power is written **" if text[position:].lstrip().startswith("^") else ""
            raise ExpressionError(
                f"'{text[position : position + 12].strip()}' is not part of the language{power}; allowed are {ALLOWED}"
            )
        tokens.append((match.lastgroup or "", match.group(match.lastgroup or 0)))
        position = match.end()
    if len(tokens) > MAX_TOKENS:
        raise ExpressionError(f"an expression of {len(tokens)} words; at most {MAX_TOKENS} are read")
    if not tokens:
        raise ExpressionError("an expression was expected, but the text is empty")
    reader = _Reader(tokens)
    result = reader.comparison()
    if reader.at < len(tokens):
        raise ExpressionError(f"'{tokens[reader.at][1]}' was not expected here; an operator or the end was")
    level = [result]
    for _ in range(MAX_LEVELS):
        level = [a for e in level for a in e.args]
        if not level:
            if any(e.op == "num" and not math.isfinite(e.value) for e in walk(result)):
                raise ExpressionError("a sum or product of numbers in it is too large")
            return result
    raise ExpressionError(f"more than {MAX_LEVELS} terms or factors in a row: put some of them in brackets")


class _Reader:
    """Recursive descent with Python's precedences."""

    def __init__(self, tokens: list[tuple[str, str]]):
        self.tokens, self.at, self.depth = tokens, 0, 0

    def peek(self) -> str:
        """Return the next token's text without consuming it, '' at the end."""
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

    def take(self, text: str) -> bool:
        """Consume the operator `text` if it is next; return whether it was."""
        if self.at < len(self.tokens) and self.tokens[self.at] == ("op", text):
            self.at += 1
            return True
        return False

    def need(self, text: str) -> None:
        """Consume the operator `text`. Raises ExpressionError if it is not next."""
        if not self.take(text):
            raise ExpressionError(
                f"'{text}' was expected" + (f" before '{self.peek()}'" if self.peek() else " at the end")
            )

    def comparison(self) -> Expr:
        """Read a sum, or two sums and a comparison between them. Raises ExpressionError."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels")
        left = self.sum()
        if self.peek() in COMPARISONS:
            op = self.peek()
            self.at += 1
            left = make(op, left, self.sum())
            if self.peek() in COMPARISONS:
                raise ExpressionError(
                    "chained comparisons are not part of the language; use a product of two"
                )
        self.depth -= 1
        return left

    def sum(self) -> Expr:
        """Read products with + and - between them, from left to right."""
        left = self.product()
        while self.peek() in ("+", "-"):
            op = self.peek()
            self.at += 1
            right = self.product()
            left = add(left, right if op == "+" else neg(right))
        return left

    def product(self) -> Expr:
        """Read factors with * and / between them, from left to right."""
        left = self.unary()
        while self.peek() in ("*", "/"):
            op = self.peek()
            self.at += 1
            right = self.unary()
            left = _product(op, left, right, ONE in (left, right))
        return left

    def unary(self) -> Expr:
        """Read an operand with its signs and its power: -a**b is -(a**b). Raises ExpressionError."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels")
        try:
            if self.take("-"):
                return neg(self.unary())
            if self.take("+"):
                return self.unary()
            base = self.atom()
            return power(base, self.unary()) if self.take("**") else base
        finally:
            self.depth -= 1

    def atom(self) -> Expr:
        """Read a number, a name, a call or an expression in brackets. Raises ExpressionError."""
        if self.at >= len(self.tokens):
            raise ExpressionError("the expression ends where a number, a name or '(' was expected")
        kind, text = self.tokens[self.at]
        self.at += 1
        if kind == "number":
            value = float(text)
            if not math.isfinite(value):
                raise ExpressionError(f"the number {text} is too large")
            return num(value)
        if kind == "name":
            if self.peek() == "(":
                return self.call(text)
            return num(math.pi) if text == "pi" else name(text)
        if text == "(":
            inner = self.comparison()
            self.need(")")
            return inner
        raise ExpressionError(f"'{text}' was not expected here; a number, a name or '(' was")

    def call(self, function: str) -> Expr:
        """Read the arguments of `function`, from the bracket on. Raises ExpressionError."""
        if function not in FUNCTIONS and function not in SPECIAL:
            raise ExpressionError(
                f"'{function}' is not a function of the language; allowed are "
                + ", ".join((*FUNCTIONS, *SPECIAL))
            )
        self.need("(")
        if function == "first":
            kind, text = self.tokens[self.at] if self.at < len(self.tokens) else ("", "")
            if kind != "name":
                raise ExpressionError("first() takes the name of an input or an output")
            self.at += 1
            self.need(")")
            return make("first", value=text)
        if function == "fmu":
            return self.fmu()
        args = [self.comparison()]
        if function == "table":
            self.need(",")
            xs = self.list()
            self.need(",")
            ys = self.list()
            self.need(")")
            if len(xs) != len(ys) or len(xs) < 2:
                raise ExpressionError(
                    f"table() has {len(xs)} x points and {len(ys)} y points; two or more of each, "
                    "alike in number, were expected"
                )
            numbers = [x.value for x in xs if x.op == "num"]
            if any(b <= a for a, b in zip(numbers, numbers[1:], strict=False)):
                raise ExpressionError("the x points of table() must increase")
            return make("table", args[0], *xs, *ys, value=len(xs))
        while self.take(","):
            args.append(self.comparison())
        self.need(")")
        if function == "delay":
            if len(args) != 2:
                raise ExpressionError("delay() takes an expression and seconds")
            return make("delay", *args)
        if function in ("min", "max"):
            if len(args) < 2:
                raise ExpressionError(f"{function}() takes two or more arguments")
            result = args[0]
            for other in args[1:]:
                result = make(function, result, other)
            return result
        if len(args) != 1:
            raise ExpressionError(f"{function}() takes one argument, not {len(args)}")
        return make(function, args[0])

    def fmu(self) -> Expr:
        """Read the arguments of fmu(): file, result, and pairs of variable and value."""
        path = self.text("the file of an FMU")
        self.need(",")
        result = self.text("a derivative or an output of the FMU")
        given: dict[str, Expr] = {}
        while self.take(","):
            variable = self.text("a variable of the FMU")
            self.need(",")
            given[variable] = self.comparison()
        self.need(")")
        return make("fmu", name("t"), *given.values(), value=(path, result, tuple(given)))

    def text(self, what: str) -> str:
        """Read a text in quotes. Raises ExpressionError, in which `what` is the text expected."""
        kind, text = self.tokens[self.at] if self.at < len(self.tokens) else ("", "")
        if kind != "text":
            raise ExpressionError(f'fmu(): {what} was expected in "quotes"')
        self.at += 1
        return text[1:-1]

    def list(self) -> list[Expr]:
        """Read one or more expressions in square brackets."""
        self.need("[")
        items = [self.comparison()]
        while self.take(","):
            items.append(self.comparison())
        self.need("]")
        return items


# --------------------------------------------------------------------------------------------------- looking


@lru_cache(maxsize=20_000)
def walk(expr: Expr) -> tuple[Expr, ...]:
    """Yield every distinct node, arguments before their users."""
    seen: set[int] = set()
    stack, out = [(expr, False)], []
    while stack:
        node, done = stack.pop()
        if done:
            out.append(node)
        elif id(node) not in seen:
            seen.add(id(node))
            stack.append((node, True))
            stack.extend((a, False) for a in reversed(node.args))
    return tuple(out)


@lru_cache(maxsize=100_000)
def names(expr: Expr) -> frozenset[str]:
    """Return the names an expression reads (those inside first() are not among them)."""
    return frozenset(n.value for n in walk(expr) if n.op == "name")


def calls_fmu(expr: Expr) -> bool:
    """Return whether an FMU computes a part of the expression."""
    return any(n.op == "fmu" for n in walk(expr))


def substitute(expr: Expr, change: Callable[[Expr], Expr | None]) -> Expr:
    """Return a copy where `change(node)` replaces each node for which it is not None (bottom up)."""
    done: dict[int, Expr] = {}
    for node in walk(expr):
        rebuilt = node
        if node.args:
            args = tuple(done[id(a)] for a in node.args)
            if any(a is not b for a, b in zip(args, node.args, strict=True)):
                rebuilt = _rebuild(node, args)
        done[id(node)] = change(rebuilt) or rebuilt
    return done[id(expr)]


def fill(expr: Expr, symbols: Mapping[str, Expr]) -> Expr:
    """Return a copy with each name that is a key of `symbols` replaced by its expression."""
    return substitute(expr, lambda e: symbols.get(e.value) if e.op == "name" else None)


def undelayed(expr: Expr) -> Expr:
    """Return a copy with each delayed signal replaced by the signal itself."""
    return substitute(expr, lambda e: e.args[0] if e.op == "delay" else None)


def _rebuild(node: Expr, args: tuple[Expr, ...]) -> Expr:
    if node.op in ("*", "/"):
        return _product(node.op, args[0], args[1], ONE in node.args)
    simple = {"+": add, "**": power}
    if node.op in simple:
        return simple[node.op](*args)
    return neg(args[0]) if node.op == "neg" else make(node.op, *args, value=node.value)


_PRECEDENCE = {**dict.fromkeys(COMPARISONS, 1), "+": 2, "*": 3, "/": 3, "neg": 4, "**": 5}


def _text(e: Expr, outer: int) -> str:
    if e.op == "num":
        text = repr(e.value)
        text = text[:-2] if text.endswith(".0") else text
        return f"({text})" if e.value < 0 and outer > 2 else text
    if e.op == "name":
        return str(e.value)
    if e.op == "first":
        return f"first({e.value})"
    if e.op == "table":
        k = e.value
        return (
            f"table({_text(e.args[0], 0)}, [{', '.join(_text(a, 0) for a in e.args[1 : k + 1])}], "
            f"[{', '.join(_text(a, 0) for a in e.args[k + 1 :])}])"
        )
    if e.op == "fmu":
        path, result, given = e.value
        pairs = [f'"{n}", {_text(a, 0)}' for n, a in zip(given, e.args[1:], strict=True)]
        return f'fmu("{path}", "{result}"' + "".join(f", {pair}" for pair in pairs) + ")"
    p = _PRECEDENCE.get(e.op)
    if p is None:
        return f"{e.op}({', '.join(_text(a, 0) for a in e.args)})"
    if e.op == "neg":
        text = "-" + _text(e.args[0], p)
    elif e.op == "+" and e.args[1].op == "neg":
        text = f"{_text(e.args[0], p)} - {_text(e.args[1].args[0], p + 1)}"
    elif e.op == "+" and e.args[1].op == "num" and e.args[1].value < 0:
        text = f"{_text(e.args[0], p)} - {_text(num(-e.args[1].value), p + 1)}"
    elif e.op == "**":
        text = f"{_text(e.args[0], p + 1)}**{_text(e.args[1], p)}"
    else:
        left = p + 1 if e.op in COMPARISONS else p  # a comparison inside a comparison needs brackets
        text = f"{_text(e.args[0], left)} {e.op} {_text(e.args[1], p + 1)}"
    return f"({text})" if p < outer else text


# ----------------------------------------------------------------------------------------------- derivatives


@lru_cache(maxsize=50_000)
def derivative(expr: Expr, by: str) -> Expr:
    """Return d expr / d name, exact.

    At kinks (abs, min, max, table) it is one-sided; a jump has the slope of its smooth form."""
    done: dict[int, Expr] = {}
    for node in walk(expr):
        done[id(node)] = _derive(node, by, done)
    return done[id(expr)]


def _derive(e: Expr, by: str, done: Mapping[int, Expr]) -> Expr:
    if e.op == "name":
        return ONE if e.value == by else ZERO
    d = [done[id(a)] for a in e.args]
    if not d or all(x is ZERO for x in d):
        return ZERO
    a = e.args
    match e.op:
        case "+":
            return add(d[0], d[1])
        case "neg":
            return neg(d[0])
        case "*":
            return add(mul(d[0], a[1]), mul(a[0], d[1]))
        case "/":
            return add(div(d[0], a[1]), neg(div(mul(e, d[1]), a[1])))
        case "**":
            first = mul(
                mul(a[1], power(a[0], add(a[1], num(-1.0))) if _whole(a[1]) else make("dpow", a[0], a[1])),
                d[0],
            )
            return (
                first
                if d[1] is ZERO
                else add(first, mul(mul(e, make("log", make("max", a[0], num(1e-300)))), d[1]))
            )
        case "abs":
            return mul(make("side", a[0]), d[0])
        case "sqrt":
            return mul(mul(num(0.5), make("dpow", a[0], num(0.5))), d[0])
        case "exp":
            return mul(e, d[0])
        case "log":
            return div(d[0], a[0])
        case "sin":
            return mul(make("cos", a[0]), d[0])
        case "cos":
            return neg(mul(make("sin", a[0]), d[0]))
        case "tanh":
            return mul(add(ONE, neg(mul(e, e))), d[0])
        case "min" | "max":
            use = make("le", *(a if e.op == "min" else a[::-1]))  # 1 if the first argument is the result
            return add(mul(use, d[0]), mul(add(ONE, neg(use)), d[1]))
        case "sign":
            return mul(mul(num(2.0), make("bump", a[0])), d[0])
        case "step":
            return mul(make("bump", a[0]), d[0])
        case ">" | ">=":
            return mul(make("bump", add(a[0], neg(a[1]))), add(d[0], neg(d[1])))
        case "<" | "<=":
            return mul(make("bump", add(a[1], neg(a[0]))), add(d[1], neg(d[0])))
        case "==" | "!=" | "le" | "side" | "bump" | "dpow":
            return ZERO
        case "fmu":  # time is not among the unknowns
            total = ZERO
            for n, change in zip(e.value[2], d[1:], strict=True):
                if change is not ZERO:
                    total = add(total, mul(make("fmu_slope", *a, value=(*e.value, n)), change))
            return total
        case "table":
            k = e.value
            total = mul(make("table_slope", *a, value=k), d[0])
            for j in range(k):  # weight of the point j at x: the table of a unit vector
                if d[1 + k + j] is not ZERO:
                    unit = [ONE if i == j else ZERO for i in range(k)]
                    total = add(total, mul(make("table", a[0], *a[1 : k + 1], *unit, value=k), d[1 + k + j]))
            return total
    raise ExpressionError(f"'{e.op}' cannot be differentiated by {by} here")


def _whole(e: Expr) -> bool:
    return e.op == "num" and e.value == int(e.value) and e.value >= 1


# ------------------------------------------------------------------------------------- evaluating with numpy


def evaluate(
    expr: Expr,
    values: Mapping[str, Any],
    first: Callable[[str], float] | None = None,
    width: Callable[[Expr], float] | None = None,
) -> Any:
    """Return the value with numpy.

    `values`: name to number or array; `first(name)` serves first(); `width(argument)` is the half width over
    which a jump is smoothed (0: a true jump)."""
    if not expr.args:  # most starts and many rates are one name or number
        return _value(expr, [], values, first, width)
    done: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for e in walk(expr):
            done[id(e)] = _value(e, [done[id(a)] for a in e.args], values, first, width)
    return done[id(expr)]


def series(expr: Expr, values: Mapping[str, Any], t: np.ndarray) -> np.ndarray:
    """Return the values (N,) of an expression at the times t (N,), also of one that is constant."""
    return np.broadcast_to(np.asarray(evaluate(expr, values), float), t.shape)


_NUMPY: dict[str, Callable[..., Any]] = {
    "+": np.add,
    "*": np.multiply,
    "/": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
    "min": np.minimum,
    "max": np.maximum,
}


def _value(
    e: Expr,
    a: list[Any],
    values: Mapping[str, Any],
    first: Callable[[str], float] | None,
    width: Callable[[Expr], float] | None,
) -> Any:
    op = e.op
    if op == "num":
        return e.value
    if op == "name":
        return values[e.value]
    if op == "first":
        if first is None:
            raise ExpressionError("first() may stand in 'initial' only")
        return first(e.value)
    if op in _NUMPY:
        return _NUMPY[op](*a)
    if op == "**":
        return np.power(np.asarray(a[0], float), a[1])
    if op in ("step", "sign", ">", ">=", "<", "<=", "bump"):
        z = a[0] if op in ("step", "sign", "bump") else (a[0] - a[1] if op in (">", ">=") else a[1] - a[0])
        w = width(e) if width else 0.0
        if op == "bump":
            return (0.5 / w) * (1 - np.tanh(z / w) ** 2) if w else np.zeros_like(z)
        if w:
            smooth = np.tanh(z / w)
            return smooth if op == "sign" else 0.5 * (1 + smooth)
        if op == "sign":
            return np.sign(z)
        return np.where(z > 0 if op in (">", "<") else z >= 0, 1.0, 0.0)
    if op in ("==", "!="):
        return np.where((a[0] == a[1]) == (op == "=="), 1.0, 0.0)
    if op == "le":
        return np.where(np.less_equal(a[0], a[1]), 1.0, 0.0)
    if op == "side":
        return np.where(np.asarray(a[0]) >= 0, 1.0, -1.0)
    if op == "dpow":
        base = np.maximum(a[0], 1e-8)
        return np.where(np.asarray(a[0]) > 0, np.power(base, a[1] - 1.0), 0.0)
    if op in ("fmu", "fmu_slope"):
        path, result, given, *by = e.value
        return opened(path).evaluate(result, given, a, *by)
    if op in ("table", "table_slope"):
        k = e.value
        x = np.asarray(a[0], float)
        xs, ys = np.array(a[1 : k + 1], float), np.array(a[k + 1 :], float)
        if op == "table":
            return np.interp(x, xs, ys)
        slopes = np.concatenate([[0.0], np.diff(ys) / np.diff(xs), [0.0]])
        return slopes[np.searchsorted(xs, x, side="right")]
    if op == "delay" and np.ndim(values.get("t", 0.0)):  # interpolate linearly between samples at values["t"]
        t = np.asarray(values["t"], float)
        return np.interp(t - a[1], t, np.broadcast_to(a[0], t.shape))
    raise ExpressionError(f"'{op}' cannot stand here")
