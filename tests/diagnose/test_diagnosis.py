"""Diagnoses of rigs whose truth this file simulates itself (scipy, no plant code), judged from outside by what is written."""

import json
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, dlsim, lsim

from tests.plants import FREE_CARRIAGE, SPRING_STAGE, TANK, TWO_BLOCKS
from thermoctl.cli import main
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import Placed, fitted
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.report.explain import why
from thermoctl.diagnosis.report.notes import doubts
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table

LEVELS = (0.0, 2.5, 0.8, 0.0, 1.6, 3.0, 0.0, 2.0)


def heater(
    folder,
    extra=lambda t, x, air: (0.0, 0.0),
    seeds=(1, 2),
    sensor=lambda t, y: y,
    start=0.0,
    heavier=lambda x: 1.0,
):
    """Two recordings of a two-block heater that has `extra` watts into its blocks, begins `start` above the air and whose first
    block's capacity is multiplied by `heavier(temperature)`; returns the plant's and their paths."""
    (folder / "plant.yaml").write_text(TWO_BLOCKS)
    paths = [folder / "plant.yaml"]
    c, g, g12 = (5.2, 7.1), (0.062, 0.043), 0.026
    t = np.arange(0.0, 1600.0, 2.0)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        heat = np.array(rng.permutation(LEVELS))[(t // 200).astype(int)]
        air = 21.5 + 0.4 * np.sin(t / 700 + seed)
        x = np.empty((len(t), 2))
        x[0] = air[0] + start

        def slope(s, q, watts, a):
            e = extra(s, q, a)
            flow = g12 * (q[0] - q[1])
            first = (watts - flow - g[0] * (q[0] - a) + e[0]) / c[0] / heavier(q[0])
            return np.array([first, (flow - g[1] * (q[1] - a) + e[1]) / c[1]])

        for k, (now, h) in enumerate(zip(t, np.diff(t), strict=False)):  # Runge-Kutta, steps far below 80 s
            half, end = now + h / 2, now + h * (1 - 1e-9)  # what begins with the next row is not in this one
            a = air[k], (air[k] + air[k + 1]) / 2, air[k + 1]
            r1 = slope(now, x[k], heat[k], a[0])
            r2 = slope(half, x[k] + h / 2 * r1, heat[k], a[1])
            r3 = slope(half, x[k] + h / 2 * r2, heat[k], a[1])
            x[k + 1] = x[k] + h / 6 * (r1 + 2 * r2 + 2 * r3 + slope(end, x[k] + h * r3, heat[k], a[2]))
        y = sensor(t, x) + rng.normal(0, 0.1, x.shape)
        path = folder / f"run_{seed}.csv"
        write(
            path,
            "t,heat,air_temperature,temperature_1,temperature_2",
            np.column_stack([t, heat, air, y]),
            "%.7g",
        )
        paths.append(path)
    return paths


def write(path, names, rows, digits="%.9g"):
    np.savetxt(path, rows, delimiter=",", comments="", fmt=digits, header=names)


def diagnosed(paths, out):
    """The command's result."""
    assert main(["diagnose", "--plant", str(paths[0]), *map(str, paths[1:]), "--out", str(out)]) == 0
    return json.loads((out / "diagnosis.json").read_text())


def test_nothing_missing_is_said_with_what_would_have_been_seen(tmp_path):
    r = diagnosed(heater(tmp_path), tmp_path / "out")
    assert r["verdict"] == "consistent" and r["findings"] == r["mismatch"] == [] and r["remainder"] is None
    smallest = {(e["effect"], e["where"]): e["smallest"] for e in r["not_seen"]}
    assert smallest and all(size > 0 for size in smallest.values())


def test_natural_convection_is_named_placed_and_worth_it_on_unseen_data(tmp_path):
    r = diagnosed(
        heater(tmp_path, lambda t, x, a: (-0.02 * (x[0] - a) * abs(x[0] - a) ** 0.25, 0.0)), tmp_path / "out"
    )
    named = {(f["effect"], f["where"]) for f in r["findings"]} | {
        (a["effect"], a["where"]) for a in r["alternatives"]
    }
    assert ("natural_convection", "one") in named and r["verdict"] in ("explained", "ambiguous")
    fit = r["fit"]
    assert fit["held_out_after"]["temperature_1"] < 0.115 < fit["held_out_refit_only"]["temperature_1"]
    # The extended plant runs in the simulator and gives the error that was reported.
    plant = load(tmp_path / "out" / "plant.yaml")
    model = compile_plant(plant)
    errors = np.concatenate(
        [
            read_table(tmp_path / f"run_{s}.csv").columns["temperature_1"]
            - model.simulate(read_table(tmp_path / f"run_{s}.csv")).y[:, 0]
            for s in (1, 2)
        ]
    )
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(fit["after"]["temperature_1"], rel=0.1)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "natural" in page.lower() and not re.search(r"(src|href)=.?https?://", page)


@pytest.mark.parametrize("stays", [True, False])
def test_a_joint_that_loosens_in_one_recording_is_found_there(tmp_path, stays):
    """At the same time of every recording nothing happens: it was unexplained. The third recording is set aside."""

    def opened(since):
        return lambda t, x, a: (-0.03 * (x[0] - a) * (t >= since), 0.0)

    heater(tmp_path, seeds=(1,))
    heater(tmp_path, opened(700), seeds=(2,))
    paths = [
        *heater(tmp_path, opened(0 if stays else np.inf), seeds=(3,))[:1],
        *sorted(tmp_path.glob("run_*.csv")),
    ]
    r = diagnosed(paths, tmp_path / "out")
    (finding,) = r["findings"]
    assert (finding["effect"], finding["where"], r["verdict"]) == ("conductance_step", "loss_1", "explained")
    assert finding["recording"] == "run_2" and finding["when"][0][0] == pytest.approx(700, abs=20)
    assert any(p["value"] == pytest.approx(0.03 / 0.062, rel=0.1) for p in finding["parameters"].values())


def test_a_reading_that_jumps_in_one_of_two_recordings_is_found_there(tmp_path):
    paths = heater(tmp_path)
    rows = paths[1].read_text().splitlines()
    k = rows[0].split(",").index("temperature_1")
    for n, row in enumerate(rows[1:], 1):
        cells = row.split(",")
        cells[k] = str(float(cells[k]) + 0.8 * (float(cells[0]) >= 611))
        rows[n] = ",".join(cells)
    paths[1].write_text("\n".join(rows) + "\n")
    r = diagnosed(paths, tmp_path / "out")
    (finding,) = r["findings"]
    assert (finding["effect"], finding["where"]) == ("sensor_offset_step", "temperature_1")
    assert (finding["recording"], finding["lasts"]) == ("run_1", False)
    assert finding["when"][0][0] == pytest.approx(611, abs=10)


def test_a_drift_of_two_recordings_is_confirmed_by_each_from_the_other(tmp_path):
    """Their errors are twice the noise that the plant file states: "nothing else confirms it" was said."""
    paths = heater(tmp_path, sensor=lambda t, y: y + [0.0, 6e-4] * t[:, None])
    paths[0].write_text(TWO_BLOCKS.replace("noise: 0.1", "noise: 0.05"))
    r = diagnosed(paths, tmp_path / "out")
    (finding,) = r["findings"]
    assert (finding["effect"], finding["where"]) == ("sensor_drift", "temperature_2")
    (slope,) = finding["parameters"].values()
    assert slope["value"] == pytest.approx(6e-4, rel=0.1) and finding["confirmed"] > 0.9


def test_heat_from_outside_is_found_with_its_interval(tmp_path):
    r = diagnosed(heater(tmp_path, lambda t, x, a: (0.0, 0.3 * (500 <= t < 900))), tmp_path / "out")
    (finding,) = r["findings"]
    assert (finding["effect"], finding["where"], r["verdict"]) == ("external_heat_source", "two", "explained")
    assert finding["when"][0] == pytest.approx([500, 900], abs=15)
    value = next(p for n, p in finding["parameters"].items() if n.startswith("Q"))
    assert abs(value["value"] - 0.3) < max(4 * value["sd"], 0.01)
    extended = load(tmp_path / "out" / "plant.yaml").parameters
    assert all(
        extended[n].value == pytest.approx(p["value"], rel=1e-9) for n, p in finding["parameters"].items()
    )
    assert "range: [" in (tmp_path / "out" / "plant.yaml").read_text(), "short lists stand on one line"


def test_an_offset_begins_at_its_sample_and_says_how_surely(tmp_path):
    def sensor(t, y):
        return y + np.column_stack([0 * t, 0.3 * (t >= 777.0)])

    r = diagnosed(heater(tmp_path, sensor=sensor), tmp_path / "out")
    (finding,) = r["findings"]
    assert (finding["effect"], finding["where"], r["verdict"]) == (
        "sensor_offset_step",
        "temperature_2",
        "explained",
    )
    found = {n.split("_")[0]: p for n, p in finding["parameters"].items()}
    assert found["T0"]["value"] == pytest.approx(777.0, abs=6.0)  # three samples: steps of 3 sigma in noise
    assert 0.3 < found["T0"]["sd"] < 6.0 and abs(found["T0"]["value"] - 777.0) < 3 * found["T0"]["sd"]
    assert abs(found["A"]["value"] - 0.3) < 3 * found["A"]["sd"]


def test_a_lag_begins_where_what_it_follows_begins(tmp_path):
    """The blocks begin 0.7 K off the air: what is read of them late begins there, too, and is no delay instead."""

    def sensor(t, y):
        late, keep = y.copy(), np.exp(-2.0 / 6.0)
        for k in range(1, len(t)):  # exact for straight lines between samples
            slope = (y[k, 0] - y[k - 1, 0]) / 2.0
            late[k, 0] = y[k, 0] - slope * 6.0 + (late[k - 1, 0] - y[k - 1, 0] + slope * 6.0) * keep
        return late

    r = diagnosed(heater(tmp_path, sensor=sensor, start=0.7), tmp_path / "out")
    assert (r["findings"][0]["effect"], r["findings"][0]["where"]) == ("sensor_lag", "temperature_1")
    (tau,) = r["findings"][0]["parameters"].values()
    assert abs(tau["value"] - 6.0) < 3 * tau["sd"] < 2.0


def test_a_delay_of_very_many_samples_is_found(tmp_path):
    """The screening sees a short one: parameters of the plant take up most of it, and stand far off until it is there."""

    def late(t, x):
        return np.column_stack([x[:, 0], np.interp(t - 70.0, t, x[:, 1])])

    r = diagnosed(heater(tmp_path, sensor=late), tmp_path / "out")
    assert [(f["effect"], f["where"]) for f in r["findings"]] == [("sensor_delay", "temperature_2")]
    assert r["findings"][0]["parameters"]["TD_sensor_delay_temperature_2"]["value"] == pytest.approx(
        70, rel=0.05
    )


def test_the_lag_of_what_holds_goes_on_straight_lines_in_one_form(tmp_path):
    """A voltage over a resistance, read 0.2 s late, sampled every 2 s: held, the reading would be a whole sample late."""
    _, run, _ = heater(tmp_path)
    (tmp_path / "plant.yaml").write_text(
        TWO_BLOCKS.replace("outputs:", "outputs:\n  voltage: {value: 3 * heat, unit: V, noise: 0.02}")
    )
    rows = np.loadtxt(run, delimiter=",", skiprows=1)
    write(
        run,
        "t,heat,air_temperature,temperature_1,temperature_2,voltage",
        np.column_stack([rows, 3 * rows[:, 1]]),
    )
    plant, table = load(tmp_path / "plant.yaml"), read_table(run)
    drive = compile_plant(plant).excitation(table)
    lags = [
        c
        for c in candidates(Rig(plant, [drive], [table.columns]), {"sensor_lag": catalogue()["sensor_lag"]})
        if c.place.where == "voltage"
    ]
    held, straight = (compile_plant(c.extend({"TAU": 0.2})).simulate(table).y[:, 0] for c in lags)
    u, t = 3 * rows[:, 1], rows[:, 0]
    line = lsim(([1.0], [0.2, 1.0]), u, t, interp=True)[1] + u[0] * np.exp(-t / 0.2)
    stair = lsim(([1.0], [0.2, 1.0]), u, t, interp=False)[1] + u[0] * np.exp(-t / 0.2)
    assert np.allclose(straight, line, atol=1e-4 * np.ptp(u)) and np.allclose(
        held, stair, atol=1e-4 * np.ptp(u)
    )
    assert np.abs(straight - held).max() > 0.5 * np.abs(np.diff(u)).max()
    # Where what is read is a node, there is one form.
    assert (
        len(
            [
                c
                for c in candidates(
                    Rig(plant, [drive], [table.columns]), {"sensor_lag": catalogue()["sensor_lag"]}
                )
                if c.place.where == "temperature_1"
            ]
        )
        == 1
    )


def swept_stage(folder, read):
    """Two recordings of a stage on springs that is swept slowly; `read`: of its position in m, with noise."""
    t = np.arange(0.0, 20.0, 0.005)
    paths = [folder / "plant.yaml"]
    A, B = np.array([[-33 / 1.3, -640 / 1.3], [1, 0]]), np.array([[1 / 1.3], [0]])
    *stage, h = cont2discrete((A, B, np.array([[0, 1]]), np.zeros((1, 1))), 0.005)
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        force = np.interp(t, np.arange(0, 21, 1.0), rng.uniform(-10, 10, 21))
        x = dlsim((*stage, h), force)[1][:, 0]
        y = read(x, rng.normal(0, 2e-6, len(t)))
        paths.append(folder / f"run_{seed}.csv")
        write(paths[-1], "t,force,encoder", np.column_stack([t, force, y]))
    return paths


@pytest.mark.parametrize(("period", "size", "rows"), [(0.25e-3, 3e-6, 6000), (0.06e-3, 0.3e-6, 500)])
def test_a_cyclic_error_of_a_period_far_below_the_travel_is_found(tmp_path, monkeypatch, period, size, rows):
    """The shorter one passes more than once in a sample, and 8 samples are summed in a row of the screening."""
    monkeypatch.setattr("thermoctl.diagnosis.search.metric.ROWS", rows)
    (tmp_path / "plant.yaml").write_text(SPRING_STAGE)
    paths = swept_stage(tmp_path, lambda x, noise: x + size * np.sin(2 * np.pi * x / period + 0.7) + noise)
    r = diagnosed(paths, tmp_path / "out")
    assert r["verdict"] == "explained" and [(f["effect"], f["where"]) for f in r["findings"]] == [
        ("cyclic_error", "encoder")
    ]
    found = {k.split("_")[0]: v["value"] for k, v in r["findings"][0]["parameters"].items()}
    assert found["P"] == pytest.approx(period, rel=1e-3) and abs(found["A"]) == pytest.approx(size, rel=0.1)


@pytest.mark.parametrize("stated", [True, False])
def test_the_steps_of_an_encoder_are_no_cyclic_error(tmp_path, stated):
    """A rounded reading errs with the period of its step, however long the recording makes that certain."""
    step = 8e-6
    noise = f"noise: 2e-6, resolution: {step}" if stated else f"noise: {np.hypot(2e-6, step / 12**0.5)}"
    (tmp_path / "plant.yaml").write_text(re.sub(r"noise: 2e-6\b[^}]*", noise, SPRING_STAGE))
    paths = swept_stage(tmp_path, lambda x, noise: step * np.round((x + noise) / step))
    r = diagnosed(paths, tmp_path / "out")
    assert r["verdict"] == "consistent" and not r["findings"]


def test_dry_friction_that_sticks_is_no_load(tmp_path):
    """A stage on springs comes to rest up to a micrometre beside where it would, and stays there: half a sensor's noise."""
    (tmp_path / "plant.yaml").write_text(SPRING_STAGE)
    paths, h, m, k, b, dry = [tmp_path / "plant.yaml", tmp_path / "run.csv"], 1e-4, 1.3, 640.0, 12.0, 8e-4
    rng = np.random.default_rng(1)
    step = np.arange(300_000)
    force = np.where(step % 30_000 < 10_000, rng.uniform(2, 8, 10)[step // 30_000], 0.0)
    x, v, seen = 0.0, 0.0, np.empty(len(step))
    for i, f in enumerate(force):  # Strang splitting, friction as the set-valued law that it is
        seen[i] = x
        x += h / 2 * v
        v = (v * (1 - h * b / m / 2) + h * (f - k * x) / m) / (1 + h * b / m / 2)
        v = np.sign(v) * max(abs(v) - h * dry / m, 0.0)
        x += h / 2 * v
    assert np.ptp(seen[step % 30_000 > 29_000]) > 1e-6
    write(
        paths[1],
        "t,force,encoder",
        np.column_stack([step * h, force, seen + rng.normal(0, 2e-6, len(step))])[::50],
    )
    r = diagnosed(paths, tmp_path / "out")
    (friction,) = r["findings"]
    assert friction["probability"] > 0.9 and friction["members"][0]["effect"] == "coulomb_friction"
    found = {k.split("_")[0]: v["value"] for k, v in friction["parameters"].items()}
    assert found["F"] == pytest.approx(dry, rel=0.15) and found["W"] < 2e-6  # m/s, of 0.3: it does not creep


def test_hysteresis_of_no_width_is_dry_friction(tmp_path):
    """The encoder does not resolve what comes before sliding: an entry that models it says hardly more."""
    played = FREE_CARRIAGE.replace(
        "travel:", "rub: {from: velocity, rate: 1.5 * tanh(velocity / 0.0005), unit: N}\n  travel:"
    )
    t = np.arange(1500) * 0.002
    rng = np.random.default_rng(1)
    force = np.interp(t, np.arange(0, 9, 0.4), rng.uniform(-8, 8, 23))
    ran = compile_plant(loads(played)).measure(
        Table("run", "run", t, {"force": force, "encoder": np.zeros(len(t))})
    )
    plant, run = tmp_path / "plant.yaml", tmp_path / "run.csv"
    plant.write_text(FREE_CARRIAGE.replace("noise: 5e-6, resolution: 1e-5", "noise: 5e-4"))
    rows = np.column_stack([t, force, ran.columns["encoder"] + rng.normal(0, 5e-4, len(t))])
    write(run, "t,force,encoder", rows)
    r = diagnosed([plant, run], tmp_path / "out")
    # those that contain it, with another part too small to show, keep some probability, and are a family
    (family,) = r["findings"]
    assert r["verdict"] == "ambiguous" and family["probability"] > 0.95 and family["where"] == "velocity"
    assert family["effect"] == " or ".join(m["effect"] for m in family["members"]) and not r["families"]
    assert family["members"][: len(r["alternatives"])] == r["alternatives"]
    assert family["members"][0]["effect"] == "coulomb_friction"
    size = family["parameters"]["F_coulomb_friction_velocity"]
    assert size["value"] == pytest.approx(1.5, abs=3 * size["sd"])
    report = (tmp_path / "out/report.html").read_text()
    assert "One of coulomb friction at velocity" in report and "do not tell which" in report
    reasons = {why(r, m["effect"]) for m in family["members"]}
    assert all("one of its family is there, and these data do not tell which" in text for text in reasons)
    told = {" + ".join(h["effects"]): h["why_not"] for h in r["hypotheses"]}
    assert [h for h, why_not in told.items() if why_not is None] == ["coulomb_friction at velocity"]
    assert told[""] == "less likely than the result"
    given = load(tmp_path / "out/plant.yaml").parameters["F_coulomb_friction_velocity"]
    assert given.value == pytest.approx(size["value"])


@pytest.mark.parametrize(("least", "absent"), [(1e-5, True), (1e-6, False)])  # m, of X0
def test_hysteresis_pressed_to_its_least_width_is_no_finding(least, absent):
    """What comes before sliding lies below the least width that was asked for: the simpler entry says the same."""
    rubbed = FREE_CARRIAGE.replace(
        "travel:", "rub: {from: velocity, rate: 3.0 * tanh(velocity / 0.0005), unit: N}\n  travel:"
    )
    t, rng = np.arange(2000) * 0.002, np.random.default_rng(1)
    force = np.interp(t, np.arange(0, 9, 0.4), rng.uniform(-8, 8, 23))
    table = compile_plant(loads(rubbed)).measure(
        Table("run", "run", t, {"force": force, "encoder": np.zeros(len(t))})
    )
    table.columns["encoder"] = table.columns["encoder"] + rng.normal(0, 5e-6, len(t))
    known = catalogue((CATALOGUE,))
    c = case(loads(FREE_CARRIAGE), [table], known, Budget(1))
    rig = Rig(c.plant, c.drives(c.null.model), [t.columns for t in c.tables])
    entry = next(x for x in candidates(rig, known) if x.key == ("backlash_hysteresis", "velocity"))
    start = {"F": 3.0, "X0": 3 * least}
    plant = entry.extend(start, {"F": (0.1, 30.0), "X0": (least, 0.1)})
    f = fitted(c, plant, (Placed(entry, {p: entry.own(p) for p in start}),))
    assert bool(f.absent) == absent == (f.fit.at_bound.get(entry.own("X0")) == "low")


def test_a_pump_that_is_clipped_is_the_actuators_entry(tmp_path):
    """What was asked of the pump is recorded, and was never saturated; what it gave ends at 3.1 V."""
    (tmp_path / "plant.yaml").write_text(TANK)
    paths = [tmp_path / "plant.yaml"]
    t = np.arange(0.0, 1200.0, 2.0)
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        pump = rng.uniform(0.8, 4.0, 30)[(t // 40).astype(int)]
        x = np.empty(len(t))
        x[0] = 2.0
        for k in range(len(t) - 1):
            given = min(pump[k], 3.1)
            x[k + 1] = solve_ivp(
                lambda s, q, given=given: 0.047 * given - 0.066 * np.sqrt(max(q[0], 0.0)),
                (t[k], t[k + 1]),
                [x[k]],
                rtol=1e-7,
                atol=1e-9,
            ).y[0, -1]
        path = tmp_path / f"run_{seed}.csv"
        write(
            path,
            "t,pump,level_start,level",
            np.column_stack([t, pump, np.full(len(t), 2.0), x + rng.normal(0, 0.02, len(t))]),
            "%.7g",
        )
        paths.append(path)
    r = diagnosed(paths, tmp_path / "out")
    (f,) = r["findings"]
    assert (r["verdict"], f["effect"], f["where"]) == ("explained", "actuator_saturation", "pumped")
    (u,) = f["parameters"].values()
    assert u["value"] == pytest.approx(3.1, abs=0.03)


@pytest.mark.slow
def test_physics_outside_the_catalogue_leaves_a_remainder_at_its_place(tmp_path):
    def boiling(t, x, a):
        return (-1.2 * np.sin(t / 9.0) ** 2 * (x[0] > 45), 0.0)

    r = diagnosed(heater(tmp_path, boiling), tmp_path / "out")
    assert r["verdict"] in ("unexplained", "partly_explained", "ambiguous") and not r["findings"]
    assert r["remainder"]["node"] == "one" and r["remainder"]["rms"]["temperature_1"] > 0.1
    m = r["mismatch"][0]
    assert m["missing_flow_unit"] == "W"
    # truth: 1.2 W * sin^2 in 40 % of the time, 0.4 W rms; the plant's own loss absorbs a part
    assert 0.2 < m["missing_flow_rms"] < 0.45, m


@pytest.mark.slow
def test_a_change_of_phase_is_unknown_and_sits_in_the_storage(tmp_path):
    """The first block melts round 40 degC, in 0.8 K: no entry says that."""
    r = diagnosed(
        heater(tmp_path, heavier=lambda x: 1 + 1.0 * np.exp(-0.5 * ((x - 40.0) / 0.8) ** 2)), tmp_path / "out"
    )
    assert not r["findings"]
    law = r["remainder"]["law"]
    assert (law["part"], law["into"], law["of"]) == ("storage", "one", ["one"]) and law["confirmed"] > 0.9


@pytest.mark.slow
def test_a_resonance_is_unknown_and_sits_between_drive_and_carriage(tmp_path):
    """A second mass on a spring on a carriage that runs against a damper: no entry says that."""
    (tmp_path / "plant.yaml").write_text("""
format: thermoctl-plant/1
title: Carriage
inputs:
  force: {unit: N}
parameters:
  mass: {value: 12, unit: kg, range: [5, 25]}
  damping: {value: 30, unit: N*s/m, range: [8, 90]}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0}
  position: {unit: m, storage: 1, initial: 0}
flows:
  motor: {into: velocity, rate: force, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  encoder: {value: position, unit: m, noise: 2e-5}
""")
    t, paths = np.arange(0.0, 20.0, 0.005), [tmp_path / "plant.yaml"]
    m, m2, k, d, b = 10.0, 1.0, 900.0, 1.2, 35.0
    A = np.array(
        [[-(b + d) / m, -k / m, d / m, k / m], [1, 0, 0, 0], [d / m2, k / m2, -d / m2, -k / m2], [0, 0, 1, 0]]
    )
    A, B, C, D, _ = cont2discrete(
        (A, np.array([[1 / m], [0], [0], [0]]), np.array([[0, 1, 0, 0]]), np.zeros((1, 1))), 0.005
    )
    rng = np.random.default_rng(1)
    force = rng.choice([-6.0, 0.0, 6.0], 40)[(t // 0.5).astype(int)]
    y = dlsim((A, B, C, D, 0.005), force)[1][:, 0] + rng.normal(0, 2e-5, len(t))
    paths.append(tmp_path / "run.csv")
    write(paths[-1], "t,force,encoder", np.column_stack([t, force, y]))
    r = diagnosed(paths, tmp_path / "out")
    assert r["verdict"] not in ("explained", "consistent") and r["remainder"]["node"] == "velocity"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: p[1].write_text(p[1].read_text().replace("heat,", "warmth,", 1)), "no column 'heat'"),
        (lambda p: p[1].write_text("\n".join(p[1].read_text().splitlines()[:12])), "too little data"),
        (lambda p: p[1].write_text(p[1].read_text().replace("\n2,", "\nx,", 1)), "run_1.csv"),
        (lambda p: p[0].write_text(TWO_BLOCKS.replace("G_12 *", "G_13 *")), "G_13"),
    ],
)
def test_unusable_input_is_one_line_and_leaves_nothing(tmp_path, capsys, spoil, words):
    paths = heater(tmp_path, seeds=(1,))
    spoil(paths)
    capsys.readouterr()
    assert main(["diagnose", "--plant", str(paths[0]), str(paths[1]), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_entry_of_the_catalogue_reads_and_a_users_own_replaces_it(tmp_path):
    entries = catalogue()
    assert {"radiation", "coulomb_friction", "sensor_lag", "missing_member", "overflow"} <= set(
        entries
    ) and len(entries) >= 48
    (tmp_path / "mine.yaml").write_text(
        "effect: mine\ntitle: T\nwhere: temperature_node\nsource: me\n"
        "change: [{flow: {from: T, rate: 'K * (T - air)**3'}}]\nparameters: {K: {low: 0}}\n"
    )

    assert "mine" in catalogue((CATALOGUE, tmp_path))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("effect: mine\n", "'where' is missing"),
        (
            "effect: m\ntitle: T\nwhere: temperature_nod\nsource: s\nchange: []\nparameters: {}\n",
            "did you mean 'temperature_node'",
        ),
        (
            "effect: m\ntitle: T\nwhere: sensor\nsource: s\nchange: [{vlaue: y}]\nparameters: {}\n",
            "'vlaue' is not a change (did you mean 'value'?)",
        ),
        (
            "effect: m\ntitle: T\nwhere: sensor\nsource: s\nchange: [{value: y}]\nparameters: {}\ncolour: red\n",
            "unknown key 'colour'",
        ),
        (
            "effect: m\ntitle: T\nwhere: sensor\nsource: s\nchange: [{value: y * G}]\nparameters: {g: {low: 0}}\n",
            "bad.yaml:5:18: value: 'G' is not known here (did you mean 'g'?); allowed are air",
        ),
    ],
)
def test_a_bad_effect_file_gives_its_one_error(tmp_path, text, words):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(InputError, match="bad.yaml:") as e:
        catalogue((tmp_path,))
    assert words in str(e.value)


def _rewritten(path, change):
    """A recording with its columns changed: change(names, rows) -> rows."""
    names = path.read_text().splitlines()[0].split(",")
    rows = change(names, np.genfromtxt(path, delimiter=",", skip_header=1))
    write(path, ",".join(names), rows, "%.7g")


@pytest.mark.slow
def test_a_channel_whose_clock_runs_ahead_is_no_physics_of_the_catalogue(tmp_path):
    paths = heater(tmp_path, seeds=(1,))

    def ahead(names, rows):
        k = names.index("temperature_2")
        rows[:-20, k] = rows[20:, k]  # 20 samples of 2 s
        return rows[:-20]

    for p in paths[1:]:
        _rewritten(p, ahead)
    assert diagnosed(paths, tmp_path / "out")["verdict"] != "explained"


def test_a_recording_of_another_rig_is_doubted(tmp_path):
    paths = heater(tmp_path, seeds=(1, 2))

    def other(names, rows):
        rng = np.random.default_rng(5)
        for name in ("temperature_1", "temperature_2"):  # a machine that works to its own timetable
            rows[:, names.index(name)] = (
                40 + 15 * np.sin(rows[:, 0] / 90 + rng.uniform(0, 6)) + rng.normal(0, 0.1, len(rows))
            )
        return rows

    def doubted(path):
        known = case(load(paths[0]), [read_table(path)], {}, Budget(1))
        sigma = {o: n.sigma for o, n in zip(known.null.model.outputs, known.noise, strict=True)}
        return doubts(known, known.null, sigma)

    assert doubted(paths[1]) == []
    _rewritten(paths[2], other)
    assert [("of this rig" in n) for n in doubted(paths[2])] == [True, True]


def test_a_recording_in_which_nothing_moves_shows_nothing(tmp_path):
    paths = heater(tmp_path, seeds=(1,))

    def rest(names, rows):
        rng = np.random.default_rng(6)
        for name, value, noise in (
            ("heat", 0, 0),
            ("air_temperature", 21.5, 0),
            ("temperature_1", 21.5, 0.1),
            ("temperature_2", 21.5, 0.1),
        ):
            rows[:, names.index(name)] = value + noise * rng.normal(size=len(rows))
        return rows

    _rewritten(paths[1], rest)
    r = diagnosed(paths, tmp_path / "out")
    assert r["verdict"] == "consistent" and r["findings"] == []
    assert any("excited" in n for n in r["notes"])
