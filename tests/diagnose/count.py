"""Size of the diagnosis: `python -m tests.diagnose.count [FOLDER ...]` (default: thermoctl/diagnosis and its folders).

A FOLDER of an older checkout is counted in the same way. A branch is an if, a loop, an except, a comprehension, or a
Boolean operator. Named numbers are names in capitals of a module that hold numbers.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

from thermoctl.diagnosis.limits import limits

ROOMS = sorted(p.parent for p in Path("thermoctl/diagnosis").glob("*/__init__.py"))
FOLDERS = ("thermoctl/diagnosis", *map(str, ROOMS))
BRANCHES = (ast.If, ast.For, ast.While, ast.BoolOp, ast.IfExp, ast.comprehension, ast.ExceptHandler)


def numbers(node: ast.AST) -> int:
    """Names in capitals that a statement of a module gives numbers to."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return 0
    held = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
    return sum(n.isupper() for n in names) if held else 0


def row(folder: Path) -> str:
    """One folder's figures as a row of a Markdown table."""
    files = sorted(folder.rglob("*.py"))
    trees = [ast.parse(f.read_text()) for f in files]
    functions = [
        (f, n)
        for f, t in zip(files, trees, strict=True)
        for n in ast.walk(t)
        if isinstance(n, ast.FunctionDef)
    ]
    longest = max((n.end_lineno - n.lineno + 1, f.stem, n.name) for f, n in functions if n.end_lineno)
    branches = max((sum(isinstance(x, BRANCHES) for x in ast.walk(n)), f.stem, n.name) for f, n in functions)
    lines = [len(f.read_text().splitlines()) for f in files]
    named = sum(numbers(n) for t in trees for n in t.body)
    cells = [folder, len(files), sum(lines), max(lines)]
    cells += [f"{n} ({module}.{name})" for n, module, name in (longest, branches)]
    return "| " + " | ".join(map(str, [*cells, named])) + " |"


def main() -> int:
    """Print the table, and the number of numbers that decide."""
    print("| folder | files | lines | longest file | longest function | most branches | named numbers |")
    print("|---|---|---|---|---|---|---|")
    for folder in sys.argv[1:] or FOLDERS:
        print(row(Path(folder)))
    print(f"\nnumbers that decide (config/diagnosis.yaml): {len(vars(limits()))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
