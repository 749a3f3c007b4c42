"""Random machines with loops, parts of their logs, hold-outs; the long campaign is `experiments/random_machines.py`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from jsonschema import Draft202012Validator

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts.judge_machines import judge_command, judge_diagnosis, judge_forces
from fuzz_parts.machines import MAX_JOINTS, build_machine

SCHEMA = Path(__file__).resolve().parents[2] / "docs" / "reference" / "result.schema.json"
QUICK = settings(derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
SEEDS = st.integers(0, 2**32)


def test_the_machines_are_what_is_said_of_them() -> None:
    """Up to twelve joints, most with loops, each of which leaves one freedom to its drive."""
    robots = [build_machine(seed)[0] for seed in range(12)]
    assert max(r.model.nv for r in robots) > 8 and sum(bool(r.loops) for r in robots) > 6
    for robot in robots:
        assert robot.model.nv == robot.na + 3 * len(robot.loops) <= MAX_JOINTS


@settings(QUICK, max_examples=12)
@given(SEEDS)
def test_forces_of_any_machine_obey_its_equations(seed: int) -> None:
    """`tau = Y pi = M a + h` with a mass matrix that is symmetric and positive, whatever tree and loops there are."""
    assert not judge_forces(seed)


def test_any_part_of_a_log_is_answered_or_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Columns gone, short pieces, any hold-outs: one sentence and status 2, or a result that agrees with the schema."""
    schema = Draft202012Validator(json.loads(SCHEMA.read_text()))

    @settings(QUICK, max_examples=8)
    @given(SEEDS)
    def case(seed: int) -> None:
        assert not judge_command(seed, tmp_path, schema)
        assert "Traceback" not in capsys.readouterr().err

    case()


@pytest.mark.parametrize("seed", [1, 3])
def test_a_models_own_data_have_no_finding(seed: int) -> None:
    """Without noise, too, nothing is confirmed where nothing hides, and nothing is called unexplained."""
    assert not judge_diagnosis(seed, 4)
