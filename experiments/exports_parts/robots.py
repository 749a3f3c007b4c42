"""Eight robots of the zoo and two stock arms, with the effects that hide in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot

ROBOTS: dict[str, Callable[[], Robot]] = {
    "axis": lambda: load_robot("linear_axis"),
    "l1": lambda: load_robot("gantry_tau", gravity_mass=22.38),
    "d1": lambda: load_robot("gantry_tau", arms="complete", prototype="d1"),
    "f1": lambda: load_robot("gantry_tau_f1"),
    "delta": lambda: load_robot("delta"),
    "triglide": lambda: load_robot("triglide"),
    "h4": lambda: load_robot("h4"),
    "stewart": lambda: load_robot("stewart"),
    "ur5": lambda: load_robot("ur5"),
    "panda": lambda: load_robot("panda"),
}

CAUSES = ("stribeck", "position_friction", "quadratic_drag", "cyclic_ripple", "load_friction", "drive_gain", "delay")
SETTINGS = {
    "cyclic_ripple": {"period": 0.05},
    "position_friction": {"half": 1.0, "degree": 3},
    "stribeck": {"speed": 0.05},
    "delay": {"about": 2e-3},
}
SIZES = {"coulomb_pos": 0.4, "coulomb_neg": 0.3, "viscous_pos": 1.0, "viscous_neg": 0.7, "quadratic_drag": 0.1}
"""Of a parameter, in units of the force that stops a joint within a second, at its speed where it multiplies one."""
FIXED = {"gain_error": 0.05, "load_friction": 0.02, "delay": 2e-3}
_OTHER = 0.1  # of all others, in the same units


def find_speed(robot: Robot) -> float:
    """Return a speed [m/s or rad/s] at which half a second stays within the workspace."""
    return 0.02 if robot.source == "stewart" else 0.2


def build_model(name: str, causes: tuple[str, ...] = CAUSES) -> Model:
    """Return a robot with friction that differs by direction and with these effects."""
    robot = ROBOTS[name]()
    effects = [*build_friction_model("asymmetric", robot.actuated, robot.force_units)]
    effects += [EFFECTS[c](robot.actuated, robot.force_units, **SETTINGS.get(c, {})) for c in causes]
    model = Model.of(robot, effects)
    mass = np.diag(model.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[0])
    stops = dict(zip(robot.actuated, find_speed(robot) * mass, strict=True))
    speed = find_speed(robot)
    values = {}
    for parameter in model.effect_parameters.names:
        joint, quantity = parameter.rsplit(".", 1)
        power = {"viscous_pos": 1, "viscous_neg": 1, "quadratic_drag": 2}.get(quantity, 0)
        size = SIZES.get(quantity, _OTHER) / speed**power
        values[parameter] = FIXED.get(quantity, size * stops.get(joint, 1.0))
    return model.with_values(values)
