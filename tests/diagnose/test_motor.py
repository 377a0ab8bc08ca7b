"""A motor on a voltage whose plant lacks the back electromotive force; SciPy's solver makes the recordings."""

import numpy as np
from scipy.integrate import solve_ivp

from tests.diagnose.test_effect_units import MOTOR
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import load
from thermoctl.recording.table import Table

R, L, J, B, K = 1.3, 0.004, 9e-4, 2e-4, 0.082


def recording(levels: list[float], rng: np.random.Generator) -> Table:
    """Steps of voltage of a quarter of a second, 500 rows a second."""
    t = np.arange(0, 0.25 * len(levels), 0.002)
    voltage = np.repeat(levels, len(t) // len(levels))
    x, rows = np.zeros(2), [np.zeros(2)]
    for u in voltage[:-1]:
        slope = lambda _, y, u=u: [(u - R * y[0] - K * y[1]) / L, (K * y[0] - B * y[1]) / J]  # noqa: E731
        x = solve_ivp(slope, (0, 0.002), x, rtol=1e-8, atol=1e-10).y[:, -1]
        rows.append(x)
    i, w = np.array(rows).T
    read = {"current": i + rng.normal(0, 0.05, len(t)), "speed": w + rng.normal(0, 0.5, len(t))}
    return Table("run", "run", t, {"voltage": voltage, **read})


def test_the_voltage_of_motion_is_found_at_the_current_that_it_opposes(tmp_path):
    (tmp_path / "plant.yaml").write_text(MOTOR)
    rng = np.random.default_rng(5)
    runs = [recording([6, -4, 10, 2], rng), recording([-8, 3, 7, -2], rng)]
    found = diagnose(load(tmp_path / "plant.yaml"), runs, catalogue(), limits())
    assert found.decision.named == (("back_emf", "i"),)
    (effect,) = found.shown
    (name,) = effect.own.values()
    value, sd = found.best.plant.parameters[name].value, found.best.sd[name]
    assert abs(value - K) < 4 * sd and sd < 0.01 * K
