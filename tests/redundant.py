"""Robots with more drives than freedoms, and their forces by d'Alembert's principle: no equation of the package is used.

Three arms of two links meet in one point, in a vertical plane: three drives on two freedoms. A cart runs on two rails with a
motor each: two drives on one freedom. Rigid forces are the least-squares share of the generalised forces, and a drive pushes
with a constant preload against the others, which balance it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.log import Log

CRANK, COUPLER = 0.35, 0.45  # [m]
SHOULDERS = np.array([[-0.3, 0.0], [0.35, 0.05], [0.05, 0.75]])  # [m] x and z
BENDS = (1.0, -1.0, 1.0)
HOME = np.array([0.03, 0.33])  # [m] the common tip
CRANK_MASS, COUPLER_MASS, TIP_MASS = 2.0, 1.2, 3.0  # [kg]
CRANK_INERTIA, COUPLER_INERTIA = 0.03, 0.025  # [kg m^2] about the centres, which are in the middle
COULOMB, VISCOUS = np.array([1.5, 2.5, 3.5]), np.array([0.8, 1.1, 0.5])
CART_MASS, SHOE_MASS = 20.0, 5.0
_GRAVITY = 9.81
_STEP = 1e-3  # [s] of finite differences


class Motion(NamedTuple):
    """Drive positions and speeds (N, n), and forces without friction and preload (N, n), at times (N,)."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    inside: np.ndarray
    """Forces that move nothing (N, n), of any size."""


