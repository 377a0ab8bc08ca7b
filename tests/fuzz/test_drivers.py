"""Nothing that a device sends ends the loop: every driver behind its port, some seconds of foreign frames (issue 21, B9).

`make fuzz` feeds each the frames of an hour.
"""

import pytest

from tests.fuzz.drivers import DRIVERS, QUICK


@pytest.mark.parametrize("name", DRIVERS)
def test_no_frame_ends_the_loop(name):
    counts = DRIVERS[name]().run(QUICK.get(name, 4000), seed=7)
    if name != "drive_setup":
        assert counts["frames"] > 0 and counts["errors"] + counts.get("ignored", 0) > 0, counts
