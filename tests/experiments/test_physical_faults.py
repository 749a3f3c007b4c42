"""The list of faults that a physicist makes fits the code, so that a campaign runs from its first to its last."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from mutation_parts.physical import read_faults

ROOT = Path(__file__).resolve().parents[2]


def test_each_fault_changes_one_place_of_the_code() -> None:
    """What a fault replaces stands in its file exactly once."""
    faults = read_faults()
    assert len(faults) > 250
    assert not [f"{f.file}: {f.why}" for f in faults if f.path(ROOT).read_text(encoding="utf-8").count(f.old) != 1]
