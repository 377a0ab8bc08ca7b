"""The wheel in a fresh environment, from an empty folder: what works, its size, the time of its imports.

`make size`. The last step takes the C compiler away, and shows what asks for one.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STEPS = (
    "init",
    "check config/simulated.yaml",
    "demo --seconds 5",
    "diagnose --plant examples/heater/plant.yaml examples/heater/run_1.csv examples/heater/run_2.csv --out result --quiet",
    "plant export result/plant.yaml --to python --out plant.py --data examples/heater/run_1.csv",
    "service install --config config/simulated.yaml --root root",
    "devices",
)
IMPORTS = ("thermoctl", "thermoctl.api", "thermoctl.commands", "thermoctl.daemon.loop")


def size(folder: Path) -> float:
    """Megabytes of a folder's files."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file() and not p.is_symlink()) / 1e6


def main() -> int:
    """Print the tables; return 1 where a step fails."""
    failed = 0
    with tempfile.TemporaryDirectory(prefix="thermoctl-wheel") as made:
        work, pip = Path(made), [sys.executable, "-m", "pip", "--disable-pip-version-check", "-qq"]
        wheels = sys.argv[1:]
        if not wheels:
            subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", work, ROOT], check=True)
            wheels = [str(next(work.glob("*.whl")))]
        subprocess.run([sys.executable, "-m", "venv", work / "venv"], check=True)
        python, program = work / "venv/bin/python", work / "venv/bin/thermoctl"
        subprocess.run([python, *pip[1:], "install", *wheels], check=True)
        site = next((work / "venv/lib").glob("python*/site-packages"))
        sizes = sorted(((size(p), p.name) for p in site.iterdir() if p.is_dir()), reverse=True)
        print(
            f"{sum(s for s, _ in sizes):.0f} MB: " + ", ".join(f"{n} {s:.0f}" for s, n in sizes[:8]),
            flush=True,
        )
        for module in IMPORTS:
            begin = time.monotonic()
            subprocess.run([python, "-c", f"import {module}"], check=True, cwd=work)
            print(f"import {module}: {time.monotonic() - begin:.2f} s", flush=True)
        folder = work / "empty"
        folder.mkdir()
        own = {
            **os.environ,
            "HOME": str(work),
            "XDG_CACHE_HOME": str(work / "cache"),
            "XDG_STATE_HOME": str(work / "state"),
        }
        for step, more in [
            *((s, {}) for s in STEPS),
            (STEPS[3], {"PATH": str(python.parent), "XDG_CACHE_HOME": str(work / "none")}),
        ]:
            begin = time.monotonic()
            done = subprocess.run(
                [program, *step.split()], cwd=folder, env=own | more, capture_output=True, text=True
            )
            failed += bool(done.returncode) and not more
            says = (done.stderr or done.stdout).strip().splitlines()[-1:] if done.returncode else []
            print(
                f"{time.monotonic() - begin:6.1f} s  status {done.returncode}  thermoctl {step[:60]}",
                *says,
                flush=True,
            )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
