"""Hypotheses refitted: likelihood with noise and remainder, prior odds, log evidence."""
