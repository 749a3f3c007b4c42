"""Identified robots to report on: one axis with a clean answer, one that leaves questions, both with hostile names."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.effects import friction_model
from tau_dyn.identify import Identification, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, robot_from_urdf

HOSTILE = "<script>alert('log')</script>\x1b[31m.csv"
TRUTH = {
    "one_link.mass": 12.0,
    "two_link.mass": 3.0,
    "slide.coulomb_pos": 30.0,
    "slide.coulomb_neg": 25.0,
    "slide.viscous_pos": 80.0,
    "slide.viscous_neg": 60.0,
    "lift.coulomb_pos": 9.0,
    "lift.coulomb_neg": 9.0,
    "lift.viscous_pos": 20.0,
    "lift.viscous_neg": 20.0,
}


@pytest.fixture(scope="session")
def hostile() -> str:
    """A file name that tries to be markup and a terminal command."""
    return HOSTILE


@pytest.fixture(scope="session")
def truth() -> dict[str, float]:
    """The true values of the simulated robot."""
    return TRUTH


def _link(name: str, mass: float) -> str:
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'


def _joint(name: str, parent: str, child: str, axis: str) -> str:
    limit = '<limit lower="-1" upper="1" velocity="3" effort="1000"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    drive = f'<transmission name="{name}_drive"><joint name="{name}"/></transmission>'
    return f'<joint name="{name}" type="prismatic">{ends}<axis xyz="{axis}"/>{limit}</joint>{drive}'


@pytest.fixture(scope="session")
def robot() -> Robot:
    """A cross slide: one axis along x carries another along y; each link's mass is its only inertial parameter."""
    links = '<link name="base_link"/>' + _link("one_link", 10) + _link("two_link", 3)
    joints = _joint("slide", "base_link", "one_link", "1 0 0") + _joint("lift", "one_link", "two_link", "0 1 0")
    ties = '<t:link name="one_link" parameters="mass"/><t:link name="two_link" parameters="mass"/>'
    name = "&lt;img src=x onerror=alert(1)&gt;"
    return robot_from_urdf(f'<robot name="{name}" xmlns:t="urn:tau_dyn">{links}{joints}{ties}</robot>', "slide.urdf")


def _log(model: Model, amplitude: tuple[float, float], name: str, rng: np.random.Generator) -> Log:
    t = np.arange(0, 20, 0.004)
    shape = [(1.1, 2.3, 5.0), (1.4, 2.9, 4.3)]
    q, v, a = np.zeros((3, len(t), 2))
    for j, (size, frequencies) in enumerate(zip(amplitude, shape, strict=True)):
        for k, w in enumerate(frequencies):
            q[:, j] += size * np.sin(w * t + k) / w
            v[:, j] += size * np.cos(w * t + k)
            a[:, j] -= size * np.sin(w * t + k) * w
    tau = np.einsum("nij,j->ni", model.regressor(q, v, a), model.parameters.values) + 2 * rng.normal(size=q.shape)
    q = q + 1e-6 * rng.normal(size=q.shape)
    return Log(t, {"q_slide": q[:, 0], "q_lift": q[:, 1], "tau_slide": tau[:, 0], "tau_lift": tau[:, 1]}, name)


@pytest.fixture(scope="session")
def plant(robot) -> Model:
    return Model.of(robot, friction_model("asymmetric", robot.actuated, robot.force_units)).with_values(TRUTH)


@pytest.fixture(scope="session")
def found(robot, plant) -> Identification:
    """A rich motion, judged on a log of its own; every parameter is determined."""
    rng = np.random.default_rng(7)
    return identify(robot, _log(plant, (0.3, 0.25), HOSTILE, rng), holdout=_log(plant, (0.25, 0.3), "other.csv", rng))


@pytest.fixture(scope="session")
def doubtful(robot, plant) -> Identification:
    """The second joint stands still, so its friction and its share of the mass stay unknown."""
    return identify(robot, _log(plant, (0.3, 0.0), "still.csv", np.random.default_rng(8)))
