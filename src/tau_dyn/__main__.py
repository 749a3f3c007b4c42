"""`python -m tau_dyn`: the command line, also if its script is not on the path."""

import sys

from tau_dyn.cli import main

sys.exit(main())
