"""A planned motion, what it costs, and which limits hold it back.

A plan judged on a fine clock, by the model in Python instead of the solver's expressions, and what the next round must keep.

Limits hold at the nodes and half-way between; friction that turns in between can leave them for a moment. Where the fine clock
finds an excess, the limit nearby is tightened by as much. A few rounds settle it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import Actuated, Coordinates
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.nodes import Nodes, build_node_motion
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory

AT_LIMIT = 0.99
"""Share of a limit from which on it counts as reached."""


class Binding(NamedTuple):
    """A limit that the motion reaches: quantity, joint, and the share of the time it does."""

    quantity: str
    joint: str
    share: float


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """A motion between two states of rest.

    Attributes:
        model: What was planned for.
        t: Time (N,) [s], evenly spaced.
        q: Positions (N, na) [m or rad].
        v: Speeds (N, na).
        a: Accelerations (N, na).
        tau: Forces (N, na) [N or N m] that the model needs for it, with smoothed friction.
        tool: Tool positions (N, 3) [m], or None for a robot without a tool.
        duration: What the optimiser found [s]; the clock's end is up to a step later.
        energy: `sum_i int tau_i^2 dt` [N^2 s], the thesis' measure.
        work: `sum_i int |tau_i v_i| dt` [J], without recuperation.
        objective: Duration plus weight times energy [s].
        energy_weight: The weight [s per N^2 s].
        path: 'free', 'line' or 'points'.
        status: IPOPT's word for the solution.
        iterations: IPOPT's iterations, of all rounds.
        seconds: Wall time of the search [s].
        start_duration: Duration of the trapezoidal profile that it started from [s].
        binding: The limits that it reaches, most of the time first.
        excess: Largest share by which a force, speed or acceleration leaves its limit on the clock; 0 for none.
        limits: What it might use.
        width: Speed within which friction's sign was smoothed (na,).
        warnings: Sentences.
    """

    model: Model
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    tool: np.ndarray | None
    duration: float
    energy: float
    work: float
    objective: float
    energy_weight: float
    path: str
    status: str
    iterations: int
    seconds: float
    start_duration: float
    binding: tuple[Binding, ...]
    excess: float
    limits: MotionLimits
    width: np.ndarray
    warnings: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the actuated joints."""
        return self.model.robot.actuated

    @property
    def tool_speed(self) -> np.ndarray | None:
        """Speed of the tool (N,) [m/s], or None without one."""
        if self.tool is None:
            return None
        J = self.model.mechanism.tool_jacobian(self.q)
        return np.linalg.norm(np.einsum("nij,nj->ni", J, self.v), axis=1)

    def trajectory(self) -> Trajectory:
        """Return the motion as `simulate` and controllers take it."""
        return Trajectory(self.joints, self.t, self.q, self.v, self.a, "planned motion")

    def to_csv(self, path: str | Path) -> None:
        """Write t, q_ref, v_ref, a_ref, the file that `simulate --motion` reads."""
        self.trajectory().to_csv(path)

    def peaks(self) -> list[dict[str, Any]]:
        """Return each joint's largest speed, acceleration and force, and the limits of speed and force."""
        robot, limits = self.model.robot, self.limits
        return [
            {
                "joint": joint,
                "travel": float(np.ptp(self.q[:, k])),
                "speed": float(np.abs(self.v[:, k]).max()),
                "speed_limit": float(limits.speed[k]),
                "acceleration": float(np.abs(self.a[:, k]).max()),
                "force": float(np.abs(self.tau[:, k]).max()),
                "force_limit": float(limits.force[k]),
                "at_force_limit": float(np.mean(np.abs(self.tau[:, k]) >= AT_LIMIT * limits.force[k])),
                "unit": robot.position_units[k],
                "force_unit": robot.force_units[k],
            }
            for k, joint in enumerate(self.joints)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` keeps."""
        return {
            "robot": self.model.robot.name,
            "path": self.path,
            "duration_s": self.duration,
            "energy_N2s": self.energy,
            "work_J": self.work,
            "energy_weight": self.energy_weight,
            "objective_s": self.objective,
            "solver": {"name": "ipopt", "status": self.status, "iterations": self.iterations, "seconds": self.seconds},
            "start_profile": {"shape": "trapezoidal", "duration_s": self.start_duration},
            "samples": len(self.t),
            "rate_hz": (len(self.t) - 1) / float(self.t[-1]),
            "binding": [b._asdict() for b in self.binding],
            "excess": self.excess,
            "friction_width": self.width,
            "joints": self.peaks(),
            "from": {"q": self.q[0], "tool": None if self.tool is None else self.tool[0]},
            "to": {"q": self.q[-1], "tool": None if self.tool is None else self.tool[-1]},
        }


MAX_LIMIT_EXCESS = 1e-3
"""Share of a limit that the solver leaves unused, and by which a plan may leave the rest between the places it looks at."""

_FINE = 10  # looks an interval


def compute_limit_usage(feedforward: Feedforward, motion: Actuated, limits: MotionLimits, which: list) -> np.ndarray:
    """Return by how much of its limit each limited quantity is used (M, m) along a motion."""
    values = {"force": feedforward(*motion), "speed": motion.v, "acceleration": motion.a}
    columns = [np.abs(values[name][:, k]) / getattr(limits, name)[k] for name, k in which]
    return np.stack(columns, axis=1)


def tighten_limits(
    share: np.ndarray,
    nodes: Nodes,
    coordinates: Coordinates,
    feedforward: Feedforward,
    limits: MotionLimits,
    which: list,
) -> np.ndarray | None:
    """Return the shares of the limits (2 N + 1, m) for the next round, or None where this one keeps everything."""
    looks = np.linspace(0, 1, _FINE * (len(nodes.x) - 1) + 1)
    used = compute_limit_usage(feedforward, build_node_motion(coordinates, nodes, looks, nodes.T), limits, which)
    if used.max(initial=0.0) <= 1 + MAX_LIMIT_EXCESS:
        return None
    step = _FINE // 2
    out = share.copy()
    for look, k in np.argwhere(used > 1 + MAX_LIMIT_EXCESS / 2):
        near = [look // step, min(look // step + 1, len(share) - 1)]
        out[near, k] = np.minimum(out[near, k], share[near, k] / used[look, k])
    return out
