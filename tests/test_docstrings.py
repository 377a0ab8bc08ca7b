"""Every public module, class and function of the product says what it is."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def undocumented(path):
    """'file:line name' of each public definition without a docstring; what a function defines inside itself is its own affair."""

    def look(node, inside):
        for child in getattr(node, "body", ()):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                name = f"{inside}{child.name}"
                overload = any(isinstance(d, ast.Name) and d.id == "overload" for d in child.decorator_list)
                if not (child.name.startswith("_") or overload) and ast.get_docstring(child) is None:
                    yield f"{path.relative_to(ROOT)}:{child.lineno} {name}"
                if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                    yield from look(child, f"{name}.")
            elif isinstance(child, ast.If | ast.Try):
                yield from look(child, inside)

    tree = ast.parse(path.read_text())
    if ast.get_docstring(tree) is None and tree.body:
        yield f"{path.relative_to(ROOT)}:1 module"
    yield from look(tree, "")


def test_nothing_public_is_without_a_docstring():
    paths = sorted(p for folder in ("thermoctl", "hal") for p in (ROOT / folder).rglob("*.py"))
    assert len(paths) > 90
    missing = [m for p in paths for m in undocumented(p)]
    assert missing == [], f"{len(missing)} without a docstring:\n" + "\n".join(missing)
