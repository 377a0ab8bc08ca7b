"""Writes run_1.csv and run_2.csv: two heated blocks simulated by scipy alone, with a lamp on the second block for 400 s that
plant.yaml knows nothing of, other parameters than plant.yaml's, and noise. `python docs/examples/heater/make.py [FOLDER]`"""

import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

LEVELS_W = (0.0, 2.5, 0.8, 0.0, 1.6, 3.0, 0.0, 2.0)
LAMP_W, LAMP_S = 0.3, (500.0, 900.0)


def record(seed: int) -> np.ndarray:
    """(N, 5): t s, heat W, air, temperature_1 and temperature_2 in degC."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 1600.0, 2.0)
    heat = random.permutation(LEVELS_W)[(t // 200).astype(int)]
    air = 21.5 + 0.4 * np.sin(t / 700 + seed)
    x = np.empty((len(t), 2))
    x[0] = air[0]
    for k in range(len(t) - 1):

        def slope(s: float, q: np.ndarray, k: int = k) -> list[float]:
            a, between = np.interp(s, t, air), 0.026 * (q[0] - q[1])
            lamp = LAMP_W * (LAMP_S[0] <= s < LAMP_S[1])
            return [
                (heat[k] - between - 0.062 * (q[0] - a)) / 5.2,
                (between - 0.043 * (q[1] - a) + lamp) / 7.1,
            ]

        x[k + 1] = solve_ivp(slope, (t[k], t[k + 1]), x[k], rtol=1e-6, atol=1e-8).y[:, -1]
    return np.column_stack([t, heat, air, x + random.normal(0, 0.1, x.shape)])


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)
    for seed in (1, 2):
        np.savetxt(
            folder / f"run_{seed}.csv",
            record(seed),
            fmt="%.5g",
            delimiter=",",
            comments="",
            header="t,heat,air_temperature,temperature_1,temperature_2",
        )
