"""The experiment that tells explanations apart: proposed inside the rig's limits, written, run, and decisive."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.plants import HEATED_BLOCK, HEATED_RADIATES
from thermoctl.cli import main
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.experiment import file as experiment_file
from thermoctl.diagnosis.experiment.design import Excitation, courses, levers
from thermoctl.diagnosis.experiment.file import peaks
from thermoctl.diagnosis.experiment.propose import bits, distances, propose
from thermoctl.diagnosis.experiment.resolve import resolve
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search.beam import search, searched
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.experiments import load_experiments, load_inputs
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table

CONFIG = Path(__file__).resolve().parents[2] / "config/simulated.yaml"
TRUTH = HEATED_RADIATES.replace("value: 40,", "value: 46,").replace("value: 0.25,", "value: 0.2,")
LIMITS = {"T_block": (15.0, 110.0)}


def short_pulses():
    """Twenty minutes with two pulses of 72 s: 25 K, at which T^4 and a conductance that rises with T look the same."""
    t = np.arange(240) * 5.0
    heat = np.where((np.abs(t - 156) < 36) | (np.abs(t - 636) < 36), 20.0, 0.0)
    return Table("run_1", "run_1", t, {"heat": heat, "air": np.full(len(t), 22.0)})


@pytest.fixture(scope="module")
def undecided():
    return shared_by_two(HEATED_BLOCK, TRUTH, short_pulses())


def shared_by_two(belief, truth, inputs):
    """A diagnosis that two refitted hypotheses share equally: each entry is searched alone, so that both are refitted."""
    table = compile_plant(loads(truth), ()).measure(inputs, seed=1)
    two = ("radiation", "temperature_dependent_conductance")
    entries = {k: e for k, e in catalogue((CATALOGUE,)).items() if k in two}
    known = case(loads(belief), [table], entries, Budget(30))
    numbers = dataclasses.replace(limits(), effects=1)
    apart = (dataclasses.replace(known, catalogue={k: entries[k]}, limits=numbers) for k in two)
    one, other = (searched(search(x)) for x in apart)
    both = dataclasses.replace(one, tried=(*one.tried, *(w for w in other.tried if w.fitted.hypothesis.keys)))
    single = [w.fitted.hypothesis.keys for w in both.tried if w.fitted.hypothesis.keys]
    assert {e for keys in single for e, _ in keys} == set(two)
    best = [next(k for k in single if e in {n for n, _ in k}) for e in two]
    return undecided_between(known, both, best)


def undecided_between(known, searched, hypotheses, verdict="ambiguous"):
    """A diagnosis as the next experiment reads it."""
    share = 1 / max(len(hypotheses), 1)
    return SimpleNamespace(
        case=known,
        searched=searched,
        posterior=SimpleNamespace(hypotheses=dict.fromkeys(hypotheses, share), something=share),
        decision=SimpleNamespace(verdict=verdict),
        law=None,
        asked={},
    )


def test_proposal_stays_inside_the_limits_and_is_the_best_per_hour(undecided):
    found = undecided
    entry, chosen = propose(found, limits=LIMITS)
    heat = np.array(entry["inputs"]["heat"])
    assert heat[:, 1].min() >= 0 and heat[:, 1].max() <= 20 and entry["inputs"]["air"] == [[0.0, 22.0]]
    ahead = compile_plant(loads(TRUTH), ()).simulate(chosen.table(found.case.plant, 5.0)).y
    assert ahead.min() > 15 and ahead.max() < 110
    assert entry["separates"][0]["sigmas"] > 3 and entry["bits"] > 0.6
    assert entry["bits_per_hour"] == pytest.approx(entry["bits"] / (entry["duration_s"] / 3600))
    near, _ = propose(found)  # no limits given: not beyond what was recorded, and there they look alike
    assert near["bits"] < 0.5 * entry["bits"] and near["also_helpful"]


HOT_END = HEATED_BLOCK.replace("heat: {unit: W}", "heat: {unit: W}, fan: {unit: '1'}").replace(
    "rate: G * (T - air)", "rate: (G + 0.15 * fan) * (T - air)"
)
HOT_TRUTH = HOT_END.replace(
    "flows: {",
    "flows: {missing: {from: T, rate: 1.07e-10 * ((T + 273.15)**4 - (air + 273.15)**4), unit: W}, ",
)


def printing():
    """A hot-end on its thermostat: full heat, then pulses about it, the fan on for half of the time."""
    t = np.arange(360) * 5.0
    heat = np.where((t > 30) & (t < 290), 60.0, np.where((t > 700) & (np.sin(t / 40) > 0.5), 60.0, 0.0))
    heat = np.where((t > 300) & (t < 700) & (np.sin(t / 25) > 0.3), 60.0, heat)
    return Table(
        "run_1", "run_1", t, {"heat": heat, "fan": np.where(t > 400, 1.0, 0.0), "air": np.full(len(t), 22.0)}
    )


def test_a_hot_end_is_not_heated_beyond_what_was_recorded(tmp_path):
    """Full heat at fan 0 would go on far beyond the hottest reading: neither as any hypothesis nor as the truth has it."""
    found = shared_by_two(HOT_END, HOT_TRUTH, printing())
    entry, chosen = propose(found)
    (p,) = entry["predicted"].values()
    top = float(found.case.tables[0].columns["T_block"].max())
    assert top > 200 and p["high"] <= top and p["recorded"][1] == pytest.approx(top)
    assert compile_plant(loads(HOT_TRUTH), ()).simulate(chosen.table(found.case.plant, 5.0)).y.max() <= top
    full = Table(
        "full",
        "full",
        np.arange(600) * 5.0,
        {"heat": np.full(600, 60.0), "fan": np.zeros(600), "air": np.full(600, 22.0)},
    )
    assert compile_plant(loads(HOT_TRUTH), ()).simulate(full).y.max() > top + 20, "the danger is there"
    experiment_file.write(tmp_path, found.case, entry, chosen)
    text = (tmp_path / "next_experiment.yaml").read_text()
    assert f"{p['high']:.4g} degC predicted (recorded" in text and "predicted (recorded" in peaks(entry)[0]
    (read,) = load_inputs(tmp_path / "next_experiment.yaml").values()
    assert read.predicted["T_block"] == pytest.approx((p["low"], p["high"]), rel=1e-4)


def test_an_experiment_that_would_leave_the_protection_is_refused(tmp_path, capsys):
    (tmp_path / "hot.yaml").write_text(
        "format: thermoctl-experiments/1\nexperiments:\n  hot:\n    title: hot\n    sample_s: 1\n    inputs:\n"
        "      setpoint_um: {corners: [[0, 0], [60, 200]]}\n    predicted:\n      coil_c: [22, 85]\n"
    )
    assert main(["experiment", str(tmp_path / "hot.yaml"), "--config", str(CONFIG)]) == 2
    assert "coil_c would reach 22 to 85" in capsys.readouterr().err


def test_distance_is_what_dense_algebra_says():
    rng = np.random.default_rng(2)
    a, b = ((rng.normal(size=(30, 2)), rng.normal(size=(30, 2, 3))) for _ in range(2))
    sigma = np.array([0.3, 0.7])
    stacked = [np.concatenate([q[0][:, 0], q[0][:, 1]]) for q in (a, b)]
    J = [np.concatenate([q[1][:, 0], q[1][:, 1]]) for q in (a, b)]
    covariance = np.diag(np.repeat(sigma**2, 30)) + J[0] @ J[0].T + J[1] @ J[1].T
    difference = stacked[0] - stacked[1]
    dense = difference @ np.linalg.solve(covariance, difference)
    assert distances([a, b], [[0, 1], [0, 1]], sigma)[0, 1] == pytest.approx(dense, rel=1e-9)


def test_bits_are_none_for_equals_and_one_for_two_that_differ():
    w = np.array([0.5, 0.5])
    assert bits(np.zeros((2, 2)), w) == pytest.approx(0)
    assert bits(np.array([[0, 1e4], [1e4, 0]]), w) == pytest.approx(1)


def test_decided_diagnoses_ask_for_nothing(undecided):
    both = list(undecided.posterior.hypotheses)
    again = (undecided.case, undecided.searched)
    assert propose(undecided_between(*again, both, "explained")) is None
    assert propose(undecided_between(*again, both[:1])) is None
    with pytest.raises(InputError, match="no such input or output"):
        propose(undecided, limits={"T_blok": (0, 1)})


def test_where_an_effect_is_likelier_than_none_an_experiment_tells_it_from_the_plant_as_it_is(undecided):
    radiation = next(k for k in undecided.posterior.hypotheses if ("radiation", "T") in k)
    perhaps = undecided_between(undecided.case, undecided.searched, [frozenset(), radiation], "consistent")
    perhaps.posterior.hypotheses |= {frozenset(): 0.3, radiation: 0.7}
    assert propose(perhaps) is None  # as likely as not
    perhaps.posterior.something = 0.7
    entry, _ = propose(perhaps, limits=LIMITS)
    assert [x["hypothesis"] for x in entry["separates"]] == ["the plant as it is"]
    assert entry["separates"][0]["from"] == "radiation at T" and entry["separates"][0]["sigmas"] > 3


def test_what_nothing_else_confirms_is_told_from_the_plant_as_it_is(undecided):
    radiation = next(k for k in undecided.posterior.hypotheses if ("radiation", "T") in k)
    refused = undecided_between(undecided.case, undecided.searched, [radiation], "unexplained")
    assert propose(refused, limits=LIMITS) is None  # one hypothesis, and no doubt
    refused.asked = dict.fromkeys(radiation, 0.6)
    entry, _ = propose(refused, limits=LIMITS)
    assert [x["hypothesis"] for x in entry["separates"]] == ["the plant as it is"] and entry["bits"] > 0.5


def test_what_is_written_is_read_by_the_experiment_command(undecided, tmp_path):
    found = undecided
    entry, chosen = propose(found, limits=LIMITS)
    experiment_file.write(tmp_path, found.case, entry, chosen)
    assert {p.name for p in tmp_path.iterdir()} == {"next_experiment.yaml", "next_experiment.csv"}
    (read,) = load_inputs(tmp_path / "next_experiment.yaml").values()
    assert read.corners["heat"] == pytest.approx(chosen.corners["heat"]) and read.assumed == {"air": 22.0}
    by_hand = read_table(tmp_path / "next_experiment.csv")
    assert set(by_hand.columns) == {"heat"}
    assert by_hand.columns["heat"] == pytest.approx(np.interp(by_hand.t, *chosen.corners["heat"].T), abs=1e-6)


def test_surroundings_are_not_driven_and_what_moves_together_is_one_lever():
    plant = loads("""format: thermoctl-plant/1
