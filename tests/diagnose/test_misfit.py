"""Standard errors of sizes beside a misfit that nobody names: a block in draughts, whose reading is late."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import Placed, fitted
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search import beam
from thermoctl.diagnosis.verdict.misfit import deviations, energies
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

LAG_S, STEP_S, ROWS, LASTS_S = 12.0, 2.0, 600, 60.0
TRUTH = (
    ONE_BLOCK.replace("  air:", "  draught: {}\n  air:")
    .replace("rate: G *", "rate: (G + 0.06 * draught) *")
    .replace(
        "flows:",
        f"  seen: {{unit: degC, storage: 1, initial: air}}\nflows:\n  reading: {{into: seen, rate: (block - seen) / {LAG_S}}}",
    )
    .replace("{value: block", "{value: seen")
)


def draughts(rng: np.random.Generator, size: float) -> np.ndarray:
    """Return, by rows, a first-order random disturbance of a standard deviation."""
    x, kept = np.zeros(ROWS), 1 - STEP_S / LASTS_S
    for k in range(1, ROWS):
        x[k] = kept * x[k - 1] + size * np.sqrt(1 - kept**2) * rng.standard_normal()
    return x


def read_as(plant: str, effect: str) -> str:
    """Return a plant whose reading an effect may make late: its temperature, or its length."""
    if effect == "sensor_lag":
        return plant
    return re.sub(r"(\w+), unit: degC, noise: 0.1", r"5 * (\1 - 20), unit: um, noise: 0.5", plant)


def errors(seed: int, size: float, effect: str) -> tuple[float, float]:
    """Return the error of the fitted lag in standard errors of the refit, and in those of a result."""
    rng = np.random.default_rng(seed)
    columns = {
        "heat": np.repeat(rng.uniform(0, 3, 6), ROWS // 6),
        "air": np.full(ROWS, 20.0),
        "draught": draughts(rng, size),
    }
    table = compile_plant(loads(read_as(TRUTH, effect))).measure(
        Table("run", "run", STEP_S * np.arange(ROWS), columns), seed=seed
    )
    seen = {c: v for c, v in table.columns.items() if c != "draught"}
    plant, table = loads(read_as(ONE_BLOCK, effect)), dataclasses.replace(table, columns=seen)
    known = case(plant, [table], catalogue(), Budget(20))
    s = beam.started(known)
    rig = known.rig(known.plant, known.drives(known.null.model))
    c = next(c for c in candidates(rig, known.catalogue) if c.key[0] == effect)
    lag = Placed(c, {"TAU": c.own("TAU")})
    f = fitted(known, c.extend({"TAU": 5.0}, {"TAU": (0.5, 200.0)}), (lag,))
    s.keep([s.weighed(f)])
    sd = deviations(f, energies(known, beam.searched(s)), limits())
    away = f.plant.parameters[lag.own["TAU"]].value - LAG_S
    return away / f.sd[lag.own["TAU"]], away / sd[lag.own["TAU"]]


@pytest.mark.parametrize("size", [0.0, 0.3])
@pytest.mark.parametrize("effect", ["sensor_lag", "expansion_lag"])
def test_a_size_is_as_uncertain_as_the_misfit_beside_it_makes_it(effect, size):
    refit, result = np.sqrt(np.mean(np.square([errors(seed, size, effect) for seed in range(8)]), 0))
    assert result < 1.8  # 99.9 % of the rms of eight normal numbers
    assert refit > 2.0 if size else refit == pytest.approx(result)
