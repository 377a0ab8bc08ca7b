"""Which hypotheses are tried: the score test of all entries at all places, and a beam that grows by refits."""
