"""Conventions of a pose file are found without parameters, named, and applied; sound files are read as written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet, calibrate, read_poses
from tau_dyn.calibrate.conventions import FoundReading, find_reading
from tau_dyn.calibrate.conventions.readings import list_readings
from tau_dyn.calibrate.conventions.rigid_fit import measure_misfit
from tau_dyn.calibrate.conventions.search import _join, is_far_beyond
from tau_dyn.calibrate.models import RodFamily, Spec, TreeFamily, get_family
from tau_dyn.calibrate.simulated import TRACKER, simulate_poses
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import build_rods
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

NOISE = (1e-4, 3e-4)
LIMITS = (np.full(4, -3.0), np.full(4, 3.0))


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return an arm of four turning joints, none of whose axes meet at right angles."""
    rows = ['<robot name="four"><link name="l0_link"/>']
    places = (("0 0 0.4", "0 0 0"), ("0.1 0 0", "1.4 0.2 0"), ("0.5 0 0.05", "0.1 0.3 0"), ("0.35 0.05 0", "0.2 1.3 0"))
    for k, (xyz, rpy) in enumerate(places):
        rows.append(
            f'<link name="l{k + 1}_link"/><joint name="j{k + 1}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{k}_link"/><child link="l{k + 1}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="90"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.2 0.02 0.05"/>')
    return load_robot_from_urdf("".join(rows) + '<parent link="l4_link"/><child link="tool"/></joint></robot>', "four")


def measure(robot: Robot, seed: int, n: int = 40, *, size: float = 3e-3, turned: bool = True) -> PoseSet:
    """Return poses of an arm built 3 mm and 3 mrad off its file."""
    rng, arm = np.random.default_rng(seed), build_tree_geometry(robot)
    theta = arm.parameters.values + size * rng.standard_normal(len(arm.parameters)) * arm.parameters.free
    return simulate_poses(arm, theta, rng.uniform(-1.3, 1.3, (n, 4)), rng, noise=NOISE, frames=TRACKER, turned=turned)


def search(robot: Robot, poses: PoseSet) -> FoundReading | None:
    """Return the reading that is found, with a fit that may not be asked."""
    family = get_family(robot, poses)
    assert isinstance(family, TreeFamily)
    return find_reading(
        family.build(family.spec("frames")), poses, LIMITS, lambda _: pytest.fail("dimensions were fitted")
    )


def _exchange(poses: PoseSet) -> PoseSet:
    return replace(poses, q=poses.q[:, [0, 2, 1, 3]])


def _invert(poses: PoseSet) -> PoseSet:
    assert poses.rotation is not None
    back = np.swapaxes(poses.rotation, 1, 2)
    return replace(poses, rotation=back, position=-np.einsum("nij,nj->ni", back, poses.position))


def _roll(poses: PoseSet) -> PoseSet:
    assert poses.rotation is not None
    wxyz = np.roll(Rotation.from_matrix(poses.rotation).as_quat(), 1, axis=1)
    return replace(poses, rotation=Rotation.from_quat(wxyz).as_matrix())


WRONG: dict[str, tuple[Callable[[PoseSet], PoseSet], tuple[str, ...]]] = {
    "joint_sign": (lambda p: replace(p, q=p.q * [1, 1, -1, 1]), ("j3",)),
    "joint_zero": (lambda p: replace(p, q=p.q + [0, np.pi / 2, 0, 0]), ("j2",)),
    "columns_exchanged": (_exchange, ("j2", "j3")),
    "joint_unit": (lambda p: replace(p, q=np.rad2deg(p.q)), ()),
    "position_unit": (lambda p: replace(p, position=1e3 * p.position), ()),
    "axis_sign": (lambda p: replace(p, position=p.position * [1, 1, -1]), ()),
    "quaternion_order": (_roll, ()),
    "inverse_poses": (_invert, ()),
    "row_shift": (lambda p: replace(p.take(np.arange(p.n - 1)), q=p.q[1:], approach=p.approach[1:]), ()),
}
"""What a file may do, and the joints that are named for it."""


