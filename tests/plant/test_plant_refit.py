"""What a refit reports, and the noise that it measures, against truths that are known."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from thermoctl.cli import main
from thermoctl.plant import expression as ex
from thermoctl.plant import extended, loads
from thermoctl.plant.fitting.estimate import report
from thermoctl.plant.fitting.noise import coloured, innovations
from thermoctl.plant.fitting.refit import fit, fit_by_first_parts
from thermoctl.plant.fitting.residuals import Prior, Problem
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

BLOCK = """format: thermoctl-plant/1
inputs: {P: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 30, unit: J/K, range: [10, 90]}, G: {value: 0.5, unit: W/K, range: [0.1, 1]}}
nodes: {T: {unit: degC, storage: C, initial: air, initial_sigma: 0.5}}
flows: {heat: {into: T, rate: P, unit: W}, loss: {from: T, rate: "G * (T - air)", unit: W}}
outputs: {y: {value: T, unit: degC, noise: 0.1}}
"""


def text(extra, loss):
    return BLOCK.replace("[0.1, 1]}", f"[0.1, 1]}}{extra}").replace("G * (T - air)", loss)


def plant(extra="", loss="G * (T - air)", noise="noise: 0.1"):
    return loads(text(extra, loss).replace("noise: 0.1", noise))


def recorded(truth, n=900, name="a", seed=1, noise=0.1, phi=0.0, step=None):
    """A run of `truth` with AR(1) noise of standard deviation `noise`, rounded to `step`."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(n))
    table = Table(name, name, t, {"P": 6.0 * rng.integers(0, 2, n // 50).repeat(50), "air": np.full(n, 21.0)})
    white = rng.normal(0, noise * np.sqrt(1 - phi**2), n)
    white[0] /= np.sqrt(1 - phi**2)
    y = compile_plant(truth, ()).simulate(table).y[:, 0] + lfilter([1.0], [1.0, -phi], white)
    table.columns["y"] = np.round(y / step) * step if step else y
    return table


def judged(believed, table):
    model = compile_plant(believed)
    return {e.name: e for e in report(fit(model, [model.excitation(table)]))}


TRUTH = extended(
    plant(), lambda d: (d["parameters"]["C"].update(value=46.0), d["parameters"]["G"].update(value=0.31))
)


def test_good_parameters_are_ok_with_errors_that_hold_the_truth():
    found = judged(plant(), recorded(TRUTH))
    assert {e.state for e in found.values()} == {"ok"}
    assert all(
        abs(found[q].value - v) < 4 * found[q].sd and found[q].sd < 0.02 * v
        for q, v in (("C", 46.0), ("G", 0.31))
    )


def test_a_parameter_that_the_data_do_not_feel_is_dead():
    found = judged(
        plant(", K: {value: 1, unit: W/K, range: [0.1, 5]}", "G * (T - air) + K * max(T - 500, 0)"),
        recorded(TRUTH),
    )
    assert found["K"].state == "dead" and found["C"].state == "ok"


def test_a_parameter_pressed_against_its_range_is_at_bound():
    narrow = extended(plant(), lambda d: d["parameters"]["G"].update(range=[0.4, 1.0]))
    found = judged(narrow, recorded(TRUTH))
    assert found["G"].state == "at bound" and found["G"].value == pytest.approx(0.4)


def test_two_of_which_only_the_sum_is_felt_are_flat_and_trade():
    found = judged(
        plant(", H: {value: 0.3, unit: W/K, range: [0.02, 1]}", "(G + H) * (T - air)"), recorded(TRUTH)
    )
    assert found["G"].state == found["H"].state == "flat"
    assert (
        found["G"].trades_with == ("H",) and found["H"].trades_with == ("G",) and found["C"].trades_with == ()
    )


def test_the_command_says_all_of_it(tmp_path, capsys):
    (tmp_path / "p.yaml").write_text(
        text(
            ", H: {value: 0.3, unit: W/K, range: [0.02, 1]}, K: {value: 1, unit: W/K, range: [0.1, 5]}",
            "(G + H) * (T - air) + K * max(T - 500, 0)",
        )
    )
    for name, seed in (("a", 1), ("b", 2)):
        write_table(tmp_path / f"{name}.csv", recorded(TRUTH, name=name, seed=seed))
    files = f"{tmp_path / 'p.yaml'} {tmp_path / 'a.csv'} --held-out {tmp_path / 'b.csv'}"
    assert main(f"refit --plant {files}".split()) == 0
    told = " ".join(capsys.readouterr().out.split())
    for words in ("standard error", "dead", "flat", "trades with", "before", "after"):
        assert words in told, words


def test_outliers_hardly_move_a_fit():
    clean, hit = recorded(TRUTH), recorded(TRUTH)
    hit.columns["y"][::90] += 15.0  # one reading of ninety
    a, b = (judged(plant(), t) for t in (clean, hit))
    assert all(abs(a[q].value - b[q].value) < 3 * a[q].sd for q in ("C", "G"))


@pytest.mark.parametrize(("phi", "step"), [(0.0, None), (0.8, None), (0.8, 0.1), (0.95, 0.1)])
def test_noise_is_measured_with_its_colour_beside_the_sensors_steps(phi, step):
    """Correlation of neighbours of the coloured part alone, on the mean of six recordings; AR(1) comes with its own sampling error."""
    believed = plant(noise=f"noise: 0.1{f', resolution: {step}' if step else ''}")
    model = compile_plant(believed)
    measured = []
    for seed in range(6):
        drive = model.excitation(recorded(TRUTH, seed=seed, phi=phi, step=step))
        (noise,) = coloured(fit(model, [drive]), [drive])
        measured.append(noise.phi if len(noise.ar) == 1 else -noise.ar[1])
    assert np.mean(measured) == pytest.approx(phi, abs=0.06 if phi < 0.9 else 0.03)


def test_innovations_form_has_the_variance_and_the_correlation_of_its_parts():
    """AR(1) of variance 0.9 beside white noise of 0.1, from the impulse response of ma/ar."""
    noise = innovations(0.7, 0.1, 1.0)
    response = noise.sigma * lfilter(noise.ma, noise.ar, np.r_[1.0, np.zeros(400)])
    assert response @ response == pytest.approx(1.0)
    assert response[1:] @ response[:-1] == pytest.approx(0.7 * 0.9) and response[2:] @ response[
        :-2
    ] == pytest.approx(0.49 * 0.9)


CHAIN = """format: thermoctl-plant/1
inputs: {P: {unit: W}, air: {unit: degC}}
parameters:
  C: {value: 30, unit: J/K, range: [3, 300]}
  D: {value: 30, unit: J/K, range: [1, 1000]}
  E: {value: 30, unit: J/K, range: [1, 1000]}
  K: {value: 0.5, unit: W/K, range: [0.01, 20]}
  L: {value: 0.5, unit: W/K, range: [0.01, 20]}
  G: {value: 0.5, unit: W/K, range: [0.05, 5]}
nodes:
  T: {unit: degC, storage: C, initial: air}
  U: {unit: degC, storage: D, initial: air}
  V: {unit: degC, storage: E, initial: air}
flows:
  heat: {into: T, rate: P, unit: W}
  one: {from: T, into: U, rate: K * (T - U), unit: W}
  two: {from: U, into: V, rate: L * (U - V), unit: W}
  loss: {from: V, rate: G * (V - air), unit: W}
outputs: {y: {value: T, unit: degC, noise: 0.02}}
"""


def test_parameters_that_trade_along_a_curve_are_followed_in_fewer_steps(monkeypatch):
    """Two bodies that nobody measures behind the one that is: from eight starts, the same fit as by straight steps and sooner."""
    believed, slopes = loads(CHAIN), []
    truth = extended(
        believed,
        lambda d: [
            d["parameters"][q].update(value=v)
            for q, v in (("C", 12.0), ("D", 40.0), ("E", 90.0), ("K", 0.8), ("L", 1.5), ("G", 0.3))
        ],
    )
    table = recorded(truth, n=3000, noise=0.02)
    model = compile_plant(believed)
    evaluate = Problem.evaluate

    def counted(self, z, jacobian, *more):
        slopes[-1] += jacobian
        return evaluate(self, z, jacobian, *more)

    monkeypatch.setattr(Problem, "evaluate", counted)
    for bent in (0.75, 0.0):
        monkeypatch.setattr("thermoctl.plant.fitting.climb.CURVED", bent)
        slopes.append(0)
        costs = [
            fit(model, [model.excitation(table)], start=np.random.default_rng(k).uniform(0.35, 0.65, 6)).cost
            for k in range(8)
        ]
        assert max(costs) < min(costs) + 1 and costs[0] == pytest.approx(3000, rel=0.1)
    assert slopes[0] < 0.8 * slopes[1], slopes


def test_what_is_believed_of_parameters_gives_the_posterior_and_the_evidence_of_a_straight_line():
    """Against the closed form: y = A u + B + noise with A, B ~ N(1, 0.2^2), N(A, 0.5^2); evidence is y's own density, N(X m, s^2 I + X V X')."""
    line = loads("""format: thermoctl-plant/1
inputs: {u: {unit: K}}
parameters: {C: {value: 1, unit: J/K}, A: {value: 0, unit: "1", range: [-50, 50]}, B: {value: 0, unit: K, range: [-50, 50]}}
nodes: {T: {unit: degC, storage: C, initial: "20"}}
flows: {heat: {into: T, rate: "0 * C * T", unit: W}}
outputs: {y: {value: "A * u + B", unit: K, noise: 0.3}}
""")
    rng = np.random.default_rng(4)
    u = rng.normal(0, 1, 12)
    y = 1.4 * u + 1.1 + rng.normal(0, 0.3, 12)
    model = compile_plant(line)
    drive = model.excitation(Table("a", "a", np.arange(12.0), {"u": u, "y": y}))
    belief = Prior("a", ex.parse("((A - 1) / 0.2)**2 + ((B - A) / 0.5)**2"))
    found = fit(model, [drive], priors=[belief, Prior("another recording", ex.parse("A**2"))], tolerance=1e-9)
    m, X = np.array([1.0, 1.0]), np.column_stack([u, np.ones(12)])
    V = np.array([[0.04, 0.04], [0.04, 0.04 + 0.25]])
    P = np.linalg.inv(V) + X.T @ X / 0.09
    assert [found.parameters()[q] for q in "AB"] == pytest.approx(
        np.linalg.solve(P, np.linalg.inv(V) @ m + X.T @ y / 0.09), abs=1e-4
    )
    assert np.sqrt(np.diag(np.linalg.inv(P))) == pytest.approx(
        100 * np.sqrt(np.diag(np.linalg.inv(found.hessian))), rel=1e-3
    )


ROESSLER = """format: thermoctl-plant/1
parameters: {a: {value: 0.19, range: [0.1, 0.3]}, b: {value: 0.2, range: [0.1, 0.4]}, c: {value: 5.6, range: [4, 8]}}
nodes:
  x: {storage: 1, initial: first(X), initial_sigma: 0.2}
  y: {storage: 1, initial: first(Y), initial_sigma: 0.2}
  z: {storage: 1, initial: first(Z), initial_sigma: 0.2}
flows: {fx: {into: x, rate: -y - z}, fy: {into: y, rate: x + a * y}, fz: {into: z, rate: b + z * (x - c)}}
outputs: {X: {value: x, noise: 0.1}, Y: {value: y, noise: 0.1}, Z: {value: z, noise: 0.1}}
"""


def test_an_oscillator_whose_period_is_a_little_wrong_is_fitted():
    """A free run that slips by a period has an optimum of its own: what is missing was "a law", above 0.99."""
    t, rng = np.arange(0.0, 60.0, 0.1), np.random.default_rng(805)

    def rates(_, x):
        return -x[1] - x[2], x[0] + 0.2 * x[1], 0.2 + x[2] * (x[0] - 5.7)

    x = solve_ivp(rates, (0, 60), (1.0, -3.0, 0.1), t_eval=t, rtol=1e-10, atol=1e-10).y
    table = Table("run", "", t, dict(zip("XYZ", x + rng.normal(0, 0.1, x.shape), strict=True)))
    model = compile_plant(loads(ROESSLER))
    assert max(fit(model, [model.excitation(table)]).rms().values()) > 1.0
    found = fit_by_first_parts(model, [model.excitation(table)])
    assert max(found.rms().values()) < 0.11
    assert found.parameters() == pytest.approx({"a": 0.2, "b": 0.2, "c": 5.7}, rel=0.02)


def test_readings_that_begin_late_are_fitted_all_the_same():
    """The first half of such a recording holds nothing to compare."""
    truth = plant(loss="G * (T - air) + 0.05 * (T - air)**2")
    table = recorded(truth, noise=0.02)
    table.columns["y"][:500] = np.nan
    model = compile_plant(plant(noise="noise: 0.02"))
    drives = [model.excitation(table)]
    assert fit_by_first_parts(model, drives).cost == pytest.approx(fit(model, drives).cost)


FISHERY = """
format: thermoctl-plant/1
title: A stock with its catch
inputs: {catch: {between_samples: hold}}
parameters:
  r: {value: 0.12, range: [0.02, 0.6]}
  K: {value: 600, range: [200, 2000]}
nodes: {N: {storage: 1, initial: first(count), initial_sigma: 25}}
flows:
  growth: {into: N, rate: r * N * log(K / N)}
  fishing: {from: N, rate: catch}
outputs: {count: {value: N, noise: 8}}
"""


def test_a_stock_that_the_files_values_use_up_before_the_end_is_fitted():
    """The free run ended at the logarithm of a negative number: the recording was refused."""
    t = np.arange(0.0, 60.0)
    catch = np.full(len(t), 34.0)
    truth = compile_plant(loads(FISHERY.replace("0.12", "0.2").replace("600", "500")))
    table = truth.measure(Table("run", "", t, {"catch": catch, "count": np.full(len(t), 400.0)}), 6)
    model = compile_plant(loads(FISHERY))
    drives = [model.excitation(table)]
    with pytest.raises(SimulationError):
        fit(model, drives)
    found = fit_by_first_parts(model, drives)
    assert found.rms()["count"] < 9.5
    assert found.parameters() == pytest.approx({"r": 0.2, "K": 500}, rel=0.1)


UNSTABLE = """format: thermoctl-plant/1
inputs: {u: {unit: N}}
parameters: {F: {value: 5, unit: N, range: [1, 20]}}
nodes: {v: {unit: m/s, storage: 1, initial: 0, initial_sigma: 0.01}}
flows: {push: {into: v, rate: F * tanh(v / 0.01), unit: N}, force: {into: v, rate: u, unit: N}}
outputs: {y: {value: v, unit: m/s, noise: 0.01}}
"""


@pytest.mark.filterwarnings("error")
def test_slopes_that_overflow_end_a_refit_by_an_error():
    """A friction of the wrong sign at rest: the run stays at zero, its slope by the start is exp(500 t)."""
    t = np.arange(0.0, 5.0, 0.02)
    model = compile_plant(loads(UNSTABLE))
    table = Table("a", "a", t, {"u": np.zeros(len(t)), "y": np.zeros(len(t))})
    with pytest.raises(SimulationError, match="slopes"):
        fit(model, [model.excitation(table)])
