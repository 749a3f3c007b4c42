"""The test bench of `evidence/bench.py` as a fixture."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "evidence"))
from bench import make  # noqa: F401
