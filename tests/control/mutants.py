"""Mutation of the protection: every small change of the source must break a scenario of protection.py.

    python -m tests.control.mutants [--page docs/proof/mutants.md] [--only NAME]

Mutated are arming.py and faults.py whole, of law.py the functions that judge, compare, protect and arm, and what the axes of a
rig have in common (tests/control/axes.py): a comparison takes
its neighbour (< <=, > >=, == !=) or is turned round, and / or change places, `not` goes, + - and * / change places, a number grows
by one, an assignment or a call goes, a condition is always true or never, |= becomes = and &=. A mutant that no scenario breaks is
listed; WHY says of each why it means the same, or the run fails. One that does not end within LIMIT_S of processor time is broken,
too: the tick would not return. Every processor takes its share, and a mutant meets first the scenarios that broke its neighbours:
the whole takes minutes. Our own mutator because law.py runs here as a module of its own
beside the compiled one, in one process: mutmut and cosmic-ray start pytest anew for each of the mutants.
"""

from __future__ import annotations

import argparse
import ast
import copy
import multiprocessing
import os
import signal
import sys
import time
import types
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from tests.control import axes, protection
from tests.control.test_protection import CONTROL, PROTECTION

LIMIT_S = 10.0  # all scenarios take about 2 s on the source as it is

SWAPS: dict[type, list[type]] = {
    ast.Lt: [ast.LtE, ast.Gt],
    ast.LtE: [ast.Lt, ast.Gt],
    ast.Gt: [ast.GtE, ast.Lt],
    ast.GtE: [ast.Gt, ast.Lt],
    ast.Eq: [ast.NotEq],
    ast.NotEq: [ast.Eq],
    ast.In: [ast.NotIn],
    ast.And: [ast.Or],
    ast.Or: [ast.And],
    ast.Add: [ast.Sub],
    ast.Sub: [ast.Add],
    ast.Mult: [ast.Div],
    ast.Div: [ast.Mult],
    ast.BitOr: [ast.BitAnd],
    ast.BitAnd: [ast.BitOr],
    ast.LShift: [ast.RShift],
    ast.RShift: [ast.LShift],
}

_FLAG = "a flag: only ever looked at as zero or not"
WHY: dict[str, str] = {
    "axes.py:__init__: `0` + 1 in `self.sample = Sample(0)`": "the sample's arrays are replaced in the next lines",
    "law.py:_agree: `if self.coil_fresh: self._compare_order()` condition True in `if self.coil_fresh:`": "means and estimates move over seconds: looked at in every tick the same is found, up to 0.1 s earlier, at a cost",
    "law.py:_agree: `self.last[_CURRENT] if current else 0.0` condition True in "
    "`amperes = self.last[_CURRENT] if current else 0.0`": "amperes is looked at only where `current` holds",
    "law.py:_judge_readings: `1.0 + _K_ERROR` Add -> Sub in `self.verdict[c] = 1.0 + _K_ERROR`": "_K_ERROR is 0",
    "law.py:_judge_readings: `1.0 + _K_ERROR` Add -> Sub in `self.verdict[c] = 1.0 + _K_ERROR` (2)": "_K_ERROR is 0",
    "law.py:_judge_readings: `1.0 + _K_ERROR` Add -> Sub in `self.verdict[c] = 1.0 + _K_ERROR` (3)": "_K_ERROR is 0",
    "law.py:_judge_readings: `self.age[c] > _RESISTANCE_LATE_S` Gt -> GtE in `if self.seen[c] == 0.0 or self.age[c] > _RESISTANCE_LATE_S:`": "an age is a sum of rounded ticks, which never is exactly the limit",
    "law.py:_judge_reading: `1.0` + 1 in `self.seen[c] = 1.0`": _FLAG,
    "law.py:_judge_readings: `1` + 1 in `self.hold = 1`": _FLAG,
    "law.py:_watch_amplifier: `1.0` + 1 in `self.driving = 1.0`": _FLAG,
    "law.py:_compare_order: `1.0` + 1 in `self.exchanged = 1.0`": _FLAG,
    "law.py:_agree: `1.0` + 1 in `self.reference_zeroed = 1.0 if self.state != _OFF else 0.0`": _FLAG,
    "law.py:_compare_position: `1.0` + 1 in `self.zeroed = 1.0 if self.state != _OFF else 0.0`": _FLAG,
    "law.py:_arm: `0 <= command < _COMMANDS` LtE -> Lt in `before, known = self.state, command if 0 <= command < _COMMANDS else _NONE`": "command 0 is _NONE itself",
    "law.py:_arm: `0` + 1 in `before, known = self.state, command if 0 <= command < _COMMANDS else _NONE`": "command 0 is _NONE itself",
    "law.py:_arm: `(((before * _COMMANDS + known) * 2 + started) * 2 + tripped)` Add -> Sub in "
    "`self.state = _NEXT[(((before * _COMMANDS + known) * 2 + started) * 2 + tripped) * 2 + crit`": "the place before, critical and not tripped: next_state asks for critical first, and has the same there",
    "law.py:_agree: `0.0` + 1 in `amperes = self.last[_CURRENT] if current else 0.0`": "amperes is looked at only where `current` holds",
}
"""'file:function: what' of a mutant that survives -> why it means the same."""


def changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """(what, replacement) for each small change of this one node."""

    def changed(field: str, value: object) -> ast.AST:
        other = copy.deepcopy(node)
        setattr(other, field, value)
        return other

    if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp):
        for new in SWAPS.get(type(node.op), []):
            yield f"{type(node.op).__name__} -> {new.__name__}", changed("op", new())
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for new in SWAPS.get(type(op), []):
                yield (
                    f"{type(op).__name__} -> {new.__name__}",
                    changed("ops", [*node.ops[:k], new(), *node.ops[k + 1 :]]),
                )
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield f"{type(node.op).__name__} gone", node.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield "+ 1", changed("value", node.value + 1)
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        for value in (True, False):
            if not (isinstance(node, ast.While) and value):  # would not end
                yield f"condition {value}", changed("test", ast.Constant(value))
    if isinstance(node, ast.AugAssign):
        yield "set, not added", ast.Assign([node.target], node.value)
    if (
        isinstance(node, ast.Assign | ast.AugAssign)
        or isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Call)
    ):
        yield "gone", ast.Pass()


def mutants(path: Path, functions: tuple[str, ...] | None) -> Iterator[tuple[str, ast.Module]]:
    """(name, tree) of every mutant of a file; of some functions and loops only, or of the whole module but its texts. A loop is
    named by its line, as `for k in range(n):`. Lines that are the same have their number behind the name. The tree is the same object every time, changed in one place until the next one
    is asked for."""
    source, seen = path.read_text(), dict[str, int]()
    lines, tree = source.splitlines(), ast.parse(source)
    owners = [(f.lineno, f.end_lineno or 0, f.name) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef)]
    loops = [
        (f.lineno, f.end_lineno or 0, lines[f.lineno - 1].strip())
        for f in ast.walk(tree)
        if isinstance(f, ast.For)
    ]
    places = [
        (parent, field, k, node)
        for parent in ast.walk(tree)
        for field, value in ast.iter_fields(parent)
        for k, node in enumerate(value if isinstance(value, list) else [value])
        if isinstance(node, ast.AST)
    ]
    for parent, field, k, node in places:
        line = getattr(node, "lineno", 0)
        owner = next((name for first, last, name in owners if first <= line <= last), "module")
        within = {owner, *(name for first, last, name in loops if first <= line <= last)}
        if not line or functions is not None and within.isdisjoint(functions):
            continue
        segment = " ".join((ast.get_source_segment(source, node) or "").split())
        context = " ".join(lines[line - 1].split())
        for what, new in changes(node):
            name = f"{path.name}:{owner}: `{segment[:60]}` {what} in `{context[:90]}`"
            seen[name] = seen.get(name, 0) + 1
            replaced = ast.fix_missing_locations(ast.copy_location(new, node))
            _put(parent, field, k, replaced)
            yield name + f" ({seen[name]})" * (seen[name] > 1), tree
            _put(parent, field, k, node)


def _put(parent: ast.AST, field: str, k: int, node: ast.AST) -> None:
    value = getattr(parent, field)
    if isinstance(value, list):
        value[k] = node
    else:
        setattr(parent, field, node)


