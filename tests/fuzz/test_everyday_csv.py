"""CSV files over locales, clocks, blanks and rates are read right, or refused in one true sentence: some of the study's cases."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from everyday_parts.judge import judge_case
from everyday_parts.write import build_case


@pytest.mark.parametrize("k", range(30))
def test_a_file_is_read_right_or_refused(k: int, tmp_path: Path) -> None:
    """`python experiments/everyday_csv.py --seed 0` tries ten thousand of them."""
    case = build_case((0, k), tmp_path)
    outcome, why = judge_case(case)
    assert outcome in ("read", "refused"), f"{case.described}: {why}"


def test_the_judge_sees_a_wrong_sample(tmp_path: Path) -> None:
    """A digit changed in the file is a fault; so the study cannot pass by comparing nothing."""
    case = next(c for k in range(40) if (c := build_case((0, k), tmp_path)).kind == "stamp / none")
    name = next(iter(case.channels))
    wrong = {**case.channels, name: np.asarray(case.channels[name]) + 1e-4}
    assert judge_case(case)[0] == "read"
    assert judge_case(type(case)(**{**case.__dict__, "channels": wrong}))[0] == "fault"
