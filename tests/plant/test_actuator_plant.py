"""The simulated actuator does what the paper's rig does: time constant, temperature after an hour, error, stable loop.

The references are computed here with scipy from the plant file's equations, not with the program's integrator.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from thermoctl.plant import expression as ex
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant

PLANTS = Path(__file__).parents[2] / "config" / "plants"
ELECTRIC = ("u_integral", "i_coil", "velocity", "position")


@pytest.fixture(scope="module")
def plant():
    return load(PLANTS / "actuator.yaml")


def slopes(plant, point):
    out = []
    for n in plant.nodes.values():
        net = sum(
            (1 if f.target == n.name else -1) * ex.evaluate(f.rate, point)
            for f in plant.flows.values()
            if n.name in (f.source, f.target)
        )
        out.append(net / ex.evaluate(n.storage, point))
    return np.array(out, float)


def linear(plant, names, at=22.0):
    """A of the named nodes by central differences (exact for linear ones), and the point."""
    point = {p.name: p.value for p in plant.parameters.values()} | {
        n: 0.0 if n in ELECTRIC else at for n in plant.nodes
    }
    point |= {"drive": 0.0, "air": at, "t": 0.0}
    rows = [list(plant.nodes).index(n) for n in names]
    A = np.array(
        [
            (slopes(plant, point | {n: point[n] + 1e-3}) - slopes(plant, point | {n: point[n] - 1e-3}))[rows]
            / 2e-3
            for n in names
        ]
    ).T
    B = (slopes(plant, point | {"drive": 1.0}) - slopes(plant, point))[rows]
    return A, B, point


def heating(plant, power_w, hours, step_s=5.0):
    """Rises (N, 12) under a power course (N,) into the coil."""
    names = [n for n in plant.nodes if n not in ELECTRIC]
    A, _, point = linear(plant, names)
    b = np.zeros(12)
    b[0] = 1 / point["C_coil"]
    Ad = expm(A * step_s)
    Bd = np.linalg.solve(A, (Ad - np.eye(12)) @ b)
    x, out = np.zeros(12), []
    for k in range(int(hours * 3600 / step_s)):
        out.append(x)
        x = Ad @ x + Bd * power_w[min(k, len(power_w) - 1)]
    return names, np.array(out), -np.linalg.solve(A, b) * power_w[-1]


def test_coil_reaches_63_percent_of_its_rise_after_370_s(plant):
    _, rise, final = heating(plant, np.array([3.2]), 1.0)
    assert np.interp(0.632 * final[0], rise[:, 0], np.arange(len(rise)) * 5.0) == pytest.approx(370, abs=5)


def test_hour_of_trapezoids_brings_28_degrees_and_5_to_15_um(plant):
    values = {p.name: p.value for p in plant.parameters.values()}
    t = np.arange(0, 3600, 5.0) % 75
    x = 250e-6 * np.interp(t, [0, 15, 37.5, 52.5, 75], [0, 1, 1, 0, 0])  # 16.7 um/s: 1 mm/min
    power = values["R_20"] * (values["k_flexure"] * x / values["k_T"]) ** 2
    names, rise, _ = heating(plant, power, 1.0)
    assert 22 + rise[-1, 0] == pytest.approx(28, abs=0.8)
    error = sum(values[f"a_{n}"] * rise[:, names.index(n)] for n in names if f"a_{n}" in values)
    assert 5 < error.max() < 15


@pytest.mark.parametrize(("kp", "ti", "td", "average"), [(0.021, 0.004, 0.001, 1), (0.0105, 0.004, 0.001, 4)])
def test_paper_gains_hold_the_position_at_1_ms(plant, kp, ti, td, average):
    A, B, _ = linear(plant, list(ELECTRIC))
    full = expm(np.block([[A, B[:, None]], [np.zeros((1, 5))]]) * 1e-3)
    x, v, errors, readings, out = np.zeros(4), 0.0, [0.0, 0.0, 0.0], [0.0] * average, []
    for n in range(3000):
        readings = [*readings[1:], x[3] * 1e6]
        errors = [min(n * 1e-3 * 1000 / 60, 20.0) - np.mean(readings), *errors[:2]]
        v += kp * (
            (1 + 1e-3 / ti + td / 1e-3) * errors[0] - (1 + 2 * td / 1e-3) * errors[1] + td / 1e-3 * errors[2]
        )
        x = full[:4, :4] @ x + full[:4, 4] * v
        out.append(x[3] * 1e6)
    assert np.abs(np.array(out[-500:]) - 20.0).max() < 0.005  # the encoder's step
    assert max(out) < 20.5


def test_encoder_does_not_see_the_growth(plant):
    used = {o.name: ex.names(o.value) & set(plant.nodes) for o in plant.outputs.values()}
    assert used["position_um"] == {"position"}
    assert {"position", "bobbin", "shaft_1", "shaft_2"} <= used["output_reference_um"]


@pytest.mark.parametrize("name", ["actuator", "actuator_truth"])
def test_fast_stepper_agrees_with_fine_steps(name):
    """A step of the drive beyond the supply's limit and back: the exponential stepper against itself at 1/50 of the period."""
    model = compile_plant(load(PLANTS / f"{name}.yaml"), ())
    u = np.array([0.0, 22.0])
    coarse, fine = model.stepper(1e-3, u), model.stepper(2e-5, u, rtol=1e-9)
    for k in range(300):
        u[0] = 8.0 if 50 <= k < 60 else 0.4 * np.sin(0.05 * k)
        y = coarse.step(u)
        for _ in range(50):
            reference = fine.step(u)
    names = list(model.outputs)
    assert y[names.index("position_um")] == pytest.approx(reference[names.index("position_um")], abs=1e-3)
    assert y[names.index("coil_c")] == pytest.approx(reference[names.index("coil_c")], abs=1e-4)
