"""The diagnosis on one probability model: hypotheses, their log evidence, and what follows from it."""
