"""Expansion models, filters, tuning and calibration files."""

import numpy as np
import pytest
import yaml
from scipy import signal

from tests.identify.peers import time_constant_s
from tests.reproduction import paper
from tests.reproduction.sensors import choose_sensors
from thermoctl.control.model import CompensatorModel, zero_model
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import expansion, filter, modelfile, online, tuning
from thermoctl.identify.statespace import StateSpace


def motion(n=9000, seed=0):
    """Two temperature rises and the position error of a first-order expansion with tau = 120 s."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)
    heat = ((t % 1500) < 700 + 300 * np.sin(t / 1900)).astype(float)
    rises = np.column_stack(
        [signal.lfilter([1 - p], [1, -p], 8 * heat) for p in np.exp(-1 / np.array([250.0, 1400.0]))]
    )
    f = np.exp(-1 / 120)
    y = signal.lfilter([0, 1 - f], [1, -f], rises @ [1.2, -0.8])
    return rises, y, rng


def test_equation_error_is_biased_and_output_error_is_not():
    rises, y, rng = motion()
    read = y + 0.1 * rng.standard_normal(len(y))
    biased, true = paper.recursion(rises, read, 1.0), expansion.output_error([rises], [read], 1.0)
    assert time_constant_s(biased) < 30
    assert abs(time_constant_s(true) - 120) < 15
    left = [np.std((y - m.predict(rises))[2000:]) for m in (biased, true)]
    assert left[1] < 0.15 * left[0]


def test_the_air_enters_with_the_sum_of_the_gains():
    rises, _, rng = motion()
    air = 22 + 0.5 * np.sin(np.arange(len(rises)) / 3000)
    y = (rises + (air - air[0])[:, None]) @ [0.7, 0.5] + 0.3
    m = expansion.output_error(
        [rises], [y + 0.01 * rng.standard_normal(len(y))], 1.0, air=[air], tau_range_s=(0.5, 60)
    )
    assert m.b_air == pytest.approx((m.b1 + m.b2).sum())
    assert np.std((y - m.predict(rises, air, m.info["start_um"]))[100:]) < 0.02


def test_noisy_inputs_shrink_the_gains():
    rises, y, _ = motion(4000)
    free, careful = (
        expansion.output_error([rises], [y], 1.0),
        expansion.output_error([rises], [y], 1.0, input_sigma_k=5.0),
    )
    assert np.abs(careful.b1 + careful.b2).sum() / (1 - careful.f1) < np.abs(free.b1 + free.b2).sum() / (
        1 - free.f1
    )


def test_bank_online_comes_near_the_block_fit_and_misses_samples():
    rises, y, rng = motion()
    read = y + 0.05 * rng.standard_normal(len(y))
    read[::7] = np.nan
    bank = expansion.Bank(2, 1.0)
    for r, v in zip(rises, read, strict=True):
        bank.update(r, v)
    m = bank.bounded(-np.inf, np.inf)
    assert 60 < time_constant_s(m) < 240
    assert np.std((y - m.predict(rises))[2000:]) < 0.1


def thermal():
    p = np.exp(-1 / np.array([30.0, 300.0, 2000.0]))
    return StateSpace(
        np.diag(p),
        (1 - p)[:, None],
        np.array([[1.0, 1.0, 0.6], [0.2, 1.2, 0.8], [0.1, 0.3, 1.0]]),
        1.0,
        np.zeros(3),
    )


def test_steady_filter_is_where_the_kalman_recursion_ends():
    m = filter.disturbed(filter.with_air(thermal()))
    v = np.array([1e-2, 1e-9, 1e-6, 1e-12])
    k = filter.steady(m, v, 0.01)
    q, c = filter.process_noise(m, v), m.c[:1]
    p = np.eye(m.order)
    for _ in range(60_000):
        p = m.a @ p @ m.a.T + q
        gain = p @ c.T / (c @ p @ c.T + 0.01)
        p = p - gain @ c @ p
    assert np.allclose(k.gain, gain, rtol=1e-4, atol=1e-7)


def test_warming_air_lowers_every_rise_by_as_much():
    m = filter.with_air(thermal())
    quick = m.simulate(np.column_stack([np.zeros(3), [1.0, 0, 0]]))
    assert np.allclose(quick[1], -1.0, atol=1e-9)


def test_filter_follows_an_unmodelled_disturbance_better_than_the_model_alone():
    rng = np.random.default_rng(3)
    m = thermal()
    u = ((np.arange(7200) % 1500) < 700).astype(float) * 4
    wrong = m.simulate((u * 1.08)[:, None])
    measured = np.round((wrong + 0.06 * rng.standard_normal(wrong.shape)) / 0.25) * 0.25
    f, _ = filter.tune(
        filter.disturbed(filter.with_air(m)),
        [filter.Record(u, 0 * u, measured)],
        filter.sensor_variance(0.25, 0.06),
    )
    left = [
        np.sqrt(np.mean((e - wrong) ** 2)) for e in (m.simulate(u[:, None]), f.run(u, 0 * u, measured[:, 0]))
    ]
    assert left[1] < 0.5 * left[0]


def test_more_sensors_never_cost_accuracy():
    m = filter.disturbed(filter.with_air(thermal()))
    choice = choose_sensors(m, np.array([1e-2, 1e-9, 1e-5, 1e-12]), 0.01, np.array([0.5, 1.0, -0.7]), 3)
    assert [len(s) for s, _ in choice] == [1, 2, 3]
    errors = [e for _, e in choice]
    assert errors[0] >= errors[1] >= errors[2] > 0


# PID
PLANT = tuning.SecondOrder(300.0, 0.012, 0.0012, 0.002)


def recorded(plant, rate_um_s, noise_um, seed):
    """Drive and position of a closed loop (41) that follows setpoint ramps of 0.1 to 0.3 s: (t, drive, position)."""
    g, ts = tuning.imc(plant, 0.01), 0.001
    reference = np.zeros(500)
    for ramp in 8 * (100, 200, 100, 300):
        for sign in (1, -1):
            reference = np.append(reference, reference[-1] + sign * rate_um_s * ts * np.arange(1, ramp + 1))
    n = len(reference)
    impulse = np.diff(plant.step(np.arange(200) * ts))
    noise = noise_um * np.random.default_rng(seed).standard_normal(n)
    e, u, y = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(2, n):
        past = u[max(0, k - 199) : k][::-1]
        y[k] = past @ impulse[: len(past)] + noise[k]
        e[k] = reference[k] - y[k]
        change, before = e[k] - e[k - 1], e[k - 1] - e[k - 2]
        u[k] = u[k - 1] + g.kp * (change + ts / g.ti_s * e[k] + g.td_s / ts * (change - before))
    return np.arange(n) * ts, u, y


def test_the_closed_loop_tells_the_response_without_bias():
    """Fed-back noise does not bias the fit: margins as of the plant itself, also where ticks are missing."""
    clean = tuning.margins(PLANT, tuning.imc(PLANT, 0.01), 0.001)
    for seed in range(3):
        t, u, y = recorded(PLANT, 1000 / 60, 0.05, seed)
        late = np.random.default_rng(seed).random(len(t)) < 0.01
        held = u[np.maximum.accumulate(np.where(late, 0, np.arange(len(t))))]
        got = tuning.fit_response(t[~late], held[~late], y[~late], 0.001)
        m = tuning.margins(got, tuning.imc(PLANT, 0.01), 0.001)
        assert got.gain == pytest.approx(300, rel=0.003)
        assert m.phase_deg == pytest.approx(clean.phase_deg, abs=2) and m.gain == pytest.approx(
            clean.gain, rel=0.1
        )


def test_the_tangent_from_a_noisy_step_is_within_three_percent():
    """Kp of Ziegler and Nichols, 1.2 tau_c / (K0 tau_d), is the tangent in one number."""

    def kp(model):
        k0, tau_d, tau_c = tuning.tangent(model)
        return 1.2 * tau_c / (k0 * tau_d)

    t = np.arange(-0.02, 0.2, 0.001)
    drive = np.where(t >= -1e-9, 0.3, 0.0)
    for seed in range(5):
        y = PLANT.response(drive, 0.001) + 0.15 * np.random.default_rng(seed).standard_normal(len(t))
        got = tuning.fit_response(t, drive, y, 0.001)
        assert kp(got) == pytest.approx(kp(PLANT), rel=0.03)


def test_the_tangent_of_the_paper():
    """tau_d 2 ms, tau_c 10.8 ms, K_0 308."""
    found = tuning.tangent(tuning.SecondOrder(308.0, 0.0108, 1e-7, 0.002))
    assert found == pytest.approx((308.0, 0.002, 0.0108), rel=0.02)


def test_margins_predict_where_the_loop_becomes_unstable():
    g = tuning.imc(PLANT)
    m = tuning.margins(PLANT, g, 0.001)

    def diverges(factor):
        n = 4000
        impulse = np.diff(PLANT.step(np.arange(400) * 0.001))
        ts, kp, ti, td = 0.001, g.kp * factor, g.ti_s, g.td_s
        e, v, y = np.zeros(n + 2), np.zeros(n), np.zeros(n)
        for k in range(n):
            past = v[max(0, k - 399) : k][::-1]
            y[k] = past @ impulse[: len(past)]
            e[k] = 1 - y[k]
            v[k] = (v[k - 1] if k else 0) + kp * (
                (1 + ts / ti + td / ts) * e[k]
                - (1 + 2 * td / ts) * (e[k - 1] if k else 0)
                + td / ts * (e[k - 2] if k > 1 else 0)
            )
            if abs(y[k]) > 1e6:
                return True
        return np.abs(y[-500:] - 1).max() > 0.5

    assert m.stable and not diverges(0.93 * m.gain) and diverges(1.07 * m.gain)


def test_robust_tuning_has_the_margins():
    g = tuning.robust((PLANT,), 0.001, 4)
    m = tuning.margins(PLANT, g, 0.001, 4)
    assert m.phase_deg >= 45 and m.gain >= 2


def test_a_response_that_noise_hides_is_refused():
    """No gains from noise: the position does not answer to the drive, or far below its noise, or nothing was driven."""
    t, u, y = recorded(PLANT, 1000 / 60, 0.0, 0)
    noise = np.random.default_rng(0).standard_normal(len(t))
    for drive, position in ((u, noise), (u, y + 20 * noise), (0 * u, y)):
        with pytest.raises(InputError, match="raise control.setpoint_rate_um_s"):
            tuning.fit_response(t, drive, position, 0.001)


def test_a_proposal_changes_only_the_three_lines(tmp_path):
    path = tmp_path / "rig.yaml"
    text = "rig: {name: a}\ncontrol:            # gains\n  kp: 0.01          # um\n  ti_s: 4 ms\n  td_s: 0.001\n  moving_average: 4\nloop:\n  kp: 7\n"
    path.write_text(text)
    tuning.write(path, tuning.Gains(0.02, 0.005, 0.002, "test"))
    assert path.read_text() == text.replace("kp: 0.01 ", "kp: 0.02 ").replace(
        "ti_s: 4 ms", "ti_s: 0.005"
    ).replace("td_s: 0.001", "td_s: 0.002")
    path.write_text("control: {kp: 1}\n")
    with pytest.raises(InputError):
        tuning.write(path, tuning.Gains(0.02, 0.005, 0.002, "test"))


def test_a_proposal_for_an_axis_changes_no_other(tmp_path):
    path = tmp_path / "rig.yaml"
    common = "control:\n  kp: 0.01\n  ti_s: 0.004\n  td_s: 0.001\n"
    x, y = "  x:\n    points: {coil: {role: coil}}\n", "  y:\n    control:\n      kp: 3  # own\n"
    path.write_text(f"axes:\n{x}{y}{common}")
    gains = tuning.Gains(0.02, 0.005, 0.002, "test")
    for axis in "xyx":
        tuning.write(path, gains, axis)
    written = yaml.safe_load(path.read_text())
    own = {"kp": 0.02, "ti_s": 0.005, "td_s": 0.002}
    assert written["axes"]["x"] == {"points": {"coil": {"role": "coil"}}, "control": own}
    assert written["axes"]["y"] == {"control": own} and "# own" in path.read_text()
    assert path.read_text().endswith(common)
    for flow in ("axes: {x: {}}\n", "axes:\n  x: {}\n", "axes:\n  x:\n    control: {kp: 1}\n"):
        path.write_text(flow + common)
        with pytest.raises(InputError, match=r"no section 'axes.x.control'.*write by hand: kp: 0.02"):
            tuning.write(path, gains, "x")
        assert path.read_text() == flow + common


# calibrations
def test_calibration_round_trip_and_roll_back(tmp_path):
    recording = tmp_path / "r.csv"
    recording.write_text("t,x\n0,1\n")
    one = modelfile.install(tmp_path / "m", zero_model(), "bench", [recording], {"rms_um": 0.1})
    two = modelfile.install(tmp_path / "m", zero_model(0.002), "bench")
    c = modelfile.load_calibration(one, "bench")
    assert c.fingerprints == {"r.csv": modelfile.fingerprint(recording)} and c.figures == {"rms_um": 0.1}
    assert all(
        np.array_equal(getattr(c.model, k), getattr(zero_model(), k))
        for k in ("A_minus_I", "B", "C", "gain", "b1")
    )
    assert modelfile.load_model(tmp_path / "m").period_s == 0.002 and modelfile.current(tmp_path / "m") == two
    assert (
        modelfile.roll_back(tmp_path / "m") == one and modelfile.load_model(tmp_path / "m").period_s == 0.001
    )
    with pytest.raises(InputError, match="oldest"):
        modelfile.roll_back(tmp_path / "m")
    with pytest.raises(InputError, match="never overwritten"):
        modelfile.save_model(one, zero_model(), "bench")


def test_a_calibration_that_does_not_fit_is_refused(tmp_path):
    path = modelfile.save_model(tmp_path / "a.yaml", zero_model(), "bench")
    with pytest.raises(InputError, match="rig 'bench', this one is 'other'"):
        modelfile.load_model(path, "other")
    text = path.read_text()
    path.write_text(text.replace("R_v: 1.0", "R_v: 2.0"))
    with pytest.raises(InputError, match="checksum"):
        modelfile.load_model(path)
    path.write_text("format: something\n")
    with pytest.raises(InputError, match="not a calibration"):
        modelfile.load_model(path)
    with pytest.raises(InputError, match="no calibration is current"):
        modelfile.load_model(tmp_path)


@pytest.mark.parametrize(
    "place, value, message",
    [
        ("units.offset_um", "mm", r"a.yaml:\d+:\d+: offset_um: 'mm', expected 'um'"),
        ("model", "text", "model: a mapping was expected, found 'text'"),
        ("figures", [1], "figures: a mapping was expected, found a list"),
        ("model.A_minus_I", 1.0, r"A_minus_I has shape \(\), expected \(1, 1\)"),
        ("model.A_minus_I", [[0.1]], "a pole outside the unit circle"),
        ("model.A_minus_I", [["-0.1"]], "A_minus_I holds something that is no number"),
        ("model.R_v", "1.0", "R_v is '1.0', expected a number above 0"),
        ("model.f1", float("nan"), "f1 is nan, expected a finite number"),
        ("model.period_s", 10**400, "too large"),
        ("model.sensors", None, "not the entries of a model of this version"),
        ("model.points", [1] * 12, "12 points with 12 names"),
        ("model.gain_of_old", 1.0, "not the entries of a model of this version"),
    ],
)
def test_a_calibration_of_another_content_is_refused_at_its_line(tmp_path, place, value, message):
    """Its checksum is right, as a program of another version would write it; half of these ended with a traceback."""
    path = modelfile.save_model(tmp_path / "a.yaml", zero_model(), "bench")
    content = yaml.safe_load(path.read_text())
    del content["checksum"]
    *above, key = place.split(".")
    (content[above[0]] if above else content)[key] = value
    if value != 10**400:
        content["checksum"] = modelfile._checksum(content)
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=message):
        modelfile.load_model(path)


def test_a_damaged_marker_is_named_and_replaced(tmp_path):
    one = modelfile.install(tmp_path, zero_model(), "bench")
    (tmp_path / "0x-copy.yaml").write_text("")
    assert modelfile.install(tmp_path, zero_model(), "bench").name.startswith("0002-")
    (tmp_path / "current").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="current: names .*rollback NAME"):
        modelfile.load_model(tmp_path)
    assert modelfile.roll_back(tmp_path, one.name) == modelfile.current(tmp_path) == one


# online
def compensator(gain):
    b = np.zeros(12)
    b[:2] = gain
    f = np.exp(-1 / 120)
    return CompensatorModel(
        "kalman",
        0.001,
        -np.eye(2) * 1e-6,
        np.zeros((2, 2)),
        np.zeros((12, 2)),
        np.zeros(2),
        0.0,
        1.0,
        f,
        np.zeros(12),
        (1 - f) * b,
        1.0,
    )


def test_online_tuning_waits_for_excitation_and_is_clipped():
    rises, y, rng = motion(9000)
    wide = np.zeros((len(rises), 12))
    wide[:, :2] = rises
    tuner = online.Tuner(compensator([1.0, -0.7]), buckets_k=(1.0, 3.0, 5.0), full=200)
    for k in range(400):
        tuner.update(wide[k], y[k])
    new, why = tuner.proposal()
    assert new is None and "excitation" in why and tuner.progress < 100
    for k in range(400, len(y)):
        tuner.update(wide[k], y[k] + 0.02 * rng.standard_normal())
    assert tuner.progress == 100
    new, why = tuner.proposal()
    assert new is not None, why
    old = compensator([1.0, -0.7])
    move = (new.b1 + new.b2) / (1 - new.f1) - (old.b1 + old.b2) / (1 - old.f1)
    assert np.abs(move).max() <= 0.3 + 1e-9
