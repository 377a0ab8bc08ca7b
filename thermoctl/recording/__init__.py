"""Recordings: tables of numbers, written crash-safe, read in the formats that people bring, exported to more."""

from thermoctl.recording.table import Table, read_table, write_table

__all__ = ["Table", "read_table", "write_table"]
