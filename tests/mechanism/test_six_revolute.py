"""All solutions of six turning joints: against the UR's closed form, a published arm with sixteen, and random arms."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics import build_inverse_table
from tau_dyn.mechanism import Poses, find_all_solutions, forward_kinematics
from tau_dyn.robot import Robot, load_robot_from_urdf

UR5 = {
    "a": [0, -0.425, -0.39225, 0, 0, 0],
    "alpha": [90, 0, 0, 90, -90, 0],
    "d": [0.089159, 0, 0, 0.10915, 0.09465, 0.0823],
}
"""Denavit-Hartenberg values [m, deg] that Universal Robots publishes."""
SIXTEEN = {"a": [0.3, 1, 0, 1.5, 0, 0], "alpha": [90, 1, 90, 1, 90, 1], "d": [0, 0, 0.2, 0, 0, 0]}
"""The arm of Manseur and Doty 1989 [m, deg], with a pose that it takes in sixteen ways."""
SIXTEEN_WAYS = [
    [-0.760117, -0.641689, 0.102262, -1.140175],
    [0.133333, 0.0, 0.991071, 0.0],
    [-0.635959, 0.766965, 0.085558, 0.0],
]
PUMA = {"a": [0, 0.4318, 0.0203, 0, 0, 0], "alpha": [90, 0, -90, 90, -90, 0], "d": [0.6, 0, 0.15, 0.4318, 0, 0.1]}


def transform(a: float, alpha: float, d: float) -> np.ndarray:
    """Return a link's transform (4, 4) at angle zero by its Denavit-Hartenberg values [m, deg]."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_euler("x", alpha, degrees=True).as_matrix(), [a, 0, d]
    return X


def arm_of(places: list[np.ndarray], axes: str = "0 0 1") -> Robot:
    """Return an arm whose link k + 1 has joint k + 1 at its start and this placement at its end; the last is the tool's."""
    rows = ['<robot name="arm"><link name="l0_link"/>']
    for k, X in enumerate([np.eye(4), *places], start=1):
        rpy = Rotation.from_matrix(X[:3, :3]).as_euler("xyz")
        origin = f'<origin xyz="{" ".join(map(repr, X[:3, 3].tolist()))}" rpy="{" ".join(map(repr, rpy.tolist()))}"/>'
        name, kind = (f"j{k}", "continuous") if k <= 6 else ("tool", "fixed")
        link = f"l{k}_link" if k <= 6 else "tool_link"
        ends = f'<parent link="l{k - 1}_link"/><child link="{link}"/>{origin}<axis xyz="{axes}"/>'
        rows.append(f'<link name="{link}"/><joint name="{name}" type="{kind}">{ends}</joint>')
    return load_robot_from_urdf("".join(rows) + "</robot>", "arm")


def arm_by_values(values: dict) -> Robot:
    return arm_of([transform(*x) for x in zip(values["a"], values["alpha"], values["d"], strict=True)])


@cache
def ur5() -> Robot:
    return arm_by_values(UR5)


def solve_ur(T: np.ndarray) -> np.ndarray:
    """Return all angles (n, 6) [rad] of the UR5 by its closed form (Hawkins 2013), other geometry than the elimination's."""
    a2, a3, d4, d6 = UR5["a"][1], UR5["a"][2], UR5["d"][3], UR5["d"][5]
    found = []
    wrist = T[:3, 3] - d6 * T[:3, 2]
    reach = np.hypot(wrist[0], wrist[1])
    if reach < d4:
        return np.zeros((0, 6))
    for shoulder in (1, -1):
        q1 = np.arctan2(wrist[1], wrist[0]) + shoulder * np.arccos(d4 / reach) + np.pi / 2
        s1, c1 = np.sin(q1), np.cos(q1)
        cosine = (T[0, 3] * s1 - T[1, 3] * c1 - d4) / d6
        if abs(cosine) > 1:
            continue
        for flip in (1, -1):
            q5 = flip * np.arccos(cosine)
            back = np.linalg.inv(T)
            x, y = back[:3, 0] * s1 - back[:3, 1] * c1, np.sign(np.sin(q5))
            q6 = np.arctan2(-x[1] * y, x[0] * y)
            T14 = np.linalg.inv(turn(q1, 0)) @ T @ np.linalg.inv(turn(q5, 4) @ turn(q6, 5))
            p = T14[:3, 3]
            cosine3 = (p[0] ** 2 + p[1] ** 2 - a2**2 - a3**2) / (2 * a2 * a3)
            if abs(cosine3) > 1:
                continue
            for elbow in (1, -1):
                q3 = elbow * np.arccos(cosine3)
                q2 = np.arctan2(p[1], p[0]) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
                last = np.linalg.inv(turn(q2, 1) @ turn(q3, 2)) @ T14
                found.append([q1, q2, q3, np.arctan2(last[1, 0], last[0, 0]), q5, q6])
    return np.array(found).reshape(-1, 6)


