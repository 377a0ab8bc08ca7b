"""Recordings: tables of numbers, written crash-safe, read and exported in many formats."""
