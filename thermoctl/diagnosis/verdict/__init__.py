"""The decision: physics or misfit, confirmed or not, and the verdict."""

OVERRULED = "the findings predict held-out data worse than a refit alone"  # reason of a verdict
