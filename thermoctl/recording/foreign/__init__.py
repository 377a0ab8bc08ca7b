"""Recordings of other programs and loggers: their clock, layout, units and numbers."""
