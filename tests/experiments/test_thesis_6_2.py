"""The claims of `experiments/thesis_6_2.py` on shorter or fewer simulations."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import Motion
from tau_dyn.identify import identify
from tau_dyn.model import Model

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from thesis_6_2_parts import friction, gravity, masses, models
from thesis_6_2_parts.hidden import PassiveJointFriction
from thesis_6_2_parts.motions import SIDEWAYS_FAST, WELL, fast_and_slow, strokes
from thesis_6_2_parts.plant import closed_form, follow_perfectly, model_2, record, robot_l1
from thesis_6_2_parts.printed import CARTS, GRAVITY_MASS, TABLE_6_1, TABLE_6_2, G

STAR, CIRCLE = (-1.182, 0.299), (-1.281, 0.378)  # m


@pytest.fixture(scope="module")
def weight() -> gravity.GravityStudy:
    return gravity.study(closed_form(robot_l1(gravity=True)), np.array([11.5, GRAVITY_MASS, 30.0]))


def test_two_rows_of_table_6_2_have_no_mass_in_common_with_the_others(weight: gravity.GravityStudy) -> None:
    """At 22.38 kg star, square and circle are met exactly, diamond and plus are 15 N off; at 30 kg it is plus that is met."""
    assert np.all(weight.misfit[:3] < 1e-6) and np.all(weight.misfit[3:] > 14.0)
    at_30 = weight.profile.set_index("mass_kg").loc[30.0]
    assert at_30["+_N"] < gravity.EXACT < 10 < at_30["*_N"]


def test_11_5_kg_cannot_give_table_6_2(weight: gravity.GravityStudy) -> None:
    """No position in the frame gives cart 3 even the smallest printed force, and the misfit is six times larger."""
    assert G * 11.5 * weight.largest_lever < TABLE_6_2[:, 2].min()
    assert weight.rms_at(11.5) > 6 * weight.rms_at(GRAVITY_MASS)


def test_the_star_is_not_in_the_middle_of_the_frame(weight: gravity.GravityStudy) -> None:
    """In the middle gravity pushes cart 2 forwards; the star's printed force pushes it back."""
    assert weight.centre[1] > 20 and TABLE_6_2[0, 1] < -14


def test_as_symmetric_as_possible_is_not_one_mass() -> None:
    """Least squares, least sum and least maximum of the asymmetries disagree; the sum leaves 6 kg open."""
    offset = (TABLE_6_1["coulomb_pos"] - TABLE_6_1["coulomb_neg"]) / 2
    best = gravity.most_symmetric(offset, TABLE_6_2[0])
    assert_allclose(best["squares"], 22.72, atol=0.02)
    assert_allclose(best["largest"], 17.96, atol=0.02)
    low, high = best["sum"]
    assert low < 20 < 25.5 < high


def test_one_position_hides_the_gravity_mass_and_two_show_it() -> None:
    """With Coulomb friction free in both directions the star alone leaves gravity open by more than its value."""
    robot = robot_l1(gravity=True)
    places = {"*": STAR, "circle": CIRCLE}
    logs = [friction.experiment(name, place, speeds=(0.15, 0.4, 0.8)) for name, place in places.items()]
    given = identify(robot, logs[0], choices=friction.GIVEN, exclude=("ramp",)).parameters
    for name, printed in TABLE_6_1.items():
        assert_allclose([given[f"{j}.{name}"].value for j in CARTS], printed, rtol=0.02)
    alone = identify(robot, logs[0], choices=friction.FREE, exclude=("ramp",)).parameters["plate_link.gravity_mass"]
    assert alone.stderr is None or alone.stderr > GRAVITY_MASS
    both = identify(robot, logs, choices=friction.FREE, exclude=("ramp",)).parameters["plate_link.gravity_mass"]
    assert both.stderr is not None and both.stderr < 0.2
    assert_allclose(both.value, robot.parameters["plate_link.gravity_mass"].value, atol=4 * both.stderr)


def test_models_rank_as_in_table_6_3(monkeypatch: pytest.MonkeyPatch) -> None:
    """Symmetric friction fits best; old asymmetric friction worst at carts 1 and 2, no viscous friction worst at cart 3."""
    monkeypatch.setattr(models, "drive_ideal", follow_perfectly)
    study = models.table_6_3()
    for column in ("e_N2", "e_floor_N2"):
        assert [study.order(j, column) for j in CARTS] == [(2, 4, 1, 3), (2, 4, 1, 3), (2, 4, 3, 1)]
    plate = study.table["plate_kg"][study.table["model"] == 2].iloc[0]
    assert_allclose(plate, 9.13 + 4.8 / 2, atol=0.1)  # rods left out: half their mass goes to the plate
    assert_allclose(study.known_rods, 9.13, atol=0.05)


def test_one_plate_mass_answers_with_gravity_and_two_columns_tell_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where gravity feels 22.38 kg and inertia 9.13 kg, motion alone does not give 9 kg until the column is split."""
    monkeypatch.setattr(masses, "drive_ideal", follow_perfectly)
    found = masses.two_masses()
    assert found.one_column[0] > 22.0
    assert_allclose(found.inertia[0], 9.13, atol=4 * found.inertia[1])
    assert_allclose(found.gravity[0], GRAVITY_MASS, atol=0.02)


def test_friction_in_the_ball_joints_makes_a_rod_negative() -> None:
    """4 N m in each ball joint take rod 2 below zero by plain least squares; the library's stays at its bound."""
    robot = robot_l1()
    motion = fast_and_slow(closed_form(robot), SIDEWAYS_FAST, "along x")
    run = follow_perfectly(
        model_2(robot, passive_moment=3.0), motion
    )  # the shift, about -4 kg per N m, is 3 sd of noise at 1
    plain, found = masses.free_rods(robot, record(run))
    assert plain["rod2_link.mass"] < 0 <= found.parameters["rod2_link.mass"].value
    assert {row["name"]: row for row in found.rows()}["rod2_link.mass"]["at_bound"]


def test_ball_joint_friction_takes_the_power_of_turning_rods() -> None:
    """Force times cart speed is moment times turning speed, summed over all ball joints (virtual work)."""
    robot = robot_l1()
    mechanism = closed_form(robot)
    motion = fast_and_slow(mechanism, WELL, "all axes", 6.0)
    model = Model.of(robot, [PassiveJointFriction(mechanism)]).with_values({"rods.passive_moment": 1.0})
    power = np.sum(model.effect_force(Motion.of(CARTS, motion.q, motion.v, motion.a)) * motion.v, axis=1)
    tool = np.gradient(mechanism.tool_position(motion.q), motion.t, axis=0)
    across = np.linalg.norm(tool[:, None] - motion.v[:, :, None] * mechanism.direction, axis=2)
    fast = np.all(across > 0.1, axis=1)  # the direction turns over 1 mm/s
    assert_allclose(power[fast], (across / mechanism.length @ [2, 4, 6])[fast], rtol=2e-3)


def test_strokes_are_steady_where_they_say_so() -> None:
    """All carts share one constant speed and none leaves its travel, even at the farthest fitted position."""
    robot = robot_l1(gravity=True)
    motion, steady = strokes(closed_form(robot), (0.0, 0.475), "diamond")
    assert np.all(np.abs(motion.q - robot.home) < 1.0)
    assert_allclose(motion.a[steady], 0.0, atol=1e-12)
    assert len(np.unique(np.abs(motion.v[steady]).round(9))) == 15
