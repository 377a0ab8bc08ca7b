"""The decision: physics or misfit, confirmed or not, and the verdict."""
