"""Hypotheses: the catalogue's entries, the places in a plant, and a plant with an entry at a place."""
