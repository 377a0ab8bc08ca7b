"""Hypotheses: the catalogue's entries, the places of a plant, and a plant with an entry at a place."""
