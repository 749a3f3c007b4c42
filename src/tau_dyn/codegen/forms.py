"""Mechanisms on expressions: each replaces the mechanism of a model, so that feedforward and effects run on it unchanged.

Closed forms and the array code of trees are traced unchanged; `loops.py` solves the loops of a tree on expressions. Parameters
are numbers, or inputs named `theta`. Random states around home are where traced code is compared with Python.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from tau_dyn.codegen.loops import Loops, require_joints
from tau_dyn.equations import ExpressionArray, Graph, Node, as_expression_array, build_inputs
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    GantryTauMechanism,
    LoadedTree,
    LoopSolver,
    Mechanism,
    Rods,
    forward_kinematics,
    get_robot,
)
from tau_dyn.model import Model
from tau_dyn.robot import Robot

_SEED = 1  # any; of the reference state


class ClosedForm(GantryTauMechanism):
    """The simplified Gantry-Tau on expressions."""

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample from mass matrix and bias."""
        M, h = self.mass_and_bias(q[0], v[0])
        return as_expression_array((M @ a[0] + h)[None])

    def _under(self, gravity: np.ndarray) -> ClosedForm:
        other = copy(self)
        other.gravity = gravity
        return other

    def open_parameters(self, value: Any) -> None:
        """Put expressions in the place of the masses; `value` gives a parameter by its name."""
        robot = self.robot
        armature = as_expression_array([value(f"{arm.cart_joint}.armature") for arm in robot.arms])
        self.m_cart = as_expression_array([value(f"{arm.cart_link}.mass") for arm in robot.arms]) + armature
        self.m_rod = as_expression_array([value(f"{arm.rod_link}.mass") for arm in robot.arms])
        self.m_plate = as_expression_array(value(f"{robot.plate}.mass"))
        weight = f"{robot.plate}.gravity_mass"
        self.m_gravity = as_expression_array(value(weight)) if weight in robot.parameters else 0.0
        self._armature = lambda: armature  # type: ignore[method-assign]


def _refuse(what: str) -> Any:
    """Return a method that raises `TypeError` with this message."""

    def refuse(self: Mechanism, *_: Any) -> NoReturn:
        raise TypeError(what)

    return refuse


def _ask_tree(name: str) -> Any:
    """Return a method that asks the array code of the tree."""
    return lambda self, *arrays: getattr(self.tree, name)(*arrays)


class TreeForm(Mechanism):
    """A tree, with loops or without, on expressions: the array code of `mechanism` with expressions for its numbers."""

    def __init__(self, robot: Robot, value: Callable[[str], Any], loops: Loops | None) -> None:
        """Take a robot, its parameters by name, and its loops on expressions.

        Raises:
            InputError: A joint neither turns about nor slides along one axis, a joint of a robot with loops follows another, or
                a drive has a scale.
        """
        super().__init__(robot)
        joints = require_joints(robot)
        self.tree = LoadedTree(robot, LoopSolver(robot) if loops is None else loops.solver, joints, value, loops)
        self.tree.pi = {joint: as_expression_array(pi) for joint, pi in self.tree.pi.items()}
        self.tree.drive = as_expression_array(self.tree.drive)

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def _with(self, **changes: Any) -> TreeForm:
        """Return the same form with other attributes of its tree."""
        other = copy(self)
        other.tree = copy(self.tree)
        vars(other.tree).update(changes)
        return other

    def _under(self, gravity: np.ndarray) -> TreeForm:
        return self._with(gravity=gravity)

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` (na, na) and `h` (na,) of one sample."""
        rest = as_expression_array(np.zeros((1, self.robot.na)))
        return self.tree.inertia(q[None])[0], self.inverse_dynamics(q[None], v[None], rest)[0]

    def reducer_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force that each drive's reducer transmits (1, na), loops included; see `Mechanism.reducer_torque`."""
        return self._with(drive=as_expression_array(np.zeros(self.robot.na))).inverse_dynamics(q, v, a)

    inverse_dynamics, guide_force = _ask_tree("inverse_dynamics"), _ask_tree("guide_force")
    tool_position, tool_jacobian = _ask_tree("tool_position"), _ask_tree("tool_jacobian")
    passive_rates = _ask_tree("passive_rates")
    regressor = _refuse("the regressor of a tree")
    cart_sensitivity = _refuse("the tool's sensitivity on a tree")
    condition = _refuse("the conditioning of a tree")


@dataclass(frozen=True, eq=False)
class TracedModel(Model):
    """A model whose mechanism is another one's tracing."""

    stand_in: Mechanism | None = None

    @property
    def mechanism(self) -> Mechanism:  # type: ignore[override]
        """Return the mechanism on expressions."""
        assert self.stand_in is not None
        return self.stand_in


def find_loops(model: Model) -> Loops | None:
    """Return the loops that have to be solved numerically; None for a tree and for a closed form."""
    return Loops(model.robot) if model.robot.loops and model.mechanism.equations == "tree" else None


class TracingInputs:
    """A graph with the inputs of a model's equations, and the mechanism on them.

    Attributes:
        graph: The graph.
        q: Positions (1, na); also `v` and `a`.
        theta: The model's parameters if they are inputs, else None.
        passive: With loops, the passive joints (np,).
        form: The mechanism.
    """

    def __init__(self, model: Model, loops: Loops | None, *, open_parameters: bool = False) -> None:
        """Make inputs, with their values at a reference state.

        Args:
            model: The model.
            loops: From `find_loops`.
            open_parameters: Whether the parameters are inputs as well, named `theta`.
        """
        self.model, self.loops, self.graph = model, loops, Graph()
        state = [x[0] for x in draw_random_states(model, 1, np.random.default_rng(_SEED))]
        self.q, self.v, self.a = (build_inputs(self.graph, n, x)[None] for n, x in zip("qva", state, strict=True))
        self.theta = build_inputs(self.graph, "theta", model.parameters.values) if open_parameters else None
        self.passive: ExpressionArray | None = None
        if loops is not None:
            self.passive = build_inputs(self.graph, "p", loops.closed(state[0])[loops.passive])
        self.form = self._form()

    def value(self, name: str) -> Node | float:
        """Return a parameter of the model."""
        if self.theta is None:
            return self.model.parameters[name].value
        return self.theta[self.model.parameters.names.index(name)]

    def _form(self) -> Mechanism:
        robot = self.model.robot
        if self.model.mechanism.equations != "tree":
            form = ClosedForm(robot)
            if self.theta is not None:
                form.open_parameters(self.value)
            return form
        loops = None if self.loops is None else self.loops.on_expressions(self.graph, self.passive)
        return TreeForm(robot, self.value, loops)


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
            "unreachable", f"{robot.source}: no position around home can be reached, so there is no export"
        )
    return q
