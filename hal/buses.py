"""Every bus of a device profile: the one place where a bus is entered.

A row names functions and classes as `module:name`. They are imported for a profile of that bus only, because
a bus may need packages of an extra.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple


class Bus(NamedTuple):
    """The parts of a bus; a part `module:name` is in this package."""

    spec: str  # reads the bus's section of a profile: (profile, folder) -> BusSpec
    source: str  # reads the keys that locate a channel's value: (channel, BusSpec) -> Source
    driver: str  # the class of the driver, a thermoctl_hal.device.Device
    drive: str = ""  # the driver of an amplifier that messages command, where it is another class
    section: str = ""  # name of the bus's section in a profile; '': its keys are keys of the profile
    table: str = ""  # table of the section's keys in keys.TABLES
    has_line: bool = False  # a profile may have the settings of a serial line


BUSES = {
    "serial-binary": Bus(
        "read_serial:read_frame",
        "read_serial:read_field",
        "serial_port:SerialDevice",
        "serial_drive:SerialDrive",
        "frame",
        "frame",
        True,
    ),
    "serial-lines": Bus(
        "read_serial:read_text",
        "read_serial:read_text_field",
        "serial_port:SerialDevice",
        "serial_drive:SerialDrive",
        "text",
        "text",
        True,
    ),
    "can-dbc": Bus(
        "read_can:read_dbc", "read_can:read_signal", "dbc:DbcDevice", "dbc:DbcDrive", table="can-dbc"
    ),
    "can-cia402": Bus(
        "read_can:read_cia402", "read_can:read_object", "drive:Cia402Device", section="cia402", table="cia402"
    ),
    "modbus": Bus(
        "read_modbus:read_modbus",
        "read_modbus:read_register",
        "modbus:ModbusDevice",
        "modbus:ModbusDrive",
        "modbus",
        "modbus",
        True,
    ),
    "ethercat": Bus(
        "read_ethercat:read_ethercat",
        "read_ethercat:read_place",
        "ethercat:EthercatDevice",
        section="ethercat",
        table="ethercat",
    ),
}


def part(name: str) -> Any:
    """Import a part `module:name` of this package. Raises ImportError where its extra is missing."""
    module, _, item = name.partition(":")
    return getattr(import_module(f"{__package__}.{module}"), item)
