"""Answers do not drift: every watched value is what was written down, and the same seed gives the same bytes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from golden_parts.cases import CASES, REASONS, Case, l1_log
from golden_parts.drift import drifted, read_golden

QUICK = [name for name, case in CASES.items() if not case.slow]


def test_every_case_is_written_down_and_every_tolerance_has_a_reason():
    """A case that nobody wrote down cannot drift, and a tolerance without a reason is a loosened one."""
    assert set(read_golden()) == set(CASES)
    assert all(len(reason) > 30 for _, reason in REASONS.values())
    for name, case in CASES.items():
        floats = [key for key, x in read_golden()[name].items() if isinstance(x, float)]
        assert floats and all(case.kind(key) != "exact" for key in floats)


@pytest.mark.parametrize("name", QUICK)
def test_answers_are_what_they_were(name, measured):
    """Measured and made data give the values that were written down, each within its tolerance."""
    case = CASES[name]
    for file in case.data:
        measured(file)
    folder = measured(case.data[0].split("/")[0]).parent if case.data else Path()
    assert drifted(case, case.compute(folder), read_golden()[name]) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in QUICK])
def test_slow_answers_are_what_they_were(name, measured):
    """The same for searches that take longer."""
    test_answers_are_what_they_were(name, measured)


def test_a_drift_is_seen():
    """A part in 10^5 on a least-squares value, another count and a lost value are each reported; rounding is not."""
    case = Case(lambda folder: {}, {"value": "fit"})
    written = {"value a": 2.0, "rank": 5, "gone": "x"}
    assert drifted(case, {"value a": 2.0 * (1 + 1e-8), "rank": 5, "gone": "x"}, written) == []
    off = drifted(case, {"value a": 2.0 * (1 + 1e-5), "rank": 6}, written)
    assert [row[0] for row in off] == ["gone", "rank", "value a"]


def identified(folder: Path, threads: int) -> dict:
    """Return the JSON of one identification in a process of its own."""
    out = folder / f"{threads}_{len(list(folder.iterdir()))}.json"
    command = [sys.executable, "-m", "tau_dyn.cli", "identify", "gantry_tau", str(folder / "made.csv"), "--quiet",
               "--seed", "3", "--json", str(out)]  # fmt: skip
    threaded = {k: str(threads) for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    subprocess.run(command, check=True, env={**os.environ, **threaded}, capture_output=True)
    return json.loads(out.read_text())


def numbers(value, path="") -> dict[str, float]:
    """Return every number of a result by its path."""
    if isinstance(value, dict):
        return {k: x for key, part in value.items() for k, x in numbers(part, f"{path}/{key}").items()}
    if isinstance(value, list):
        return {k: x for i, part in enumerate(value) for k, x in numbers(part, f"{path}/{i}").items()}
    return {path: float(value)} if isinstance(value, int | float) and not isinstance(value, bool) else {}


def test_the_same_seed_gives_the_same_bytes_and_blas_threads_change_nothing_beyond_rounding(tmp_path):
    """Run twice with one seed the JSON is equal, number for number; with two BLAS threads to 1e-8."""
    l1_log(5).to_csv(tmp_path / "made.csv")
    one, again, two = identified(tmp_path, 1), identified(tmp_path, 1), identified(tmp_path, 2)
    assert json.dumps(one) == json.dumps(again)
    a, b = numbers(one), numbers(two)
    assert a.keys() == b.keys() and len(a) > 100
    np.testing.assert_allclose(list(b.values()), list(a.values()), rtol=1e-8, atol=1e-12)
