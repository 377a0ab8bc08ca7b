"""Few samples are enough where the plant file states the noise; else the error says how many are needed."""

import re

import numpy as np
import pytest

import thermoctl as tc
from tests.plants import WIDE_BLOCK
from thermoctl.cli import main
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.files import loads


def run(count, extra_w=0.0):
    """Return a recording of 1200 s of 100 J/K and 0.2 W/K, with a source of `extra_w` from 600 s on."""
    t = np.linspace(0.0, 1200.0, count)
    heat = np.where(t < 400, 10.0, 0.0) + np.where(t >= 800, 5.0, 0.0)
    one = np.full(count, 22.0)
    for k in range(count - 1):
        begin = one[k]
        for m in np.linspace(t[k], t[k + 1], 201)[:-1]:
            source = heat[k] + extra_w * (m > 600) - 0.2 * (begin - 22.0)
            begin += source * (t[k + 1] - t[k]) / 200 / 100.0
        one[k + 1] = begin
    noise = 0.05 * np.random.default_rng(1).standard_normal(count)
    return {"t": t, "heat": heat, "air": np.full(count, 22.0), "T": one + noise}


@pytest.mark.parametrize("count", [12, 20])
def test_few_samples_of_stated_noise_are_enough(count):
    plant = tc.Plant(loads(WIDE_BLOCK, "plant.yaml"))
    assert tc.diagnose(plant, run(count)).verdict == "consistent"
    found = tc.diagnose(plant, run(count, extra_w=2.0))
    assert found.verdict != "consistent"
    assert {f.effect for f in found.findings} <= {"external_heat_source"}


def test_of_unknown_noise_more_are_needed():
    unknown = tc.Plant(loads(WIDE_BLOCK.replace(", noise: 0.05", ""), "plant.yaml"))
    for plant, data in (
        (unknown, run(20)),
        (tc.Plant(loads(WIDE_BLOCK, "plant.yaml")), run(11)),
        (tc.Plant(loads(WIDE_BLOCK, "plant.yaml")), [run(7), run(7)]),
    ):
        with pytest.raises(InputError, match="too little data: .* 40 are needed, or 12 where"):
            tc.diagnose(plant, data)


def test_a_warning_of_the_plant_is_printed_once(tmp_path, capsys):
    (tmp_path / "plant.yaml").write_text(re.sub(r"unit: [^,}]+(, )?", "", WIDE_BLOCK))
    data = run(20)
    rows = np.column_stack(list(data.values()))
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header=",".join(data), comments="")
    out, plant = str(tmp_path / "out"), str(tmp_path / "plant.yaml")
    assert main(["diagnose", "--plant", plant, str(tmp_path / "run.csv"), "--out", out]) == 0
    assert capsys.readouterr().err.count("no quantity has a unit") == 1
