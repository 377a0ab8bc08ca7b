"""Rigs of any points, made from nothing but a plant file and a rig file."""
