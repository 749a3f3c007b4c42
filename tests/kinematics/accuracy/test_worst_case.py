"""Worst cases, bounds and random errors of robots held by rods, against each other and against what is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pinocchio as pin
from raising import raises_code

from tau_dyn.kinematics.accuracy import (
    ActuatorError,
    ErrorBounds,
    RodError,
    build_device,
    build_isotropic_error,
    compute_positioning_errors,
    shells,
)
from tau_dyn.kinematics.accuracy.device import Moved, State
from tau_dyn.kinematics.accuracy.worst_case import bound_first_order, draw, monte_carlo, solve_worst_case
from tau_dyn.mechanism import Poses, build_rods, forward_kinematics
from tau_dyn.robot import load_robot

CASE_2 = {
    "cart1": ActuatorError(axes=(11e-6, 28e-6, 28e-6)),
    "cart2": ActuatorError(axes=(58e-6, 38e-6, 38e-6)),
    "cart3": ActuatorError(axes=(19e-6, 47e-6, 47e-6)),
}


@cache
def rods_of(prototype: str = "d1", arms: str = "simplified"):
    return build_rods(load_robot("gantry_tau", prototype=prototype, arms=arms))


def poses_of(rods, n: int = 5, seed: int = 0) -> tuple[np.ndarray, Poses]:
    spread = 0.3 * np.random.default_rng(seed).standard_normal((n, rods.na))
    q = rods.robot.home + (spread if rods.translates else spread.mean(axis=1, keepdims=True))
    found = forward_kinematics(rods, q)
    assert found.ok.all()
    return q, found.poses


def test_random_errors_stay_below_the_exact_worst_case_and_that_below_the_proved_bound() -> None:
    """No draw within the bounds moves the tool farther than the exact worst case, and none farther than what is proved."""
    for arms, errors in (
        ("simplified", ErrorBounds(CASE_2, {"rod2": RodError(5e-5, 2e-5, 1e-5)})),
        (
            "complete",
            ErrorBounds(CASE_2, {name: RodError(1e-5, 2e-5, 3e-5) for name in rods_of(arms="complete").names}),
        ),
    ):
        rods = rods_of(arms=arms)
        q, tool = poses_of(rods, 3)
        for scale in (1.0, 100.0):
            more = errors.scaled(scale)
            found = compute_positioning_errors(build_device(rods, more), more, q, tool, samples=150)
            exact, proved = found.largest["exact"], found.largest["certified"]
            assert np.all(found.largest["montecarlo"] <= exact * (1 + 1e-12))
            assert np.all(found.largest["montecarlo"] > 0.3 * exact)
            if arms == "simplified" or scale == 1:
                assert np.all(exact <= proved)
            if arms == "simplified" and scale == 1:
                assert np.all(proved < 1.001 * exact)


def test_orthogonal_rods_with_equal_errors_err_by_root_three() -> None:
    """Orthogonal rods turn balls of radius r into a cube: the tool errs by sqrt(3) r, and never by less elsewhere."""
    rods = rods_of("l1")
    r = 1e-6
    errors = ErrorBounds({j: build_isotropic_error(r) for j in rods.robot.actuated})
    device = build_device(rods, errors)
    q, tool = poses_of(rods, 60)
    state = device.state(q, tool)
    first, _ = bound_first_order(device.sensitivity(state), device.balls, True)
    C, _ = device.tangent(state, state.plate)
    skew = np.abs(np.linalg.det(C))
    assert np.all(first.size >= np.sqrt(3) * r)
    bound = np.sqrt(3) * r / np.linalg.svd(C, compute_uv=False)[:, -1]
    assert np.all(first.size <= bound * (1 + 1e-12))
    order = np.argsort(-skew)
    assert first.size[order[0]] < first.size[order[-1]]
    cube = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0] * r
    assert np.isclose(
        bound_first_order(cube[None], (slice(0, 1), slice(1, 2), slice(2, 3)), True)[0].size[0], np.sqrt(3) * r
    )


def test_parallelepiped_is_the_brute_force_over_corners_for_small_errors() -> None:
    """The farthest of the eight exact corners, found with lengths L +- h by forward kinematics, is A.4's longest diagonal."""
    rods = rods_of("l1")
    h = np.array([32e-6, 77e-6, 54e-6])
    errors = ErrorBounds({j: build_isotropic_error(x) for j, x in zip(rods.robot.actuated, h, strict=True)})
    device = build_device(rods, errors)
    q, tool = poses_of(rods, 1)
    state = device.state(q, tool)
    reach = []
    for signs in product((1, -1), repeat=3):
        values = {f"arm{k + 1}.length": rods.lengths[k] + signs[k] * h[k] for k in range(3)}
        longer = rods.with_geometry(rods.geometry.update({n: {"value": v} for n, v in values.items()}))
        reach.append(np.linalg.norm(forward_kinematics(longer, q).poses.position - tool.position))
    first, corners = bound_first_order(device.sensitivity(state), device.balls, True)
    assert np.isclose(first.size[0], max(reach), rtol=2e-4)
    assert np.isclose(solve_worst_case(device, state, corners).size[0], max(reach), rtol=1e-9)
    edges = shells.compute_half_edges(device, state)[0]
    assert np.isclose(max(np.linalg.norm(edges @ s) for s in product((1, -1), repeat=3)), first.size[0], rtol=1e-12)


