"""Feedforward: the model's force away from standstill, no jump through it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.control import Feedforward
from tau_dyn.effects import ReducerCoupling, friction_model
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.model import Model
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def model() -> Model:
    """The L1 with asymmetric friction."""
    robot = load_robot("gantry_tau")
    plain = Model.of(robot, friction_model("asymmetric", robot.actuated, robot.force_units))
    sizes = {"coulomb_pos": 90.0, "coulomb_neg": 70.0, "viscous_pos": 130.0, "viscous_neg": 110.0}
    return plain.with_values({f"{j}.{k}": x for j in robot.actuated for k, x in sizes.items()})


def at(model: Model, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.tile(model.robot.home, (len(v), 1)), v, np.zeros_like(v)


def test_ramp_is_the_identified_law_outside_the_width(model, rng) -> None:
    """Beyond the width feedforward equals the model's force exactly; tanh comes within 4 % of Coulomb at one width."""
    v = rng.choice([-1, 1], (30, 3)) * rng.uniform(0.011, 0.5, (30, 3))
    q, v, a = at(model, v)
    assert_allclose(Feedforward(model, width=0.01)(q, v, a), model.torque(q, v, a), rtol=1e-14)
    tanh = Feedforward(model, width=0.01, shape="tanh")
    assert_allclose(tanh.smooth_sign(np.array([[0.01, -0.005, 0.0]])), [[np.tanh(2), -np.tanh(1), 0]])
    assert np.abs(tanh(q, v, a) - model.torque(q, v, a)).max() < 0.04 * 90
    far = np.full((1, 3), 0.2)
    assert_allclose(tanh(*at(model, far)), model.torque(*at(model, far)), rtol=1e-12)


def test_ramp_is_piecewise_linear(model) -> None:
    """Within the width, one a joint, friction is a straight line from law to law (Dressler 2012, Figure 3.6)."""
    feedforward = Feedforward(model, width=np.array([0.01, 0.02, 0.04]))
    sign = feedforward.smooth_sign(np.array([[0.005, 0.005, 0.005], [-0.02, -0.02, -0.02], [0.0, 0.1, -0.1]]))
    assert_allclose(sign, [[0.5, 0.25, 0.125], [-1, -1, -0.5], [0, 1, -1]])
    share = np.linspace(-1, 1, 21)[:, None]
    q, v, a = at(model, share * feedforward.width)
    friction = feedforward(q, v, a) - model.mechanism.inverse_dynamics(q, v, a)
    assert_allclose(friction, friction[0] + (1 + share) / 2 * (friction[-1] - friction[0]), atol=1e-9)


@pytest.mark.parametrize("shape", ["ramp", "tanh"])
def test_force_is_continuous_through_standstill_and_friction_never_overdone(model, shape: str) -> None:
    """No jump for a drive to chatter on; inside the width the friction lies between the two directions' laws."""
    speeds = np.linspace(-0.03, 0.03, 601)
    q, v, a = at(model, np.repeat(speeds[:, None], 3, axis=1))
    force = Feedforward(model, width=0.01, shape=shape)(q, v, a)
    # tanh is steepest: 2 / w, times half of the 160 N from law to law; twice that, for the viscous share
    steepest = 2 * 160 / 0.01 * (speeds[1] - speeds[0])
    assert np.abs(np.diff(force, axis=0)).max() < steepest
    friction = force - model.mechanism.inverse_dynamics(q, v, a)
    assert np.all(friction <= 90 + 130 * np.abs(v) + 1e-9) and np.all(friction >= -70 - 110 * np.abs(v) - 1e-9)
    at_rest = (90 - 70) / 2 + ((130 - 110) * 0.01 / 2 if shape == "ramp" else 0.0)  # the mean of both directions
    assert_allclose(friction[300], at_rest, atol=1e-9)


def test_an_array_is_its_samples(model, rng) -> None:
    """Many samples at once equal one by one, in the shape given."""
    q, v, a = at(model, rng.standard_normal((5, 3)))
    feedforward = Feedforward(model)
    one_by_one = [feedforward(*x) for x in zip(q, v, a, strict=True)]
    assert one_by_one[0].shape == (3,)
    assert_allclose(feedforward(q, v, a), one_by_one, rtol=1e-14)


@pytest.mark.parametrize(
    "shapes", [((2,), (2,), (2,)), ((3,), (1, 3), (3,)), ((4, 3), (4, 3), (1, 3)), ((1, 4, 3),) * 3, ((),) * 3]
)
def test_wrong_shapes_are_refused(model, shapes) -> None:
    """Broadcasting in silence would send one joint's force to another."""
    with pytest.raises(InputError, match=r"must have one shape, \(3,\) or \(N, 3\) for cart1, cart2, cart3"):
        Feedforward(model)(*(np.zeros(s) for s in shapes))


@pytest.mark.parametrize("width", [0.0, -0.01, np.nan, np.inf])
def test_widths_must_be_speeds(model, width: float) -> None:
    """A width of zero is the jump we avoid."""
    with pytest.raises(InputError, match="must be a positive speed"):
        Feedforward(model, width=width)


def test_unknown_shapes_and_wrong_numbers_of_widths_are_refused(model) -> None:
    """The shapes there are are listed; two widths do not fit three joints."""
    with pytest.raises(UnknownName, match="named 'step'; there are ramp, tanh"):
        Feedforward(model, shape="step")
    with pytest.raises(InputError, match="width"):
        Feedforward(model, width=np.array([0.01, 0.02]))


def test_it_loads_what_identify_wrote(model, rng, tmp_path) -> None:
    """A model file on disk gives the same forces, without the xacro it came from."""
    model.save(tmp_path / "l1.yaml")
    q, v, a = at(model, rng.standard_normal((5, 3)))
    loaded = Feedforward.load(tmp_path / "l1.yaml", width=0.02)
    assert_allclose(loaded(q, v, a), Feedforward(model, width=0.02)(q, v, a), rtol=1e-13)


def test_joints_that_share_a_motor_keep_their_law_outside_the_width(two_link) -> None:
    """A coupling's force follows the summed speed; clamping each joint's speed would change it far from standstill."""
    coupling = ReducerCoupling(two_link.actuated, two_link.force_units)
    model = Model.of(two_link, [coupling])
    values = dict(zip(coupling.parameters.names, (0.1, 5.0, 7.0), strict=True))
    model = model.with_values(values)
    q, v, a = np.zeros((1, 2)), np.array([[1.0, -0.6]]), np.zeros((1, 2))
    assert_allclose(Feedforward(model, width=0.01)(q, v, a), model.torque(q, v, a), rtol=1e-12)
