"""A base install: what works, and what says in one line which extra it lacks. Packages are hidden, not removed."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from thermoctl.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
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


def imported(path):
    """Every module of another project that a source file imports, at any place in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def test_every_import_is_declared():
    """Each comes from a requirement of pyproject.toml itself, not from what another package brings along."""
    ours = {"thermoctl", "thermoctl_hal", "cython", "__future__", *sys.stdlib_module_names}
    declared = names_of(PROJECT["dependencies"]).union(
        *map(names_of, PROJECT["optional-dependencies"].values())
    )
    extras = {m for packages in EXTRAS.values() for m in packages}
    base = names_of(PROJECT["dependencies"])
    of = packages_distributions()
    seen = set()
    for path in sorted({p.resolve() for top in ("thermoctl", "hal") for p in (ROOT / top).rglob("*.py")}):
        for module in set(imported(path)) - ours:
            seen.add(module)
            names = {n.lower() for n in of.get(module, [module])}
            assert names & declared, (
                f"{path}: {module} comes with {names}, which pyproject.toml does not name"
            )
            assert names & base or module in extras, (
                f"{path}: {module} is of an extra that thermoctl.extras cannot name"
            )
    assert {"numpy", "crccheck", "serial"} <= seen


EACH_ALONE = """
import importlib, os, sys
from thermoctl.cli.commands import COMMANDS
from thermoctl.extras import EXTRAS, lacking
for packages in EXTRAS.values():
    for module in packages:
        sys.modules[module] = None
modules = sorted({c.function.partition(":")[0] for c in COMMANDS})
def load(extra):
    bad = 0
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as e:
            if lacking(e) is None:
                print(f"{extra}: {module}: {e}", file=sys.stderr)
                bad = 1
    return bad
bad = load("no extra")  # what loads without any is loaded once, for all
for extra in EXTRAS:
    child = os.fork()
    if not child:
        for module in EXTRAS[extra]:
            del sys.modules[module]
        os._exit(load(extra))
    bad |= os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
sys.exit(bad)
"""


def test_each_commands_modules_load_with_any_extra_alone():
    """Or they name the extra that they lack; a package that only another extra brings would end in a traceback."""
    done = subprocess.run([sys.executable, "-c", EACH_ALONE], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


SEVERAL = HIDDEN.replace(
    "sys.exit(main())",
    """import os
for line in {lines}:
    if not os.fork():
        print(line, "gave", main(line.split()), flush=True)
        os._exit(0)
    os.wait()""",
)


def test_words_need_no_drivers_package():
    """One process for several commands: each loads the same modules."""
    lines = [f"check config/{rig}.yaml" for rig in ("wire", "examples/stage", "examples/small")]
    lines += ["devices list", "devices search thermocouple"]
    names = [module for extra in ("rig", "ethercat") for module in EXTRAS[extra]]
    command = [sys.executable, "-c", SEVERAL.format(names=names, lines=lines)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr
    for line in lines:
        assert f"{line} gave 0" in done.stdout, done.stdout
    notes = re.findall(
        r"note: (\S+): not every device was checked; .*pip install 'thermoctl\[rig\]'", done.stdout
    )
    assert {"config/wire.yaml", "config/examples/stage.yaml", "config/examples/small.yaml"} <= set(notes)
    assert done.stdout.count(": good. ") == 4  # the stage has two axes
    assert "can-dbc" in done.stdout and " ethercat " in done.stdout


def test_a_mistake_is_found_without_a_drivers_package(tmp_path):
    text = (ROOT / "config/wire.yaml").read_text().replace("{voltage: voltage_v, ", "{")
    (tmp_path / "rig.yaml").write_text(
        re.sub(r"(profile: |plant: |model: )(\w+/)", rf"\g<1>{ROOT}/config/\g<2>", text)
    )
    done = without(["rig"], "check", tmp_path / "rig.yaml")
    assert done.returncode == 1 and "protection.required names voltage_v" in done.stdout, done


@pytest.mark.parametrize(
    "extra, command",
    [
        ("rig", "devices show meter-can"),
        ("ethercat", "devices probe eth0 --profile beckhoff-el3314"),
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