def build(trees: dict[str, ast.Module]) -> types.ModuleType:
    """law.py as a module of its own, with `arming` and `faults` of its own; `trees` replaces the source of some of them."""
    import thermoctl.control as package

    kept = {n: sys.modules.get(f"thermoctl.control.{n}") for n in ("arming", "faults")}
    made = {}
    try:
        for name in ("faults", "arming", "law"):
            tree = trees.get(name) or ast.parse((CONTROL / f"{name}.py").read_text())
            module = types.ModuleType(f"mutant_{name}")
            module.__file__ = str(CONTROL / f"{name}.py")
            sys.modules[module.__name__] = module  # dataclass looks it up
            exec(compile(tree, module.__file__, "exec"), vars(module))
            made[name] = module
            if name != "law":
                sys.modules[f"thermoctl.control.{name}"] = module
                setattr(package, name, module)
    finally:
        for name, module in kept.items():
            if module is not None:
                sys.modules[f"thermoctl.control.{name}"] = module
                setattr(package, name, module)
    made["law"].WARM_UP_TICKS = made["law"]._WARM_UP = 6  # interpreted ticks are slow
    made["law"]._AIR_READINGS = 6.0
    made["law"].arming, made["law"].faults = made["arming"], made["faults"]
    return made["law"]


def survives(make: Callable[[], Any], order: list) -> bool:
    """Whether every scenario holds. The scenario that breaks comes first the next time: neighbours often break the same."""
    try:
        module = make()
    except Exception:
        return False
    for k, scenario in enumerate(order):
        try:
            scenario(module)
        except Exception:
            order.insert(0, order.pop(k))
            return False
    return True


TARGETS = (
    (CONTROL / "arming.py", None, build, protection.SCENARIOS),
    (CONTROL / "faults.py", None, build, protection.SCENARIOS),
    (CONTROL / "law.py", PROTECTION, build, protection.SCENARIOS),
    *((path, functions, axes.build, axes.SCENARIOS) for path, functions in axes.MUTATED),
)
"""Files, their functions (None: all), how a law or the code of axes is made of them, and what must break."""


class Endless(BaseException):
    """No scenario may take it for a failure of its own."""


def _endless(*_: object) -> None:
    raise Endless


def share(which: int, of: int, only: str) -> tuple[int, list[str]]:
    """(mutants tried, those that survive) of every of-th mutant, beginning with number `which`."""
    warnings.simplefilter("ignore")  # numbers that are not finite are meant
    signal.signal(signal.SIGPROF, _endless)
    number, tried, left = 0, 0, []
    orders = {id(s): list(s) for s in (protection.SCENARIOS, axes.SCENARIOS)}
    for path, functions, make, scenarios in TARGETS:
        for what, tree in mutants(path, functions):
            number += 1
            if only not in what or number % of != which:
                continue
            tried += 1
            try:
                signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
                found = survives(partial(make, {path.stem: tree}), orders[id(scenarios)])
            except Endless:
                found = False
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
            if found:
                left.append(what)
                print("survives:", what, flush=True)
    return tried, left


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page")
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    begun, count = time.perf_counter(), os.cpu_count() or 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for make, scenarios in ((build, protection.SCENARIOS), (axes.build, axes.SCENARIOS)):
            assert survives(partial(make, {}), list(scenarios)), "a scenario fails on the source as it is"
    with multiprocessing.get_context("fork").Pool(count) as pool:
        found = pool.starmap(share, [(which, count, args.only) for which in range(count)], chunksize=1)
    total, left = sum(tried for tried, _ in found), sorted(m for _, survivors in found for m in survivors)
    unexplained = [m for m in left if m not in WHY]
    text = (
        f"{total} mutants of the protection (arming.py, faults.py, {', '.join(PROTECTION)} of law.py) and of what axes have in "
        f"common ({', '.join(p.name for p, _ in axes.MUTATED)}), {total - len(left)} broken by "
        f"{len(protection.SCENARIOS)} and {len(axes.SCENARIOS)} scenarios, {len(left)} survive, {len(unexplained)} of them unexplained.\n"
    )
    print(f"{text}{time.perf_counter() - begun:.0f} s on {count} processors")
    if args.page:
        rows = "".join(f"| {m.replace('|', chr(92) + '|')} | {WHY.get(m, 'not explained')} |\n" for m in left)
        Path(args.page).write_text(
            "<!-- Written by `make mutants`. -->\n# Mutants\n\nEvery small change of the source that protects must "
            f"break a test (tests/control/mutants.py says which changes).\n\n{text}\n| survivor | why |\n"
            f"| --- | --- |\n{rows}"
        )
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