def test_linear_departs_from_exact_with_the_square_of_the_errors() -> None:
    """Ten times the errors leave a hundred times the difference between first order and the solved constraints."""
    rods = rods_of()
    q, tool = poses_of(rods, 3)
    missed = []
    for scale in (10.0, 100.0):
        errors = ErrorBounds(CASE_2).scaled(scale)
        found = compute_positioning_errors(
            build_device(rods, errors), errors, q, tool, methods=["parallelepiped", "exact"]
        )
        missed.append(np.abs(found.largest["exact"] - found.largest["parallelepiped"]))
    assert np.allclose(missed[1] / missed[0], 100.0, rtol=0.05)


def test_thesis_ellipsoids_are_exact_for_balls_and_too_small_otherwise() -> None:
    """A.2's shells of balls meet where the exact error set has its corners; those of other bounds leave some of it out."""
    rods = rods_of()
    q, tool = poses_of(rods)
    for actuators, equal in (({j: build_isotropic_error(5e-5) for j in CASE_2}, True), (CASE_2, False)):
        errors = ErrorBounds(actuators)
        device = build_device(rods, errors)
        state = device.state(q, tool)
        shifts, count = shells.find_corners(device, state)
        exact = compute_positioning_errors(device, errors, q, tool, methods=["exact"]).largest["exact"]
        assert count.max() < 8
        if equal:
            assert np.allclose(shells.measure_largest(shifts), exact, rtol=1e-9)
        else:
            share = shells.measure_largest(shifts) / exact
            assert np.all(share < 0.99) and np.all(share > 0.9)


def test_errors_that_carts_share_turn_no_plate() -> None:
    """A cart moves all its rods alike: parallel rods keep the plate's orientation, and the tool goes as with one rod."""
    simple, complete = rods_of("l1"), rods_of("l1", "complete")
    errors = ErrorBounds({"cart2": ActuatorError(3e-5, 6e-5), "cart3": build_isotropic_error(5e-5)})
    q = simple.robot.home[None]
    sizes = []
    for rods in (simple, complete):
        found = compute_positioning_errors(build_device(rods, errors), errors, q, forward_kinematics(rods, q).poses,
                                   methods=["parallelepiped", "exact"])  # fmt: skip
        sizes.append(found.largest["exact"][0])
        if rods is complete:
            assert found.turned["exact"][0] < 1e-10
    assert np.isclose(sizes[0], sizes[1], rtol=1e-9)


def test_sensitivity_is_the_derivative_of_the_solved_constraints() -> None:
    """Central differences of the closed robot agree with the sensitivity, position and orientation, tool lever included."""
    hexapod = build_rods(load_robot("stewart"))
    lever = replace(hexapod, tool=pin.SE3(np.eye(3), np.array([0.05, -0.02, 0.1])))
    for rods in (rods_of("d1", "complete"), hexapod, lever):
        errors = ErrorBounds(
            {j: ActuatorError(1e-3) for j in rods.robot.actuated}, {n: RodError(1e-3, 1e-3, 1e-3) for n in rods.names}
        )
        device = build_device(rods, errors)
        q, tool = poses_of(rods, 2)
        state = device.state(q, tool)
        H, step = device.sensitivity(state), 1e-3
        for k in range(device.m):
            e = np.zeros((2, device.m))
            e[:, k] = step
            up, down = device.closed(state, e), device.closed(state, -e)
            moved = np.concatenate([up.shift - down.shift, up.turn - down.turn], axis=1) / (2 * step)
            assert np.allclose(moved, H[:, :, k], atol=1e-7)


