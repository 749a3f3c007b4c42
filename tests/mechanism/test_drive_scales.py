"""A drive whose slide travels `s` times its reading: `x = s q`, and because work is the same in both, `tau = s F`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.codegen import build_kinematics as build_kinematics_code, build_program
from tau_dyn.control import Feedforward
from tau_dyn.exchange import build_mjcf
from tau_dyn.mechanism import (
    build_kinematics,
    build_mechanism,
    forward_kinematics,
    inverse_kinematics,
    jacobian,
)
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

SCALE = 1.05
ROBOTS = {
    "gantry_tau": {},
    "complete": {"arms": "complete"},
    "gantry_tau_f1": {},
    "stewart": {},
    "hexaglide": {},
    "linear_axis": {},
    "triglide": {},
}


def scale_drives(robot: Robot, **scales: float) -> Robot:
    """Return the robot with scales of its drives in its file; home stays where it stands."""
    elements = "".join(f'<tau_dyn:drive joint="{joint}" scale="{s}"/>' for joint, s in scales.items())
    text = robot.urdf.replace("</robot>", elements + "</robot>")
    if "xmlns:tau_dyn" not in text:
        text = text.replace("<robot ", '<robot xmlns:tau_dyn="urn:tau_dyn" ', 1)
    found = load_robot_from_urdf(text, robot.source, actuated=robot.actuated, tool=robot.tool)
    return replace(found, home=robot.home / found.drive_scale)


@pytest.fixture(params=ROBOTS, scope="module")
def pair(request) -> tuple[Robot, Robot, np.ndarray]:
    """A robot as its file has it, the same with a scale on each slide's drive, and the travel per reading (na,)."""
    name = "gantry_tau" if request.param == "complete" else request.param
    plain = load_robot(name, **ROBOTS[request.param])
    slides = [joint for joint, kind in zip(plain.actuated, plain.joint_kinds, strict=True) if kind == "prismatic"]
    scaled = scale_drives(plain, **{joint: SCALE + 0.01 * k for k, joint in enumerate(slides)})
    return plain, scaled, scaled.drive_scale


def test_kinematics_count_by_readings(pair) -> None:
    """The tool is where the slides have travelled to; its Jacobian, inverse and singularity follow."""
    plain, scaled, s = pair
    q = scaled.home + 0.02 * np.random.default_rng(1).standard_normal((5, scaled.na))
    a, b = forward_kinematics(plain, q * s), forward_kinematics(scaled, q)
    assert b.ok.all() and np.abs(a.poses.position - b.poses.position).max() < 1e-11
    assert np.abs(jacobian(plain, q * s) * s - jacobian(scaled, q)).max() < 1e-9
    back = inverse_kinematics(scaled, b.poses, limits=False, start=None if build_kinematics(plain).legs else q)
    assert np.abs(back.q - q).max() < 1e-9
    assert (
        np.abs(
            build_kinematics(plain).singularity(q * s).parallel - build_kinematics(scaled).singularity(q).parallel
        ).max()
        < 1e-9
    )


def test_forces_scale_inversely_to_travel(pair) -> None:
    """`tau dq = F dx`: forces on the reading are `s` times those on the slide; one by one and all at once alike."""
    plain, scaled, s = pair
    rng = np.random.default_rng(2)
    q = scaled.home + 0.02 * rng.standard_normal((20, scaled.na))
    v, a = rng.standard_normal((2, *q.shape))
    drive = np.array([plain.parameters[f"{joint}.armature"].value for joint in plain.actuated])
    one, other = build_mechanism(plain), build_mechanism(scaled)
    force = one.inverse_dynamics(q * s, v * s, a * s) - drive * s * a
    size = np.abs(force).max()
    assert np.abs(other.inverse_dynamics(q, v, a) - s * force - drive * a).max() < 1e-9 * size
    assert np.abs(other.inverse_dynamics(q[:3], v[:3], a[:3]) - (s * force + drive * a)[:3]).max() < 1e-9 * size
    assert np.abs(other.regressor(q, v, a) @ scaled.parameters.values - s * force - drive * a).max() < 1e-9 * size
    M, h = other.mass_and_bias(q[0], v[0])
    assert np.abs(M @ a[0] + h - other.inverse_dynamics(q[:1], v[:1], a[:1])[0]).max() < 1e-9 * size


def test_power_goes_into_energy(pair) -> None:
    """What drives put in, `tau v`, is the rate of the kinetic energy and the work against gravity."""
    _, robot, _ = pair
    mechanism, rng, h = build_mechanism(robot), np.random.default_rng(3), 1e-5
    q = robot.home + 0.02 * rng.standard_normal((15, robot.na))
    v, a = rng.standard_normal((2, *q.shape))

    def energy(t: float) -> np.ndarray:
        M = mechanism.inertia(q + t * v + t**2 / 2 * a)
        return 0.5 * np.einsum("ni,nij,nj->n", v + t * a, M, v + t * a)

    rest = np.zeros_like(q)
    power = np.sum(mechanism.inverse_dynamics(q, v, a) * v, axis=1)
    kept = (energy(h) - energy(-h)) / (2 * h) + np.sum(mechanism.inverse_dynamics(q, rest, rest) * v, axis=1)
    assert np.abs(power - kept).max() < 1e-6 * np.abs(power).max()


def test_files_and_code_carry_a_scale_or_refuse_it() -> None:
    """Code of the closed form computes with it; a MuJoCo file and a tree's code have no place for it and say so."""
    closed = scale_drives(load_robot("gantry_tau"), cart1=1.05, cart2=0.97)
    assert build_program(Feedforward(Model.of(closed, []))).difference < 1e-9 > build_kinematics_code(closed).difference
    tree = Model.of(scale_drives(load_robot("hexaglide"), cart1=1.05), [])
    for build in (build_mjcf, lambda model: build_program(Feedforward(model))):
        with raises_code("unsupported", "cart1"):
            build(tree)


@pytest.mark.parametrize(
    ("element", "said"),
    [
        ('<tau_dyn:drive joint="arm1" scale="1.01"/>', "prismatic"),
        ('<tau_dyn:drive joint="no_such" scale="1.01"/>', "no_such"),
        ('<tau_dyn:drive joint="cart1" scale="-1"/>', "above zero"),
        ('<tau_dyn:drive joint="cart1" scale="1"/><tau_dyn:drive joint="cart1" scale="1"/>', "one scale"),
    ],
)
def test_wrong_scales_are_refused(element: str, said: str) -> None:
    """A turn has no travel, and a slide has one scale above zero."""
    robot = load_robot("delta" if "arm1" in element else "gantry_tau")
    with raises_code("robot_structure", said):
        load_robot_from_urdf(robot.urdf.replace("</robot>", element + "</robot>"), "wrong.urdf")
