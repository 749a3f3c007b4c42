"""Small robots written here as URDF text: a pendulum, a block on a guideway, a simplified Gantry-Tau."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

_HEAD = '<robot name="{name}" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"><link name="base_link"/>'


def _link(name: str, mass: float, centre: str = "0 0 0", inertia: str = "0 0 0") -> str:
    ixx, iyy, izz = inertia.split()
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial></link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, axis: str, origin: str = "", limit: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        f"<origin {origin}/>{limit}</joint>"
    )


def _drive(joint: str) -> str:
    return f'<transmission name="{joint}_drive"><joint name="{joint}"/></transmission>'


def _limit(lower: float, upper: float, velocity: float, effort: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>'


def pendulum_robot(mass: float = 2.0, length: float = 0.5, limited: bool = True) -> Robot:
    """Return a point mass on a massless rod that turns about y, hanging along -z at zero, or for ever around."""
    urdf = _HEAD.format(name="pendulum") + _link("rod_link", mass, f"0 0 {-length}")
    kind, limit = ("revolute", _limit(-3, 3, 20, 200)) if limited else ("continuous", "")
    urdf += _joint("pivot", kind, "base_link", "rod_link", "0 1 0", limit=limit)
    return load_robot_from_urdf(urdf + _drive("pivot") + "</robot>", "pendulum")


def block_robot(mass: float = 95.0, effort: float = 400.0) -> Robot:
    """Return a block on a level guideway, such as the EMPS drive."""
    urdf = _HEAD.format(name="block") + _link("carriage_link", mass)
    urdf += _joint("axis", "prismatic", "base_link", "carriage_link", "1 0 0", limit=_limit(-0.5, 0.5, 1.2, effort))
    urdf += '<tau_dyn:link name="carriage_link" parameters="mass"/>'
    return load_robot_from_urdf(urdf + _drive("axis") + "</robot>", "block")


def gantry_robot(closed_form: bool = True, travel: float = 0.9) -> Robot:
    """Return a simplified Gantry-Tau of the size of L1 (Dressler 2012, Tables 5.7 and 6.3), uniform rods.

    Without `closed_form` its dynamics go through Pinocchio and the loop solver. Carts travel by `travel` to both sides.
    """
    origins = np.array([[0.04, 0, 1.44], [0.25, -1.31, 1.46], [0, 0, 0]])
    lengths, rods, carts = (2.05, 1.82, 1.81), (0.8, 1.6, 2.4), (13.58, 13.64, 38.23)
    tool = np.array([2.2, -0.5, 0.7])
    urdf = _HEAD.format(name="gantry")
    for i in range(3):
        urdf += _arm(i + 1, origins[i], lengths[i], rods[i], carts[i], tool - origins[i], travel)
    urdf += _link("plate_link", 9.13) + '<link name="px_link"/><link name="py_link"/>'
    free = _limit(-5, 5, 20, 1e5)
    place = 'xyz="{} {} {}"'.format(*tool)
    urdf += _joint("px", "prismatic", "base_link", "px_link", "1 0 0", place, free)
    urdf += _joint("py", "prismatic", "px_link", "py_link", "0 1 0", limit=free)
    urdf += _joint("pz", "prismatic", "py_link", "plate_link", "0 0 1", limit=free)
    urdf += '<link name="tool"/>' + _joint("flange", "fixed", "plate_link", "tool", "1 0 0")
    arms = "".join(f'<tau_dyn:arm cart="cart{i}" rod="rod{i}_link"/>' for i in (1, 2, 3))
    if closed_form:
        urdf += f'<tau_dyn:mechanism plate="plate_link">{arms}</tau_dyn:mechanism>'
    urdf += '<tau_dyn:link name="plate_link" parameters="mass"/>'
    return load_robot_from_urdf(urdf + "</robot>", "gantry")


def _arm(i: int, origin: np.ndarray, length: float, rod: float, cart: float, reach: np.ndarray, travel: float) -> str:
    home = reach[0] - np.sqrt(length**2 - reach[1] ** 2 - reach[2] ** 2)
    direction = (reach - [home, 0, 0]) / length
    names = f"cart{i}", f"cart{i}_link", f"knuckle{i}_link", f"rod{i}_link"
    inertia = rod * length**2 / 12
    start = np.array([origin[0] + home, *origin[1:]])
    limit = _limit(-travel, travel, 2.0, 2000)
    free = _limit(-3, 3, 100, 1e5)
    text = _link(names[1], cart) + f'<link name="{names[2]}"/>'
    text += _link(names[3], rod, f"{length / 2} 0 0", f"0 {inertia} {inertia}")
    text += _joint(names[0], "prismatic", "base_link", names[1], "1 0 0", 'xyz="{} {} {}"'.format(*start), limit)
    pitch = f'rpy="0 {-np.arcsin(direction[2])} 0"'
    yaw = f'rpy="0 0 {np.arctan2(direction[1], direction[0])}"'
    text += _joint(f"turn{i}", "revolute", names[1], names[2], "0 0 1", yaw, free)
    text += _joint(f"tilt{i}", "revolute", names[2], names[3], "0 1 0", pitch, free)
    text += "".join(f'<tau_dyn:link name="{name}" parameters="mass"/>' for name in (names[1], names[3]))
    ends = {"body_A": f'name="{names[3]}"', "body_B": 'name="plate_link"'}
    points = {"p_AP": f'value="{length} 0 0"', "p_BQ": 'value="0 0 0"'}
    ball = "".join(f"<drake:ball_constraint_{k} {v}/>" for k, v in {**ends, **points}.items())
    return text + f"<drake:ball_constraint>{ball}</drake:ball_constraint>" + _drive(names[0])


def with_friction(robot: Robot, coulomb: float, viscous: float, asymmetry: float = 0.0) -> Model:
    """Return a model with asymmetric friction on all joints; forward coefficients are larger by twice `asymmetry`."""
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    values = {"coulomb_pos": coulomb * (1 + asymmetry), "coulomb_neg": coulomb * (1 - asymmetry)}
    values |= {"viscous_pos": viscous * (1 + asymmetry), "viscous_neg": viscous * (1 - asymmetry)}
    return model.with_values({f"{joint}.{name}": value for joint in robot.actuated for name, value in values.items()})


ARMS = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", None),
    "panda": ("panda_description/urdf/panda.urdf", [f"panda_joint{i}" for i in range(1, 8)]),
}


def arm_model(name: str) -> Model:
    """Return a serial arm of `example-robot-data`, with friction in proportion to its drives' limits."""
    path, joints = ARMS[name]
    try:
        found = [f for f in files("example-robot-data") or () if str(f).endswith(path)]
    except PackageNotFoundError:
        found = []
    if not found:
        pytest.skip("example-robot-data is not installed")
    robot = load_robot(Path(str(found[0].locate())), actuated=joints)
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    shares = {"coulomb_pos": 0.05, "coulomb_neg": 0.04, "viscous_pos": 0.03, "viscous_neg": 0.02}
    drives = zip(robot.actuated, robot.effort_limit, strict=True)
    return model.with_values({f"{joint}.{k}": x * limit for joint, limit in drives for k, x in shares.items()})


@pytest.fixture(params=sorted(ARMS))
def arm(request) -> Model:
    """Each of the serial arms."""
    return arm_model(request.param)


@pytest.fixture(scope="session")
def gantry() -> Model:
    """A simplified Gantry-Tau with asymmetric friction of the size of L1's."""
    return with_friction(gantry_robot(), 80.0, 120.0, 0.15)


@pytest.fixture(scope="session")
def block() -> Model:
    """A 95 kg drive with the EMPS friction."""
    return with_friction(block_robot(), 20.0, 200.0)


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """The makers of robots and models above, for tests that need one of their own."""
    return SimpleNamespace(
        arm=arm_model, block=block_robot, friction=with_friction, gantry=gantry_robot, pendulum=pendulum_robot
    )


@pytest.fixture
def rng() -> np.random.Generator:
    """A seeded generator."""
    return np.random.default_rng(20120)
