"""Rows of the command table: the library of device profiles."""

from __future__ import annotations

from thermoctl.command import RUN, Table, argument, command, option

TABLE: Table = {
    RUN: (
        command(
            "devices list",
            "list the device profiles that come with the program",
            "thermoctl.devices.library:list_all",
            "",
        ),
        command(
            "devices show",
            "show a device profile: its channels, where its facts come from, its text",
            "thermoctl.devices.library:show",
            "name",
            argument("name", metavar="NAME"),
        ),
        command(
            "devices search",
            "find device profiles by words: vendor, model, bus, channel; exit 1 when there is none",
            "thermoctl.devices.library:search",
            "words",
            argument("words", nargs="+", metavar="WORD"),
        ),
        command(
            "devices new",
            "ask for the facts of a device's manual and write its profile",
            "thermoctl.devices.new:new",
            "file",
            argument("file", metavar="FILE"),
        ),
        command(
            "devices probe",
            "read a device and show raw numbers, or the raw traffic of a port; drives nothing",
            "thermoctl.devices.probe:probe",
            "port profile address seconds baud",
            argument("port", metavar="PORT"),
            option("--profile", "NAME", "profile: a file, or a name of the library", default=""),
            option("--address", "N", "unit, node id or address (default: the profile's)", type=int),
            argument("--seconds", type=float, default=3.0, help="longest time to read for (default 3)"),
            argument("--baud", type=int, default=9600, help="baud rate without a profile (default 9600)"),
        ),
    )
}
