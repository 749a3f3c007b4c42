"""Configuration states name the side of a singularity; motions between modes keep to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.assembly import find_reachable_modes, find_robot_assembly_modes, solve_configuration_states
from tau_dyn.kinematics.assembly.motion import Limits, advance, measure_rod_distance, sample_at
from tau_dyn.kinematics.assembly.robot_modes import find_translating_modes, select_real_poses
from tau_dyn.mechanism import Poses, Rods, StraightWay, build_rods, forward_kinematics
from tau_dyn.robot import load_robot

URDF = Path(__file__).resolve().parents[2] / "urdf"


@pytest.fixture(scope="module")
def stewart() -> Rods:
    """The hexapod with six driven legs."""
    return build_rods(load_robot(URDF / "stewart.urdf.xacro"))


@pytest.fixture(scope="module")
def stewart_modes(stewart) -> tuple[np.ndarray, Poses, int]:
    """Actuated positions off the symmetric home, the real modes there, and which of them is the usual one."""
    q = stewart.robot.home + 0.05 * np.random.default_rng(2).uniform(-1, 1, 6)
    poses = select_real_poses(find_robot_assembly_modes(stewart, q))
    return q, poses, int(np.argmin(np.linalg.norm(poses.position - stewart.home.position, axis=1)))


def test_a_robots_modes_fit_its_rods_and_hold_its_forward_kinematics(stewart, stewart_modes) -> None:
    """Every real mode closes all gaps, and one of them is what forward kinematics finds."""
    q, poses, home = stewart_modes
    assert poses.n_samples == 8
    assert np.abs(stewart.gap(np.repeat(q[None], 8, axis=0), poses)).max() < 1e-12
    plate = forward_kinematics(stewart, q[None]).plate
    assert_allclose(poses.position[home], plate.position[0], atol=1e-10)
    assert_allclose(poses.rotation[home], plate.rotation[0], atol=1e-10)


def test_a_translating_plate_has_two_modes() -> None:
    """Three spheres: the simplified Gantry-Tau's pose and its mirror image, with determinants of opposite sign."""
    rods = build_rods(load_robot(URDF / "gantry_tau.urdf.xacro"))
    q = rods.robot.home
    modes = find_robot_assembly_modes(rods, q)
    assert modes.certified and modes.n_real == 2 and modes.residual.max() < 1e-14
    plate = forward_kinematics(rods, q[None]).plate
    assert np.linalg.norm(modes.position.real - plate.position, axis=1).min() < 1e-12
    states = solve_configuration_states(rods, np.array([q, q]), select_real_poses(modes))
    assert states.assembly[0] == -states.assembly[1] != 0


def test_spheres_that_do_not_meet_have_a_complex_pair() -> None:
    """Rods too short give two conjugate points that still fit, and no real one; centres in a line are refused."""
    A, B = np.eye(3), np.zeros((3, 3))
    modes = find_translating_modes(A, B, np.full(3, 0.5), np.eye(3))
    assert modes.certified and modes.n_real == 0
    assert_allclose(modes.position[0], modes.position[1].conj())
    assert_allclose(((modes.position[:, None] - A) ** 2).sum(axis=2), 0.25)
    with raises_code("unsupported", "line"):
        find_translating_modes(np.outer([0, 1, 2], [1, 1, 0]), B, np.ones(3), np.eye(3))


def test_modes_apart_in_sign_are_apart_by_a_singularity(stewart, stewart_modes) -> None:
    """On the straight way to a mode of the other sign the determinant passes zero; the answer says so and gives no motion."""
    q, poses, home = stewart_modes
    states = solve_configuration_states(stewart, np.repeat(q[None], 8, axis=0), poses)
    assert sorted(states.assembly) == [-1] * 4 + [1] * 4
    other = int(np.flatnonzero(states.assembly != states.assembly[home])[0])
    reach = find_reachable_modes(stewart, q, poses, home, n_samples=0)
    assert reach[home].verdict == "home" and reach[other].verdict == "behind a singularity"
    a, b = poses.take(slice(home, home + 1)), poses.take(slice(other, other + 1))
    way = [StraightWay(a, b).at(share) for share in np.linspace(0, 1, 50)]
    signs = [np.sign(np.linalg.det(stewart.gap_by_pose(q[None], pose)[0])) for pose in way]
    assert set(signs) == {-1.0, 1.0}


