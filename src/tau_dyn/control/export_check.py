"""An exported graph against Python: it is walked through on arrays of random states, and a difference refuses the export."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tau_dyn.control.graph import Graph, Node
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Rods, forward_kinematics, get_robot
from tau_dyn.model import Model
from tau_dyn.robot import Robot


def draw_random_states(model: Model, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random states (n, na) around home that the robot can reach, slow and fast ones."""
    robot, found = model.robot, []
    for _ in range(50 * n):
        q = robot.home + rng.uniform(-1, 1, robot.na) * _room(robot, 0.8, 1.0)
        if len(found) < n and model.mechanism.reachable(q):
            found.append(q)
    q = _some(robot, np.array(found))
    v = rng.choice([-1, 1], q.shape) * 10 ** rng.uniform(-3, 0.3, q.shape)
    return q, v, 3 * rng.standard_normal(q.shape)


def draw_reachable_positions(robot: Robot | Rods, n: int, rng: np.random.Generator, share: float = 0.4) -> np.ndarray:
    """Return random positions (n, na) around home that have a tool pose; `share` of the way to the limits, or of 1 rad or m."""
    owner = get_robot(robot)
    q = owner.home + rng.uniform(-1, 1, (4 * n, owner.na)) * _room(owner, share, min(1.0, 1.25 * share))
    return _some(owner, q[forward_kinematics(robot, q).ok][:n])


def _room(robot: Robot, share: float, most: float) -> np.ndarray:
    """Return how far from home to look (na,) [m or rad]."""
    room = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    return np.where(np.isfinite(room), share * room, most)


def _some(robot: Robot, q: np.ndarray) -> np.ndarray:
    if not len(q):
        raise InputError(
            "unreachable", f"{robot.source}: no position around home can be reached, so nothing can be exported"
        )
    return q


def evaluate_graph(graph: Graph, outputs: Sequence[Any], known: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs (N, k) and whether every guard holds (N,), by walking through a graph.

    Args:
        graph: The graph.
        outputs: Its outputs: nodes or numbers.
        known: The input arrays (N, ...) by name.
    """
    n = len(next(iter(known.values())))
    values: dict[int, Any] = {}
    for node in graph.needed(outputs):
        values[node.index] = _value(node, values, known, n)
    shown = [values[x.index] if isinstance(x, Node) else x for x in outputs]
    fine = np.ones(n, bool)
    for index, answer in graph.guards.items():
        fine &= values[index] == answer
    return np.column_stack([np.broadcast_to(x, n) for x in shown]), fine


def _value(node: Node, values: dict[int, Any], known: dict[str, np.ndarray], n: int) -> Any:
    if node.op == "const":
        return node.args[0]
    if node.op == "input":
        name = node.args[0].rstrip("0123456789")
        return known[name][:, int(node.args[0][len(name) :])]
    if node.op == "item":
        return values[node.args[0]][:, node.args[1]]
    args = [values[k] for k in node.args]
    if node.op == "factor":
        size = round(len(args) ** 0.5)
        return np.stack([np.broadcast_to(x, n) for x in args], axis=1).reshape(n, size, size)
    if node.op in ("solve", "solve_t"):
        A = args[0] if node.op == "solve" else np.swapaxes(args[0], 1, 2)
        return np.linalg.solve(A, np.stack([np.broadcast_to(x, n) for x in args[1:]], axis=1)[:, :, None])[:, :, 0]
    with np.errstate(all="ignore"):
        return NUMPY[node.op](*args)


NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "abs": np.abs,
    "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh,
    "atan2": np.arctan2, "hypot": np.hypot, "sign": np.sign, "min": np.minimum, "max": np.maximum, "select": np.where,
    "lt": np.less, "le": np.less_equal, "eq": np.equal, "and": np.logical_and, "or": np.logical_or,
    "not": np.logical_not,
}  # fmt: skip
"""What each operation is, on arrays."""