@pytest.mark.parametrize("cause", WRONG)
def test_a_wrong_convention_is_named(robot, cause: str):
    """The robot file misses the poses by half its reach as they are written, and by millimetres as they are meant."""
    spoil, joints = WRONG[cause]
    found = search(robot, spoil(measure(robot, 1)))
    assert found is not None
    assert [(change.cause, change.joints) for change in found.reading] == [(cause, joints)]
    assert found.meant.position < 0.02 and found.meant.value < 0.1 * found.written.value


def test_loops_are_not_closed_far_beyond_the_limits():
    """A Delta's arms turn by half a radian; taken for radians, their degrees are turns that no way leads to."""
    robot = load_robot("delta")
    rods = build_rods(robot)
    family = RodFamily(rods, PoseSet(np.tile(robot.home, (2, 1)), np.zeros((2, 3))))
    rng, geometry = np.random.default_rng(4), family.build(Spec("frames"))
    q = robot.home + rng.uniform(-0.3, 0.3, (20, 3))
    poses = simulate_poses(geometry, geometry.parameters.values, q, rng, noise=NOISE, frames=TRACKER, turned=False)
    degrees, limits = np.rad2deg(poses.q), (robot.lower, robot.upper)
    assert is_far_beyond(degrees, limits) and not is_far_beyond(poses.q + np.pi / 2, limits)
    found = find_reading(geometry, replace(poses, q=degrees), limits, lambda _: 1.0)
    assert found is not None and [change.cause for change in found.reading] == ["joint_unit"]


def test_two_wrong_conventions_are_named_together(robot):
    """Degrees and millimetres in one table: neither alone makes the robot fit."""
    poses = measure(robot, 2)
    found = search(robot, replace(poses, q=np.rad2deg(poses.q), position=1e3 * poses.position))
    assert found is not None and {change.cause for change in found.reading} == {"joint_unit", "position_unit"}
    assert found.n_tried < 250  # the two likeliest are combined, and no third one is looked for


def test_inverse_poses_in_another_order_of_quaternions_are_read(robot):
    """Inverse and roll together turn both frames only: orientations fit as written, and positions alone miss by the reach."""
    found = search(robot, _roll(_invert(measure(robot, 5))))
    assert found is not None
    assert [change.cause for change in found.reading] == ["quaternion_order", "inverse_poses"]
    assert found.meant.position < 0.02


def test_the_format_of_orientations_is_applied_before_they_are_inverted(robot):
    """The inverse of numbers in another order is no inverse, in whatever order the two changes are found."""
    poses = measure(robot, 5)
    every = {r[0].cause: r for r in list_readings(poses, robot.actuated, ["rad"] * 4, turns=True) if len(r) == 1}
    joined = _join(every["inverse_poses"], every["quaternion_order"])
    assert joined is not None and [change.cause for change in joined] == ["quaternion_order", "inverse_poses"]


def test_orientations_that_stay_the_same_are_not_measured(robot):
    """A tracker of one ball writes 0 0 0 1 while the arm turns its tool: positions alone are calibrated, and it is said."""
    poses = measure(robot, 6)
    same = replace(poses, rotation=np.tile(np.eye(3), (poses.n, 1, 1)), source="ball.csv")
    found = calibrate(robot, same)
    (said,) = [w for w in found.warnings if get_code(w) == "orientation_unused"]
    assert said.startswith("ball.csv: the orientation is the same in all poses")
    assert found.poses.rotation is None and found.errors(found.chosen).position_size.rms < 4 * NOISE[0]


def test_a_column_that_keeps_one_value_is_the_first_cause_of_a_misfit(robot):
    """A logger that repeats one height: no geometry explains it, and the column is named before exchanged ones."""
    poses = measure(robot, 7, turned=False)
    found = calibrate(robot, replace(poses, position=poses.position * [1, 1, 0] + [0, 0, 0.5]), model="frames")
    assert any("z_tool keep one value in all poses" in w for w in found.warnings)


def test_one_campaign_may_follow_another_convention(robot):
    """Inverse poses of one campaign alone are read as they are meant, and no frame is called moved."""
    poses, half = measure(robot, 8), np.arange(40) >= 20
    spoiled = _invert(poses)
    assert spoiled.rotation is not None and poses.rotation is not None
    mixed = replace(
        poses,
        position=np.where(half[:, None], spoiled.position, poses.position),
        rotation=np.where(half[:, None, None], spoiled.rotation, poses.rotation),
        campaign=half.astype(int),
        campaigns=("monday", "tuesday"),
    )
    found = calibrate(robot, mixed)
    (said,) = [w for w in found.warnings if get_code(w) == "poses_reread"]
    assert "campaign tuesday" in said and "inverse" in said
    assert found.errors(found.chosen).position_size.rms < 4 * NOISE[0]
    assert not {f.cause for f in found.findings if f.status == "confirmed"} & {"device_moved", "target_moved"}


