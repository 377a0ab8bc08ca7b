"""The daemon itself, with a probe: the loop's own `stopping()` question, asked once a tick after all its work, notes the time.

    python tests/bench/realtime/daemon.py CONFIG STAMPS TICKS     STAMPS: int64 ns, one a tick, in a file mapped into memory

Nothing else differs from `thermoctl run`; the probe costs the loop about 0.2 us a tick, which the figures contain.
"""
import sys

import numpy as np
from thermoctl.daemon.clock import now_ns

from thermoctl.daemon import loop, supervisor
from thermoctl.settings import load_settings


def main(config: str, stamps_path: str, ticks: str) -> int:
    """Run the daemon until SIGTERM; returns its exit status."""
    stamps = np.memmap(stamps_path, np.int64, "w+", shape=(int(ticks),))
    run_loop = loop.run_loop

    def probed(settings, shared, rig, stopping, **more):
        view, at = memoryview(stamps), 0

        def question() -> bool:
            nonlocal at
            if at < len(view):
                view[at] = now_ns()
                at += 1
            return stopping()
        run_loop(settings, shared, rig, question, **more)
    loop.run_loop = probed
    return supervisor.run(load_settings(config))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
