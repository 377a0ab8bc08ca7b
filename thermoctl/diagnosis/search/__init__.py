"""The search for hypotheses: a score test of all entries at all places, and a beam that grows by refits."""
