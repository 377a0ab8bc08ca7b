"""Results of a simulation and of a diagnosis."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.api.plants import Plant
from thermoctl.api.plots import over_time
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.plant.simulation.simulate import Simulation as Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Simulation:
    """A free run. `t` (N,) s; `outputs`, `states` and `errors` (measured - simulated) by name, (N,) each."""

    plant: Plant
    excitation: Excitation
    run: Run

    @property
    def t(self) -> np.ndarray:
        """Seconds from the recording's first sample."""
        return self.excitation.t

    @property
    def outputs(self) -> dict[str, np.ndarray]:
        """Return the readings of sensors without noise (N,), by output."""
        return dict(zip(self.plant.description.outputs, self.run.y.T, strict=True))

    @property
    def states(self) -> dict[str, np.ndarray]:
        """Return the values (N,) of the nodes, by node."""
        return dict(zip(self.plant.description.nodes, self.run.x.T, strict=True))

    @property
    def last(self) -> dict[str, float]:
        """Return the nodes' last values: `x0` of a run that continues from here."""
        return {n: float(x[-1]) for n, x in self.states.items()}

    @property
    def errors(self) -> dict[str, np.ndarray]:
        """Return measured minus simulated outputs (N,), by output; NaN where not measured."""
        return dict(zip(self.plant.description.outputs, (self.excitation.y - self.run.y).T, strict=True))

    @property
    def rms(self) -> dict[str, float]:
        """Root-mean-square error of each output, NaN where not measured."""
        return {
            o: float(np.sqrt(np.nanmean(e**2))) if np.isfinite(e).any() else float("nan")
            for o, e in self.errors.items()
        }

    def plot(self) -> Figure:
        """Return measured and simulated outputs over time."""
        return over_time(self.plant.description, self.excitation, {"simulated": self.run.y})


def joined(
    plant: Plant, drives: Sequence[Excitation], runs: Sequence[Run], begins: Sequence[float]
) -> Simulation:
    """Return the runs of a recording's parts, which begin at `begins`, s, as one."""
    t = np.concatenate([d.t + b for d, b in zip(drives, begins, strict=True)])
    whole = dataclasses.replace(
        drives[0], t=t, u=np.concatenate([d.u for d in drives]), y=np.concatenate([d.y for d in drives])
    )
    return Simulation(
        plant, whole, Run(t, np.concatenate([r.x for r in runs]), np.concatenate([r.y for r in runs]))
    )
