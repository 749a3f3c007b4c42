"""Kinematics in C: compiled, they are Python's; what is out of reach is a status and leaves everything as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.codegen import build_identifiers, build_kinematics, kinematics as check, write_kinematics_source
from tau_dyn.codegen.forms import draw_reachable_positions
from tau_dyn.mechanism import build_rods, forward_kinematics, inverse_kinematics, jacobian
from tau_dyn.robot import load_robot, load_robot_from_urdf

IRB140 = Path(__file__).parents[2] / "experiments" / "lead_through_parts" / "irb140.urdf"
POSITIONS = 6
CLOSED = {"gantry_tau": {}, "delta": {"arms": "simplified"}}
SOLVED = {
    "stewart": {},  # a free plate whose legs have a closed inverse
    "gantry_tau_f1": {},  # chains of several drives
    "gantry_tau": {"arms": "complete"},  # three drives: the rotation follows
    "gantry_tau_queensland": {"dof": "5"},  # five: the rotation as near as it can
    "wrist": {"wrist": "serial2", "wrist_moves": "true"},  # a tree with loops
}


class Kinematics:
    """Compiled kinematics of one robot."""

    def __init__(self, program, compiled) -> None:
        """Write and compile."""
        self.program, self.code = program, compiled(write_kinematics_source(program, "kin"), "kin")
        self.na = program.robot.na
        self.start = np.zeros(len(program.home))
        self.home()

    def home(self) -> None:
        """Set the last configuration to home, where there is one."""
        if self.program.kind != "closed" and (self.program.freedoms or self.program.inverse is None):
            self.code("start", self.start)

    def forward(self, q) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        """Return status, place, rotation and Jacobian."""
        p, R, J = np.full(3, 7.0), np.full((3, 3), 7.0), np.full((self.program.rows, self.na), 7.0)
        first = [self.start] if self.program.freedoms else []
        q = np.array(q, float)
        statuses = {self.code("fk", *first, q, p, R), self.code("jacobian", *first, q, J)}
        assert len(statuses) == 1
        return statuses.pop(), p, R, J

    def inverse(self, p, R) -> tuple[int, np.ndarray]:
        """Return status and positions."""
        q = np.full(self.na, 7.0)
        first = [self.start] if self.program.inverse is None else []
        return self.code("ik", *first, np.array(p, float), np.array(R, float), q), q


def robot_named(name: str):
    """Return a robot of the tables above."""
    if name in CLOSED:
        return load_robot(name, **CLOSED[name])
    return load_robot("gantry_tau" if name in ("complete", "wrist") else name, **SOLVED[name])


def same(kin: Kinematics, source, atol: float, rng) -> None:
    """Compare with Python over random positions, each call from home."""
    q = draw_reachable_positions(source, POSITIONS, rng)
    poses, J = forward_kinematics(source, q).poses, jacobian(source, q)
    expected = inverse_kinematics(source, poses)
    assert expected.ok.all()
    for k in range(len(q)):
        kin.home()
        status, p, R, found = kin.forward(q[k])
        assert status == 0
        np.testing.assert_allclose(p, poses.position[k], rtol=0, atol=atol)
        np.testing.assert_allclose(R, poses.rotation[k], rtol=0, atol=atol)
        np.testing.assert_allclose(found, J[k], rtol=atol, atol=atol)
        kin.home()
        status, back = kin.inverse(poses.position[k], poses.rotation[k])
        assert status == 0
        np.testing.assert_allclose(back, expected.q[k], rtol=0, atol=atol)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_are_pythons(name, compiled, rng) -> None:
    """Trilateration and the chains' roots, carts and turning arms: to 1e-12."""
    robot = robot_named(name)
    program = build_kinematics(robot)
    assert program.kind == "closed" and program.difference < 1e-12
    same(Kinematics(program, compiled), robot, 1e-12, rng)


