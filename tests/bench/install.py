"""The wheel in a fresh environment, from an empty folder: what works; with --sizes also megabytes, imports and every extra.

`make try-wheel` and `make size`, which run `python tests/bench/install.py WHEEL [--sizes]`. One step of --sizes takes the C compiler
away, and shows what asks for one.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DIAGNOSE = "diagnose --plant examples/heater/plant.yaml examples/heater/run_1.csv examples/heater/run_2.csv --out result --quiet"
STEPS = (
    "--version",
    "init",
    "check config/simulated.yaml",
    "demo --seconds 5",
    DIAGNOSE,
    "plant export result/plant.yaml --to python --out plant.py --data examples/heater/run_1.csv",
    "service install --config config/simulated.yaml --root root",
)
WITH_ALL = ("check config/wire.yaml", "devices list", DIAGNOSE)
IMPORTS = ("thermoctl", "thermoctl.api", "thermoctl.cli.commands", "thermoctl.daemon.tick.loop")
PIP = ("-m", "pip", "--disable-pip-version-check", "-qq")


def size(folder: Path) -> float:
    """Megabytes of a folder's files."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file() and not p.is_symlink()) / 1e6


def step(program: Path, command: str, folder: Path, own: dict[str, str]) -> int:
    """Run one command and print its time, its status and, where it failed, its last line."""
    begin = time.monotonic()
    done = subprocess.run([program, *command.split()], cwd=folder, env=own, capture_output=True, text=True)
    says = (done.stderr or done.stdout).strip().splitlines()[-1:] if done.returncode else []
    took = time.monotonic() - begin
    print(f"{took:6.1f} s  status {done.returncode}  thermoctl {command[:60]}", *says, flush=True)
    return done.returncode


def main() -> int:
    """Print the tables; return 1 where a step fails."""
    with tempfile.TemporaryDirectory(prefix="thermoctl-wheel") as made:
        work, wheel, sizes = Path(made), Path(sys.argv[1]).resolve(), "--sizes" in sys.argv
        subprocess.run([sys.executable, "-m", "venv", work / "venv"], check=True)
        python, program = work / "venv/bin/python", work / "venv/bin/thermoctl"
        site = next((work / "venv/lib").glob("python*/site-packages"))
        empty = size(site)
        subprocess.run([python, *PIP, "install", wheel], check=True)
        if sizes:
            base(python, site, empty)
        folder = work / "empty"
        folder.mkdir()
        own = {
            **os.environ,
            "HOME": str(work),
            "XDG_CACHE_HOME": str(work / "cache"),
            "XDG_STATE_HOME": str(work / "state"),
        }
        failed = sum(step(program, s, folder, own) != 0 for s in STEPS)
        if sizes:
            print("without a C compiler, and without plants that were compiled before:")
            bare = {"PATH": str(python.parent), "XDG_CACHE_HOME": str(work / "none")}
            step(program, DIAGNOSE, folder, own | bare)
            project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
            for extra in re.split(r"[\[,\]]", project["optional-dependencies"]["all"][0])[1:-1]:
                before = size(site)
                subprocess.run([python, *PIP, "install", f"{wheel}[{extra}]"], check=True)
                print(f"extra {extra}: {size(site) - before:.0f} MB more", flush=True)
            print(f"with all extras: {size(site) - empty:.0f} MB", flush=True)
            failed += sum(step(program, s, folder, own) != 0 for s in WITH_ALL)
    return int(failed > 0)


def base(python: Path, site: Path, empty: float) -> None:
    """Print the megabytes of the base installation, and the seconds of each import."""
    sizes = sorted(((size(p), p.name) for p in site.iterdir() if p.is_dir()), reverse=True)
    large = ", ".join(f"{n} {s:.0f}" for s, n in sizes if n != "pip" and s > 4)
    print(f"{size(site) - empty:.0f} MB: {large}", flush=True)
    for module in IMPORTS:
        took = []
        for _ in range(4):  # the first also reads the disk
            begin = time.monotonic()
            subprocess.run([python, "-c", f"import {module}"], check=True, cwd=site.parents[2])
            took.append(time.monotonic() - begin)
        print(f"import {module}: {min(took):.2f} s, the first time {took[0]:.2f} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
