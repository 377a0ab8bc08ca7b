"""The library of device profiles, and the commands about devices."""