@pytest.mark.parametrize("name", SOLVED)
def test_what_is_solved_for_is_pythons(name, compiled, rng) -> None:
    """Free plates and trees by Newton's method: to 1e-10, whatever the drives can reach."""
    robot = load_robot("gantry_tau", **SOLVED[name]) if name == "gantry_tau" else robot_named(name)
    same(Kinematics(build_kinematics(robot), compiled), robot, 1e-10, rng)


def test_a_tool_beside_the_plates_origin_moves_by_its_lever(compiled, rng) -> None:
    """Where the plate turns, a tool 11 cm off its origin moves as well, in C as in Python."""
    rods = build_rods(load_robot("stewart"))
    rods = replace(rods, tool=pin.SE3(np.eye(3), np.array([0.05, -0.02, 0.1])))
    same(Kinematics(build_kinematics(rods), compiled), rods, 1e-10, rng)


def test_calibrated_rods_are_written_with_their_geometry(compiled, rng) -> None:
    """A rod 1 mm longer and a guideway that is not quite straight are what is written, not the robot file's numbers."""
    rods = build_rods(load_robot("gantry_tau"))
    moved = {"arm1.length": rods.geometry["arm1.length"].value + 1e-3, "arm2.direction_y": 0.01}
    rods = rods.with_geometry(rods.geometry.update({k: {"value": x} for k, x in moved.items()}))
    kin = Kinematics(build_kinematics(rods), compiled)
    same(kin, rods, 1e-12, rng)
    nominal = forward_kinematics(build_rods(load_robot("gantry_tau")), rods.robot.home[None]).poses.position[0]
    assert np.abs(kin.forward(rods.robot.home)[1] - nominal).max() > 1e-4


def test_a_serial_arm_follows_a_path_in_one_branch(compiled, rng) -> None:
    """From near by, the inverse of a six-joint arm finds the very joints, where the wrist is bent."""
    arm = load_robot(IRB140, actuated=[f"joint{k}" for k in range(1, 7)])
    kin = Kinematics(build_kinematics(arm), compiled)
    q = draw_reachable_positions(arm, POSITIONS, rng)
    q[:, 4] = rng.uniform(0.5, 1.2, POSITIONS)
    poses = forward_kinematics(arm, q).poses
    for k in range(len(q)):
        status, p, R, J = kin.forward(q[k])
        assert (
            status == 0 and np.abs(p - poses.position[k]).max() < 1e-12 and np.abs(R - poses.rotation[k]).max() < 1e-12
        )
        np.testing.assert_allclose(J, jacobian(arm, q[k : k + 1])[0], rtol=0, atol=1e-12)
        kin.start[:] = q[k] + 0.05 * rng.standard_normal(6)
        status, back = kin.inverse(p, R)
        assert status == 0 and np.abs(back - q[k]).max() < 1e-10


def test_an_arm_with_a_joint_to_spare_stays_near_its_start(write, compiled, rng) -> None:
    """Of all positions that meet the pose those nearest to the start are found: moving along what is idle gains nothing."""
    rows: list[str] = []
    parent = "base_link"
    for k, axis in enumerate(("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")):
        rows += [write.link(f"l{k}_link", 1.0, "0 0 0.1", "0.1 0.1 0.1")]
        rows += [
            write.joint(f"j{k}", "revolute", parent, f"l{k}_link", axis, f"{0.03 * k} 0 0.3"),
            write.drive(f"j{k}"),
        ]
        parent = f"l{k}_link"
    rows += [
        write.link("tool"),
        f'<joint name="end" type="fixed"><parent link="{parent}"/><child link="tool"/></joint>',
    ]
    arm = load_robot_from_urdf(write.text("seven", *rows), "seven")
    program = build_kinematics(arm)
    assert program.idle and program.rank == 6
    kin = Kinematics(program, compiled)
    for _ in range(POSITIONS):
        goal = arm.home + rng.uniform(0.3, 1.0, 7)
        pose = forward_kinematics(arm, goal[None]).poses
        first = goal + 0.2 * rng.standard_normal(7)
        kin.start[:] = first
        status, q = kin.inverse(pose.position[0], pose.rotation[0])
        found = forward_kinematics(arm, q[None]).poses
        assert status == 0 and np.abs(found.position - pose.position).max() < 1e-10
        assert np.abs(found.rotation - pose.rotation).max() < 1e-10
        idle = np.linalg.svd(jacobian(arm, q[None])[0])[2][-1]
        assert abs(idle @ (q - first)) < 1e-9 and np.linalg.norm(q - first) <= np.linalg.norm(goal - first) + 1e-9


