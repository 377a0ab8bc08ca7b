"""Start of the small commands: nothing is loaded that they do not use, and they take little processor time."""

import math
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PLOTS = {"matplotlib", "pandas", "asammdf"}
SLOW = {*PLOTS, "pint", "scipy.stats", "scipy.signal", "scipy.optimize", "scipy.interpolate"}
FORBIDDEN = {  # by command: modules that it has no use for
    "--help": {*SLOW, "numpy", "pyarrow", "rich", "scipy"},
    "status --config config/simulated.yaml": {*SLOW, "pyarrow", "rich", "scipy", "thermoctl.control.law"},
    "status --config config/wire.yaml": {*SLOW, "pyarrow", "rich", "scipy", "thermoctl.control.law"},
    "check --config config/simulated.yaml": {
        *PLOTS,
        "scipy.stats",
        "scipy.signal",
        "thermoctl.diagnosis.evidence.fit",
    },
    "effects": {*SLOW, "pyarrow", "scipy", "thermoctl.plant.simulation.simulate"},
    "diagnose --explain nothing": {
        *SLOW,
        "scipy",
        "thermoctl.diagnosis.evidence.fit",
        "thermoctl.fleet.commands",
    },
    "recordings list": {*SLOW, "scipy", "thermoctl.plant.simulation.simulate"},
    "devices list": {*SLOW, "scipy", "thermoctl.plant.simulation.simulate"},
}
RUN = """import sys
import thermoctl.cli
try:
    thermoctl.cli.main(sys.argv[1:])
except SystemExit:
    pass
print("\\n@", *sys.modules)"""


def loaded(code, *words):
    printed = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, cwd=ROOT)
    return set(printed.stdout.rpartition("\n@")[2].split())


@pytest.mark.parametrize("command", FORBIDDEN)
def test_a_command_loads_nothing_that_it_does_not_use(command):
    modules = loaded(RUN, *command.split())
    assert "thermoctl.cli" in modules and not FORBIDDEN[command] & modules


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        ("thermoctl", {"numpy", "thermoctl.api"}),
        ("thermoctl.api", {*SLOW, "scipy", "thermoctl.diagnosis.diagnose"}),
        ("thermoctl.diagnosis.run", SLOW),
    ],
)
def test_an_import_loads_nothing_slow(module, forbidden):
    modules = loaded(f"import sys, {module}; print('\\n@', *sys.modules)")
    assert module in modules and not forbidden & modules


BUDGETS = {  # in imports of numpy, about 0.12 s
    "status --config config/wire.yaml": 3,
    "check --config config/wire.yaml": 6,
    "effects": 4,
    "diagnose --explain nothing": 4,
    "import thermoctl.api": 6,
}


@pytest.mark.parametrize("words", BUDGETS)
def test_a_small_command_costs_a_few_imports_of_numpy(words, tmp_path):
    # A checkout that may not write compiled modules, or runs a command first, compiles: that is not the command's cost.
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path), "PYTHONDONTWRITEBYTECODE": ""}

    def seconds(*arguments):
        """Processor time of a run, s."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *arguments], capture_output=True, cwd=ROOT, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    command = ["-c", words] if words.startswith("import") else ["-m", "thermoctl.cli", *words.split()]
    seconds(*command), seconds("-c", "import numpy")
    plain = used = math.inf
    for _ in range(6):  # a machine shared with others: the least of alternating runs
        plain, used = min(plain, seconds("-c", "import numpy")), min(used, seconds(*command))
        if used < BUDGETS[words] * plain:
            break
    print(f"\n{words}: {used:.2f} s, {used / plain:.1f} imports of numpy")
    assert used < BUDGETS[words] * plain
