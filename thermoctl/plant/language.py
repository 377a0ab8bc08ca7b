"""The content of a plant file (format thermoctl-plant/1, docs/reference/plant.md).

    storage * d(node)/dt = sum(flows into) - sum(flows from)          outputs = readings of perfect sensors

`load` reads a file, `from_plain` plain dicts. `Plant.plain` returns the dicts and `save` writes them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from thermoctl.plant.expression import Expr

FORMAT = "thermoctl-plant/1"
_ROLES = "ambient temperature position velocity current voltage setpoint level time_of_day"
ROLES = tuple(_ROLES.split())
"""Kinds of quantities, for units that fit several kinds."""
FLICKER_DECADES = 4  # range of a 1/f part: 20 000 samples reach from 1 / length to half the sampling rate


def _place() -> Any:
    """Return the field 'line:column' of an item's entry in its file, for messages; it takes no part in ==."""
    return field(default="0:0", compare=False)


@dataclass(frozen=True)
class SensorNoise:
    """A sensor's random error in its unit: a white part, and a slow part of first order or 1/f.

    `white` and `drift` are standard deviations and `time` is the time constant of `drift` in seconds.
    `flicker` is the standard deviation of the 1/f part over one decade of frequency. `sd` is the standard
    deviation of the logarithm of all of them: how well the noise is known."""

    white: float
    drift: float | None = None
    time: float | None = None
    flicker: float | None = None
    sd: float | None = None

    def __str__(self) -> str:
        slow = f", drift {self.drift:g} over {self.time:g} s" if self.drift is not None else ""
        slow += f", flicker {self.flicker:g}" if self.flicker is not None else ""
        return f"{self.white:g}{slow}"

    @property
    def total(self) -> float:
        """Return the standard deviation of all parts together, the 1/f part over FLICKER_DECADES."""
        return math.hypot(self.white, self.drift or 0.0, (self.flicker or 0.0) * math.sqrt(FLICKER_DECADES))


@dataclass(frozen=True)
class Conversion:
    """From a recorded column to the plant's unit: by the column's `unit`, else scale * column + offset."""

    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Input:
    """A recorded column that drives the simulation; `linear`: straight lines between samples, else held.

    `stated`: does the plant file state which? By default an input is held. `trusted`: see `Plant.trusts`."""

    name: str
    unit: str | None = None
    column: str = ""
    linear: bool = False
    role: str | None = None
    conversion: Conversion | None = None
    stated: bool = False
    trusted: bool = False
    at: str = _place()


@dataclass(frozen=True)
class Parameter:
    """A parameter; `range`: bounds of a refit (None: known); `values`: per recording.

    `known`: recordings in which a refit does not move it."""

    name: str
    value: float
    unit: str | None = None
    range: tuple[float, float] | None = None
    per_recording: bool = False
    values: Mapping[str, float] = field(default_factory=dict)
    at: str = _place()
    known: tuple[str, ...] = ()

    def value_in(self, recording: str) -> float:
        """Return its value in a recording, or in a part of one after a gap (`run_1_part2`)."""
        whole = re.sub(r"_part\d+$", "", recording)
        return self.values.get(recording, self.values.get(whole, self.value))


@dataclass(frozen=True)
class Node:
    """A stored quantity; `initial_sigma` is the standard deviation of its initial value (None: known)."""

    name: str
    storage: Expr
    initial: Expr
    unit: str | None = None
    initial_sigma: float | None = None
    role: str | None = None
    at: str = _place()


@dataclass(frozen=True)
class Flow:
    """A flow from node `source` to node `target`; one of them may be None, the surroundings."""

    name: str
    rate: Expr
    source: str | None = None
    target: str | None = None
    unit: str | None = None
    at: str = _place()


