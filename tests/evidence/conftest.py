"""The test bench of `bench.py` as a fixture."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from bench import make  # noqa: F401
