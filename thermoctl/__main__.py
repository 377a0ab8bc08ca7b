"""`python -m thermoctl` is the command `thermoctl`."""

import runpy

runpy.run_module("thermoctl.cli", run_name="__main__")
