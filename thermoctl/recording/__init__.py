"""Recordings: tables of numbers, written crash-safe, read in the formats that people bring, exported to more."""
