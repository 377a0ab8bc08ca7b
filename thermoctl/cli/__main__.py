"""`python -m thermoctl.cli` is the command `thermoctl`."""

import sys

from thermoctl.cli import main

sys.exit(main())
