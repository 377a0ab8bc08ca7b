"""How inputs go on between rows, where the plant file does not say: held, or on straight lines.

A logger that polls a device records a switch up to one row late, half a row on average. Held until the next
row, such an input is late by this half. Refits of the plant imitate that by lags and hidden masses. On
straight lines the mean is right, if the input enters in proportion: the heat of a current does not. An input
that is held, and logged a whole row late, stays held: the catalogue has an effect for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from thermoctl.checks.data import driving_inputs
from thermoctl.diagnosis.data.case import FAILS, ROUGH, Budget, Case
from thermoctl.diagnosis.evidence.fit import fitted
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant

# Nats by which straight lines have to fit better. Where inputs are held, they fitted at most 13 better, on 11
# real rigs, 4 systems and 20 generated cases, and 32 where radiation is missing in four recordings. Where
# switches lie between rows, it was 19 to 2700 on 18 rigs.
CLEARLY = 40.0


def between(plant: Plant, made: Callable[[Plant], Case]) -> Case:
    """Return the case of a plant, or that with straight inputs, if the plant alone fits clearly better so.

    `made`: makes the case of a plant. Inputs whose file states how they go on are left alone. A diagnosis
    that goes on reads them as it did before. Raises InputError."""
    case = made(plant)
    past, moving = case.memory, case.rig(case.plant, case.drives(case.null.model)).moving_inputs
    asked = past.straight if past.recordings else moving
    loose = [
        i
        for i in driving_inputs(plant)
        if i.name in asked and not (i.linear or i.stated) and _in_proportion(plant, i.name)
    ]
    if not loose:
        return case
    inputs = {**plant.inputs} | {i.name: dataclasses.replace(i, linear=True) for i in loose}
    if past.recordings:
        return made(dataclasses.replace(plant, inputs=inputs))
    try:
        held, straight = alone(case), alone(case, dataclasses.replace(case.plant, inputs=inputs))
        if straight <= held + CLEARLY or alone(case, _early(case, [i.name for i in loose])) > straight:
            return case
    except FAILS:
        return case
    better, names = made(dataclasses.replace(plant, inputs=inputs)), ", ".join(f"'{i.name}'" for i in loose)
    better.notes.append(
        f"straight lines between the rows of {names} let the plant alone follow the recordings better ({straight - held:.0f} nats), as "
        "where a switch is logged up to a row late: taken so; between_samples in the plant file says what is right"
    )
    return better


def _in_proportion(plant: Plant, name: str) -> bool:
    """Return whether all flows and outputs are in proportion to an input, beside parts without it."""
    read = [*(f.rate for f in plant.flows.values()), *(o.value for o in plant.outputs.values())]
    return not any(
        name in ex.names(ex.derivative(ex.undelayed(e), name)) for e in read if name in ex.names(e)
    )


def _early(case: Case, inputs: Sequence[str]) -> Plant:
    """Return the plant with its inputs a row earlier, as held inputs fit that are logged a row late."""
    row = float(np.median(np.concatenate([np.diff(t.t) for t in case.tables])))
    early = {i: ex.make("delay", ex.name(i), ex.num(-row)) for i in inputs}
    plant = case.plant
    flows = {k: dataclasses.replace(f, rate=ex.fill(f.rate, early)) for k, f in plant.flows.items()}
    outputs = {k: dataclasses.replace(o, value=ex.fill(o.value, early)) for k, o in plant.outputs.items()}
    return dataclasses.replace(plant, flows=flows, outputs=outputs)


def alone(case: Case, plant: Plant | None = None) -> float:
    """Return the log evidence of the case's plant, or of another one, without effects.

    Raises SimulationError; InputError for a delay within a delay."""
    uncounted = dataclasses.replace(case, budget=Budget(1))
    if plant is not None:
        model = compile_plant(plant)
        null = fit(model, case.drives(model), case.noise, tolerance=ROUGH, seconds=np.inf)
        uncounted = dataclasses.replace(uncounted, plant=plant, null=null)
    return fitted(uncounted, uncounted.plant, (), uncounted.null).log_evidence
