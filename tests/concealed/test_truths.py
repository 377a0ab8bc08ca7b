"""The concealed rigs themselves: against other integrators and closed forms, and that their answers are sealed."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from tests.concealed import generate, rigs_motion, rigs_tanks, rigs_thermal, sensors, thermal
from tests.concealed.judge import Judge, beyond, snr
from tests.concealed.thermal import Network, Variant
from thermoctl.plant import load
from thermoctl.recording.files import read_table


def test_thermal_truth_agrees_with_radau_on_the_same_volumes():
    net = Network(
        {"a": "Ca", "b": "Cb"},
        {"link": ("G", "a", "b"), "loss": ("H", "b", "air")},
        {"power": ("a", "power")},
        cells=3,
        stiffness=20.0,
    )
    theta = {"Ca": 8.0, "Cb": 15.0, "G": 0.3, "H": 0.1}
    t = np.arange(0, 400.0, 2.0)
    air = 20 + 0.005 * t
    run = {"t": t, "air": air, "heat:power": np.where(t < 200, 4.0, 0.5)}
    effects = [("radiation", "b", {"E": 3e-10}), ("conductance_step", "link", {"A": -0.5, "T0": 300.0})]
    ours = thermal.simulate(net, theta, run, [Variant(effects=effects)])[0]

    inner = {"a": 20 * 0.3 * 3, "b": 20 * (0.3 + 0.1) * 3}

    def rate(now, x):
        a, b, c = x[:3], x[3:], np.interp(now, t, air)
        da, db = np.zeros(3), np.zeros(3)
        for v, d, g in ((a, da, inner["a"]), (b, db, inner["b"])):
            flow = g * np.diff(v)
            d[:2] += flow
            d[1:] -= flow
        g = 0.3 * (0.5 if now >= 300 else 1.0)
        da[0] -= g * (a[0] - b[0])
        db[0] += g * (a[0] - b[0]) - 0.1 * (b[0] - c) - 3e-10 * ((b[0] + 273.15) ** 4 - (c + 273.15) ** 4)
        da += (4.0 if now < 200 else 0.5) / 3
        return np.concatenate([da / (8 / 3), db / (15 / 3)])

    x, ours_at = np.full(6, 20.0), {0.0: 0}
    for begin, end in ((0, 200), (200, 300), (300, 398)):  # Radau from event to event
        found = solve_ivp(rate, (begin, end - 1e-9), x, method="Radau", rtol=1e-9, atol=1e-9)
        x = found.y[:, -1]
        k = end // 2
        assert ours[k, 0] == pytest.approx(x[:3].mean(), abs=2e-3)
        assert ours[k, 1] == pytest.approx(x[3:].mean(), abs=2e-3)
    assert ours_at is not None and ours[:, 0].max() > 30


def test_dry_friction_stops_where_the_closed_form_says_and_holds():
    n = 1001
    t = np.arange(n) * 0.002
    drive = np.where(t < 0.5, 1.0, 0.0)
    drive[t >= 1.5] = 0.2  # below what dry friction holds
    run = {"t": t, "drive": drive, "held": True, "air": np.zeros(n)}
    theta = {"gain": 10.0, "mass": 2.0, "damping": 0.0, "stiffness": 0.0}
    out = rigs_motion.simulate(theta, run, [Variant(effects=[("coulomb_friction", "velocity", {"F": 4.0})])])
    speed = (10 - 4) / 2 * 0.5  # reached at 0.5 s, then 4/2 m/s^2 of deceleration
    stop = 0.5 + speed / 2
    distance = 0.5 * 3 * 0.25 + speed**2 / (2 * 2)
    assert out["velocity"][0, 250] == pytest.approx(speed, rel=1e-9)
    assert out["position"][0, -1] == pytest.approx(distance, rel=1e-4)
    assert np.all(out["velocity"][0, t > stop + 0.002] == 0)


def test_damped_stage_follows_the_exponential():
    t = np.arange(500) * 0.01
    run = {"t": t, "drive": np.ones(500), "held": True, "air": np.zeros(500)}
    out = rigs_motion.simulate({"gain": 3.0, "mass": 0.5, "damping": 2.0, "stiffness": 0.0}, run, [Variant()])
    assert np.allclose(out["velocity"][0], 1.5 * (1 - np.exp(-4 * t)), atol=1e-9)


def test_a_delay_is_not_rounded_to_the_truths_steps():
    """A step of the held drive at 1 s, 13.7 ms late at samples of 10 ms: the exponential from 1.0137 s on."""
    t = np.arange(500) * 0.01
    run = {"t": t, "drive": np.where(t < 0.999, 0.0, 1.0), "held": True, "air": np.zeros(500)}
    theta = {"gain": 3.0, "mass": 0.5, "damping": 2.0, "stiffness": 0.0}
    out = rigs_motion.simulate(theta, run, [Variant(effects=[("actuator_delay", "motor", {"TD": 0.0137})])])
    exact = 1.5 * (1 - np.exp(-4 * np.maximum(t - 1.0137, 0.0)))
    assert np.allclose(out["velocity"][0], exact, atol=2e-5)


def test_tank_empties_by_torricelli():
    t = np.arange(0, 60.0, 3.0)
    run = {"t": t, "pump": np.zeros(20), "upper_start": np.full(20, 4.0), "lower_start": np.full(20, 1.0)}
    theta = {"k_pump": 0.05, "k_upper": 0.05, "k_lower": 0.06}
    levels = rigs_tanks._integrate(["upper", "lower"], theta, Variant(), run)
    assert np.allclose(np.sqrt(levels[:, 0]), 2 - 0.025 * t, atol=1e-6)


@pytest.mark.parametrize("family", ["heater", "drive"])
def test_nothing_missing_is_nothing(family, monkeypatch):
    """What the finite volumes leave after a refit of lumped bodies is under one sigma of the whole record."""
    rng = np.random.default_rng(5)
    scene = generate.FAMILIES[family].scene(rng, "designed", True)
    bench = generate.Bench(scene, rng)
    bench.measure([])
    lumped = thermal.simulate
    monkeypatch.setattr(
        rigs_thermal, "simulate", lambda net, *rest: lumped(dataclasses.replace(net, cells=1), *rest)
    )
    one_cell = [scene.outputs_of(k, [Variant()])[0] for k in range(2)]
    d = bench.judge.whiten([(a - b)[None] for a, b in zip(bench.base, one_cell, strict=True)])
    assert np.linalg.norm(d) > 1.0  # the models do differ
    assert snr(bench.judge.left_over(d))[0] < 1.0


@pytest.mark.parametrize("family", ["flexure", "stage"])
def test_the_step_of_a_motion_truth_is_fine_enough(family):
    """Twice as many substeps change less than one sigma of what a refit leaves."""
    rng = np.random.default_rng(3)
    scene = generate.FAMILIES[family].scene(rng, "designed", True)
    bench = generate.Bench(scene, rng)
    bench.measure([])
    for run in scene.runs:
        run["substeps"] = 2 * run.get("substeps", rigs_motion.SUBSTEPS)
    finer = [scene.outputs_of(k, [Variant()])[0] for k in range(2)]
    d = bench.judge.whiten([(a - b)[None] for a, b in zip(bench.base, finer, strict=True)])
    assert snr(bench.judge.left_over(d))[0] < 1.0


@pytest.mark.parametrize("family", ["flexure", "stage"])
def test_what_a_refit_leaves_does_not_hang_on_the_step_of_its_derivatives(family, monkeypatch):
    """Half the step, the same sigmas: the derivatives are those of a straight piece."""
    rng = np.random.default_rng
    found = []
    for step in (generate.STEP, generate.STEP / 2):
        monkeypatch.setattr(generate, "STEP", step)
        scene = generate.FAMILIES[family].scene(rng(1), "designed", True)
        bench = generate.Bench(scene, rng(1))
        bench.measure([next(s for s in scene.suspects if s.effect == "sensor_drift")])
        found.append(snr(bench.curve[0][2]))
    assert np.allclose(*found, rtol=0.05)


@pytest.mark.parametrize("family", ["tanks", "heater", "stage"])
def test_an_honest_refit_finds_parameters_wherever_they_are(family):
    """Where nothing is missing it leaves no more than the moved parameters themselves are worth.

    Four steps of Gauss and Newton left 1797 sigmas of a heater whose parameters were 1.4 quarters of a range off."""
    scene = generate.FAMILIES[family].scene(np.random.default_rng(7), "designed", True)
    bench = generate.Bench(scene, np.random.default_rng(7))
    bench.measure([])
    free = len(bench.derivatives)
    ends = [[(r[i] - scene.theta[p]) * 4 / (r[1] - r[0]) for p, r in scene.ranges.items()] for i in (0, 1)]
    for seed in range(2):
        moved = np.random.default_rng(seed).uniform(0.7 * np.array(ends[0]), 0.7 * np.array(ends[1]))
        moved = np.append(moved, np.zeros(free - len(moved)))
        left = bench.refit(bench.tangents(moved)[0])
        assert snr(left) < np.linalg.norm(moved) + 0.05


@pytest.mark.parametrize("family", ["tanks", "heater"])
def test_an_honest_refit_leaves_what_least_squares_leave_without_its_slopes(family):
    """Of a large effect and moved parameters: the same sigmas as with derivatives by scipy's own differences."""
    scene = generate.FAMILIES[family].scene(np.random.default_rng(7), "designed", True)
    bench = generate.Bench(scene, np.random.default_rng(7))
    bench.measure([])
    free, n = len(bench.derivatives), len(scene.ranges)
    s = next(x for x in scene.suspects if x.effect in ("orifice_exponent", "radiation"))
    readings = bench.readings([(s.effect, s.where, s.make(s.top))])

    def residual(x):
        return np.append(bench.off(readings, bench.tangents(x)[0]), x)

    walls = [
        np.array(
            [(r[i] - scene.theta[p]) * 4 / (r[1] - r[0]) for p, r in scene.ranges.items()]
            + [e * np.inf] * (free - n)
        )
        for i, e in ((0, -1), (1, 1))
    ]
    peer = least_squares(residual, np.zeros(free), bounds=walls, diff_step=1e-4, xtol=1e-6)
    assert snr(bench.refit(readings)) == pytest.approx(np.sqrt(2 * peer.cost), rel=0.05)


