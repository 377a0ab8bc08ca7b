"""ISO 230-2, experiments as data, and the chain on a rig."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.reproduction import closed_loop, paper, rigs
from thermoctl import plant
from thermoctl.calibration import chain, iso230
from thermoctl.calibration.recorded import Recorded
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import experiments
from thermoctl.identify.statespace import StateSpace
from thermoctl.report.page import page, table

ROOT = Path(__file__).parents[2]


def test_iso230_by_hand():
    d = iso230.unidirectional(np.array([0, 0, 0, 10, 10.0]), np.array([1, 2, 3, -1, 1.0]))
    assert np.allclose(d.mean, [2, 0]) and np.allclose(d.s, [1, np.sqrt(2)])
    with pytest.raises(InputError, match="two approaches"):
        iso230.unidirectional(np.array([0.0]), np.array([1.0]))


def test_approaches_are_found_with_their_direction():
    s = np.array([0, 0, 1, 2, 2, 2, 2, 1, 0, 0, 0, 0.0])
    assert [(t, d) for _, t, d in iso230.approaches(s, 1)][-2:] == [(2.0, 1), (0.0, -1)]


def test_schedules_of_the_paper():
    tests = experiments.load_experiments(ROOT / "config" / "experiments.yaml")
    assert tests["test_4a"].duration_s + tests["test_4b"].duration_s == pytest.approx(5 * 3600)
    b = tests["test_4b"]
    up = [t for t, _, v in b.commands() if v == 250]
    assert len(up) == 96 and np.allclose(np.diff(up[:32]), 75, atol=0.1)
    rate = np.abs(np.diff(b.setpoint_um) / np.diff(b.t_s))
    assert rate.max() <= 1000 / 60 * 1.001
    t = np.arange(0, tests["test_2"].duration_s)
    assert experiments.share_below(t, tests["test_2"].at(t) ** 2, 4.3e-4) > 0.8


def test_designed_pulses_beat_equal_ones():
    widths, gaps = experiments.design_pulses(3, 8400, 4.3e-4, 600)
    assert sum(widths) + sum(gaps) == pytest.approx(8400) and min(widths + gaps) >= 600

    def share(w, g):
        t = np.arange(15000.0)
        u, at = np.zeros(15000), 0.0
        for a, b in zip(w, g, strict=True):
            u[(t >= at) & (t < at + a)] = 1
            at += a + b
        return experiments.share_below(t, u, 4.3e-4)

    assert share(widths, gaps) > share([600, 600, 600], [2200, 2200, 2200])


@pytest.mark.parametrize(
    "text, message",
    [
        ("format: x", "missing|expected"),
        (
            "format: thermoctl-experiments/1\nrate_um_s: 1\nexperiments:\n  a: {title: t, parts: [{hold: [[1]]}]}",
            ":4:.*seconds",
        ),
        (
            "format: thermoctl-experiments/1\nrate_um_s: 1\nexperiments:\n  a: {title: t, parts: [{hald: [[1, 2]]}]}",
            ":4:.*one of",
        ),
    ],
)
def test_bad_experiments(tmp_path, text, message):
    path = tmp_path / "e.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        experiments.load_experiments(path)


def test_the_papers_model_is_exact_without_noise():
    """A rich input and hardly any noise: N4SID with (26) finds three poles, four outputs and B."""
    rng = np.random.default_rng(0)
    p = np.exp(-1 / np.array([20.0, 150.0, 900.0]))
    truth = StateSpace(np.diag(p), (1 - p)[:, None], rng.uniform(0.3, 2, (4, 3)), 1.0, np.zeros(3))
    u = rng.standard_normal((4000, 1))
    y = truth.simulate(u)
    m = paper.n4sid(u, y + 1e-6 * rng.standard_normal(y.shape), 1.0, 3, 10)
    assert np.abs(m.simulate(u) - y).max() < 0.01 * np.abs(y).max()


@pytest.fixture(scope="module")
def proof():
    tests = experiments.load_experiments(ROOT / "config" / "experiments.yaml")
    rig = rigs.ProvingRig(
        plant.load(ROOT / "config" / "plants" / "actuator_truth.yaml"), 2, None, rigs.PAPER_SCALE
    )
    run4 = rigs.joined(tests["test_4a"], tests["test_4b"], "test_4")
    r2, r3, r4 = rig.run(tests["test_2"], 1), rig.run(tests["test_3"], 2), rig.run(run4, 4)
    r4a = Recorded(*(getattr(r4, f.name)[:7200] for f in dataclasses.fields(Recorded)))
    return rig, run4, r4, paper.calibrate(r2, r3, r4a)


@pytest.mark.slow
def test_the_better_method_beats_the_papers_and_the_coil_alone(proof):
    rig, run4, r4, c = proof
    left = {k: iso230.mean_and_two_s((r4.true_um - v)[7200:])[1] for k, v in paper.estimates(c, r4).items()}
    bound = iso230.mean_and_two_s((r4.true_um - rig.bayes(run4, 4, r4))[7200:])[1]
    assert left["better"] < 0.6 * left["paper"] and left["better"] < 0.2 * left["siso"]
    assert bound < left["better"] < 6 * bound


@pytest.mark.slow
def test_compensators_for_the_daemon_follow_the_estimators(proof):
    """The law's form at 0.1 s, stepped plainly, gives what the filter at 1 s gives."""
    _, _, r4, c = proof
    m = chain.compensator(c.kalman, c.better_um, period_s=0.1)
    n = 1800
    x = np.zeros(len(m.A_minus_I))
    rate, coil = chain.air_rate(r4.air_c), chain.rises(r4)[:, 0]
    out = np.empty((n, 12))
    for k in range(n):
        for j in range(10):
            x = x + m.gain[:, 0] * (coil[k] - m.C[0] @ x)
            if j == 0:
                out[k] = m.C @ x
            x = x + m.A_minus_I @ x + m.B @ [r4.power_w[k], rate[k]]
    wanted = chain.run_kalman(c.kalman, r4)[:n]
    assert np.sqrt(np.mean((out - wanted) ** 2)) < 0.15
    assert paper.compensator(c, "paper").kind == "mkf"


def test_the_full_runs_truth_is_found_from_any_folder(tmp_path, monkeypatch):
    """Settings read a relative path from their own folder; the truth is written beside the report."""
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    written = closed_loop.scaled_truth(
        ROOT / "config" / "plants" / "actuator_truth.yaml", Path("out") / "truth.yaml"
    )
    assert written.is_absolute() and written.is_file()
    was, now = (
        plant.load(p).parameters["a_bracket_1"].value
        for p in (ROOT / "config" / "plants" / "actuator_truth.yaml", written)
    )
    assert now == pytest.approx(rigs.PAPER_SCALE["a_bracket_1"] * was)


def test_page_is_self_contained():
    text = page("A <b>", [("One", table(["x", "y"], [["<i>", 1.23456], [None, 2]]))], "note")
    assert (
        "<b>" not in text
        and "&lt;i&gt;" in text
        and "1.235" in text
        and "src=" not in text
        and "http" not in text
    )