inputs: {v: {unit: V}, i: {unit: A}, air: {unit: degC}, sun: {unit: kW/m^2}, still: {unit: V}}
parameters: {C: {value: 40, range: [20, 80]}, A: {value: 1}, B: {value: 1}}
nodes: {T: {storage: C, initial: air}}
flows: {p: {into: T, rate: v * i + A * still * i + B * sun}}
outputs: {y: {value: T}}""")
    t = np.arange(100.0)
    i = np.abs(np.sin(t / 9))
    table = Table(
        "r", "r", t, {"v": 5 * i + 0.1, "i": i, "air": 20 + t / 50, "sun": i**2, "still": np.ones(100)}
    )
    (lever,) = levers(plant, [table])
    assert set(lever.moves) == {"v", "i"} and lever.moves["i"] == pytest.approx((0.2, -0.02))
    assert [q.name for q in levers(plant, [table], only=["sun"])] == ["sun"]
    with pytest.raises(InputError, match="not an input"):
        levers(plant, [table], only=["moon"])
    for word, corners in courses(lever, 60.0, 1.0).items():
        assert (
            corners[0, 0] == 0 and corners[-1, 0] == pytest.approx(60) and np.all(np.diff(corners[:, 0]) > 0)
        ), word
        assert corners[:, 1].min() >= lever.low - 1e-9 and corners[:, 1].max() <= lever.high + 1e-9, word
        speed = np.abs(np.diff(corners[:, 1]) / np.diff(corners[:, 0]))
        assert speed.max() <= lever.rate * (1 + 1e-9) + 1e-9, word


def test_on_the_programs_own_rig_the_setpoint_is_driven(tmp_path):
    plant = loads(HEATED_BLOCK.replace("heat: {unit: W}", "heat: {unit: W, column: power_w}"))
    t = np.arange(300.0)
    setpoint = 100 * (t // 50 % 3)
    table = Table(
        "r",
        "r",
        t,
        {
            "power_w": 0.01 * setpoint,
            "setpoint_um": setpoint,
            "air": np.full(300, 20.0),
            "T_block": 20 + t / 300,
        },
    )
    known = case(plant, [table], {}, Budget(1))
    chosen = Excitation("hold", 60.0, {"heat": np.array([[0, 0.0], [10, 1.5], [60, 1.5]])}, {"air": 20.0})
    experiment_file.write(
        tmp_path, known, {"why": "", "sample_s": 1.0, "predicted": {}, "limits": {}}, chosen
    )
    schedule = load_experiments(tmp_path / "next_experiment.yaml")["next_experiment"]
    assert schedule.setpoint_um == pytest.approx([0, 150, 150]) and schedule.commands() == [
        (0.0, "setpoint", pytest.approx(150.0))
    ]


@pytest.mark.parametrize(
    "last", [None, {"profile": "c", "bits": 0.004}], ids=["none", "none that is worth rig time"]
)
def test_rounds_end_when_nothing_is_left_to_ask(last, tmp_path):
    results = iter(
        [
            {"verdict": "ambiguous", "findings": [], "next_experiment": {"profile": "a", "bits": 0.5}},
            {"verdict": "ambiguous", "findings": [], "next_experiment": {"profile": "b", "bits": 0.1}},
            {"verdict": "explained", "findings": [], "next_experiment": last},
        ]
    )
    asked, ran = [], []
    end = resolve(
        lambda paths: asked.append(list(paths)) or next(results),
        ["run_1.csv"],
        tmp_path,
        lambda file, out: ran.append((file.name, out.name)),
        3,
        print,
    )
    assert ran == [("next_experiment.yaml", "round_1.csv"), ("next_experiment.yaml", "round_2.csv")]
    assert [len(p) for p in asked] == [1, 2, 3] and end["verdict"] == "explained"
    assert [r["experiment"] for r in json.loads((tmp_path / "diagnosis.json").read_text())["resolved"]] == [
        "a",
        "b",
    ]


@pytest.mark.slow
def test_two_explanations_that_look_alike_are_decided_by_the_proposed_experiment(tmp_path, capsys):
    """The whole way by the command line: ambiguous at 25 K; the rig in the experiment's place is simulated from the truth."""
    (tmp_path / "plant.yaml").write_text(HEATED_BLOCK)
    (tmp_path / "truth.yaml").write_text(TRUTH)
    write_table(tmp_path / "run_1.csv", compile_plant(loads(TRUTH), ()).measure(short_pulses(), seed=1))
    plant, run, out = (str(tmp_path / n) for n in ("plant.yaml", "run_1.csv", "out"))
    common = ["diagnose", "--plant", plant, run, "--out", out, "--limit", "T_block=15:110", "--json"]
    assert main([*common, "--quiet"]) == 0
    alone = json.loads(capsys.readouterr().out)
    names = {f["effect"] for f in alone["findings"]} | {a["effect"] for a in alone["alternatives"]}
    assert alone["verdict"] == "ambiguous" and {"radiation", "temperature_dependent_conductance"} <= names
    assert alone["next_experiment"] and "proposed experiment" in (tmp_path / "out/report.html").read_text()
    assert yaml.safe_load((tmp_path / "out/next_experiment.yaml").read_text())["experiments"]
    assert main([*common, "--resolve", "--rig", str(tmp_path / "truth.yaml")]) == 0
    told = json.loads((tmp_path / "out/diagnosis.json").read_text())
    assert (
        told["verdict"] == "explained" and told["next_experiment"] is None and 1 <= len(told["resolved"]) <= 3
    )
    (finding,) = told["findings"]
    assert (finding["effect"], finding["where"]) == ("radiation", "T") and finding["probability"] > 0.9
    (size,) = finding["parameters"].values()
    assert size["value"] == pytest.approx(2.5e-9, rel=0.1)
    assert not (tmp_path / "out/next_experiment.yaml").exists()
