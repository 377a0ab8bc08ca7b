"""The numbers of an exported plant: parameters, scales of states, widths of jumps, first readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.equations import Equations
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


@dataclass(frozen=True)
class Values:
    """The numbers that an export writes as defaults.

    - `parameters`: by name, of the recording where it has its own
    - `width`: half width of each jump, in the order of `Equations.jumps`; 0 is a true jump
    - `scale`: range of each state; empty: the export estimates it from the start
    - `first`: first reading of each output that `first()` asks for"""

    parameters: Mapping[str, float]
    width: tuple[float, ...]
    scale: tuple[float, ...] = ()
    first: Mapping[str, float] = field(default_factory=dict)


def values(plant: Plant, equations: Equations, recording: Table | None = None) -> Values:
    """Return the numbers of an export; `recording` gives first readings and ranges.

    Raises InputError where the plant needs a recording and none is given."""
    asked = first_outputs(plant)
    if recording is None:
        if asked:
            raise InputError(
                f"{plant.file}: an initial value reads first({asked[0]}), an output: give a recording (--data REC)"
            )
        for jump, kind in equations.jumps:
            if kind == "state":
                raise InputError(
                    f"{plant.file}: the jump at {jump} = 0 depends on a state, so its width is a share of the range that "
                    "the argument has in a recording: give one (--data REC)"
                )
        return Values({p.name: p.value for p in plant.parameters.values()}, (0.0,) * len(equations.jumps))
    model = compile_plant(plant, ())
    excitation = model.prepare(model.excitation(recording))
    assert excitation.width is not None and excitation.scale is not None
    own = dict(zip(model.parameters, map(float, model.vector(None, excitation.name)), strict=True))
    first = {}
    for name in asked:
        if name not in excitation.first:
            raise InputError(f"{recording.path}: first({name}) is asked for, but the recording has no value")
        first[name] = excitation.first[name]
    width = tuple(map(float, excitation.width[: len(equations.jumps)]))
    return Values(own, width, tuple(map(float, excitation.scale)), first)


def first_outputs(plant: Plant) -> list[str]:
    """Return the outputs whose first reading an initial value needs."""
    used = {e.value for n in plant.nodes.values() for e in ex.walk(n.initial) if e.op == "first"}
    return [o for o in plant.outputs if o in used]
