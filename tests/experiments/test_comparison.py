"""The comparison: all tools see the same samples and no held-out target, the missing are said, the page is what was measured."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
import comparison
from comparison_parts import page
from comparison_parts.case import Case, split_in_time
from comparison_parts.environments import TOOLS, Missing, ensure_environment
from comparison_parts.samples import write_samples
from comparison_parts.score import compare, judge, start_freely

from tau_dyn.log import Log
from tau_dyn.robot import load_robot

MASS, VISCOUS, COULOMB = 80.0, 150.0, 20.0


@pytest.fixture(scope="module")
def case() -> Case:
    """A lone axis of known mass and friction, 20 s at 200 Hz."""
    t = np.arange(0, 20, 0.005)
    w, size = np.array([[1.3], [4.1], [9.0]]), np.array([[0.1], [0.04], [0.01]])
    q, v, a = (
        np.sum(x, axis=0) for x in (size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t))
    )
    tau = MASS * a + VISCOUS * v + COULOMB * np.sign(v) + np.random.default_rng(1).normal(size=len(t))
    train, held = split_in_time(Log(t, {"q_axis": q, "tau_axis": tau}, "made"))
    return Case("made", "force", train, held, load_robot("linear_axis"))


def test_tools_get_the_same_samples_and_no_held_out_force(case: Case, tmp_path: Path) -> None:
    """Held-out files hold the motion alone; which samples count follows from the motion, not from the force."""
    (held,) = write_samples(case, tmp_path / "a")
    seen = dict(np.load(tmp_path / "a" / "held_00.npz"))
    assert set(seen) == {"t", "q", "v", "a"} and "tau" in np.load(tmp_path / "a" / "train_00.npz")
    assert len(list((tmp_path / "a" / "logs").iterdir())) == 1
    log = case.held[0]
    other = replace(case, held=[replace(log, channels={**log.channels, "tau_axis": 3 * log.channels["tau_axis"] + 5})])
    (changed,) = write_samples(other, tmp_path / "b")
    assert np.array_equal(held.counts, changed.counts) and 0.3 < held.counts.mean() < 0.95
    assert np.all(np.abs(seen["v"][held.counts]) > 0.01)
    assert judge(case, [held], [held.target]).errors()[0] < 1e-9
    assert judge(case, [held], [np.zeros_like(held.target)]).errors()[0] == pytest.approx(100)
    with pytest.raises(ValueError, match="other samples"):
        judge(case, [held], [held.target[1:]])


def test_a_missing_tool_is_said_and_the_others_run(case: Case) -> None:
    """The baseline predicts a plain axis to its noise; a tool that is absent and one that does not apply leave a reason."""
    python = {"baseline": sys.executable, "SLICOT": sys.executable, "FIGAROH": "not installed: no network"}
    rows = {row["tool"]: row for row in comparison.run_case(case, python)}
    assert rows["FIGAROH"]["skipped"] == "not installed: no network" and "does not apply" in rows["SLICOT"]["skipped"]
    assert rows["baseline"]["errors"][0] < 2.0 and rows["baseline"]["lines"] > 20
    mass, stderr = rows["baseline"]["parameters"]["axis.mass"]
    assert mass == pytest.approx(MASS, rel=0.01) and 0 < stderr < 1
    assert rows["baseline"]["parameters"]["axis.coulomb"][0] == pytest.approx(COULOMB, rel=0.03)
    absent = next(name for name, tool in TOOLS.items() if tool.absent)
    with pytest.raises(Missing, match="not installed"):
        ensure_environment(absent, Path("nowhere"))


def test_a_difference_is_told_by_blocks(case: Case, tmp_path: Path) -> None:
    """Twice the residual is a difference beyond its interval; the same residual of other sign is none."""
    (held,) = write_samples(case, tmp_path)
    noise = np.random.default_rng(2).normal(size=held.target.shape)
    one, same, twice = (judge(case, [held], [held.target + k * noise]) for k in (1, -1, 2))
    assert compare(one, twice, 0)[2] < 0 < compare(twice, one, 0)[1]
    assert compare(one, same, 0) == pytest.approx((0, 0, 0), abs=1e-6)


def test_a_free_simulation_starts_where_it_fits_best() -> None:
    """What an unknown initial state adds to a decaying oscillation is taken out, and nothing else."""
    A, C = 0.99 * np.array([[0.9, 0.4358899], [-0.4358899, 0.9]]), np.array([[1.0, 0.3]])
    free = np.array([C @ np.linalg.matrix_power(A, k) @ [2.0, -1.0] for k in range(200)])
    forced = np.sin(0.05 * np.arange(200))[:, None]
    found = start_freely(forced + free, forced, {"A": A, "C": C})
    assert np.allclose(found, forced + free, atol=1e-8)


def test_the_page_is_what_was_measured() -> None:
    """The page follows from the stored table; every set where we are behind is explained."""
    table = page.read_table()
    text = page.PAGE.read_text(encoding="utf-8")
    assert text == page.build_page(table) and "not explained" not in text
    verdicts = page.judge_sets(table)
    measured = [name for name in verdicts if not name.startswith("simulated")]
    assert len(measured) >= 9 and table.loc[table["error"].notna(), "tool"].nunique() >= 4
    assert not "".join(table.loc[table["tool"] == page.OURS, "false_causes"])