def test_size_is_what_a_refit_leaves_in_sigmas():
    n, sd = 400, 0.5
    t = np.arange(n)
    judge = Judge([np.full((n, 1), sd**2)])
    along, across = np.sin(2 * np.pi * t / n), np.cos(2 * np.pi * t / n)
    judge.set_parameters(judge.whiten([1e3 * along[None, :, None]]))
    left = judge.left_over(judge.whiten([np.stack([along, across, along + across])[:, :, None]]))
    assert snr(left)[0] < 0.01
    assert snr(left)[1] == pytest.approx(np.sqrt(n / 2) / sd)
    assert snr(left)[2] == pytest.approx(np.sqrt(n / 2) / sd, rel=1e-4)
    assert beyond(left[2], left[1:2]) < 0.01


def test_what_a_test_that_learns_the_noise_is_left_with_is_its_mean_likelihood_ratio():
    """Against draws: the best noise with the signal and without it, each by Nelder and Mead's method."""
    from scipy.optimize import minimize

    rng, n, noise = np.random.default_rng(4), 300, sensors.Noise(white=0.8, ar=0.6, rho=0.8)
    w, spectrum = np.pi * np.arange(n) / n, noise.spectrum(n)
    judge = Judge([spectrum[:, None]])
    course = judge.whiten(
        [np.interp(np.arange(n), np.linspace(0, n, 6), [0, 1, 0.2, 0.9, 0.1, 1])[None, :, None]]
    )[0]
    course *= 8 / np.linalg.norm(course)

    def least(power: np.ndarray) -> float:
        def minus(x: np.ndarray) -> float:
            white, ar, flicker = np.exp(np.clip(x[:3], -9, 6))
            rho = 1 / (1 + np.exp(-x[3]))
            s = white + ar * (1 - rho**2) / (1 - 2 * rho * np.cos(w) + rho**2)
            s[1:] += flicker * n / np.arange(1, n) / (1 / np.arange(1, n)).sum()
            return float(np.sum(np.log(s) + power / s))

        starts = [[-0.5, -1.0, -4.0, 1.0], [-0.5, -1.0, -2.0, 3.0]]
        return min(minimize(minus, x, method="Nelder-Mead", options={"maxiter": 1500}).fun for x in starts)

    ratios = []
    for _ in range(24):
        z = rng.standard_normal(n)
        ratios.append(least(spectrum * (z + course) ** 2) - least(spectrum * z**2))
    told = judge.learnt(np.append(course, 0.0))
    assert 3 < told < 5  # of 8 sigmas
    assert told == pytest.approx(np.sqrt(np.mean(ratios)), abs=3 * np.std(ratios) / np.sqrt(24) / (2 * told))


