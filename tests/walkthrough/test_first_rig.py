"""From an empty folder to ARMED and compensating with the page alone, in real time. Slow: `make first-rig`."""

import pytest

from tests.walkthrough import first_rig


@pytest.mark.slow
def test_an_own_rig_from_an_empty_folder(tmp_path):
    first_rig.judge(first_rig.walk(tmp_path))
