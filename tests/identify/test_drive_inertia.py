"""A rotor's reflected inertia is a parameter of its own where motion can tell it from the bodies' inertia."""

import numpy as np
import pytest

from tau_dyn.estimate import read_expression
from tau_dyn.identify import Choices, build_model, identify
from tau_dyn.log import Log
from tau_dyn.robot import load_robot, load_robot_from_urdf

DRIVES = """<transmission name="t{k}"><type>x</type><joint name="j{k}"/><actuator name="m{k}">{more}</actuator></transmission>"""
LINK = """<link name="{name}"><inertial><origin xyz="0.2 0.01 0"/><mass value="{mass}"/>
 <inertia ixx="0.02" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>
 <axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="5" effort="500"/></joint>"""


def two_links(*more: str):
    """Return a pendulum of two links, whose transmissions hold `more`."""
    links = LINK.format(name="a_link", mass=4) + LINK.format(name="b_link", mass=2)
    joints = JOINT.format(k=1, parent="base_link", child="a_link", x=0) + JOINT.format(
        k=2, parent="a_link", child="b_link", x=0.4
    )
    drives = "".join(DRIVES.format(k=k + 1, more=text) for k, text in enumerate(more))
    return load_robot_from_urdf(f'<robot name="two"><link name="base_link"/>{links}{joints}{drives}</robot>', "two")


def armature(model, joint: str):
    """Return the drive inertia of a joint."""
    return model.parameters[f"{joint}.armature"]


def test_the_second_rotor_of_a_chain_is_free_and_the_first_is_within_its_link():
    """The first joint's rotor turns as its link does; the second's does not feel the first joint's acceleration."""
    model = build_model(two_links("", ""), "asymmetric")
    assert armature(model, "j2").free and not armature(model, "j1").free
    assert armature(model, "j1").origin == "within a_link.iyy"


@pytest.mark.parametrize(
    ("name", "joint", "holder"),
    [("linear_axis", "axis", "carriage_link.mass"), ("gantry_tau", "cart2", "cart2_link.mass")],
)
def test_a_direct_drive_keeps_its_mass_readable(name: str, joint: str, holder: str):
    """No data separate a slide's rotor from its mass, so the mass stays a parameter of its own."""
    found = armature(build_model(load_robot(name), "asymmetric"), joint)
    assert not found.free and found.origin == f"within {holder}"


def test_what_the_file_or_the_user_gives_is_kept():
    """A rotor of 2e-4 kg m2 behind a gear of 100 is 2 kg m2 at the joint, by Drake's ratio or ROS' reduction; `--fix` wins."""
    rotor = '<rotor_inertia xmlns="http://drake.mit.edu" value="2e-4"/>'
    geared = rotor + '<gear_ratio xmlns="http://drake.mit.edu" value="100"/>'
    for text in (geared, rotor + "<mechanicalReduction>100</mechanicalReduction>"):
        found = armature(build_model(two_links("", text), "asymmetric"), "j2")
        assert found.value == pytest.approx(2.0) and not found.free
    model = Choices(fix=("j2.armature=0.5",)).apply(build_model(two_links("", ""), "asymmetric"))
    assert armature(model, "j2").value == 0.5 and not armature(model, "j2").free
    held = build_model(model.robot, Choices(fix=("j2.armature",)).apply(build_model(two_links("", ""), "rigid")))
    assert not armature(held, "j2").free, "a model that holds it is not freed again"


def test_the_column_that_is_free_is_the_one_that_bodies_cannot_make():
    """What is left of the second rotor's column beside all bodies' columns is far from nothing."""
    model = build_model(two_links("", ""), "rigid")
    rng = np.random.default_rng(1)
    W = model.regressor(*rng.normal(size=(3, 50, 2))).reshape(100, -1)
    names = model.parameters.names
    bodies = [k for k, n in enumerate(names) if not n.endswith("armature")]
    for joint, least in (("j1", None), ("j2", 0.1)):
        column = W[:, names.index(f"{joint}.armature")]
        left = column - W[:, bodies] @ np.linalg.lstsq(W[:, bodies], column, rcond=None)[0]
        share = np.linalg.norm(left) / np.linalg.norm(column)
        assert share > least if least else share < 1e-9


