"""A diagnosis goes on with a new recording: evidence adds up, and the old recordings are not needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.run import diagnose
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, loads
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

WEEKS = 3
RADIATION = 3e-10  # W/K^4; in one recording it is a matter of chance


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plant, list[Table]]:
    path: Path = tmp_path_factory.mktemp("rig") / "plant.yaml"
    lost = f"{{from: block, rate: {RADIATION} * ((block + 273.15)**4 - (air + 273.15)**4), unit: W}}"
    path.write_text(ONE_BLOCK.replace("flows:\n", f"flows:\n  concealed: {lost}\n"))
    true, rng, t = compile_plant(load(path)), np.random.default_rng(4), np.arange(400.0)
    tables = []
    for week in range(WEEKS):
        heat = 4.0 * rng.integers(0, 2, 8)[(t // 50).astype(int)]
        at = {"start": f"2026-03-{7 * week + 1:02d}T00:00:00"}
        table = Table(f"week_{week}", f"week_{week}", t, {"heat": heat, "air": 20 + 0 * t}, at)
        tables.append(true.measure(table, seed=week))
    path.write_text(ONE_BLOCK)
    return load(path), tables


def gains(found: dict) -> dict[str, float]:
    """Log evidence over no effect, by hypothesis."""
    return {" + ".join(h["effects"]): h["log_evidence"] for h in found["hypotheses"]}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out")


@pytest.fixture(scope="module")
def results(rig, out) -> list[dict]:
    plant, tables = rig
    found = [diagnose(plant, tables[:1], out / "0")]
    for k in range(1, WEEKS):
        found.append(diagnose(plant, tables[k : k + 1], out / str(k), earlier=out / str(k - 1)))
    return found


def test_evidence_and_estimate_are_those_of_all_recordings_together(rig, results, tmp_path):
    """About: noise and remainder are averaged for each part alone."""
    plant, tables = rig
    together = diagnose(plant, tables, tmp_path / "out", held_out=tables[:1])
    known = "radiation at block"
    one, last, joint = (gains(r)[known] for r in (results[0], results[-1], together))
    assert last > 1.5 * one
    assert last == pytest.approx(joint, rel=0.4)
    ((name, mine),) = results[-1]["findings"][0]["parameters"].items()
    theirs = together["findings"][0]["parameters"][name]
    assert mine["value"] == pytest.approx(theirs["value"], abs=theirs["sd"])
    assert mine["sd"] == pytest.approx(theirs["sd"], rel=0.3)


def test_the_result_says_what_it_rests_on(rig, results, tmp_path):
    last = results[-1]
    assert last["notes"][0].startswith(f"goes on from {WEEKS - 1} earlier recordings")
    if last["findings"]:
        assert [r["recording"] for r in last["trends"][0]["recordings"]][-1] == f"week_{WEEKS - 1}"


@pytest.mark.usefixtures("results")
def test_an_old_recording_and_another_plant_are_refused(rig, out, tmp_path):
    plant, tables = rig
    with pytest.raises(InputError, match="week_0 already"):
        diagnose(plant, tables[:1], tmp_path / "1", earlier=out / "0")
    other = tmp_path / "plant.yaml"
    other.write_text(ONE_BLOCK.replace("value: 6,", "value: 7,"))
    with pytest.raises(InputError, match="free parameters"):
        diagnose(load(other), tables[1:2], tmp_path / "1", earlier=out / "0")
    with pytest.raises(InputError, match="--continue"):
        diagnose(plant, tables[1:2], tmp_path / "1", earlier=tmp_path / "none")


SIZE = '{"recording": "a", "begun_s": 0, "value": 1, "sd": %s}'
TREND = '{"trends": [{"effect": "e", "where": "w", "parameter": "p", "recordings": [%s]}]}'


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b'{"trends": [',
        b"\xff\xfe",
        b"[]",
        b'{"trends": 3}',
        b'{"trends": ["a"]}',
        b'{"trends": [{"effect": "e"}]}',
        (TREND % '{"recording": "a"}').encode(),
        (TREND % SIZE % '"x"').encode(),
        (TREND % SIZE % "NaN").encode(),
    ],
)
@pytest.mark.usefixtures("results")
def test_a_damaged_result_is_refused_before_the_work(rig, out, tmp_path, text):
    plant, tables = rig
    (tmp_path / "memory.json").write_bytes((out / "0/memory.json").read_bytes())
    (tmp_path / "diagnosis.json").write_bytes(text)
    with pytest.raises(InputError, match=r"diagnosis\.json: damaged .* was expected; diagnose all"):
        diagnose(plant, tables[1:2], tmp_path / "1", earlier=tmp_path, progress=pytest.fail)


def test_an_event_of_an_earlier_recording_lasts_in_a_new_one(tmp_path):
    """Its clock names a recording that is not here: the hypothesis would be lost with its evidence."""
    path = tmp_path / "plant.yaml"
    path.write_text(ONE_BLOCK)
    plant, t = load(path), np.arange(400.0)
    path.write_text(
        ONE_BLOCK.replace("flows:\n", "flows:\n  opened: {from: block, rate: 0.05 * (block - air)}\n")
    )
    late = loads(path.read_text().replace("rate: 0.05", "rate: 0.05 * step(t - 90)"))
    rng, tables = np.random.default_rng(4), []
    for day, true in enumerate((plant, late, load(path))):
        heat = 4.0 * rng.integers(0, 2, 8)[(t // 50).astype(int)]
        table = Table(f"day_{day}", f"day_{day}", t, {"heat": heat, "air": 20 + 0 * t})
        tables.append(compile_plant(true).measure(table, seed=day))
    first = diagnose(plant, tables[:2], tmp_path / "0")
    then = diagnose(plant, tables[2:], tmp_path / "1", earlier=tmp_path / "0")
    (event,) = first["findings"]
    assert event["effect"] == "conductance_step" and event["recording"] == "day_1" and event["lasts"]
    name = "conductance_step at loss"
    assert gains(then)[name] > gains(first)[name] + 3
