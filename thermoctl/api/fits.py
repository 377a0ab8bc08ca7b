"""The result of a refit: parameters, residual tests and profile likelihood."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.api.plants import Plant
from thermoctl.api.plots import profile_curve, residual_panels
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant.fitting.estimate import Estimate, report, starts, updated
from thermoctl.plant.fitting.refit import Fit, fit
from thermoctl.plant.simulation.simulate import Excitation, compile_plant
from thermoctl.report.page import figure, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Refit:
    """Fitted parameters. `before` is the plant as it came; `residuals` are measured - simulated."""

    before: Plant
    fit: Fit
    excitations: tuple[Excitation, ...]

    @property
    def plant(self) -> Plant:
        """The plant with the fitted values."""
        return Plant(updated(self.before.description, self.fit, self.excitations))

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Value, standard error, state and trade-offs of each fitted parameter, by name.

        One of a recording of its own is called `NAME (RECORDING)`."""
        estimates = report(self.fit, self.excitations)
        return {f"{e.name} ({e.recording})" if e.recording else e.name: e for e in estimates}

    @property
    def starts(self) -> dict[str, dict[str, float]]:
        """Fitted initial values by recording and node, as `simulate` takes them: `x0=starts[RECORDING]`."""
        return starts(self.fit, self.excitations)

    @property
    def rms(self) -> dict[str, float]:
        """Root-mean-square residual of each output over all recordings."""
        return self.fit.rms()

    def residuals(self, output: str) -> np.ndarray:
        """Return one output's residuals of all recordings, one after the other, without missing samples."""
        outputs = self.fit.model.outputs
        if output not in outputs:
            raise InputError(
                f"'{output}' is not an output{suggest(output, outputs)}; {', '.join(outputs)} are"
            )
        j = outputs.index(output)
        e = np.concatenate([r[:, j] for r in self.fit.residuals])
        return e[np.isfinite(e)]

    def plot(self, output: str | None = None) -> Figure:
        """Return residuals of an output (default: the first), ACF, cumulated periodogram and QQ.

        White noise stays inside the 95 % bounds of the last three."""
        name = output or self.fit.model.outputs[0]
        return residual_panels(self.residuals(name), name, self.before.description.outputs[name].unit)

    def profile(self, parameter: str, points: int = 13, reach: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
        """Return values (points,) of a parameter and the rise of -2 log likelihood (points,) there.

        The other parameters are fitted anew at each. A rise of 3.84 bounds the 95 % interval. `reach`: half
        the width in standard errors. Raises InputError for a parameter that was not fitted."""
        estimate = self.parameters.get(parameter)
        limits = self.before.description.parameters[parameter].range if estimate else None
        if estimate is None or limits is None:
            names = list(self.parameters)
            raise InputError(
                f"'{parameter}' was not fitted{suggest(parameter, names)}; {', '.join(names)} were"
            )
        sd = estimate.sd if np.isfinite(estimate.sd) else limits[1] - limits[0]
        low, high = max(estimate.value - reach * sd, limits[0]), min(estimate.value + reach * sd, limits[1])
        others = tuple(q for q in self.fit.model.active if q != parameter)
        values, rise = np.linspace(low, high, points), np.empty(points)
        start = self.fit.parameters()
        for k, value in enumerate(values):
            description = self.plant.with_values({parameter: value}).description
            known = dataclasses.replace(description.parameters[parameter], range=None)
            fixed = dataclasses.replace(description, parameters={**description.parameters, parameter: known})
            again = fit(
                compile_plant(fixed, others),
                self.excitations,
                self.fit.noise,
                {**start, parameter: float(value)},
            )
            rise[k] = again.cost
        return values, rise - min(float(rise.min()), self.fit.cost)

    def plot_profile(self, parameter: str) -> Figure:
        """Return the profile likelihood of a parameter. Raises InputError for one that was not fitted."""
        unit = (
            self.before.description.parameters[parameter].unit
            if parameter in self.before.parameters
            else None
        )
        return profile_curve(*self.profile(parameter), parameter, unit)

    def __repr__(self) -> str:
        shown = ", ".join(f"{n} = {e.value:.5g} ± {e.sd:.2g}" for n, e in self.parameters.items())
        return f"<Refit: {shown}>"

    def _repr_html_(self) -> str:
        rows = [
            (n, f"{e.value:.6g}", f"{e.sd:.2g}", e.unit or "", e.state) for n, e in self.parameters.items()
        ]
        return table(("parameter", "value", "standard error", "unit", "state"), rows) + figure(self.plot())
