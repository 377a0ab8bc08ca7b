"""Plants for other programs: C, FMU, Python, Modelica."""
