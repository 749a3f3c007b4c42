"""Lead-through in C: the commands of Python sample by sample; a reading that is none stops the robot."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.codegen import write_lead_through_source
from tau_dyn.control.lead_through import ForceLoop, ForceSensor, LeadThrough, LeadThroughSettings

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from fuzz_parts.exported_programs import fuzz_lead_through

TOOL = ForceSensor(np.array([0.01, 0.0, -0.1]), np.diag([1.0, -1, -1]), 1.5, np.array([0, 0.02, 0.05]), np.full(6, 0.1))
PEG = {
    "task": "peg", "turning_stiffness": 50.0, "locked_axis": np.array([0.0, 0.1, 1.0]), "press": 0.0,
    "force_gain": np.repeat([0.006, 1.0], 3), "loop": ForceLoop(filter_hz=20.0),
}  # fmt: skip
CASES = {
    "surface": {},
    "printed normal": {"normal_hz": None},
    "no watch": {"watch": False, "normal": np.array([0.2, 0.0, 1.0])},
    "handle alone": {"tool_force": False},
    "sensors and coupled matrices": {
        "tool_sensor": TOOL, "handle_sensor": ForceSensor(mass=0.4), "mass": np.diag([3.0, 2, 4, 1, 1, 1]),
    },
    "peg": PEG,
}  # fmt: skip


class Pose(NamedTuple):
    """Where a tool is."""

    position: np.ndarray
    rotation: np.ndarray


def draw_readings(rng: np.random.Generator, n: int) -> list[tuple[np.ndarray, np.ndarray, Pose]]:
    """Return readings of touches and releases: slow walks of the wrenches, of the place and of the tool's axes."""
    t = np.arange(n)[:, None] * 0.004
    wave = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6, (1, 15))) for f in (0.4, 1.1, 2.9))
    size = np.array([3, 3, 0.8, 0.3, 0.3, 0.3, 2, 2, 5, 0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3])
    x = wave * size + 0.02 * rng.standard_normal((n, 15))
    x[n // 3 : n // 3 + 20, 2] += 12.0  # a pull that lets go, then free space
    x[n // 3 + 20 : n // 2, 6:12] = 0.0
    turns = Rotation.from_rotvec(0.2 * wave[:, 12:15]).as_matrix()
    return [
        (row[:6], row[6:12], Pose(row[12:] * 0.1, np.ascontiguousarray(R))) for row, R in zip(x, turns, strict=True)
    ]


@pytest.mark.parametrize("case", CASES)
def test_c_commands_what_python_commands(case, compiled, rng) -> None:
    """Over 1500 samples of touches, pulls and hard pushes, velocities agree to 1e-12 of the speed limit."""
    settings = LeadThroughSettings(20e3, **{"force_gain": 0.006, **CASES[case]})
    law = LeadThrough(settings)
    code = compiled(write_lead_through_source(law.list_numbers()), "lead")
    state, velocity = np.full(37, 7.0), np.zeros(6)
    code("start", state)
    touched = 0
    for handle, tool, pose in draw_readings(rng, 1500):
        expected = law(handle, tool, pose)
        touched += law.in_contact
        assert code("step", state, handle, tool, pose.position, pose.rotation, velocity) == 0
        np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-13)
    assert settings.tool_force == (300 < touched < 1400)


def test_a_reading_that_is_none_stops_the_robot_at_once(compiled) -> None:
    """A velocity has no safe last value: after a lost reading the command is zero, and it grows from rest again."""
    code = compiled(write_lead_through_source(LeadThrough(LeadThroughSettings(20e3)).list_numbers()), "lead")
    state, velocity, still, eye = np.zeros(37), np.zeros(6), np.zeros(6), np.eye(3)
    code("start", state)
    push = np.array([10.0, 0, 0, 0, 0, 0])
    for _ in range(200):
        assert code("step", state, push, still, np.zeros(3), eye, velocity) == 0
    assert velocity[0] == pytest.approx(0.1)
    for wrong in ((np.full(6, np.nan), still, eye), (push, np.full(6, 1e10), eye), (push, still, 2 * eye)):
        assert code("step", state, *wrong[:2], np.zeros(3), wrong[2], velocity) == 1
        assert not velocity.any()
        assert code("step", state, push, still, np.zeros(3), eye, velocity) == 0
        assert 0 < velocity[0] < 0.02  # one sample of 10 N on 3 kg


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
@pytest.mark.parametrize("task", ["surface", "peg"])
def test_no_input_makes_a_velocity_beyond_its_limit(task, tmp_path) -> None:
    """Hostile readings under sanitizers: velocities are numbers within their limits, or zero with a status."""
    counts = fuzz_lead_through(task, tmp_path, 3000)
    assert counts[0] > 300 and counts[1] > 100
