"""Robots with closed forms, and an independent solution of the motion along a path, for the tests beside this file."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf

START, END = np.array([1.3, -0.75, 0.65]), np.array([2.2, -0.45, 0.85])
"""Tool positions [m] in L1's workspace, 0.97 m apart."""


def block(mass: float = 95.0, effort: float = 400.0) -> Model:
    """Return a block on a level guideway: a double integrator."""
    return Model.of(
        load_robot_from_urdf(
            f"""<robot name="block" xmlns:tau_dyn="urn:tau_dyn"><link name="base_link"/><link name="carriage_link">
            <inertial><origin xyz="0 0 0"/><mass value="{mass}"/>
            <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
            <joint name="axis" type="prismatic"><parent link="base_link"/><child link="carriage_link"/><axis xyz="1 0 0"/>
            <limit lower="-0.5" upper="0.5" velocity="50" effort="{effort}"/></joint>
            <transmission name="drive"><joint name="axis"/></transmission></robot>""",
            "block",
        )
    )


def l1(coulomb: float = 0.0, viscous: float = 0.0) -> Model:
    """Return the simplified L1 with friction [N, N s/m]."""
    robot = load_robot("gantry_tau", prototype="l1")
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    values = {"coulomb": coulomb, "viscous": viscous}
    return model.with_values({f"{j}.{k}": x for j in robot.actuated for k, x in values.items()})


def bang_bang(model: Model, start: np.ndarray, end: np.ndarray, limit: float, steps: int = 150) -> float:
    """Return the shortest time [s] on the tool's straight line under a force limit, by integrating the phase plane.

    Bobrow, Dubowsky & Gibson 1985: with `s` the share of the line, `tau = m s'' + c s'^2 + g`, at every s and s' the limits
    leave an interval of s''. Full acceleration from the start and full deceleration into the end are integrated over s in
    `b = s'^2`, `db/ds = 2 s''`, and cut where they meet; coefficients come from the model by finite differences of the closed
    inverse kinematics. Holds where one switch is enough: where the full acceleration is always possible.
    """
    s = np.linspace(0, 1, steps + 1)
    m, c, g = _coefficients(model, start, end, s)
    forward, backward = np.zeros(steps + 1), np.zeros(steps + 1)
    for k in range(steps):
        forward[k + 1] = _stepped(forward[k], s[k], s[k + 1], (m, c, g), s, limit, 1)
        backward[steps - 1 - k] = _stepped(backward[steps - k], s[steps - k], s[steps - 1 - k], (m, c, g), s, limit, -1)
    b = np.minimum(forward, backward)
    return float(np.sum(2 * np.diff(s) / (np.sqrt(b[1:]) + np.sqrt(b[:-1]))))  # exact where b is linear in s


def _stepped(b: float, s0: float, s1: float, law: tuple, grid: np.ndarray, limit: float, sign: int) -> float:
    """Return b after a step of Heun's method along the largest acceleration (sign 1), or back along the largest deceleration."""

    def slope(at: float, value: float) -> float:
        m, c, g = (np.array([np.interp(at, grid, x[:, k]) for k in range(x.shape[1])]) for x in law)
        rest = c * value + g
        most = np.min((sign * limit * np.sign(m) - rest) / m * sign) * sign
        return 2 * float(most)

    first = slope(s0, b)
    second = slope(s1, max(b + (s1 - s0) * first, 0.0))
    return max(b + (s1 - s0) * (first + second) / 2, 0.0)


def _coefficients(model: Model, start: np.ndarray, end: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return m, c and g (N, na) of `tau = m s'' + c s'^2 + g` without friction."""
    h = 1e-4

    def at(x: np.ndarray) -> np.ndarray:
        return closed_inverse(model, start + x[:, None] * (end - start))

    q, ahead, behind = at(s), at(s + h), at(s - h)
    first, second = (ahead - behind) / (2 * h), (ahead - 2 * q + behind) / h**2
    zero, dynamics = np.zeros_like(q), model.mechanism.inverse_dynamics
    g = dynamics(q, zero, zero)
    return dynamics(q, zero, first) - g, dynamics(q, first, second) - g, g


def closed_inverse(model: Model, tool: np.ndarray) -> np.ndarray:
    """Return the carts (N, 3) of tool positions (N, 3) by root finding on (4.9): `|A_i + q_i e_i - T| = L_i`, on home's side."""
    mechanism, home = model.mechanism, model.robot.home
    out = np.empty_like(tool)
    centre = mechanism.tool_position(home[None])[0]
    for i in range(3):
        e, L = mechanism.direction[i], mechanism.length[i]
        side = np.sign((mechanism.origin[i] + home[i] * e - centre) @ e)
        for k, T in enumerate(tool):
            foot = float((T - mechanism.origin[i]) @ e)  # the cart nearest to the tool
            reach = lambda q: float(np.linalg.norm(mechanism.origin[i] + q * e - T)) - L  # noqa: B023, E731
            far = foot + side * 2 * L
            out[k, i] = brentq(reach, min(foot, far), max(foot, far), xtol=1e-14)
    return out