def turn(q: float, k: int) -> np.ndarray:
    """Return joint k's turn by q [rad] and its link's transform (4, 4)."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("z", q).as_matrix()
    return X @ transform(UR5["a"][k], UR5["alpha"][k], UR5["d"][k])


def homogeneous(poses: Poses, k: int) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = poses.rotation[k], poses.position[k]
    return X


def are_same(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two sets of angles (n, 6) are equal up to order and whole turns."""
    if len(one) != len(other):
        return False
    away = np.abs((one[:, None] - other[None] + np.pi) % (2 * np.pi) - np.pi).max(axis=2)
    return bool((np.sum(away < 1e-6, axis=0) == 1).all() and (np.sum(away < 1e-6, axis=1) == 1).all())


def rows_of(q: np.ndarray) -> np.ndarray:
    return q[np.isfinite(q).all(axis=1)]


def test_a_hundred_poses_of_a_ur5_have_the_solutions_of_its_closed_form() -> None:
    """Three parallel axes make most eliminations singular; one that is not gives every solution, and proves the count."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, 6))
    poses = forward_kinematics(ur5(), q).poses
    found = find_all_solutions(ur5(), poses)
    assert all(are_same(rows_of(rows), solve_ur(homogeneous(poses, k))) for k, rows in enumerate(found.q))
    assert found.proved.sum() >= 98


def test_poses_out_of_a_ur5s_reach_are_proved_to_have_no_solution() -> None:
    """Two metres away nothing is found, and nothing is left to search for."""
    poses = forward_kinematics(ur5(), np.full((1, 6), 0.5)).poses
    found = find_all_solutions(ur5(), Poses(poses.position + [2.0, 0, 0], poses.rotation))
    assert found.proved.all() and not np.isfinite(found.q).any()


def test_a_published_arm_takes_a_pose_in_sixteen_ways() -> None:
    """The most that six joints can have; all are real, and the table says that the count is proved."""
    arm, T = arm_by_values(SIXTEEN), np.array(SIXTEEN_WAYS)
    rotation = Rotation.from_matrix(T[:, :3]).as_matrix()
    table = build_inverse_table(arm, Poses(T[None, :, 3], rotation[None]), all_configurations=True)
    assert len(table.q) == 16 and table.complete
    (count,) = table.to_dict()["solutions"]
    assert count == {"pose": 1, "count": 16, "proved": True, "why": "by elimination to an eigenvalue problem"}
    back = forward_kinematics(arm, table.q).poses
    assert np.abs(back.position - T[:, 3]).max() < 1e-9 and np.abs(back.rotation - rotation).max() < 1e-9


@pytest.mark.parametrize("axes", ["0 0 1", "0.6 -0.8 0"])
def test_random_arms_have_an_even_number_of_solutions_with_the_true_one(axes: str, rng: np.random.Generator) -> None:
    """Complex roots come in pairs, so sixteen less these is even; joint axes may point anywhere."""
    for _ in range(50):
        places = [np.eye(4) for _ in range(6)]
        for X in places:
            X[:3, :3], X[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3)
        arm, q = arm_of(places, axes), rng.uniform(-np.pi, np.pi, (1, 6))
        found = find_all_solutions(arm, forward_kinematics(arm, q).poses)
        rows = rows_of(found.q[0])
        assert len(rows) % 2 == 0 or not found.proved[0]
        assert np.abs((rows - q + np.pi) % (2 * np.pi) - np.pi).max(axis=1).min() < 1e-6


def test_a_spherical_wrist_has_eight_solutions_and_a_straight_one_a_continuum(rng: np.random.Generator) -> None:
    """Where the axes of joints 4 and 6 fall together their angles are free: no count is proved, and the reason is said."""
    arm = arm_by_values(PUMA)
    q = np.column_stack(
        [rng.uniform(-0.5, 0.5, (10, 2)), rng.uniform(0.3, 1.0, (10, 1)), rng.uniform(0.3, 1.2, (10, 3))]
    )
    found = find_all_solutions(arm, forward_kinematics(arm, q).poses)
    assert found.proved.all() and (np.isfinite(found.q).all(axis=2).sum(axis=1) == 8).all()
    q[0, 4] = 0.0
    straight = find_all_solutions(arm, forward_kinematics(arm, q[:1]).poses)
    assert not straight.proved[0] and "continuum" in straight.why[0]


def test_a_calibrated_ur5_has_the_solutions_of_its_nominal_one_moved_a_little(rng: np.random.Generator) -> None:
    """Axes parallel to a milliradian are nearly special; away from singular poses all solutions move with the geometry."""
    places = [transform(*x) for x in zip(UR5["a"], UR5["alpha"], UR5["d"], strict=True)]
    for X in places:
        X[:3, :3] = X[:3, :3] @ Rotation.from_rotvec(rng.uniform(-1e-3, 1e-3, 3)).as_matrix()
    arm, q = arm_of(places), rng.uniform(-np.pi, np.pi, (20, 6))
    found = find_all_solutions(arm, forward_kinematics(arm, q).poses)
    for true, rows in zip(q, found.q, strict=True):
        assert np.abs((rows_of(rows) - true + np.pi) % (2 * np.pi) - np.pi).max(axis=1).min() < 1e-6
