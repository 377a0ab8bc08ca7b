"""Initial states of a simulation: given values, the steady state, or the last state of a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant import expression as ex
from thermoctl.plant.lacking import outputs_lacking
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.ahead import ahead, all_uncertain
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

BLOCKS = 50  # number of blocks of a recording whose last state is estimated
SETTLED = 1e-6  # largest change of a steady state, as a share of its size, over half a run
LONGER, RUNS = 4.0, 16  # each run to a steady state lasts so many times longer; the number of runs


def with_start(
    model: Model,
    excitation: Excitation,
    wanted: Mapping[str, float] | str | None,
    parameters: Mapping[str, float] | None = None,
) -> str:
    """Set the initial states of an excitation; return a note for people, or "".

    `wanted`: values by node, in the nodes' units; "steady"; None for the plant's own expressions. A node
    whose expression needs a reading that the recording lacks starts in the steady state of the first inputs.
    A part after a gap starts from its own first readings in any case.
    Raises InputError for an unknown node, and where there is no steady state."""
    values = {} if wanted is None or isinstance(wanted, str) else dict(wanted)
    for node in values:
        if node not in model.states:
            raise InputError(
                f"initial value of '{node}': {model.plant.file} has no such node"
                f"{suggest(node, model.states)}; the nodes are {', '.join(model.states)}"
            )
    x0 = np.array([values.get(n, np.nan) for n in model.states])
    if excitation.x0 is not None:
        x0 = excitation.x0.copy()
        wanted, values = None, dict(zip(model.states, x0, strict=True))
        values = {n: v for n, v in values.items() if np.isfinite(v)}
    lacking = [
        n for n in model.states if n not in values and (wanted == "steady" or _lacks(model, n, excitation))
    ]
    if lacking:
        calm = _steady(model, excitation, x0, parameters)
        for n in lacking:
            x0[model.states.index(n)] = calm[model.states.index(n)]
    excitation.x0 = x0
    if not lacking or wanted == "steady":
        return ""
    shown = ", ".join(
        f"{n} = {x0[model.states.index(n)]:.4g} {model.plant.nodes[n].unit or ''}".strip() for n in lacking
    )
    return f"no first reading: starts in the steady state of the first inputs, {shown} (else: --initial NODE=VALUE)"


def last_state(plant: Plant, table: Table) -> dict[str, float]:
    """Return the state at the end of a recording, by node, estimated from its inputs and readings.

    Raises InputError where it has none, or where the plant cannot be simulated on it."""
    model = compile_plant(all_uncertain(plant), ())
    excitation = model.excitation(table)
    if text := outputs_lacking(plant, table):
        raise InputError(text)
    if not np.isfinite(excitation.y).any():
        raise InputError(
            f"{table.path}: has no reading of {', '.join(o.column for o in plant.outputs.values())}; its last state "
            "cannot be estimated"
        )
    with_start(model, excitation, None)
    try:
        *_, state = ahead(model, excitation, float(excitation.t[-1]) / BLOCKS)
    except SimulationError as e:
        raise InputError(f"{table.path}: {e}") from None
    return dict(zip(model.states, map(float, state), strict=True))


def _lacks(model: Model, node: str, excitation: Excitation) -> bool:
    """Return whether a node's initial value needs a reading that the recording lacks."""
    return any(
        e.op == "first" and e.value not in excitation.first for e in ex.walk(model.plant.nodes[node].initial)
    )


def _steady(
    model: Model, excitation: Excitation, x0: np.ndarray, parameters: Mapping[str, float] | None
) -> np.ndarray:
    """Return the states (nx,) to which the first inputs lead when held. Raises InputError without any."""
    inputs = model.plant.inputs.values()
    airs = [float(excitation.u[0, j]) for j, i in enumerate(inputs) if i.role == "ambient"]
    x = np.where(np.isfinite(x0), x0, airs[0] if airs else 0.0)
    begin, travel = x, np.zeros(len(x))
    span = max(float(excitation.t[-1]), 1.0)
    for _ in range(RUNS):
        held = dataclasses.replace(
            excitation,
            t=np.array([0.0, span / 2, span]),
            u=np.repeat(excitation.u[:1], 3, axis=0),
            y=np.full((3, len(model.outputs)), np.nan),
            scale=None,
            width=None,
            x0=x,
        )
        try:
            run = model.run(held, parameters)
        except SimulationError:
            break
        moved, x = np.abs(run.x[2] - run.x[1]), run.x[2]
        travel = np.maximum(travel, np.abs(x - begin))
        if np.all(moved <= SETTLED * (np.abs(x) + travel)):
            return x
        span *= LONGER
    raise InputError(
        f"{excitation.name}: {model.plant.file} has no steady state at the first inputs; give the initial values: "
        f"{', '.join(f'{n}=VALUE' for n in model.states)}"
    )
