"""Unknown laws: proposals from the residual, their refits, their evidence, and their part of the result."""
