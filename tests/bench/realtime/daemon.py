"""The daemon itself, with a probe: the loop's own `stopping()` question, asked once a tick after all its work, notes the time.

    python tests/bench/realtime/daemon.py CONFIG STAMPS TICKS     STAMPS: int64 ns, one a tick, in a file mapped into memory

Nothing else differs from `thermoctl run`. The probe is compiled (batch.pyx, built by run.py) and part of the figures.
"""

import sys
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import load_settings
from thermoctl.daemon import supervisor
from thermoctl.daemon.tick import loop

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "build/bench-realtime"))
from batch import Probe


def main(config: str, stamps_path: str, ticks: str) -> int:
    """Run the daemon until SIGTERM; returns its exit status."""
    stamps = np.memmap(stamps_path, np.int64, "w+", shape=(int(ticks),))
    run_loop = loop.run_loop

    def probed(settings, shared, rig, stopping, **more):
        run_loop(settings, shared, rig, Probe(stamps, stopping), **more)

    loop.run_loop = probed
    return supervisor.run(load_settings(config))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
