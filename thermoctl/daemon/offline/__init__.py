"""The rig without a daemon: doctor, simulated time and replay."""
