"""Imports follow docs/explanation/architecture.md: no arrow that its table does not allow, no circle of modules."""

import ast

import pytest

from tests.architecture import (
    PAGE,
    Graph,
    allowed,
    circles,
    floors,
    folders,
    module_graph,
    modules,
    package,
    package_graph,
    text,
)

# Present exceptions, each to be removed with its cause. An exception that is no longer needed fails, too.
ARROWS: set[tuple[str, str]] = set()
CIRCLES: list[str] = []
INSIDE_FUNCTIONS = {"cli", "daemon"}


@pytest.fixture(scope="module")
def graph() -> Graph:
    found = module_graph()
    print("\n" + text(found))
    return found


def test_every_import_is_allowed_by_the_page(graph):
    table = allowed(PAGE.read_text(encoding="utf-8"))
    unknown = {package(m) for m in graph} - set(table)
    assert not unknown, f"{PAGE.name} has no row for {sorted(unknown)}: add it to the table of packages"
    excused = set()
    wrong = []
    for (source, target), imports in package_graph(graph).items():
        for module, imported in imports if target not in table[source] else ():
            if (module, target) in ARROWS:
                excused.add((module, target))
            else:
                wrong.append(f"{module} imports {imported}; {source} may import {sorted(table[source])}")
    assert not wrong, "\n".join(wrong)
    assert excused == ARROWS, f"no longer needed in ARROWS: {sorted(ARROWS - excused)}"


def test_no_two_modules_import_each_other(graph):
    rings = [set(ring) for ring in circles(graph)]
    excused = [set(names.split()) for names in CIRCLES]
    assert not [sorted(ring) for ring in rings if not any(ring <= e for e in excused)]
    assert not [e for e in excused if not any(ring <= e for ring in rings)], "no longer needed in CIRCLES"


def test_no_arrow_goes_up_and_no_folder_grows_beyond_a_screen(graph):
    """A package that is on no floor imports one above it."""
    levels = floors(graph)
    placed = {p for level in levels for p in level}
    assert placed == {package(m) for m in graph}
    assert len(levels) <= 9, levels
    assert {f: n for f, n in folders().items() if n > 15} == {}


def test_only_the_command_line_imports_inside_functions():
    found = set()
    for name, path in modules().items():
        if path.suffix == ".py":
            for outer in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(outer, ast.FunctionDef):
                    for node in ast.walk(outer):
                        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("thermoctl"):
                            found.add(package(name))
    assert found == INSIDE_FUNCTIONS


def test_a_wrong_arrow_and_a_circle_are_found():
    """The two tests above can fail."""
    graph = {"thermoctl.plant.a": {"thermoctl.control.b"}, "thermoctl.control.b": {"thermoctl.plant.a"}}
    assert package_graph(graph)["plant", "control"] == [("thermoctl.plant.a", "thermoctl.control.b")]
    assert circles(graph) == [["thermoctl.control.b", "thermoctl.plant.a"]]
    assert "control" not in allowed(PAGE.read_text(encoding="utf-8"))["plant"]
