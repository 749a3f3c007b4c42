"""The equations of a floating base are those of a free flyer, and no force of the ground is left in them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.effects import CoulombAsymmetry, Stribeck
from tau_dyn.identify import build_model, choose_preparation, prepare_segment
from tau_dyn.legged import complete_base, compute_contact_jacobian, eliminate_contacts
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import load_robot


@pytest.fixture
def motion(rng, walker):
    """Return 30 random positions, velocities and accelerations (30, 18)."""
    legs = np.tile([0.0, 0.6, -1.2], 4)
    q = np.concatenate([np.zeros(6), legs]) + rng.uniform(-0.5, 0.5, (30, walker.na))
    return q, rng.standard_normal(q.shape), rng.standard_normal(q.shape)


def to_free_flyer(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the free flyer's velocity per velocity of the coordinates (n, n), and its derivative in time."""
    (_, p, r), (dy, dp, dr) = q[3:6], v[3:6]
    sp, cp, sr, cr = np.sin(p), np.cos(p), np.sin(r), np.cos(r)
    turn = Rotation.from_euler("ZYX", q[3:6]).as_matrix()
    W = np.array([[-sp, 0, 1], [sr * cp, cr, 0], [cr * cp, -sr, 0]])
    dW = np.array(
        [[-cp * dp, 0, 0], [cr * cp * dr - sr * sp * dp, -sr * dr, 0], [-sr * cp * dr - cr * sp * dp, -cr * dr, 0]]
    )
    E, dE = np.eye(len(q)), np.zeros((len(q), len(q)))
    E[:3, :3], E[3:6, 3:6] = turn.T, W
    dE[:3, :3], dE[3:6, 3:6] = -pin.skew(W @ [dy, dp, dr]) @ turn.T, dW
    return E, dE


def test_forces_are_those_of_pinocchios_free_flyer(walker, walker_file, motion):
    """`E' rnea(q, E v, E a + dE v)` of a free flyer, whose velocity is in axes of the base, to 1e-9."""
    model = pin.buildModelFromUrdf(str(walker_file), pin.JointModelFreeFlyer())
    data = model.createData()
    tau = build_mechanism(walker).inverse_dynamics(*motion)
    for k, (q, v, a) in enumerate(zip(*motion, strict=True)):
        E, dE = to_free_flyer(q, v)
        pose = np.concatenate([q[:3], Rotation.from_euler("ZYX", q[3:6]).as_quat(), q[6:]])
        assert_allclose(E.T @ pin.rnea(model, data, pose, E @ v, E @ a + dE @ v), tau[k], atol=1e-9)


def test_a_contact_moves_as_the_point_of_the_ball_that_touches_the_ground(walker, walk, motion):
    """The lowest point of a foot's ball, as a point of the shank: its velocity by differences."""
    q, v, _ = motion
    model, data = walker.model, walker.model.createData()
    frame = model.getFrameId("hr_foot", pin.FrameType.BODY)

    def place(x: np.ndarray) -> pin.SE3:
        tree = np.concatenate([x[:3], *(np.array([np.cos(y), np.sin(y)]) for y in x[3:6]), x[6:]])
        pin.framesForwardKinematics(model, data, tree)
        return data.oMf[frame].copy()

    found = compute_contact_jacobian(walker, q)[:, 9:] @ v[:, :, None]
    for x, dx, one in zip(q, v, found, strict=True):
        inside = place(x).actInv(place(x).translation - [0, 0, walk.radius])
        ahead, behind = (place(x + s * 1e-6 * dx).act(inside) for s in (1, -1))
        assert_allclose((ahead - behind) / 2e-6, one[:, 0], atol=1e-7)


def test_no_force_of_the_ground_is_left(walker, rng, motion):
    """Any forces at feet that touch change nothing; with all four on the ground the six equations of the base are left."""
    q, v, a = motion
    touching = rng.random((len(q), 4)) < 0.6
    touching[0] = True
    found = eliminate_contacts(walker, q, touching)
    tau = build_mechanism(walker).inverse_dynamics(q, v, a)
    force = 50 * rng.standard_normal((len(q), 4, 3)) * touching[:, :, None]
    ground = np.einsum("nri,nr->ni", compute_contact_jacobian(walker, q), force.reshape(len(q), 12))
    assert_allclose(found.project(tau + ground), found.project(tau), atol=1e-9)
    assert np.abs(ground).max() > 10
    assert found.free[0].tolist() == [True] * 6 + [False] * 12
    assert_allclose(found.free.sum(axis=1), 18 - 3 * touching.sum(axis=1))


