"""The loop's process: its clock, the tick, the ring of rows and the shared memory."""
