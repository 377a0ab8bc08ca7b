"""A crowded case: each effect stands out of the misfit, the misfit is as large as asked, and the answer tells both."""

from __future__ import annotations

import numpy as np
import pytest

from tests.concealed.crowded import ERROR, LARGE, NAMED, NEAR, QUIET
from tests.concealed.generate import CROWDED, KINDS, make_case


@pytest.mark.parametrize("family", ["heater", "stage"])
def test_effects_stand_out_of_a_misfit_that_nobody_names(family):
    plant, runs, answer = make_case(3, 0, (family,), kind=CROWDED)
    assert answer["verdict"] == "partly_explained" and CROWDED not in KINDS
    assert 2 <= len(answer["effects"]) == len(answer["own_snr"]) <= 3
    assert min(answer["own_snr"]) >= max(LARGE, answer["misfit_snr"])
    assert ERROR[0] / NEAR < answer["misfit_over_noise"] < ERROR[1] * NEAR
    assert answer["misfits"] and not {kind for kind, _ in answer["misfits"]} & set(NAMED)
    for effect, names in zip(answer["effects"], answer["each"], strict=True):
        assert effect in names
    told = [tuple(x) for names in answer["each"] for x in names]
    assert len(told) == len(set(told))  # no name is two effects
    noise = {o: x["noise"] for o, x in plant["outputs"].items()}
    for o, rms in answer["oracle_rms"].items():  # noise and misfit against the effects alone
        assert rms > 0.8 * noise[o]
    assert len(runs) in (1, 2) and noise in (
        {"encoder": 0.02 / QUIET},
        {"encoder": 0.005 / QUIET},
        dict.fromkeys(noise, 0.1 / QUIET),
    )
    again = make_case(3, 0, (family,), kind=CROWDED)
    for (_, x), (_, y) in zip(runs[0], again[1][0], strict=True):
        np.testing.assert_array_equal(x, y)
