"""Tests of the documentation need the documentation: where the package alone is tested, there is nothing to read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
collect_ignore_glob = [] if (ROOT / "docs" / "index.md").is_file() else ["test_*.py"]
