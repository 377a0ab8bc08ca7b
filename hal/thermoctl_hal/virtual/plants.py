"""The plants of a rig's axes, read as one. A role is AXIS.CHANNEL; a shared role is the first axis's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermoctl_hal.simulated.rig import PlantRig


class Plants:
    """`PlantRig` of several axes, as the virtual devices read it."""

    def __init__(self, of_axis: Mapping[str, PlantRig]) -> None:
        self._of_axis = of_axis
        first = next(iter(of_axis.values()))
        self.stepper = first.stepper
        self.index: dict[str, Any] = {role: role for role in first.index}
        self.index |= {f"{axis}.{role}": f"{axis}.{role}" for axis, p in of_axis.items() for role in p.index}

    def _at(self, role: str) -> tuple[PlantRig, str]:
        axis, _, own = role.rpartition(".")
        return self._of_axis[axis] if axis else next(iter(self._of_axis.values())), own

    def sense(self, role: str) -> float:
        """Return the reading of the sensor in this role; see PlantRig."""
        plant, own = self._at(role)
        return plant.sense(own)

    def true(self, role: str) -> float:
        """Return the true value; see PlantRig."""
        plant, own = self._at(role)
        return plant.true(own)

    def measured(self, role: Any, value: float) -> float:
        """Return the reading of a true value by the sensor `index[role]`; see PlantRig."""
        plant, own = self._at(role)
        return plant.measured(plant.index[own], value)


Readings = PlantRig | Plants