@pytest.mark.parametrize("name", ["gantry_tau", "stewart", "wrist"])
def test_out_of_reach_is_a_status_and_changes_nothing(name, compiled) -> None:
    """Carts too far apart, a place too far away, a number that is none: outputs and last configuration stay, then all is well."""
    robot = robot_named(name)
    kin = Kinematics(build_kinematics(robot), compiled)
    before = kin.start.copy()
    home = forward_kinematics(robot, robot.home[None]).poses
    wrong = [np.full(robot.na, np.nan), robot.home + np.array([100.0, -100.0] * 3)[: robot.na]]
    for q in wrong:
        status, p, R, J = kin.forward(q)
        assert status in (1, 2) and np.all(p == 7) and np.all(R == 7) and np.all(J == 7)
    for p in (np.full(3, np.nan), home.position[0] + 50.0):
        status, q = kin.inverse(p, home.rotation[0])
        assert status in (1, 2, 3) and np.all(q == 7)
    np.testing.assert_array_equal(kin.start, before)
    status, q = kin.inverse(home.position[0], home.rotation[0])
    assert status == 0 and np.abs(q - robot.home).max() < 1e-9


@pytest.mark.parametrize("name", ["stewart", "wrist"])
def test_what_is_no_rotation_has_no_inverse(name, compiled) -> None:
    """Stretched, mirrored, all zeros: no position is given out for a matrix that turns nothing."""
    robot = robot_named(name)
    kin = Kinematics(build_kinematics(robot), compiled)
    home = forward_kinematics(robot, robot.home[None]).poses
    R = home.rotation[0]
    for wrong in (1.01 * R, R @ np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))):
        status, q = kin.inverse(home.position[0], wrong)
        assert status == 1 and np.all(q == 7)


def test_a_range_that_would_be_left_is_refused(compiled) -> None:
    """A pose that rods reach and a cart does not has status 3; no position is given out."""
    robot = load_robot("gantry_tau")
    kin = Kinematics(build_kinematics(robot), compiled)
    at_end = robot.home + 0.0
    at_end += (robot.upper - robot.home).min() + 0.05  # all carts together: the plate goes along
    found = forward_kinematics(robot, at_end[None])
    assert found.ok[0] and inverse_kinematics(robot, found.poses).reason[0] == "joint limit"
    status, q = kin.inverse(found.poses.position[0], found.poses.rotation[0])
    assert status == 3 and np.all(q == 7)


def test_too_few_drives_have_no_inverse(compiled) -> None:
    """One cart cannot hold a place: the header says so, and there is no such function."""
    program = build_kinematics(load_robot("linear_axis"))
    source, header = write_kinematics_source(program, "axis")
    assert "1 freedom(s), too few" in header and "axis_ik" not in source
    compiled((source, header), "axis")


def test_hostile_names_make_plain_c(write, compiled) -> None:
    """Names that end comments, hold quotes, trigraphs, newlines, odd letters: identifiers and comments hold."""
    names = ["a*/ int x;", 'b"??/', "c\\", "ü‮", "a__ int x_"]
    made = build_identifiers(names)
    assert len(set(made)) == len(names) and all(n.isascii() and n.replace("_", "a").isalnum() for n in made)
    joint = "x*/ #error ??/ /*&quot;*"
    text = write.text(
        "evil*/ int main", write.link("cart_link", 2.0, "0 0 0", "1 1 1"), write.link("tool"),
        write.joint(joint, "prismatic", "base_link", "cart_link", "1 0 0"), write.drive(joint),
        '<joint name="end" type="fixed"><parent link="cart_link"/><child link="tool"/></joint>',
    )  # fmt: skip
    source, header = write_kinematics_source(
        build_kinematics(load_robot_from_urdf(text, "evil\\\n*/ int y; /*")), "kin"
    )
    compiled((source, header), "kin")
    assert header.count("*/") == 2 and "#define KIN_JOINT_x____error" in header


