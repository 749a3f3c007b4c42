"""Spoiled logs: the independent simulator agrees with ours, and a spoiled log is judged by its true code."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
import spoiled_logs
from spoiled_logs_parts.corruptions import CORRUPTIONS
from spoiled_logs_parts.machines import draw_motion, make_log

from tau_dyn.model import Model


@pytest.mark.parametrize("machine", ["planar_2r", "gantry_tau", "linear_axis"])
def test_both_simulators_give_the_same_forces(machine: str) -> None:
    """Lagrange's equations written out and our regressor at the true values differ by friction and noise only."""
    made = make_log(machine, 0, noise=0.0)
    q, v, a = draw_motion(made.robot, made.log.t, np.random.default_rng([spoiled_logs.MACHINES.index(machine), 0]))
    names = made.robot.parameters.names
    rigid = Model.of(made.robot).mechanism.regressor(q, v, a) @ np.array([made.truth[n] for n in names])
    for k, joint in enumerate(made.robot.actuated):
        coulomb, viscous = (
            [made.truth[f"{joint}.{kind}_{side}"] for side in ("pos", "neg")] for kind in ("coulomb", "viscous")
        )
        forward = v[:, k] > 0
        friction = np.where(forward, coulomb[0] + viscous[0] * v[:, k], -coulomb[1] + viscous[1] * v[:, k])
        assert made.force[:, k] == pytest.approx(rigid[:, k] + friction, abs=1e-8 * np.abs(made.force).max())


def test_a_spoiled_log_is_a_row_with_its_true_code() -> None:
    """A lone axis with its force reversed is named; a sound one is not."""
    assert len(CORRUPTIONS) >= 40 and len({c.name for c in CORRUPTIONS}) == len(CORRUPTIONS)
    spoiled = spoiled_logs.make_row(("linear_axis", "zero_5%", 0, 0, 0.15))
    clean = spoiled_logs.make_row(("linear_axis", "clean", 0, 0, 0.15))
    assert spoiled["named"] and spoiled["codes"] == "zero_force_runs"
    assert clean["codes"] == "" and clean["off"] == 0
