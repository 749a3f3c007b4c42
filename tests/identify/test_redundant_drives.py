"""More drives than freedoms: masses, friction of each drive and the force inside, against forces by d'Alembert's principle."""

from __future__ import annotations

import numpy as np
import pytest
import redundant
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import build_model, complete_positions, identify
from tau_dyn.log import Log, differentiate
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot_from_urdf

PRELOAD = 4.0  # [N m] of the redundant shoulder
CART_PRELOAD, CART_COULOMB, CART_VISCOUS = 6.0, np.array([8.0, 14.0]), np.array([20.0, 35.0])


@pytest.fixture(scope="module")
def arms() -> Robot:
    """Return three arms on two freedoms, their masses a fifth too small in the file."""
    return load_robot_from_urdf(redundant.write_three_arms(0.8), "arms.urdf")


@pytest.fixture(scope="module")
def cart() -> Robot:
    """Return a cart with two motors."""
    return load_robot_from_urdf(redundant.write_cart(), "cart.urdf")


def log_arms(robot: Robot, t: np.ndarray, preload: float | np.ndarray = PRELOAD, noise: float = 0.05) -> Log:
    """Return a log of the arms with friction at all shoulders and a preload of the redundant one."""
    motion = redundant.move_three_arms(t)
    friction = redundant.COULOMB * np.sign(motion.v) + redundant.VISCOUS * motion.v
    (joint,) = robot.redundant_joints
    return redundant.write_log(motion, redundant.ARMS, friction, {joint: preload}, noise, "arms.csv")


def log_cart(t: np.ndarray) -> Log:
    """Return a log of the cart with friction at both motors, the second one pushing against the first."""
    motion = redundant.move_cart(t)
    friction = CART_COULOMB * np.sign(motion.v) + CART_VISCOUS * motion.v
    return redundant.write_log(motion, redundant.RAILS, friction, {"rail2": CART_PRELOAD}, 0.5, "cart.csv")


def test_projected_forces_are_those_of_dalembert(arms) -> None:
    """`B' tau` of the three shoulders, friction included, is the model's force at the true masses; the preload is not in it."""
    true = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf")
    t = np.arange(0, 2, 0.002)
    motion, log = redundant.move_three_arms(t), log_arms(true, t, noise=0.0)
    (projected,) = complete_positions(true, [log])
    index = [redundant.ARMS.index(joint) for joint in true.actuated]
    q, v = motion.q[:, index], motion.v[:, index]
    a = differentiate(v, 0.002, accuracy=4)
    model = build_model(true, "symmetric")
    values = {f"{joint}.coulomb": redundant.COULOMB[k] for k, joint in enumerate(redundant.ARMS)}
    values |= {f"{joint}.viscous": redundant.VISCOUS[k] for k, joint in enumerate(redundant.ARMS)}
    force = model.with_values(values).torque(q, v, a)
    assert_allclose(projected.joint("tau", true.actuated)[5:-5], force[5:-5], atol=1e-6 * np.abs(force).max())


def test_a_force_inside_of_any_size_leaves_projected_forces_as_they_are(arms) -> None:
    """Preloads that change with time move nothing: forces of the actuated joints are the same to rounding."""
    t = np.arange(0, 1, 0.01)
    (still, shaken) = complete_positions(
        arms, [log_arms(arms, t, x, 0.0) for x in (0.0, 50.0 * np.sin(9 * t)[:, None])]
    )
    assert_allclose(shaken.joint("tau", arms.actuated), still.joint("tau", arms.actuated), atol=1e-6)


def test_three_arms_are_identified_with_all_forces(arms) -> None:
    """Base parameters and the friction of each of three drives are within their intervals, and so is the preload."""
    found = identify(arms, log_arms(arms, np.arange(0, 20, 0.01)))
    true = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf").parameters
    values = dict(zip(true.names, true.values, strict=True))
    for k, joint in enumerate(redundant.ARMS):
        values |= {f"{joint}.coulomb_{side}": redundant.COULOMB[k] for side in ("pos", "neg")}
        values |= {f"{joint}.viscous_{side}": redundant.VISCOUS[k] for side in ("pos", "neg")}
    base = found.estimate.base
    off = found.estimate.beta_plain - base.combine(np.array([values[name] for name in base.names]))
    assert np.abs(off / found.estimate.stderr).max() < 4.0
    assert found.holdout is not None and found.holdout.relative_error_percent < 1.0
    assert found.parameters[f"{arms.redundant_joints[0]}.viscous_pos"].stderr is not None
    assert found.internal_force is not None
    (preload,) = found.internal_force.preloads
    assert preload.stderr is not None and preload.stderr < 0.05 * PRELOAD
    assert abs(preload.value - PRELOAD) < 3 * preload.stderr


def test_a_cart_with_two_motors_has_its_mass_and_its_preload(cart) -> None:
    """Mass and friction are the sums of both sides; what one motor pushes against the other is found next to them."""
    found = identify(cart, log_cart(np.arange(0, 20, 0.01)))
    sums = {row["expression"].split(" ")[0]: row for row in found.base_rows()}
    truth = {"cart.mass": 25.0, "rail1.coulomb_pos": 22.0, "rail1.viscous_neg": 55.0}
    for name, value in truth.items():
        assert abs(sums[name]["value"] - value) < 4 * sums[name]["stderr"], name
        assert sums[name]["stderr"] < 0.01 * value, name
    inside = found.to_dict()["internal_force"]
    (row,) = inside["preloads"]
    assert row["name"] == "rail2.preload" and row["unit"] == "N"
    assert row["ci95"][0] - row["stderr"] < CART_PRELOAD < row["ci95"][1] + row["stderr"]
    assert row["stderr"] < 0.1 and "least squares" in inside["assumed"]


def test_a_log_that_lacks_a_drives_force_is_refused(arms) -> None:
    """Without the third force the sum of work is unknown; the sentence names the column."""
    log = log_arms(arms, np.arange(0, 1, 0.01))
    (joint,) = arms.redundant_joints
    kept = {name: x for name, x in log.channels.items() if name != f"tau_{joint}"}
    with raises_code("missing_column", f"tau_{joint}", "3 drives on 2"):
        complete_positions(arms, [Log(log.t, kept, "arms.csv")])


def test_forces_are_projected_once(arms) -> None:
    """A projected log is marked and stays as it is; with other drives in the first place it is refused."""
    (once,) = complete_positions(arms, [log_arms(arms, np.arange(0, 1, 0.01))])
    assert [get_code(w) for w in once.warnings] == ["redundant_drives"]
    assert complete_positions(arms, [once]) == [once]
    other = load_robot_from_urdf(
        redundant.write_three_arms(), "arms.urdf", actuated=["shoulder3", "shoulder2", "shoulder1"]
    )
    with raises_code("unsupported", "as it was recorded"):
        complete_positions(other, [once])


def test_a_saved_model_keeps_its_drives(arms, tmp_path) -> None:
    """The file names all three drives, so that a log is projected in the same way after loading."""
    model = build_model(arms, "asymmetric")
    model.save(tmp_path / "arms.yaml")
    again = Model.load(tmp_path / "arms.yaml")
    assert again.robot.actuated == arms.actuated and again.robot.redundant_joints == arms.redundant_joints
    assert again.parameters.names == model.parameters.names