def test_positions_alone_show_a_sign(robot):
    """A target anywhere on the tool, without orientations."""
    poses = measure(robot, 3, turned=False)
    found = search(robot, replace(poses, q=poses.q * [1, -1, 1, 1]))
    assert found is not None and [c.joints for c in found.reading] == [("j2",)]


def test_limits_of_the_joints_veto_a_reading(robot):
    """A positive joint of a file written as it is meant is not read as a negative one beyond its limit."""
    poses = measure(robot, 1)
    q = np.abs(poses.q)
    wrong = replace(poses, q=q * [1, 1, -1, 1])
    family = get_family(robot, poses)
    geometry = family.build(family.spec("frames"))
    nominal = geometry.forward(geometry.parameters.values, q).poses
    wrong = replace(wrong, position=nominal.position, rotation=nominal.rotation)
    found = [find_reading(geometry, wrong, (np.full(4, -3.0), np.array([3.0, 3.0, high, 3.0])), lambda _: 1.0)
             for high in (3.0, 0.3)]  # fmt: skip
    assert found[0] is not None and [c.joints for c in found[0].reading] == [("j3",)]
    assert found[1] is None


@pytest.mark.parametrize("turned", [True, False])
def test_sound_files_are_read_as_written(robot, turned: bool):
    """Twenty arms 3 mm and 3 mrad off their file: no reading is proposed."""
    assert [k for k in range(20) if search(robot, measure(robot, k, turned=turned))] == []


def test_an_arm_far_off_its_file_is_read_as_written(robot):
    """20 mrad in every angle miss the poses by per cents of the reach, as no convention does."""
    poses = measure(robot, 5, size=2e-2)
    family = get_family(robot, poses)
    assert find_reading(family.build(family.spec("frames")), poses, LIMITS, lambda _: 1.0) is None


def test_the_geometry_is_fitted_as_the_file_is_meant(robot):
    """A reversed joint costs no accuracy, no other cause is confirmed, and held-out poses are read alike."""
    poses = measure(robot, 6, 80)
    wrong = replace(poses, q=poses.q * [1, 1, -1, 1])
    found = calibrate(robot, wrong.take(np.arange(50)), wrong.take(np.arange(50, 80)))
    causes = [(f.cause, f.joints, f.status) for f in found.findings if f.cause != "joint_placement"]
    assert causes == [("joint_sign", ("j3",), "confirmed")]
    assert found.errors(found.chosen).position_size.rms < 2.5 * NOISE[0] and "poses_reread" in map(
        get_code, found.warnings
    )


@pytest.mark.parametrize(
    ("names", "sequence", "unit"),
    [
        ("rx,ry,rz", "", 1.0),
        ("roll,pitch,yaw", "xyz", 1.0),
        ("phix1,phiy1,phiz1", "xyz", 1.0),
        ("w,p,r", "xyz", 57.29577951308232),
        ("rx,ry,rz", "XYZ", 1.0),
    ],
)
def test_three_angles_are_read(robot, tmp_path, names: str, sequence: str, unit: float):
    """Rotation vectors, roll pitch yaw, degrees, and an order of axes that no name gives."""
    poses = measure(robot, 7)
    assert poses.rotation is not None
    turned = Rotation.from_matrix(poses.rotation)
    angles = unit * (turned.as_euler(sequence) if sequence else turned.as_rotvec())
    head = ",".join(
        [f"q_j{k + 1}" for k in range(4)] + ["x1_mm,y1_mm,z1_mm" if "1" in names else "x_mm,y_mm,z_mm", names]
    )
    np.savetxt(
        tmp_path / "p.csv", np.c_[poses.q, 1e3 * poses.position, angles], delimiter=",", header=head, comments=""
    )
    read = read_poses(tmp_path / "p.csv", robot.actuated)
    found = search(robot, read)
    read = read if found is None else found.apply(read)
    assert read.rotation is not None and "columns_read" in map(get_code, read.warnings)
    assert read.rotation == pytest.approx(poses.rotation, abs=1e-6) and read.position == pytest.approx(
        poses.position, abs=1e-9
    )
    assert (found is not None) == (sequence == "XYZ")