def test_near_a_singularity_the_linear_bound_is_wrong_and_nothing_is_proved() -> None:
    """Nearer to the plane of the base points the first-order bound runs off, the exact one says so, and no bound is certified."""
    rods = rods_of("l1")
    robot = rods.robot
    errors = ErrorBounds({j: build_isotropic_error(2e-3) for j in robot.actuated})
    A = rods.base_points(robot.home[None])[0]
    n = np.cross(A[1] - A[0], A[2] - A[0])
    n /= np.linalg.norm(n)
    far = forward_kinematics(rods, robot.home[None]).poses
    height = float((far.position[0] - A[0]) @ n)
    foot = far.position[0] - height * n
    tool = np.array([foot + s * height * n for s in (1.0, 0.2, 0.02)])
    lengths = np.linalg.norm(tool[:, None] - A, axis=2)
    off, proved, exact = [], [], []
    for k in range(3):
        near = rods.with_geometry(
            rods.geometry.update({f"arm{i + 1}.length": {"value": lengths[k, i]} for i in range(3)})
        )
        device = build_device(near, errors)
        found = compute_positioning_errors(device, errors, robot.home[None], forward_kinematics(near, robot.home[None]).poses,
                                   methods=["parallelepiped", "exact", "certified"])  # fmt: skip
        off.append(found.off("parallelepiped")[0])
        proved.append(found.largest["certified"][0])
        exact.append(found.largest["exact"][0])
    assert abs(off[0]) < 0.01 < abs(off[1])
    assert np.isfinite(proved[0]) and np.isnan(proved[2]) and np.isnan(exact[2])


class _Bent:
    """One source of two numbers whose tool goes along a bent path; from its second pose on it falls off its branch."""

    balls, m = (slice(0, 2),), 2

    def sensitivity(self, state: State, plate: Poses | None = None, e: np.ndarray | None = None) -> np.ndarray:
        at = np.zeros((len(state), 2)) if e is None else e
        H = np.zeros((len(state), 3, 2))
        H[:, 0, 0], H[:, 1, 1], H[:, 1, 0] = 1.0, 1.0, at[:, 0]
        return H

    def closed(self, state: State, e: np.ndarray) -> Moved:
        ok = np.arange(len(state)) == 0
        shift = np.stack([e[:, 0], e[:, 1] + e[:, 0] ** 2 / 2, 0 * e[:, 0]], axis=1)
        return Moved(np.where(ok[:, None], shift, np.nan), np.zeros_like(shift), state.plate, ok)


def test_a_pose_that_falls_off_its_branch_leaves_its_neighbours_alone() -> None:
    """A pose's exact worst case is its own, error, size and direction: the same alone and beside a pose that has none."""
    here = Poses(np.zeros((2, 3)), np.broadcast_to(np.eye(3), (2, 3, 3)))
    state = State(np.zeros((2, 1)), here.position, here.rotation, here)
    corners = np.broadcast_to([1.0, 0.0], (2, 1, 2))
    alone = solve_worst_case(_Bent(), state.take(slice(0, 1)), corners[:1])
    beside = solve_worst_case(_Bent(), state, corners)
    assert np.isnan(beside.size[1]) and alone.size[0] > 1.2
    for one, other in zip(alone, beside, strict=True):
        assert np.allclose(one[0], other[0], rtol=1e-12)
    assert np.isclose(np.linalg.norm(_Bent().closed(state, beside.e).shift[0]), beside.size[0], rtol=1e-12)


def test_draws_fill_their_balls_evenly() -> None:
    """Errors are uniform in volume: in a ball of three numbers half of the draws lie beyond 0.7937 of the radius."""
    e = draw((slice(0, 1), slice(1, 4)), 4, (40_000,), np.random.default_rng(3))
    radius = np.linalg.norm(e[:, 1:], axis=1)
    assert np.abs(e[:, 0]).max() <= 1 and radius.max() <= 1
    assert abs(np.mean(radius > 0.5 ** (1 / 3)) - 0.5) < 0.01 and abs(np.mean(np.abs(e[:, 0]) > 0.5) - 0.5) < 0.01


def test_one_actuator_moves_the_tool_by_its_jacobian_column() -> None:
    """With one interval error all methods that take it agree on the Jacobian's column times the error."""
    rods = rods_of("l1")
    errors = ErrorBounds({"cart1": ActuatorError(1e-6)})
    q, tool = poses_of(rods, 4)
    found = compute_positioning_errors(
        build_device(rods, errors), errors, q, tool, methods=["linear", "parallelepiped", "exact"]
    )
    step = 1e-4 * np.eye(3)[0]
    up, down = (forward_kinematics(rods, q + s * step).poses.position for s in (1, -1))
    column = np.linalg.norm(up - down, axis=1) / 2e-4 * 1e-6
    for size in found.largest.values():
        assert np.allclose(size, column, rtol=1e-5)


def test_bad_requests_are_refused() -> None:
    """No errors, unknown methods and poses that are no numbers end in one sentence."""
    rods = rods_of("l1")
    with raises_code("invalid_value"):
        build_device(rods, ErrorBounds())
    errors = ErrorBounds({"cart1": ActuatorError(1e-6)})
    device = build_device(rods, errors)
    q, tool = poses_of(rods, 1)
    with raises_code("unknown_name"):
        compute_positioning_errors(device, errors, q, tool, methods=["guess"])
    with raises_code("invalid_value", "finite"):
        compute_positioning_errors(device, errors, q * np.nan, tool)
    assert shells.explain_no_certificate(device) == "" and monte_carlo(device, device.state(q, tool), 5, 0).lost[0] == 0
