"""Every bus of a device profile: the one place where a bus is entered.

A row names functions and classes as text. They are imported for a profile of that bus only, because
a bus may need packages of an extra.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple


class Bus(NamedTuple):
    """The parts of a bus, each written `module:name`."""

    spec: str  # reads the bus's section of a profile: (profile, folder) -> BusSpec
    source: str  # reads the keys that locate a channel's value: (channel, BusSpec) -> Source
    driver: str  # the class of the driver, a thermoctl_hal.base.device.Device
    drive: str = ""  # the driver of an amplifier that messages command, where it is another class
    section: str = ""  # name of the bus's section in a profile; '': its keys are keys of the profile
    table: str = ""  # table of the section's keys in profiles/keys.py
    has_line: bool = False  # a profile may have the settings of a serial line
    ports: tuple[str, str] = (".*", "")  # pattern of a port, and how it is written


_HOST = r"(\[[^]]+\]|[^:/]+):\d+/?"
_SERIAL = (rf"\.{{0,2}}/.+|socket://{_HOST}", "/dev/serial/by-id/... or socket://host:port")
_CAN = (
    r"\w+:[^@]+(@[1-9]\d*(,\d+)?)?",
    "interface:channel@bitrate with the bitrate in bit/s, as slcan:/dev/ttyACM0@500000 or socketcan:can0@500000",
)
_MODBUS = (
    rf"tcp:{_HOST}|rtu:(\.{{0,2}}/.+|socket://{_HOST})",
    "tcp:host:port, rtu:/dev/serial/by-id/... or rtu:socket://host:port",
)

BUSES = {
    "serial-binary": Bus(
        "thermoctl_hal.serial.read:read_frame",
        "thermoctl_hal.serial.read:read_field",
        "thermoctl_hal.serial.port:SerialDevice",
        "thermoctl_hal.serial.drive:SerialDrive",
        "frame",
        "frame",
        True,
        ports=_SERIAL,
    ),
    "serial-lines": Bus(
        "thermoctl_hal.serial.read:read_text",
        "thermoctl_hal.serial.read:read_text_field",
        "thermoctl_hal.serial.port:SerialDevice",
        "thermoctl_hal.serial.drive:SerialDrive",
        "text",
        "text",
        True,
        ports=_SERIAL,
    ),
    "can-dbc": Bus(
        "thermoctl_hal.can.read:read_dbc",
        "thermoctl_hal.can.read:read_signal",
        "thermoctl_hal.can.dbc:DbcDevice",
        "thermoctl_hal.can.dbc:DbcDrive",
        table="can-dbc",
        ports=_CAN,
    ),
    "can-cia402": Bus(
        "thermoctl_hal.can.read:read_cia402",
        "thermoctl_hal.can.read:read_object",
        "thermoctl_hal.can.drive:Cia402Device",
        section="cia402",
        table="cia402",
        ports=_CAN,
    ),
    "modbus": Bus(
        "thermoctl_hal.modbus.read:read_modbus",
        "thermoctl_hal.modbus.read:read_register",
        "thermoctl_hal.modbus.device:ModbusDevice",
        "thermoctl_hal.modbus.device:ModbusDrive",
        "modbus",
        "modbus",
        True,
        ports=_MODBUS,
    ),
    "ethercat": Bus(
        "thermoctl_hal.ethercat.read:read_ethercat",
        "thermoctl_hal.ethercat.read:read_place",
        "thermoctl_hal.ethercat.device:EthercatDevice",
        section="ethercat",
        table="ethercat",
    ),
}


def part(name: str) -> Any:
    """Import a part `module:name`. Raises ImportError where its extra is missing."""
    module, _, item = name.partition(":")
    return getattr(import_module(module), item)