def test_a_tool_that_turns_about_one_axis_is_placed_by_its_positions() -> None:
    """Shoulder and elbow of a UR5 are parallel: orientations leave a turn about them open, and positions show it."""
    arm = load_robot("ur5")
    geometry, rng = build_tree_geometry(arm), np.random.default_rng(4)
    theta = geometry.parameters.values + 5e-4 * rng.standard_normal(len(geometry.parameters)) * geometry.parameters.free
    q = np.tile(arm.home, (30, 1))
    q[:, 1:3] += rng.uniform(-1, 1, (30, 2))
    poses = simulate_poses(geometry, theta, q, rng, noise=(2e-5, 4e-5), frames=TRACKER)
    nominal = geometry.forward(geometry.parameters.values, q)
    found = measure_misfit(poses, nominal.poses, nominal.ok, turns=True)
    assert found.position < 2e-3 and found.rotation is not None and found.rotation < 2e-3


def _invert(poses: PoseSet) -> PoseSet:
    """Return the device in the target's frame."""
    assert poses.rotation is not None
    back = np.swapaxes(poses.rotation, 1, 2)
    return replace(poses, position=-np.einsum("nij,nj->ni", back, poses.position), rotation=back)


def test_held_out_positions_of_inverse_poses_are_refused(robot: Robot) -> None:
    """The inverse of a position needs its orientation, which these held-out poses do not have."""
    held = replace(_invert(measure(robot, 2)).without_rotation(), source="held.csv")
    with pytest.raises(InputError, match="held.csv has no orientations.*inverse") as fault:
        calibrate(robot, _invert(measure(robot, 2)), held)
    assert fault.value.code == "mismatch"


def test_held_out_distances_follow_the_joints_of_the_training_poses(robot: Robot) -> None:
    """A joint that counts the other way does so in the file of distances as well, whose numbers stay distances."""
    arm, rng = build_tree_geometry(robot), np.random.default_rng(6)
    wire = replace(TRACKER, kinds=("distance",), lengths=(0.1,))
    q = rng.uniform(-1.3, 1.3, (30, 4))
    distances = simulate_poses(
        arm, arm.parameters.values, q, rng, noise=NOISE, frames=wire, turned=False, device=np.zeros(30, int)
    )
    train, held = (replace(poses, q=poses.q * [1, -1, 1, 1]) for poses in (measure(robot, 3, size=1e-4), distances))
    found = calibrate(robot, train, replace(held, devices=("wire",)))
    assert "joint_sign" in {f.cause for f in found.findings}
    assert found.errors(found.chosen).position_size.rms < 3 * NOISE[0]


def test_each_file_may_write_its_orientations_its_own_way(robot: Robot) -> None:
    """Euler angles that are read anew in one file do not touch the quaternions of the other."""
    train, held = measure(robot, 4), measure(robot, 4, 30)
    angles = Rotation.from_matrix(train.rotation).as_euler("xyz")
    written = replace(train, angles=angles, rotation=Rotation.from_rotvec(angles).as_matrix())
    found = calibrate(robot, written, held)
    assert any(get_code(w) == "poses_reread" for w in found.warnings)
    assert found.errors(found.chosen).position_size.rms < 4 * NOISE[0]


@pytest.mark.parametrize("cause", ["quaternion_order", "joint_unit", "axis_sign"])
def test_the_held_out_file_alone_may_follow_another_convention(robot: Robot, cause: str) -> None:
    """It is named and read so, and the geometry's error is that of the measurement, as with the file of the training poses."""
    train, held = measure(robot, 4), WRONG[cause][0](measure(robot, 4, 30))
    found = calibrate(robot, train, replace(held, source="held.csv"))
    (said,) = [w for w in found.warnings if get_code(w) == "poses_reread"]
    assert said.startswith("held.csv: ")
    assert found.errors(found.chosen).position_size.rms < 4 * NOISE[0]
