"""The old name of `Rig`, for modules that have not changed it yet."""

from thermoctl.diagnosis.hypothesis.rig import Rig

Structure = Rig
