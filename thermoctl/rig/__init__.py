"""The declaration of a rig: its channels, the columns of its recordings, the row of an option."""
