"""`make first-rig`: the page of an own rig, block by block in an empty folder, each with its time.

docs/how-to/first-rig.md leads from an empty folder to ARMED and compensating, on played devices in real time. Nothing
but the page's text is used.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
from tests.walkthrough.blocks import blocks, run  # noqa: E402

PAGE = ROOT / "docs/how-to/first-rig.md"
BIN = Path(sys.executable).parent


def walk(folder, say=print):
    """Run the page in an empty folder; return its output. Nothing goes on running afterwards."""
    assert not list(folder.iterdir())
    everything, total_s = "", 0.0
    try:
        for block in blocks(PAGE):
            if block.mark == "runs":
                begin = time.monotonic()
                said = run(block, folder, BIN)
                seconds, everything = time.monotonic() - begin, everything + said
                total_s += seconds
                first = next(line for line in block.text.splitlines() if not line.startswith("export"))
                say(f"{seconds:7.1f} s  {block.where:20} {first[:90]}")
                for line in said.splitlines()[-14:]:
                    say(f"             | {line}")
    finally:
        subprocess.run(
            [BIN / "thermoctl", "stop", "--config", "config/screw.yaml"], cwd=folder, capture_output=True
        )
        pid = folder / "run/virtual-rig.pid"
        if pid.exists():
            subprocess.run(["kill", pid.read_text().strip()], capture_output=True)
    say(f"{total_s:7.1f} s  from an empty folder to the end")
    return everything


def judge(rig):
    """Check the page's promise: ARMED, compensating, `expected, not measured`; return the compensation, um."""
    assert rig.count("config/screw.yaml: good.") == 2, rig
    last = rig[rig.rindex("ARMED") :]
    compensation = float(re.search(r"compensation (-?[\d.]+)", last)[1])
    output = re.search(r"output (-?[\d.]+) um \(expected, not measured\)", last)
    assert 0.3 < abs(compensation) < 10.0 and output, last
    assert abs(float(output[1]) - 200.0) < 1.0, last
    return compensation


def main():
    """Walk and judge; 0 when the page keeps its promise."""
    with tempfile.TemporaryDirectory(prefix="thermoctl-first-rig") as temporary:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        folder.mkdir(exist_ok=True)
        print(f"ARMED, compensating {judge(walk(folder)):.2f} um")
    return 0


if __name__ == "__main__":
    sys.exit(main())
