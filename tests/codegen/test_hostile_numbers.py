"""No exported program answers with a number that no drive would take, whatever it is given; nothing of it is undefined in C.

The driver is that of `experiments/fuzz_exports.py`, with a few thousand calls: status 0 comes with finite outputs within their
limits, any other status leaves outputs and state as they were.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tau_dyn.robot import load_robot, load_robot_from_urdf

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

from fuzz_parts.exported_programs import (  # noqa: E402
    FILTERS,
    build_model,
    fuzz_feedforward,
    fuzz_filter,
    fuzz_fmu,
    fuzz_kinematics,
    fuzz_python,
)

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
CALLS = 3000
IRB140 = Path(__file__).parents[2] / "experiments" / "lead_through_parts" / "irb140.urdf"


def built(name: str, write):
    """Return a robot by a short name."""
    if name == "four_bar":
        return load_robot_from_urdf(four_bar_with_tool(write), name)
    if name == "arm":
        return load_robot(IRB140, actuated=[f"joint{k}" for k in range(1, 7)])
    return load_robot("gantry_tau", arms="complete") if name == "complete" else load_robot(name)


def four_bar_with_tool(write) -> str:
    """Return a four-bar linkage whose coupler carries a tool."""
    text = write.four_bar()
    tool = '<link name="tool"/><joint name="end" type="fixed"><parent link="coupler_link"/><child link="tool"/></joint>'
    return text.replace("</robot>", f"{tool}</robot>")


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "four_bar", "complete", "arm"])
def test_feedforward(name, write, tmp_path) -> None:
    """Forces are finite and within the joints' limits, or stay as they were; in C and in Python."""
    more = ("stribeck", "load_friction", "thermal_drift", "quadratic_drag") if name == "gantry_tau" else ()
    model = build_model(built(name, write), *more)
    counts = fuzz_feedforward(model, tmp_path, CALLS)
    assert counts[0] > CALLS / 10 and counts[1] > CALLS / 50
    answered, refused = fuzz_python(model, 100)
    assert answered > 0 and refused > 0


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "stewart", "four_bar", "arm"])
def test_kinematics(name, write, tmp_path) -> None:
    """Poses, Jacobians and positions are finite, or stay as they were; positions keep their ranges and lead to the pose."""
    for function, counts in fuzz_kinematics(built(name, write), tmp_path, CALLS).items():
        assert counts[0] > CALLS / 10 and sum(counts[1:]) > 0, function


@pytest.mark.parametrize("kind", FILTERS)
def test_filters(kind, tmp_path) -> None:
    """Observers and learning pass no number on that is none; states and corrections stay numbers."""
    counts = fuzz_filter(kind, tmp_path, CALLS)
    assert counts[0] > CALLS / 10 and counts[1] > CALLS / 50


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "four_bar"])
def test_fmu(name, write, tmp_path) -> None:
    """Forces, parameters, starts and step sizes that are odd end in an error that moves nothing, or in a finite motion."""
    good, wrong = fuzz_fmu(build_model(built(name, write)), tmp_path, CALLS // 3)
    assert good > CALLS / 10 and wrong > 0
