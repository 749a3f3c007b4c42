"""The example of docs/how_to/controller.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tau_dyn.control import read_reference
from tau_dyn.robot import load_robot

DOCUMENT = Path(__file__).parents[3] / "docs" / "how_to" / "controller.md"


def test_the_example_runs(tmp_path, monkeypatch) -> None:
    """It learns, and leaves a reference, a correction and a program behind."""
    monkeypatch.chdir(tmp_path)
    found = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(found[0], "controller.md", "exec"), names)
    before, after = names["done"].relative("motor_errors")[[0, -1]].max(axis=1)
    assert before == 100 and after < 5
    robot = load_robot("gantry_tau")
    assert read_reference("reference.csv", robot.actuated).n_samples == names["motion"].n_samples
    assert np.abs(names["sent"].q - names["motion"].q).max() > 1e-4
    assert {p.name for p in tmp_path.iterdir()} == {"reference.csv", "correction.csv", "motion.mod"}
    assert (
        "kin_ik" in names["kinematics"][0]
        and "tool_step" in names["observer"][1]
        and "ilc_update" in names["learning"][0]
    )
