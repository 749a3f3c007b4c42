"""The simulated L1 and its recordings: robot, friction, what hides in it, sensors and seed."""

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects import AsymmetricFriction, SymmetricFriction
from tau_dyn.log import Log
from tau_dyn.mechanism import GantryTauMechanism, build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.simulate import PlantRun, Sensors, Trajectory, measure, simulate_drive
from thesis_6_2_parts.hidden import PassiveJointFriction, Stribeck
from thesis_6_2_parts.motions import RATE
from thesis_6_2_parts.printed import CARTS, GRAVITY_MASS, TABLE_6_1, TABLE_6_3

SEED = 62
SENSORS = Sensors(encoder_noise=2e-6, force_noise=5.0, log_rate_hz=250.0)  # m, N
FLOOR = Sensors(encoder_noise=2e-6, force_noise=50.0, force_ar=(0.98,), log_rate_hz=250.0)  # 50 N rms that lasts 0.2 s
STRIBECK_SHARE = 0.15  # of the Coulomb friction


def robot_l1(gravity: bool = False) -> Robot:
    """Return the L1 with the thesis' point masses; with `gravity`, gravity feels `GRAVITY_MASS` and inertia does not."""
    extra = {"gravity_mass": GRAVITY_MASS} if gravity else {}
    return load_robot("gantry_tau", prototype="l1", rod_mass_model="point", **extra)


def closed_form(robot: Robot) -> GantryTauMechanism:
    """Return the robot's dynamics, which the thesis' equations (6.3) to (6.7) are."""
    mechanism = build_mechanism(robot)
    assert isinstance(mechanism, GantryTauMechanism)
    return mechanism


def table_6_1_model(robot: Robot) -> Model:
    """Return the robot with the asymmetric friction of Table 6.1."""
    model = Model.of(robot, [AsymmetricFriction(robot.actuated, robot.force_units)])
    return model.with_values({f"{j}.{name}": row[k] for name, row in TABLE_6_1.items() for k, j in enumerate(CARTS)})


def model_2(robot: Robot, *, stribeck: float = 0.0, passive_moment: float = 0.0) -> Model:
    """Return the robot with the symmetric friction of Table 6.3, model 2, and what hides in it.

    Args:
        robot: The robot.
        stribeck: Rise of friction at standstill, as a share of each cart's Coulomb friction.
        passive_moment: Friction moment of each ball joint [N m].
    """
    _, _, coulomb, viscous, _ = TABLE_6_3[2]
    effects = [SymmetricFriction(robot.actuated, robot.force_units)]
    values: dict[str, float] = {}
    for j, fc, fv in zip(CARTS, coulomb, viscous, strict=True):
        values |= {f"{j}.coulomb": fc, f"{j}.viscous": fv}
    if stribeck:
        effects.append(Stribeck(robot.actuated, robot.force_units))
        values |= {f"{j}.stribeck": stribeck * fc for j, fc in zip(CARTS, coulomb, strict=True)}
    if passive_moment:
        effects.append(PassiveJointFriction(closed_form(robot)))
        values["rods.passive_moment"] = passive_moment
    return Model.of(robot, effects).with_values(values)


def drive_ideal(model: Model, motion: Trajectory) -> PlantRun:
    """Return what really happens; `record` measures it, with as many seeds as wanted."""
    return simulate_drive(model, motion, None, SENSORS, np.random.default_rng(SEED), rate_hz=RATE, feedback="ideal")


def follow_perfectly(model: Model, motion: Trajectory) -> PlantRun:
    """Return the motion with the forces it takes, without control errors and sticking: fast, for tests."""
    force = model.torque(motion.q, motion.v, motion.a)
    return PlantRun(model, motion.t, motion.q, motion.v, motion.a, force, motion.v == 0, motion)


def record(run: PlantRun, seed: int = SEED, sensors: Sensors = SENSORS) -> Log:
    """Return the log of a run."""
    return measure(run, sensors, np.random.default_rng(seed), run.reference.name if run.reference else "run")


def fixes(values: Mapping[str, float]) -> tuple[str, ...]:
    """Return values as `--fix` spells them."""
    return tuple(f"{name}={value}" for name, value in values.items())
