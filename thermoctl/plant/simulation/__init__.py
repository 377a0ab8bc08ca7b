"""Runs of a plant: its equations as machine code, the integrator, readings of its sensors, the start."""
