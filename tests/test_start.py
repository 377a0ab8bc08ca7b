"""Start of the small commands: nothing is loaded that they do not use, and they take little processor time."""

import os
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


def seconds(*words):
    """Least processor time of two runs, s."""
    times = []
    for _ in range(2):
        child = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT)
        _, _, used = os.wait4(child.pid, 0)
        child.returncode = 0
        times.append(used.ru_utime + used.ru_stime)
    return min(times)


BUDGETS = {  # in imports of numpy, about 0.12 s
    "status --config config/wire.yaml": 3,
    "check --config config/wire.yaml": 6,
    "effects": 4,
    "diagnose --explain nothing": 4,
    "import thermoctl.api": 6,
}


def test_small_commands_cost_a_few_imports_of_numpy():
    plain = seconds(sys.executable, "-c", "import numpy")
    for words, budget in BUDGETS.items():
        how = ["-c", words] if words.startswith("import") else ["-m", "thermoctl.cli", *words.split()]
        used = seconds(sys.executable, *how)
        print(f"\n{words}: {used:.2f} s, {used / plain:.1f} imports of numpy")
        assert used < budget * plain, words