def test_noise_has_the_spectrum_that_it_tells():
    from scipy.fft import dct

    rng = np.random.default_rng(0)
    noise = sensors.Noise(white=0.5, ar=0.8, rho=0.7, flicker=0.3)
    n = 512
    drawn = np.stack([noise.draw(n, rng) for _ in range(2000)])
    power = np.mean(dct(drawn, axis=1, norm="ortho") ** 2, axis=0)
    ratio = power / noise.spectrum(n)
    assert np.abs(ratio[1:].mean() - 1) < 0.01
    assert np.all(np.abs(ratio[2:] - 1) < 0.25)
    assert drawn.var() == pytest.approx(0.25 + 0.64 + 0.09, rel=0.03)


def test_lag_is_the_exact_response_to_a_ramp():
    t = np.cumsum(np.random.default_rng(1).uniform(0.1, 3, 50))
    t -= t[0]
    assert np.allclose(sensors.lag(t, 2 * t, 4.0), 2 * (t - 4 * (1 - np.exp(-t / 4))))


def test_a_case_is_a_function_of_seed_and_number():
    one, other = (generate.make_case(11, 4, ["tanks"], True) for _ in range(2))
    different = generate.make_case(12, 4, ["tanks"], True)
    assert one[2] == other[2] and one[0] == other[0]
    for a, b in zip(one[1][0], other[1][0], strict=True):
        assert a[0] == b[0] and np.array_equal(a[1], b[1], equal_nan=True)
    assert one[2]["true_parameters"] != different[2]["true_parameters"]


