"""Forces that are late relative to the motion, and positions that only make them look so."""

import numpy as np
import pytest

from tau_dyn.identify import check_integrity
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot

RATE_HZ = 200.0
COULOMB, VISCOUS = np.array([20.0, 22.0, 60.0, 2.5]), np.array([14.0, 12.0, 90.0, 1.5])
TURNED_RAD = 0.12


def link(name: str, mass: float, centre: str, inertia: tuple[float, float, float]) -> str:
    """Return a body of a URDF."""
    ixx, iyy, izz = inertia
    tensor = f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>{tensor}</inertial></link>'


def joint(name: str, kind: str, links: tuple[str, str], place: str, axis: str, limits: tuple[float, float]) -> str:
    """Return a joint of a URDF."""
    (parent, child), (lower, upper) = links, limits
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/><axis xyz="{axis}"/>'
    limit = f'<limit lower="{lower}" upper="{upper}" effort="2000" velocity="5"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}</joint>'


BOOM = "".join(
    [
        '<robot name="boom"><link name="foot"/>',
        link("tower", 30, "0 0.02 0.2", (0.7, 0.7, 0.5)),
        link("outer", 18, "0.3 0 0.03", (0.1, 1.0, 1.0)),
        link("inner", 8, "0.25 0.01 0", (0.03, 0.4, 0.4)),
        link("hand", 3, "0.08 0 0.02", (0.01, 0.015, 0.014)),
        joint("yaw", "revolute", ("foot", "tower"), "0 0 0.2", "0 0 1", (-3, 3)),
        joint("pitch", "revolute", ("tower", "outer"), "0 0 0.5", "0 -1 0", (-1.2, 1.4)),
        joint("tele", "prismatic", ("outer", "inner"), "0.5 0 0", "1 0 0", (-0.3, 0.5)),
        joint("wrist", "revolute", ("inner", "hand"), "0.5 0 0", "0 -1 0", (-2, 2)),
        "</robot>",
    ]
)


@pytest.fixture(scope="module")
def boom(tmp_path_factory) -> Robot:
    """Return a crane: it turns, pitches and reaches out, so that the zero of its pitch is no change of its bodies."""
    path = tmp_path_factory.mktemp("boom") / "boom.urdf"
    path.write_text(BOOM)
    return load_robot(path)


def recording(robot: Robot, turned: float = 0.0, late_s: float = 0.0, seed: int = 0) -> Log:
    """Return a log whose pitch is read `turned` [rad] off, and whose pitch torque is `late_s` late."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 30, 1 / RATE_HZ)
    w = 2 * np.pi * 0.1 * np.arange(1, 11)
    size = rng.standard_normal((2, 10, 4)) / np.arange(1, 11)[:, None] ** 0.9

    def motion(t):
        angle = np.outer(t, w)
        rise, fall = np.sin(angle), np.cos(angle)
        q = rise @ size[0] + fall @ size[1]
        gain = np.array([1.2, 0.7, 0.28, 1.2]) / np.abs(q).max(axis=0)
        v = fall @ (w[:, None] * size[0]) - rise @ (w[:, None] * size[1])
        a = -rise @ (w[:, None] ** 2 * size[0]) - fall @ (w[:, None] ** 2 * size[1])
        return gain * q + np.array([0, 0.3, 0.1, 0]), gain * v, gain * a

    def force(t):
        q, v, a = motion(t)
        return build_mechanism(robot).inverse_dynamics(q, v, a) + COULOMB * np.tanh(v / 1e-3) + VISCOUS * v

    tau = force(t)
    tau[:, 1] = force(t - late_s)[:, 1]
    tau += 0.005 * tau.std(axis=0) * rng.standard_normal(tau.shape)
    q = motion(t)[0] + 1e-5 * rng.standard_normal((len(t), 4)) + np.array([0, turned, 0, 0])
    joints = robot.actuated
    return Log(
        t,
        {f"q_{j}": q[:, k] for k, j in enumerate(joints)} | {f"tau_{j}": tau[:, k] for k, j in enumerate(joints)},
        "log.csv",
    )


@pytest.mark.parametrize("seed", [58, 62, 68, 79])
def test_a_zero_that_is_off_is_no_delay(boom, seed):
    """The force that a zero misses resembles the rate of the whole force, and is not a delay."""
    assert check_integrity(boom, [recording(boom, turned=TURNED_RAD, seed=seed)]) == []


def test_a_delay_beside_a_zero_that_is_off_is_named(boom):
    """A torque that is 15 ms late stays late where the zeros are free: the size is found to 5 %."""
    (warning,) = check_integrity(boom, [recording(boom, turned=TURNED_RAD, late_s=0.015)])
    assert get_code(warning) == "force_late" and "of pitch is late" in warning
    assert float(warning.split("late by ")[1].split(" ms")[0]) == pytest.approx(15, rel=0.05)
