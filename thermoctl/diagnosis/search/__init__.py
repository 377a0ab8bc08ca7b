"""The search for hypotheses: a score test of all entries at all places, and a beam search by refits."""
