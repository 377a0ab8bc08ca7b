"""The typed configuration of a rig, and the rule by which a command finds its file."""
