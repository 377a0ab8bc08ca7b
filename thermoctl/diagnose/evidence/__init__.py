"""A hypothesis refitted: likelihood with noise and remainder, prior odds, log evidence, and what it leaves."""
