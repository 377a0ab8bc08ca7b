"""The protection's scenarios on the compiled law and on its source, and what of the source they reach."""

import importlib.util
import sys
from pathlib import Path

import pytest

from tests.control import axes, protection
from thermoctl.control import law

CONTROL = Path(law.__file__).parent
PROTECTION = (
    "_judge_readings",
    "_judge_reading",
    "_resistance",
    "_watch_amplifier",
    "_agree",
    "_compare_drive",
    "_compare_position",
    "_compare_order",
    "protect",
    "_arm",
    "_report",
)
"""The functions of law.py that belong to the protection; arming.py and faults.py belong to it whole."""


def interpreted(name="interpreted_protection"):
    """law.py run by the interpreter, its own module."""
    spec = importlib.util.spec_from_file_location(name, CONTROL / "law.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("scenario", protection.SCENARIOS, ids=lambda s: s.__name__)
def test_compiled(scenario):
    scenario(law)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", protection.SCENARIOS, ids=lambda s: s.__name__)
def test_interpreted(scenario):
    scenario(interpreted())


@pytest.mark.slow
def test_every_branch_is_reached(tmp_path):
    """`make mutants`: arming.py, faults.py and the protection's part of law.py, branch by branch."""
    coverage = pytest.importorskip("coverage")
    files = [str(CONTROL / f"{name}.py") for name in ("law", "arming", "faults")]
    measure = coverage.Coverage(
        data_file=str(tmp_path / "coverage"), branch=True, include=files, config_file=False
    )
    for name in [n for n in sys.modules if n in ("thermoctl.control.arming", "thermoctl.control.faults")]:
        del sys.modules[name]
    measure.start()
    try:
        module = interpreted()
        import thermoctl.control.arming as arming
        import thermoctl.control.faults as faults

        module.arming, module.faults = arming, faults
        for scenario in protection.SCENARIOS:
            scenario(module)
    finally:
        measure.stop()
    missing = {}
    for file in files:
        analysis = measure._analyze(file)
        lines = own_lines(file) if file.endswith("law.py") else None
        missed = [
            a
            for a in [*analysis.missing, *(b[0] for b in analysis.missing_branch_arcs().items())]
            if lines is None or a in lines
        ]
        if missed:
            missing[Path(file).name] = sorted(set(missed))
    assert not missing


def own_lines(file):
    """The lines of the protection's functions in law.py."""
    import ast

    tree = ast.parse(Path(file).read_text())
    return {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name in PROTECTION
        for line in range(node.lineno, node.end_lineno + 1)
    }


@pytest.mark.parametrize("scenario", axes.SCENARIOS, ids=lambda s: s.__name__)
def test_axes(scenario):
    scenario(axes.PRODUCT)
