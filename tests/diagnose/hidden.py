"""Logs with hidden effects for tests of `diagnose`; the generator is `experiments/hidden_effects_parts/`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from hidden_effects_parts import body_forms, drive_forms, friction_forms, slip_forms, unknown_forms
from hidden_effects_parts.judge import judgement, row_of
from hidden_effects_parts.sets import HiddenSet, draw_set

__all__ = [
    "HiddenSet",
    "body_forms",
    "draw_set",
    "drive_forms",
    "friction_forms",
    "judgement",
    "row_of",
    "slip_forms",
    "unknown_forms",
]