def test_the_generator_knows_nothing_of_the_product():
    code = "import sys, tests.concealed.generate; print([m for m in sys.modules if m.split('.')[0] in ('thermoctl','thermoctl_hal')])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_cases_are_in_the_public_formats_and_answers_are_sealed(tmp_path):
    """One case of every family: the plant loads, its inputs and outputs are columns, no answer lies beside it."""
    argv = ["--out", str(tmp_path / "cases"), "--number", "6", "--seed", "3", "--smoke", "--kind", "none"]
    assert generate.main(argv) == 0
    seen = set()
    for n in range(1, 7):
        folder = tmp_path / "cases" / f"{n:04d}"
        assert sorted(f.name for f in folder.iterdir()) == ["plant.yaml", "run_1.csv", "run_2.csv"]
        plant = load(folder / "plant.yaml")
        for run in ("run_1.csv", "run_2.csv"):
            columns = read_table(folder / run).columns
            assert {x.column for x in plant.inputs.values()} <= set(columns)
            assert {x.column for x in plant.outputs.values()} <= set(columns)
        answer = yaml.safe_load((tmp_path / "cases_answers" / f"{n:04d}.yaml").read_text())
        seen.add(answer["family"])
        for name, value in answer["true_parameters"].items():
            if name in plant.parameters and plant.parameters[name].range is not None:
                low, high = plant.parameters[name].range
                assert low < value < high and value != plant.parameters[name].value
    assert seen == set(generate.FAMILIES)
    for line in (tmp_path / "cases_answers" / "manifest.sha256").read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256((tmp_path / "cases_answers" / name).read_bytes()).hexdigest() == digest