@dataclass(frozen=True)
class Output:
    """A sensor: `value` without error, `noise` its random error (a number: white), `resolution` its step.

    `sensed`: if a diagnosis added an error of the electronics, the part of `value` that they read.
    `trusted`: see `Plant.trusts`."""

    name: str
    value: Expr
    unit: str | None = None
    column: str = ""
    noise: float | SensorNoise | None = None
    resolution: float | None = None
    role: str | None = None
    conversion: Conversion | None = None
    trusted: bool = False
    at: str = _place()
    sensed: Expr | None = None

    @property
    def noise_sd(self) -> float:
        """Return the total standard deviation of the random error, in `unit`; 0 where none is stated."""
        return self.noise.total if isinstance(self.noise, SensorNoise) else self.noise or 0.0


@dataclass(frozen=True)
class Plant:
    """A checked plant. `trusted`: are all its readings correct (`trusts`)?"""

    title: str
    inputs: Mapping[str, Input]
    parameters: Mapping[str, Parameter]
    nodes: Mapping[str, Node]
    flows: Mapping[str, Flow]
    outputs: Mapping[str, Output]
    file: str = field(default="<plant>", compare=False)
    trusted: bool = False

    def readings(self) -> tuple[Input | Output, ...]:
        """Return everything that has a column in a recording: inputs, then outputs."""
        return (*self.inputs.values(), *self.outputs.values())

    def trusts(self, reading: str) -> bool:
        """Return whether a reading is right: if stated, and a setpoint always, as it was sent."""
        item = self.inputs.get(reading) or self.outputs[reading]
        return self.trusted or item.trusted or item.role == "setpoint"

    def plain(self) -> dict[str, Any]:
        """Return the file's content as plain dicts and lists; `files.from_plain` is the inverse."""
        content: dict[str, Any] = {
            "format": FORMAT,
            "title": self.title,
            **({"sensors": "trusted"} if self.trusted else {}),
            "inputs": {i.name: _input(i) for i in self.inputs.values()},
            "parameters": {p.name: _parameter(p) for p in self.parameters.values()},
            "nodes": {n.name: _node(n) for n in self.nodes.values()},
            "flows": {f.name: _flow(f) for f in self.flows.values()},
            "outputs": {o.name: _output(o) for o in self.outputs.values()},
        }
        return {k: v for k, v in content.items() if v or k not in ("nodes", "flows")}


def _given(**items: Any) -> dict[str, Any]:
    return {k.rstrip("_"): v for k, v in items.items() if v is not None and v != {}}


def _input(i: Input) -> dict[str, Any]:
    column = _column(i)
    between = "linear" if i.linear else "hold" if i.stated else None
    return _given(unit=i.unit, column=column, between_samples=between, role=i.role, trusted=i.trusted or None)


def _column(item: Input | Output) -> str | dict[str, Any] | None:
    c = item.conversion
    if c is None:
        return None if item.column == item.name else item.column
    parts = {"unit": c.unit} if c.unit else {"scale": c.scale, "offset": c.offset}
    return {"name": item.column, **parts}


def _parameter(p: Parameter) -> dict[str, Any]:
    return _given(
        value=p.value,
        unit=p.unit,
        range=list(p.range) if p.range else None,
        per_recording=p.per_recording or None,
        values=dict(p.values),
    )


def _node(n: Node) -> dict[str, Any]:
    return _given(
        unit=n.unit,
        storage=_scalar(n.storage),
        initial=_scalar(n.initial),
        initial_sigma=n.initial_sigma,
        role=n.role,
    )


def _flow(f: Flow) -> dict[str, Any]:
    return _given(from_=f.source, into=f.target, rate=_scalar(f.rate), unit=f.unit)


def _output(o: Output) -> dict[str, Any]:
    return _given(
        value=_scalar(o.value),
        column=_column(o),
        unit=o.unit,
        noise=_given(**asdict(o.noise)) if isinstance(o.noise, SensorNoise) else o.noise,
        resolution=o.resolution,
        role=o.role,
        trusted=o.trusted or None,
    )


def _scalar(e: Expr) -> str | float:
    return e.value if e.op == "num" else str(e)
