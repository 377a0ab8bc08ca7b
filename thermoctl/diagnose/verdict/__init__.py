"""What the tried hypotheses say: physics or misfit, confirmed or not, and the verdict."""
