"""A base install: what works, and what says in one line which extra it lacks. Packages are hidden, not removed."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from thermoctl.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BASE = {"numpy", "scipy", "pyarrow", "yaml", "structlog", "pint", "rich", "shtab"}
HIDDEN = """
import sys
for name in {names}:
    sys.modules[name] = None
from thermoctl.cli import main
sys.exit(main())
"""
PAIR = ["docs/examples/heater/run_1.csv", "docs/examples/heater/run_2.csv"]


def without(extras, *arguments, names=()):
    """Run a command in a process that has none of the extras' packages, and no module of these names."""
    names = [*names, *(module for extra in extras for module in EXTRAS[extra])]
    command = [sys.executable, "-c", HIDDEN.format(names=names), *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def names_of(requirements):
    return {re.split(r"[^\w.-]", r)[0].lower() for r in requirements}


def test_extras_are_those_of_pyproject():
    stated = PROJECT["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        wanted = {p.lower() for p in packages.values()} - {"distributed"}  # comes with dask[distributed]
        assert names_of(stated[extra]) == wanted, extra
    assert all(extra in stated["all"][0] for extra in EXTRAS)


def test_every_import_is_of_the_base_or_of_an_extra():
    known = BASE | {m for packages in EXTRAS.values() for m in packages} | set(sys.stdlib_module_names)
    for path in [*(ROOT / "thermoctl").rglob("*.py"), *(ROOT / "hal").rglob("*.py")]:
        found = re.findall(r"^ *(?:from|import) (\w+)[\w.]*(?: import .*|)$", path.read_text(), re.MULTILINE)
        unknown = set(found) - known - {"thermoctl", "thermoctl_hal", "cython"}
        assert not unknown, f"{path}: {unknown}"


@pytest.mark.parametrize(
    "extra, command",
    [
        ("rig", "check config/wire.yaml"),
        ("rig", "doctor config/wire.yaml"),
        ("rig", "devices probe /dev/null"),
        ("report", "calibrate --config config/simulated.yaml"),
        ("fmu", "plant check FMU"),
        ("fleet", "fleet s3://none/none"),
    ],
)
def test_a_command_says_what_it_lacks(extra, command, tmp_path):
    (tmp_path / "any.fmu").touch()
    done = without([extra], *command.replace("FMU", str(tmp_path / "any.fmu")).split())
    assert done.returncode == 2
    assert f"pip install 'thermoctl[{extra}]'" in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_the_base_install_diagnoses(tmp_path):
    done = without(EXTRAS, "diagnose", "--plant", "docs/examples/heater/plant.yaml", *PAIR, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "external heat source" in done.stdout
    assert "note: report.html without figures and tables: needs the package 'matplotlib'" in done.stdout
    assert "external heat source" in (tmp_path / "report.html").read_text()


def test_the_base_install_knows_the_simulated_rig():
    assert without(EXTRAS, "check", "config/simulated.yaml").returncode == 0


def test_the_base_install_tunes():
    done = without(EXTRAS, "tune", "--config", "config/simulated.yaml")
    assert done.returncode == 0 and "kp" in done.stdout, done.stderr


def test_the_name_hal_is_left_to_linuxcnc():
    done = without([], "check", "config/wire.yaml", names=["hal"])
    assert done.returncode == 0, done.stderr
