"""`python -m tau_dyn.cli`."""

import sys

from tau_dyn.cli import main

sys.exit(main())
