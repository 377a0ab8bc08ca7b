"""The import graph of thermoctl and thermoctl_hal, read from the source: `python -m tests.architecture` prints it.

Every import counts: at the top of a module, inside a function, under TYPE_CHECKING, and `cimport` in Cython sources.
So does a function that a row of a table of commands names as text, "module:function".
"""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/explanation/architecture.md"
_CYTHON = re.compile(r"^\s*(?:from\s+(thermoctl[\w.]*)\s+c?import\s+(.+)|c?import\s+(thermoctl[\w.]*))")
_FUNCTION = re.compile(r"(thermoctl(?:_hal)?\.[\w.]+):\w+$")

Graph = dict[str, set[str]]


def modules() -> dict[str, Path]:
    """Every module of the product by its dotted name; a package is its `__init__`."""
    found = {}
    for folder, top in ((ROOT, "thermoctl"), (ROOT / "hal", "thermoctl_hal")):
        for path in sorted((folder / top).rglob("*.py*")):
            if path.suffix in (".py", ".pyx", ".pxd"):
                parts = path.relative_to(folder).with_suffix("").parts
                found.setdefault(".".join(parts[:-1] if parts[-1] == "__init__" else parts), path)
    return found


def _named(path: Path) -> Iterator[tuple[str, list[str]]]:
    """(module, names taken from it) of each import of ours in a source file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        for line in text.splitlines():
            if match := _CYTHON.match(line):
                yield match[1] or match[3], re.findall(r"\w+", match[2] or "")
        return
    for node in ast.walk(ast.parse(text, str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, [alias.name for alias in node.names]
        elif isinstance(node, ast.Constant) and (match := _FUNCTION.match(str(node.value))):
            yield match[1], []


def module_graph() -> Graph:
    """Which module imports which, without the modules of other projects."""
    known = modules()
    graph: Graph = {name: set() for name in known}
    for name, path in known.items():
        for source in {path, path.with_suffix(".pxd")}:
            for module, names in _named(source) if source.exists() else ():
                if module in known:
                    below = {f"{module}.{n}" for n in names if f"{module}.{n}" in known}
                    graph[name] |= below if len(below) == len(names) and names else below | {module}
        graph[name].discard(name)
    return graph


def package(module: str) -> str:
    """The package or loose module of the product that a module belongs to: `plant`, `yamlfile`, `hal.can`."""
    parts = module.split(".")
    if parts[0] == "thermoctl_hal":
        return ".".join(["hal", *parts[1:2]])
    return parts[1] if len(parts) > 1 else "thermoctl"


def package_graph(graph: Mapping[str, set[str]]) -> dict[tuple[str, str], list[tuple[str, str]]]:
    """The arrows between packages, each with the imports that make it."""
    arrows = defaultdict(list)
    for name, imported in graph.items():
        for other in imported:
            if package(name) != package(other):
                arrows[package(name), package(other)].append((name, other))
    return dict(arrows)


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, directly or through others (Tarjan's components above one)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            at = stack.index(name)
            group, stack[at:] = stack[at:], []
            if len(group) > 1:
                found.append(sorted(group))

    for name in sorted(graph):
        if name not in index:
            visit(name)
    return found


def allowed(page: str) -> dict[str, set[str]]:
    """What each package may import: the rows `| package | may import |` of the architecture page."""
    table: dict[str, set[str]] = {}
    for line in page.splitlines():
        cells = [c.strip() for c in line.strip().strip("|").split("|")]
        if line.startswith("| `") and len(cells) == 3:
            table[cells[0].strip("`")] = set(re.findall(r"`([\w.]+)`", cells[1]))
    return table


def floors(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """The packages by floor: each imports lower floors only. Packages that import each other in a circle are left out."""
    below = {package(m): set() for m in graph}
    for a, b in package_graph(graph):
        below[a].add(b)
    levels: list[list[str]] = []
    done: set[str] = set()
    while level := sorted(p for p in below if p not in done and below[p] <= done):
        levels.append(level)
        done |= set(level)
    return levels


def folders() -> dict[str, int]:
    """Modules of each folder of the product, without `__init__`."""
    return Counter(str(p.parent.relative_to(ROOT)) for p in modules().values() if p.stem != "__init__")


def long_parts(lines: int = 400, function: int = 60) -> Iterator[tuple[str, int]]:
    """Files and functions of the product above so many lines, longest first, each with its lines."""
    files, functions = [], []
    for path in modules().values():
        source = path.read_text(encoding="utf-8")
        files.append((source.count("\n"), str(path.relative_to(ROOT))))
        if path.suffix == ".py":
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.FunctionDef):
                    functions.append(
                        (node.end_lineno - node.lineno + 1, f"{path.relative_to(ROOT)}:{node.name}")
                    )
    for parts, limit in ((files, lines), (functions, function)):
        yield from ((name, n) for n, name in sorted(parts, reverse=True) if n > limit)


def text(graph: Mapping[str, set[str]]) -> str:
    """Floors, arrows between packages, circles, full folders and long parts, for people."""
    arrows = package_graph(graph)
    lines = [f"{len(graph)} modules, {len(arrows)} arrows between packages"]
    for name in sorted({package(m) for m in graph}):
        ends = [f"{b} ({len(v)})" for (a, b), v in sorted(arrows.items()) if a == name]
        lines.append(f"  {name:<12} -> {', '.join(ends) or '(nothing of ours)'}")
    rings = circles(graph)
    lines.append(f"{len(rings)} circles between modules")
    lines += ["  " + ", ".join(ring) for ring in rings]
    levels = floors(graph)
    lines += [
        f"{len(levels)} floors of packages",
        *(f"  {k:>2} {', '.join(level)}" for k, level in enumerate(levels)),
    ]
    lines += ["folders of more than 15 modules", *(f"  {n:>4} {f}" for f, n in folders().items() if n > 15)]
    lines += ["files over 400 lines, functions over 60", *(f"  {n:>4} {name}" for name, n in long_parts())]
    return "\n".join(lines)


if __name__ == "__main__":
    print(text(module_graph()))