def test_a_rotor_larger_than_any_body_may_hold_is_estimated_beside_it():
    """A turning column carries a swinging link: the link's drive has 3 kg m2, all that turns with the column 0.3.

    The rotor's column is that of the link's inertia about the same axis, but no body has that much there and so little
    across. With bodies alone the force would be missed by a tenth.
    """
    links = LINK.format(name="a_link", mass=1) + LINK.format(name="b_link", mass=2)
    upright = JOINT.format(k=1, parent="base_link", child="a_link", x=0).replace("0 1 0", "0 0 1")
    joints = upright + JOINT.format(k=2, parent="a_link", child="b_link", x=0.1)
    drives = "".join(DRIVES.format(k=k, more="") for k in (1, 2))
    robot = load_robot_from_urdf(f'<robot name="t"><link name="base_link"/>{links}{joints}{drives}</robot>', "t")
    model, rng, t = build_model(robot, "rigid"), np.random.default_rng(2), np.arange(6000) / 200
    true = model.with_parameters(model.parameters.with_values({"j2.armature": 3.0}))
    q, v, a = np.zeros((3, len(t), 2))
    for f in (0.2, 0.5, 0.9):
        w, phase = 2 * np.pi * f, rng.uniform(0, 6, 2)
        q += 0.3 * np.sin(w * t[:, None] + phase)
        v += 0.3 * w * np.cos(w * t[:, None] + phase)
        a -= 0.3 * w**2 * np.sin(w * t[:, None] + phase)
    force = true.torque(q, v, a) + 0.02 * rng.standard_normal(q.shape)
    read = q + 1e-6 * rng.standard_normal(q.shape)
    channels = {f"{key}_j{k + 1}": x[:, k] for key, x in (("q", read), ("tau", force)) for k in range(2)}
    found = identify(robot, Log(t, channels, "made.csv"), model="rigid")
    assert not armature(model, "j2").free and found.model.parameters["j2.armature"].value > 1
    assert found.train.relative_error_percent < 1 and not found.estimate.moved
    at = [rng.normal(size=(50, 2)) for _ in range(3)]
    np.testing.assert_allclose(found.model.torque(*at), true.torque(*at), atol=0.02)


GEARED = (
    '<rotor_inertia xmlns="http://drake.mit.edu" value="2e-4"/><gear_ratio xmlns="http://drake.mit.edu" value="100"/>'
)
TRUE_ROTORS = {"j1": 3.0, "j2": 2.0}
"""Reflected inertia of the rotors [kg m^2]; the robot file says 2 of both."""


def record_two_links(robot) -> Log:
    """Return 20 s of the two links, whose first rotor has another inertia than the file says."""
    rng = np.random.default_rng(0)
    true = build_model(robot, "asymmetric").with_values({f"{j}.armature": x for j, x in TRUE_ROTORS.items()})
    t = np.arange(0, 20, 0.005)
    q, v, a = np.zeros((3, len(t), 2))
    for k in range(2):
        for h in range(1, 6):
            w, size, phase = 2 * np.pi * 0.17 * h * rng.uniform(0.9, 1.1), rng.uniform(0.2, 0.4) / h, rng.uniform(0, 6)
            q[:, k] += size * np.sin(w * t + phase)
            v[:, k] += size * w * np.cos(w * t + phase)
            a[:, k] -= size * w**2 * np.sin(w * t + phase)
    tau = true.mechanism.inverse_dynamics(q, v, a) + 2 * np.sign(v) + v + 0.02 * rng.standard_normal(q.shape)
    q = q + 1e-6 * rng.standard_normal(q.shape)
    return Log(t, {f"{s}_j{k + 1}": x[:, k] for s, x in (("q", q), ("tau", tau)) for k in range(2)}, "geared.csv")


def find_inertia(found) -> dict:
    """Return the row of the base parameter that the first link's inertia leads."""
    return next(row for row in found.base_rows() if row["name"] == "a_link.iyy")


def test_a_base_parameter_names_the_fixed_rotor_that_it_contains():
    """The first rotor turns as its link does: the data determine the sum with 3 kg m2, although the file's 2 are held."""
    robot = two_links(GEARED, GEARED)
    found = identify(robot, record_two_links(robot))
    row = find_inertia(found)
    weights = read_expression(row["expression"])
    assert weights["j1.armature"] == pytest.approx(1.0)
    assert not any(
        "j2.armature" in other["expression"] for other in found.base_rows()
    )  # the second is determined alone
    truth = robot.parameters.with_values({f"{j}.armature": x for j, x in TRUE_ROTORS.items()})
    total = sum(weight * truth[name].value for name, weight in weights.items())
    assert abs(row["value"] - total) < 4 * row["stderr"] < 0.05 * TRUE_ROTORS["j1"]
    nominal = sum(weight * robot.parameters[name].value for name, weight in weights.items())
    assert row["nominal"] == pytest.approx(nominal)


def test_the_value_with_its_rotor_does_not_depend_on_the_value_that_is_held():
    """Whether 0.5 or 2 kg m2 are held, the first link and its rotor have the same inertia together."""
    robot = two_links(GEARED, GEARED)
    log = record_two_links(robot)
    rows = [find_inertia(identify(robot, log, choices=Choices(fix=(f"j1.armature={x}",)))) for x in (0.5, 2.0)]
    assert rows[0]["expression"] == rows[1]["expression"]
    assert rows[0]["value"] == pytest.approx(rows[1]["value"], rel=1e-4)


def test_a_rotor_that_nobody_gave_is_named_by_the_combination_that_holds_it():
    """Without a word about rotors the first one is within its link, whose combination says so."""
    robot = two_links("", "")
    assert "j1.armature" in read_expression(find_inertia(identify(robot, record_two_links(robot)))["expression"])
