"""The new user's walk: a clean clone, then every command of README that runs, from `make run` to a diagnosed recording.

`python tests/walkthrough/walk.py [FOLDER]` (make walkthrough); leaves FOLDER (default: a temporary one) as a reader's would be.
"""

import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
from tests.walkthrough.blocks import blocks, run  # noqa: E402


def main():
    """Walk; 0 when every step worked and the recording got its diagnosis."""
    with tempfile.TemporaryDirectory(prefix="thermoctl-walk") as temporary:
        clone = Path(sys.argv[1] if len(sys.argv) > 1 else temporary) / "thermoctl"
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)], check=True)
        steps = [b for b in blocks(clone / "README.md") if b.mark.startswith("runs")]
        for number, block in enumerate(steps, 1):
            seconds = re.search(r"for (\d+) s", block.mark)
            print(f"[{number}/{len(steps)}] README.md:{block.line}\n{block.text.rstrip()}", flush=True)
            begun = time.monotonic()
            if seconds:  # the time is that of the program; what has to be installed first is installed first
                subprocess.run(["make", "install"], cwd=clone, check=True, capture_output=True)
            try:
                said = run(block, clone, clone / ".venv/bin", float(seconds[1]) if seconds else None)
            except AssertionError:  # nothing of the walk goes on running
                subprocess.run(
                    [clone / ".venv/bin/thermoctl", "stop", "--config", "config/simulated.yaml"],
                    cwd=clone,
                    check=False,
                )
                raise
            print(
                "".join(f"    {line}\n" for line in said.splitlines()[-12:])
                + f"    ({time.monotonic() - begun:.0f} s)",
                flush=True,
            )
            if seconds:
                assert "ARMED" in said, "the loop ran"
        found = json.loads((clone / "result/diagnosis.json").read_text())
        assert found["verdict"] == "explained" and found["findings"][0]["effect"] == "external_heat_source", (
            found["verdict"]
        )
        assert (clone / "result/report.html").stat().st_size > 10000 and (
            clone / "result/plant.yaml"
        ).exists()
        print(
            f"walked: {len(steps)} steps, and the recording has its diagnosis: {found['findings'][0]['effect']} at {found['findings'][0]['where']}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
