"""The posterior of each hypothesis from earlier recordings: a diagnosis goes on without their data.

    log p(D_new, D_old | h) = log p(D_old | h) + log p(D_new | D_old, h)

The second term is the evidence of the new recordings. Its prior is the posterior of the old ones: a Gaussian
about the old optimum z with the curvature H there, own initial states eliminated. Noise and remainder are
averaged for each part of the data alone. For a hypothesis that the old diagnosis did not try, the prior is
the posterior of the largest tried hypothesis that it contains. Its other effects then have their original
priors.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.files.kept import reading
from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.language import Plant

FILE = "memory.json"
FORMAT = "thermoctl-memory/1"
KEPT = 12  # number of likeliest hypotheses that are remembered, beside the plant without any effect


@dataclass(frozen=True)
class PlacedBefore:
    """An effect of a remembered hypothesis: its candidate's label, and value and range of its parameters."""

    key: Key
    label: str
    values: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Past:
    """The posterior of one hypothesis from the old recordings: a Gaussian.

    - `unknowns` (k,): names of the parameters that all recordings share; `spans`: their ranges
    - `z` (k,): their optimum, 0..1 in the ranges; `precision` (k, k)
    - `squares`, `counts`: sum of squared residuals and number of rows of each output"""

    effects: tuple[PlacedBefore, ...] = ()
    unknowns: tuple[str, ...] = ()
    spans: tuple[tuple[float, float], ...] = ()
    z: np.ndarray = field(default_factory=lambda: np.zeros(0))
    precision: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    log_evidence: float = 0.0
    squares: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, float] = field(default_factory=dict)

    @property
    def keys(self) -> Keys:
        """Return the (effect, where) of each effect."""
        return frozenset(e.key for e in self.effects)


@dataclass(frozen=True)
class Memory:
    """All remembered hypotheses, and the names of the recordings that they were fitted to.

    `straight`: inputs that were read on straight lines, though the plant file does not say so"""

    hypotheses: tuple[Past, ...] = ()
    recordings: tuple[str, ...] = ()
    straight: tuple[str, ...] = ()

    def of(self, keys: Keys, plant: Plant) -> Past:
        """Return the posterior of a hypothesis, else of the largest, then likeliest, one that it contains."""
        ranges = {n: p.range for n, p in plant.parameters.items()}
        parts = [
            h
            for h in self.hypotheses
            if h.keys <= keys and all(ranges.get(q) == r for q, r in zip(h.unknowns, h.spans, strict=True))
        ]
        return max(parts, key=lambda h: (len(h.effects), h.log_evidence), default=Past())


NOTHING = Memory()


def stated(plant: Plant) -> dict[str, Any]:
    """Return the parts of a plant that must stay the same: its free parameters and its outputs."""
    return {
        "parameters": {n: [p.value, *p.range] for n, p in plant.parameters.items() if p.range},
        "outputs": list(plant.outputs),
    }


def write(folder: Path, plant: Plant, memory: Memory) -> None:
    """Write a memory into the folder of a result."""
    content = {
        "format": FORMAT,
        "plant": stated(plant),
        "recordings": list(memory.recordings),
        "straight": list(memory.straight),
        "hypotheses": [
            {
                **vars(h),
                "effects": [
                    {
                        "effect": e.key[0],
                        "where": e.key[1],
                        "label": e.label,
                        "values": e.values,
                        "ranges": e.ranges,
                    }
                    for e in h.effects
                ],
                "z": h.z.tolist(),
                "precision": h.precision.tolist(),
            }
            for h in memory.hypotheses
        ],
    }
    write_text(folder / FILE, json.dumps(content, allow_nan=False) + "\n")


def read(folder: Path, plant: Plant) -> Memory:
    """Read the memory of an earlier diagnosis of this plant. Raises InputError."""
    path = folder / FILE
    what, remedy = "the folder of an earlier diagnosis (its --out)", "diagnose all recordings again"
    with reading(path, what, f"--continue cannot go on; {remedy}"):
        content = json.loads(path.read_bytes())
        old_plant = content["plant"]
        past, straight = tuple(_past(h) for h in content["hypotheses"]), tuple(content.get("straight", ()))
        memory = Memory(past, tuple(content["recordings"]), straight)
    if old_plant != stated(plant):
        raise InputError(
            f"{plant.file}: its free parameters or outputs are not those of {path}: a diagnosis goes on with the plant "
            "file that it began with; diagnose all recordings again"
        )
    return memory


def _past(h: Mapping[str, Any]) -> Past:
    return Past(
        tuple(
            PlacedBefore(
                (e["effect"], e["where"]),
                e["label"],
                {n: float(v) for n, v in e["values"].items()},
                {n: (float(low), float(high)) for n, (low, high) in e["ranges"].items()},
            )
            for e in h["effects"]
        ),
        tuple(h["unknowns"]),
        tuple((float(low), float(high)) for low, high in h["spans"]),
        np.array(h["z"], float),
        np.array(h["precision"], float).reshape(len(h["z"]), len(h["z"])),
        float(h["log_evidence"]),
        h["squares"],
        h["counts"],
    )