def test_what_is_concealed_is_what_the_plan_says_and_as_large():
    """The first single effects of a set: the effect that was asked for, on a rig that holds it, in its band of sigmas."""
    low_high = {"large": (15, 240), "middle": (6, 15), "small": (3, 6)}
    families = ["heater", "tanks"]
    for slot in generate.plan(21, 2, families, "one"):
        answer = generate.make_case(21, slot.number, families, True, "one")[2]
        low, high = low_high[slot.band]
        assert low <= answer["snr"][0] <= high and answer["band"] == slot.band
        assert answer["effects"][0][0] == slot.effect and answer["family"] in generate.holders()[slot.effect]


def test_a_fixed_effect_gets_its_size_from_the_drive():
    """Copper's coefficient is what it is: the current decides how much of it is seen."""
    rigs = generate.FAMILIES["drive"]
    rng = np.random.default_rng
    full, weak = (rigs.scene(rng(4), "designed", True, v) for v in (1.0, 0.25))
    assert weak.runs[0]["current"].max() == pytest.approx(0.25 * full.runs[0]["current"].max(), rel=1e-3)
    slot = next(
        s
        for s in generate.plan(3, 144, ["drive"], "one")
        if s.effect == "resistance_temperature" and s.band == "middle"
    )
    answer = generate.make_case(3, slot.number, ["drive"], True, "one")[2]
    assert (
        answer["effects"] == [["resistance_temperature", "winding_voltage"]] and 6 <= answer["snr"][0] <= 15
    )
    assert answer["parameters"] == [{"ALPHA": 0.00393}]


def test_a_set_of_600_holds_every_effect_in_every_size_and_150_of_nothing():
    slots = generate.plan(7, 600)
    count = Counter(s.kind for s in slots)
    assert count == {"one": 360, "none": 150, "unknown": 45, "pair": 30, "cancel": 15}
    sizes = Counter((s.effect, s.band) for s in slots if s.kind == "one")
    catalogue = {f.stem for f in (Path(__file__).parents[2] / "config" / "effects").glob("*.yaml")}
    catalogue -= {"sensor_advance"}  # a fault of the recording: a form of every case (tests/truth/forms.py)
    catalogue -= {"other_value"}  # no physics that is left out (tests/diagnose/test_other_value.py)
    assert {e for e, _ in sizes} == catalogue  # every other effect that the catalogue publishes
    assert all(sizes[e, b] >= 2 for e in catalogue for b in ("small", "middle", "large"))
    for kind in ("one", "none"):
        held = Counter((s.family, s.schedule) for s in slots if s.kind == kind)
        assert len(held) == 18 and min(held.values()) >= 4  # 6 families x 3 schedules
    assert generate.plan(7, 600) == slots and generate.plan(8, 600) != slots
    assert generate.plan(7, 40) == slots[:40]  # a part of a set is the beginning of it


def test_the_listing_counts_what_was_planned_and_made(tmp_path, capsys):
    argv = f"--out {tmp_path / 'c'} --seed 3 --smoke --kind none --families tanks,heater".split()
    generate.main([*argv, "--number", "2"])
    capsys.readouterr()
    generate.main([*argv, "--number", "4", "--list"])
    text = capsys.readouterr().out
    assert text.startswith("4 cases planned, 2 made")
    assert re.search(r"^all +4/2", text, re.M)
    slots = generate.plan(3, 2, ["tanks", "heater"], "none")
    for s in slots:
        assert re.search(rf"^{s.family}, {s.schedule} +[12]/1", text, re.M)


def test_parameters_are_told_by_the_names_that_the_catalogue_publishes():
    """What a diagnosis reports can be compared with the truth: each name of an answer is one of the catalogue's."""
    for family in generate.FAMILIES.values():
        for s in family.scene(np.random.default_rng(1), "designed", True).suspects:
            entry = yaml.safe_load(
                (Path(__file__).parents[2] / f"config/effects/{s.effect}.yaml").read_text()
            )
            assert set(generate.published(s.effect, s.make(1.0))) <= set(entry["parameters"]), s.effect