def test_columns_are_projected_as_forces_are(walker, rng, motion):
    """`G' (Y x)` is `(G' Y) x`: a column may act on several joints, and on the base."""
    q, _, _ = motion
    found = eliminate_contacts(walker, q, rng.random((len(q), 4)) < 0.6)
    Y, x = rng.standard_normal((len(q), walker.na, 7)), rng.standard_normal(7)
    Y[:, 3:, 2] = 0.0
    assert_allclose(found.project(Y) @ x, found.project(Y @ x), atol=1e-10)


def test_a_friction_law_has_the_same_columns_joint_by_joint(walker, walk):
    """The law of one joint enters the equations in which the joint's force is, as if all equations were computed."""
    (log,) = complete_base(walker, [walk.record(walker, 6.0, 1)])
    piece = prepare_segment(build_model(walker, "symmetric"), log, choose_preparation(walker, [log]))
    laws = [cls((joint,), ("N m",)) for joint in ("fl_knee", "hr_swing") for cls in (Stribeck, CoulombAsymmetry)]
    for law, columns in zip(laws, piece.columns_of(laws), strict=True):
        wanted = piece.columns(law.columns(piece.motion))
        assert (np.abs(wanted).max(axis=(0, 2)) > 0).sum() >= 6
        assert_allclose(columns, wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_regression_leaves_out_what_its_equations_shut(walker, walk):
    """Forces and columns of a leg count in the air alone, those of the base always: both sides have the same gate."""
    (log,) = complete_base(walker, [walk.record(walker, 12.0, 1)])
    model = build_model(walker, "symmetric")
    piece = prepare_segment(model, log, choose_preparation(walker, [log]))
    run, m = piece.run(model), piece.motion
    rigid = build_mechanism(walker).regressor(m.q, m.v, m.a)
    assert_allclose(run.W[:, :, : rigid.shape[2]], piece.columns(rigid), atol=1e-6 * np.abs(run.W).max())
    assert (piece.gate[:, 6:] == 0).any() and run.usable[:, 6:].any()


def test_a_leg_in_the_air_keeps_its_own_equations(walker, motion):
    """Without contacts nothing is taken out; a lifted leg's three torques stay as they are."""
    q, v, a = motion
    tau = build_mechanism(walker).inverse_dynamics(q, v, a)
    assert_allclose(eliminate_contacts(walker, q, np.zeros((30, 4), bool)).project(tau), tau)
    lifted = eliminate_contacts(walker, q, np.tile([True, True, False, True], (30, 1)))
    assert lifted.free[:, 12:15].all()
    assert_allclose(lifted.project(tau)[:, 12:15], tau[:, 12:15])


def test_flat_feet_hold_by_forces_and_moments(walker_file, rng, motion):
    """A flat foot on a leg of three joints takes base equations along: 18 - 6 are left, without the wrench in them."""
    robot = load_robot(walker_file, base="floating", contacts=["fl_foot=flat"])
    q, v, a = motion
    found = eliminate_contacts(robot, q, np.ones((len(q), 1), bool))
    tau = build_mechanism(robot).inverse_dynamics(q, v, a)
    wrench = np.einsum("nri,nr->ni", compute_contact_jacobian(robot, q), 20 * rng.standard_normal((len(q), 6)))
    assert_allclose(found.project(tau + wrench), found.project(tau), atol=1e-8)
    assert (found.free.sum(axis=1) == 12).all()


def test_a_stretched_leg_leaves_its_sample_out(walker_file, motion):
    """With a straight knee a leg cannot move its foot along itself, and its torques say nothing of that force."""
    q = motion[0].copy()
    q[3, 8] = 0.0
    feet = [f"{leg}_foot=0" for leg in ("fl", "fr", "hl", "hr")]
    robot = load_robot(walker_file, base="floating", contacts=feet)
    free = eliminate_contacts(robot, q, np.ones((len(q), 4), bool)).free
    assert not free[3].any() and free[[2, 4], :6].all()