def test_a_motion_stops_before_a_singularity(stewart, stewart_modes) -> None:
    """Led straight to a mode of the other sign, the plate stops on its own side, however long the steps may be."""
    q, poses, home = stewart_modes
    begin = sample_at(stewart, q, poses.take(slice(home, home + 1)))
    free = Limits(np.full(6, -np.inf), np.full(6, np.inf), 0.0, scale=1.0, longest=0.5)
    side = np.sign(np.linalg.det(begin.parallel))
    for k in range(8):
        goal = poses.take(slice(k, k + 1))
        motion, arrived = advance(stewart, begin, goal, free)
        assert all(np.sign(np.linalg.det(sample.parallel)) == side for sample in motion)
        assert not (arrived and np.sign(np.linalg.det(stewart.gap_by_pose(q[None], goal)[0])) != side)


def test_a_motion_that_is_found_keeps_its_sign_and_closes_the_rods(stewart, stewart_modes) -> None:
    """Between two modes of one sign the legs can lead the plate round: all samples fit, and the determinant stays on its side."""
    q, poses, _ = stewart_modes
    reach = find_reachable_modes(stewart, q, poses.take(np.array([5, 0])), 0, limits=False, n_samples=60)[1]
    assert reach.verdict == "reachable"
    assert np.abs(stewart.gap(reach.q, reach.plate)).max() < 1e-9
    assert_allclose(reach.q[[0, -1]], [q, q], atol=1e-6)
    assert_allclose(reach.plate.position[[0, -1]], poses.position[[5, 0]], atol=1e-6)
    determinants = np.linalg.det(stewart.gap_by_pose(reach.q, reach.plate))
    assert (np.sign(determinants) == np.sign(determinants[0])).all()
    assert np.abs(np.diff(reach.plate.position, axis=0)).max() < 0.15


def test_limits_that_allow_no_motion_leave_the_answer_open(stewart, stewart_modes) -> None:
    """A same-signed mode that the search does not reach is unknown, never called unreachable."""
    q, poses, home = stewart_modes
    answers = find_reachable_modes(stewart, q, poses.take(np.array([home, 0])), 0, n_samples=2)
    assert answers[1].verdict == "unknown" and "no proof" in answers[1].why


def test_rods_distance_is_that_of_the_nearest_points(stewart, rng) -> None:
    """Points along all pairs of legs come as near to each other as is said, and no nearer; half a turn makes the legs cross."""
    q, share = stewart.robot.home, np.linspace(0, 1, 200)[:, None]
    for _ in range(5):
        pose = Poses(
            stewart.home.position + rng.uniform(-0.3, 0.3, 3), Rotation.from_quat(rng.normal(size=4)).as_matrix()[None]
        )
        A, B = stewart.base_points(q)[0], stewart.plate_points(pose)[0]
        points = A + share[:, :, None] * (B - A)
        pairs = [cdist(points[:, i], points[:, j]).min() for i in range(6) for j in range(i)]
        assert 0 <= min(pairs) - measure_rod_distance(stewart, q, pose) < 0.01
    half_turn = Poses(stewart.home.position, stewart.home.rotation @ np.diag([-1.0, -1, 1]))
    assert measure_rod_distance(stewart, q, half_turn) < 0.01 < measure_rod_distance(stewart, q, stewart.home)


def test_wrong_questions_are_refused(stewart, stewart_modes) -> None:
    """Too many samples, a home that is not there, more rods than actuators, too few rods."""
    q, poses, _ = stewart_modes
    with raises_code("wrong_shape"):
        find_robot_assembly_modes(stewart, np.zeros((2, 6)))
    with raises_code("invalid_value", "9"):
        find_reachable_modes(stewart, q, poses, 9)
    triglide = build_rods(load_robot(URDF / "triglide.urdf.xacro"))
    with raises_code("unsupported", "6", "3"):
        find_reachable_modes(triglide, triglide.robot.home, triglide.home, 0)
