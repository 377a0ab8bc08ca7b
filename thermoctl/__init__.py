"""thermoctl: thermal compensation of a precision linear actuator, and diagnosis of missing physics."""

__version__ = "0.1.0"
