"""Rigs of any points, from configuration alone: calibrated from their own tests, compensated, judged by the reference."""

import pytest

from tests.rigs.run import RIGS, prove


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
def test_a_rig_is_calibrated_and_compensated(rig, tmp_path):
    off, on = prove(tmp_path, *RIGS[rig])
    assert off > 1.0 and on < 0.15 * off, (off, on)