def compute_angles(tip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the absolute angles of cranks and couplers (..., 3) at tips (..., 2), by the law of cosines."""
    away = tip[..., None, :] - SHOULDERS
    d2 = np.sum(away**2, axis=-1)
    at_shoulder = np.arccos((CRANK**2 + d2 - COUPLER**2) / (2 * CRANK * np.sqrt(d2)))
    crank = np.arctan2(away[..., 1], away[..., 0]) - np.array(BENDS) * at_shoulder
    elbow = SHOULDERS + CRANK * np.stack([np.cos(crank), np.sin(crank)], axis=-1)
    rest = tip[..., None, :] - elbow
    return crank, np.arctan2(rest[..., 1], rest[..., 0])


def _bodies(tip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres (..., 7, 2) and angles (..., 7) of three cranks, three couplers and the tip."""
    crank, coupler = compute_angles(tip)

    def along(angle: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    elbow = SHOULDERS + CRANK * along(crank)
    centres = [SHOULDERS + CRANK / 2 * along(crank), elbow + COUPLER / 2 * along(coupler), tip[..., None, :]]
    return np.concatenate(centres, axis=-2), np.concatenate([crank, coupler, 0 * crank[..., :1]], axis=-1)


def move_three_arms(t: np.ndarray) -> Motion:
    """Return a motion of the three arms: `Q = sum of (m a - m g) dp/dx + I dw dangle/dx`, `A' tau = Q`, `A = dq/dx`."""

    def tip(at: np.ndarray) -> np.ndarray:
        x = 0.07 * np.sin(1.3 * at) + 0.05 * np.sin(3.1 * at + 1) + 0.02 * np.sin(7.3 * at)
        z = 0.06 * np.cos(1.7 * at) + 0.05 * np.sin(2.3 * at) + 0.02 * np.cos(6.1 * at)
        return HOME + np.stack([x, z], axis=-1)

    mass = np.repeat([CRANK_MASS, COUPLER_MASS, TIP_MASS], [3, 3, 1])
    inertia = np.repeat([CRANK_INERTIA, COUPLER_INERTIA, 0.0], [3, 3, 1])
    stencil = [_bodies(tip(t + k * _STEP)) for k in (-2, -1, 0, 1, 2)]
    second = np.array([-1, 16, -30, 16, -1]) / (12 * _STEP**2)
    a, dw = (sum(w * part[k] for w, part in zip(second, stencil, strict=True)) for k in (0, 1))
    force = mass[:, None] * (a + np.array([0.0, _GRAVITY]))
    Q, A, small = np.zeros((len(t), 2)), np.zeros((len(t), 3, 2)), 1e-6
    for k, unit in enumerate(small * np.eye(2)):
        (ahead, turned), (behind, back) = _bodies(tip(t) + unit), _bodies(tip(t) - unit)
        Q[:, k] = np.sum(force * (ahead - behind), axis=(1, 2)) / (2 * small)
        Q[:, k] += np.sum(inertia * dw * (turned - back), axis=1) / (2 * small)
        A[:, :, k] = (turned - back)[:, :3] / (2 * small)
    first = np.array([1, -8, 0, 8, -1]) / (12 * _STEP)
    v = sum(w * part[1][:, :3] for w, part in zip(first, stencil, strict=True))
    tau = (A @ np.linalg.solve(A.swapaxes(1, 2) @ A, Q[:, :, None]))[:, :, 0]
    inside = np.cross(A[:, :, 0], A[:, :, 1])
    return Motion(t, stencil[2][1][:, :3], v, tau, inside)


def move_cart(t: np.ndarray) -> Motion:
    """Return a motion of the cart: each motor has half of the force, and one pushes what the other holds."""
    w = np.array([[1.1], [2.7], [5.3]])
    size = np.array([[0.25], [0.1], [0.02]])
    q, v, a = (np.sum(size * x, axis=0) for x in (np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)))
    half = (CART_MASS + SHOE_MASS) * a / 2
    both = np.ones((1, 2))
    return Motion(
        t,
        q[:, None] * both,
        v[:, None] * both,
        half[:, None] * both,
        np.array([[-1.0, 1.0]]) * np.ones_like(t)[:, None],
    )


def write_log(
    motion: Motion, joints: tuple[str, ...], friction: np.ndarray, preloads: dict[str, float], noise: float, name: str
) -> Log:
    """Return a log with friction (N, n), preloads of drives by name, and white noise of the forces."""
    rng = np.random.default_rng(len(motion.t))
    tau = motion.tau + friction + noise * rng.standard_normal(motion.tau.shape)
    for joint, preload in preloads.items():
        tau += preload * motion.inside / motion.inside[:, [joints.index(joint)]]
    channels = {f"q_{joint}": motion.q[:, k] for k, joint in enumerate(joints)}
    return Log(motion.t, channels | {f"tau_{joint}": tau[:, k] for k, joint in enumerate(joints)}, name)


_SPACES = 'xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"'


def _link(name: str, mass: float, centre: float, inertia: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre} 0 0"/><mass value="{mass}"/><inertia ixx="{inertia}" '
        f'iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, axis: str, xyz: str, home: float, driven: bool) -> str:
    text = (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-4" upper="4" velocity="9" effort="200"/></joint>'
        f'<tau_dyn:home joint="{name}" value="{home:.12g}"/>'
    )
    drive = (
        f'<transmission name="{name}_t"><type>SimpleTransmission</type><joint name="{name}"/><actuator name="{name}_m"/>'
        "</transmission>"
    )
    return text + (drive if driven else "")


def _ball(a: str, b: str, at_a: str, at_b: str) -> str:
    return (
        f'<drake:ball_constraint><drake:ball_constraint_body_A name="{a}"/><drake:ball_constraint_body_B name="{b}"/>'
        f'<drake:ball_constraint_p_AP value="{at_a}"/><drake:ball_constraint_p_BQ value="{at_b}"/></drake:ball_constraint>'
    )


ARMS = ("shoulder1", "shoulder2", "shoulder3")
RAILS = ("rail1", "rail2")


def write_three_arms(scale: float = 1.0) -> str:
    """Return the URDF of the three arms, all masses times a scale; the tip is part of the first coupler."""
    crank, coupler = compute_angles(HOME)
    parts = []
    for k, (x, z) in enumerate(SHOULDERS):
        mass, inertia, centre = COUPLER_MASS, COUPLER_INERTIA, COUPLER / 2
        if k == 0:
            mass = COUPLER_MASS + TIP_MASS
            centre = (COUPLER_MASS * COUPLER / 2 + TIP_MASS * COUPLER) / mass
            inertia += COUPLER_MASS * (centre - COUPLER / 2) ** 2 + TIP_MASS * (COUPLER - centre) ** 2
        name = str(k + 1)
        parts += [
            _link(f"crank{name}", scale * CRANK_MASS, CRANK / 2, scale * CRANK_INERTIA),
            _link(f"coupler{name}", scale * mass, centre, scale * inertia),
            _joint(f"shoulder{name}", "revolute", "base", f"crank{name}", "0 -1 0", f"{x} 0 {z}", crank[k], True),
            _joint(
                f"elbow{name}", "revolute", f"crank{name}", f"coupler{name}", "0 -1 0", f"{CRANK} 0 0",
                coupler[k] - crank[k], False,
            ),
        ]  # fmt: skip
        if k:
            parts.append(_ball("coupler1", f"coupler{name}", f"{COUPLER} 0 0", f"{COUPLER} 0 0"))
    return f'<robot name="three_arms" {_SPACES}><link name="base"/>{"".join(parts)}</robot>'


def write_dead_centre() -> str:
    """Return the URDF of a slider with a motor, whose crank and coupler are in line at home, and of a lift beside it."""
    parts = [
        _link("crank", 1.0, 0.1, 0.01), _link("coupler", 1.0, 0.2, 0.02), _link("slider", 2.0, 0.0, 0.02),
        _joint("crank_turn", "revolute", "base", "crank", "0 0 1", "0 0 0", 0.0, False),
        _joint("coupler_turn", "revolute", "crank", "coupler", "0 0 1", "0.2 0 0", 0.0, False),
        _joint("slide", "prismatic", "base", "slider", "1 0 0", "0.6 0 0", 0.0, True),
        _link("platform", 2.0, 0.0, 0.02), _joint("lift", "prismatic", "base", "platform", "0 0 1", "1 0 0", 0.0, True),
        _ball("coupler", "slider", "0.4 0 0", "0 0 0"),
    ]  # fmt: skip
    return f'<robot name="slider_crank" {_SPACES}><link name="base"/>{"".join(parts)}</robot>'


def write_cart() -> str:
    """Return the URDF of the cart: a shoe on the second rail is tied to it by a ball."""
    parts = [
        _link("cart", CART_MASS, 0.0, 0.1), _link("shoe", SHOE_MASS, 0.0, 0.1),
        _joint("rail1", "prismatic", "base", "cart", "1 0 0", "0 0 0", 0.0, True),
        _joint("rail2", "prismatic", "base", "shoe", "1 0 0", "0 0.5 0", 0.0, True),
        _ball("cart", "shoe", "0 0.5 0", "0 0 0"),
    ]  # fmt: skip
    return f'<robot name="two_motor_cart" {_SPACES}><link name="base"/>{"".join(parts)}</robot>'
