"""Recordings of a diagnosis: outliers, means over blocks, frequencies, and memory of earlier recordings."""
