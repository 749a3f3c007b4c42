"""Positioning errors of the tool: every method with the same errors, at many poses, and with enlarged errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.device import Device, LegsDevice, State
from tau_dyn.kinematics.accuracy.error_bounds import MAX_ERROR_SIZE, ErrorBounds
from tau_dyn.kinematics.accuracy.shells import (
    bound_displacement,
    compute_face_areas,
    compute_half_edges,
    explain_no_certificate,
    explain_no_ellipsoids,
    find_corners,
    measure_largest,
)
from tau_dyn.kinematics.accuracy.worst_case import bound_first_order, monte_carlo, solve_worst_case
from tau_dyn.mechanism import Kinematics, Poses, build_kinematics, get_rods
from tau_dyn.robot import Robot

METHODS = ("linear", "parallelepiped", "ellipsoid", "exact", "certified", "montecarlo")
BLOCK = 2000
"""Poses computed at once."""


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Positioning errors at many poses.

    Attributes:
        errors: Bounds of the errors.
        q: Actuated positions (N, na).
        position: Intended tool positions (N, 3) [m].
        largest: Largest displacement of the tool by method, each (N,) [m]; nan where a method has no result.
        turned: Largest change of orientation by method, each (N,) [rad]; empty for a plate that only translates.
        usual: 95 % quantile of the displacement by random errors (N,) [m]; empty without Monte Carlo.
        worst: Errors at the exact worst case (N, m), each source within its unit ball; empty without `exact`.
        direction: Direction of the worst displacement (N, 3).
        faces: Areas of the parallelepiped's faces orthogonal to each rod (N, 3) [m^2]; empty without a parallelepiped.
        labels: Description of each source.
        left_out: Methods that do not apply, with the reason.
        samples: Draws per pose.
    """

    errors: ErrorBounds
    q: np.ndarray
    position: np.ndarray
    largest: dict[str, np.ndarray]
    turned: dict[str, np.ndarray]
    usual: np.ndarray
    worst: np.ndarray
    direction: np.ndarray
    faces: np.ndarray
    labels: tuple[str, ...]
    left_out: dict[str, str]
    samples: int

    @property
    def best_method(self) -> str:
        """The method with the highest priority: `exact` if it was computed, else the nearest to it."""
        order = ("exact", "parallelepiped", "ellipsoid", "linear", "montecarlo", "certified")
        return next(m for m in order if m in self.largest)

    def off(self, method: str) -> np.ndarray:
        """Return the relative difference of a method from the exact worst case (N,): -0.1 is 10 % too small."""
        with np.errstate(all="ignore"):
            return self.largest[method] / self.largest["exact"] - 1


def build_device(robot: Robot | Kinematics, errors: ErrorBounds) -> Device:
    """Return the robot with its error sources, those of its legs included.

    Raises:
        InputError: All errors are zero, or an error does not fit the robot.
    """
    if not errors.largest:
        raise InputError(
            "invalid_value",
            "all errors are zero, so the tool is exact; give at least one, such as --actuator-error 50e-6",
        )
    legs = get_rods(robot)
    return Device(build_kinematics(robot), errors) if legs is None else LegsDevice(legs, errors)


