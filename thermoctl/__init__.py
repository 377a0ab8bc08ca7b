"""thermoctl: thermal compensation of a precision linear actuator, and the diagnosis of physics its model left out."""

__version__ = "0.1.0"
