"""Answers about the rig from shared memory, and their text for every view."""