def compute_positioning_errors(
    device: Device,
    errors: ErrorBounds,
    q: np.ndarray,
    tool: Poses,
    *,
    methods: Sequence[str] = METHODS,
    samples: int = 300,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Accuracy:
    """Return the tool's largest errors at many poses, by every requested method.

    Args:
        device: The robot with its errors, from `build_device`.
        errors: The same errors, to be stored with the result.
        q: Actuated positions (N, na) [m or rad].
        tool: Poses of the tool there (N).
        methods: Names out of `METHODS`.
        samples: Random draws per pose for `montecarlo`.
        seed: Seed of those draws.
        progress: Called with the current step.

    Raises:
        InputError: A method is unknown, or no method applies.
    """
    unknown = [m for m in methods if m not in METHODS]
    if unknown:
        raise InputError("unknown_name", f"no method named '{unknown[0]}'; there are {', '.join(METHODS)} and all")
    if not np.isfinite(q).all():
        raise InputError(
            "invalid_value", "actuated positions must be finite numbers; a pose that is not reached has no error"
        )
    left_out = {m: why for m in methods if (why := _why_not(device, m))}
    asked = [m for m in methods if m not in left_out]
    if not asked:
        raise InputError("unsupported", "; ".join(f"{m}: {why}" for m, why in left_out.items()))
    state = device.state(q, tool)
    parts: list[dict[str, np.ndarray]] = []
    for start in range(0, len(q), BLOCK):
        progress(f"poses {start + 1} to {min(start + BLOCK, len(q))} of {len(q)}")
        parts.append(_some(device, state.take(slice(start, start + BLOCK)), asked, samples, seed))
    whole = {key: np.concatenate([p[key] for p in parts]) for key in parts[0]}
    empty = np.empty((len(q), 0))
    return Accuracy(
        errors, q, tool.position,
        largest={m: whole[m] for m in METHODS if m in whole},
        turned={m: whole[f"{m} turn"] for m in METHODS if f"{m} turn" in whole},
        usual=whole.get("usual", empty[:, 0:0].reshape(-1)), worst=whole.get("worst", empty),
        direction=whole.get("direction", empty), faces=whole.get("faces", empty),
        labels=tuple(device.labels), left_out=left_out, samples=samples if "montecarlo" in asked else 0,
    )  # fmt: skip


def _why_not(device: Device, method: str) -> str:
    if method not in ("ellipsoid", "certified"):
        return ""
    if device.legs is None:
        return "it is for a plate held by rods"
    return explain_no_ellipsoids(device.legs) if method == "ellipsoid" else explain_no_certificate(device.legs)


def _some(device: Device, state: State, methods: Sequence[str], samples: int, seed: int) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    turns = device.sensitivity(state.take(slice(0, 1))).shape[1] == 6
    if "linear" in methods:
        out |= _by_actuators(device, state, turns)
    if "parallelepiped" in methods or "exact" in methods:
        out |= _by_corners(device, state, methods, turns)
    legs = device.legs
    if legs is not None and "ellipsoid" in methods:
        out["ellipsoid"] = measure_largest(find_corners(legs, state)[0])
    if legs is not None and "certified" in methods:
        out["certified"] = bound_displacement(legs, state)
    if "montecarlo" in methods:
        drawn = monte_carlo(device, state, samples, seed)
        out |= {"montecarlo": drawn.largest, "usual": drawn.usual}
        out |= {"montecarlo turn": drawn.turn_largest} if turns else {}
    if legs is not None and legs.freedoms == 3:
        out["faces"] = compute_face_areas(compute_half_edges(legs, state))
    return out


def _by_actuators(device: Device, state: State, turns: bool) -> dict[str, np.ndarray]:
    """Return the bound of data sheets: errors of the actuators along their motion only, through the Jacobian."""
    H = device.by_actuators(state) * device.along
    H = H[:, :, device.along > 0]
    balls = tuple(slice(k, k + 1) for k in range(H.shape[2]))
    zero = np.zeros(len(state))
    out = {"linear": bound_first_order(H[:, :3], balls, True)[0].size if balls else zero}
    return out | ({"linear turn": bound_first_order(H[:, 3:], balls, True)[0].size if balls else zero} if turns else {})


def _by_corners(device: Device, state: State, methods: Sequence[str], turns: bool) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    H = device.sensitivity(state)
    for name, part in (("", slice(0, 3)), (" turn", slice(3, 6))):
        if name and not turns:
            break
        first, corners = bound_first_order(H[:, part], device.balls, device.own)
        if "parallelepiped" in methods:
            out[f"parallelepiped{name}"] = first.size
        if "exact" in methods:
            worst = solve_worst_case(device, state, corners, part=part)
            out[f"exact{name}"] = worst.size
            out |= {} if name else {"worst": worst.e, "direction": worst.direction}
    return out


FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)


class Growth(NamedTuple):
    """Errors enlarged at one pose.

    Attributes:
        factors: Factors of the errors (k,).
        largest: Largest displacement by method, each (k,) [m]; nan without a result.
    """

    factors: np.ndarray
    largest: dict[str, np.ndarray]

    def holds_to(self, method: str, share: float) -> float:
        """Return the largest tested factor up to which a method is within a share of the exact result, or nan."""
        with np.errstate(all="ignore"):
            off = np.abs(self.largest[method] / self.largest["exact"] - 1)
        good = np.cumprod(off <= share).astype(bool)
        return float(self.factors[good][-1]) if good.any() else float("nan")


def scale_errors(
    robot: Robot | Kinematics, errors: ErrorBounds, q: np.ndarray, tool: Poses, methods: Sequence[str],
    factors: Sequence[float] = FACTORS,
) -> Growth:  # fmt: skip
    """Return the methods' largest displacements at one pose (q (na,), tool 1 sample) for enlarged errors."""
    kept = [f for f in factors if errors.largest * f <= MAX_ERROR_SIZE]
    rows: list[Accuracy] = []
    for factor in kept:
        more = errors.scaled(factor)
        rows.append(
            compute_positioning_errors(build_device(robot, more), more, q[None], tool, methods=methods, samples=1)
        )
    return Growth(np.array(kept), {m: np.array([r.largest[m][0] for r in rows]) for m in rows[0].largest})