def test_a_difference_from_python_refuses_the_export(monkeypatch) -> None:
    """Were the tracing wrong by 1e-6, nothing would be written."""
    monkeypatch.setattr(check, "jacobian", lambda *args: jacobian(*args) + 1e-6)
    with raises_code("unsupported", "1e-06"):
        build_kinematics(load_robot("gantry_tau"))


def test_a_name_that_is_none_is_refused() -> None:
    """Functions of C have names of letters, digits and underscores."""
    with raises_code("invalid_value"):
        write_kinematics_source(build_kinematics(load_robot("gantry_tau")), "a-b")


def test_the_f1_says_where_its_inverse_changes_branch(compiled, rng) -> None:
    """From pose to far pose: an answer has each leg on the side where the last call had it, or there is status 4 and none."""
    robot = load_robot("gantry_tau_f1")
    program = build_kinematics(robot)
    kin, seen = Kinematics(program, compiled), []
    assert program.equations is not None

    def sides(configuration: np.ndarray) -> np.ndarray:
        known = {"q": configuration[None, :6], "z": configuration[None, 6:]}
        G = program.equations.evaluate(known)["G"].reshape(6, -1)
        return np.sign([G[0, 0], np.linalg.det(G[1:3, 1:3]), np.linalg.det(G[3:, 3:6])])

    slides = np.array([kind == "prismatic" for kind in robot.joint_kinds])
    q = robot.home + rng.uniform(-1, 1, (300, 6)) * np.where(slides, 0.3, 1.5)
    found = forward_kinematics(robot, q)
    for k in np.flatnonzero(found.ok):
        before = kin.start.copy()
        status, answer = kin.inverse(found.poses.position[k], found.poses.rotation[k])
        seen.append(status)
        if status == 0:
            np.testing.assert_array_equal(sides(kin.start), sides(before))
        else:
            np.testing.assert_array_equal(kin.start, before)
            assert np.all(answer == 7)
    assert set(seen) <= {0, 2, 3, 4} and 0 in seen and 4 in seen


def test_the_f1_answers_as_if_it_went_there_slowly(compiled, rng) -> None:
    """One call to a far pose ends where two hundred calls on the straight way there end, or it has a status.

    The first pair turns two legs over and back on the way: their sides are those of the start, the branch is another.
    """
    robot = load_robot("gantry_tau_f1")
    kin = Kinematics(build_kinematics(robot), compiled)
    pairs = [
        (
            [-0.12625957, -0.134863864, -0.319937104, 0.791970995, 0.441487716, -0.296645366],
            [0.347167467, 0.559354086, 0.460207669, 0.643867401, -0.105883681, 0.076703607],
        ),
        *(rng.uniform(robot.lower, robot.upper, (2, 6)) for _ in range(40)),
    ]
    answered = judged = 0
    for first, last in pairs:
        kin.home()
        if kin.forward(first)[0]:
            continue
        start = kin.start.copy()
        status, p, R, _ = kin.forward(last)
        if status:
            continue
        ends = forward_kinematics(robot, np.array([first])).poses
        kin.start[:] = start
        status, at_once = kin.inverse(p, R)
        answered += status == 0
        kin.start[:] = start
        turn = Rotation.from_matrix(R @ ends.rotation[0].T).as_rotvec()
        for share in np.linspace(0.005, 1, 200):
            place = ends.position[0] + share * (p - ends.position[0])
            rotation = Rotation.from_rotvec(share * turn).as_matrix() @ ends.rotation[0]
            slowly, q = kin.inverse(place, rotation)
            if slowly:
                break
        if status == 0 and slowly == 0:
            judged += 1
            assert np.abs(q - at_once).max() < 1e-6
    assert answered > 5 and judged > 3
