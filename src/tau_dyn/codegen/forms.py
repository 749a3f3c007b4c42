"""Mechanisms on expressions: each replaces the mechanism of a model, so that feedforward and effects run on it unchanged.

A mechanism with a closed form is traced unchanged. Trees and loops come from `tree.py` and `loops.py`, as Pinocchio's code
cannot be traced. Parameters are numbers, or inputs named `theta`. Random states around home are where traced code is compared
with Python.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from tau_dyn.codegen.loops import Loops, Tree, trace_frames
from tau_dyn.equations import ExpressionArray, Graph, Node, as_expression_array, build_inputs
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    GantryTauMechanism,
    Mechanism,
    Rods,
    TreePose,
    compute_perpendicular_axes,
    compute_turning_rates,
    find_passive_pairs,
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

    def gravity_turn(self, q: np.ndarray) -> np.ndarray:
        """Return how the forces at rest change per turn of gravity (1, na, 2); see `Mechanism.gravity_turn`."""
        turned = [copy(self) for _ in range(2)]
        for form, axis in zip(turned, compute_perpendicular_axes(self.gravity), strict=True):
            form.gravity = np.cross(axis, self.gravity)
        return _rest_forces(turned, q)

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


def _rest_forces(forms: list[Any], q: np.ndarray) -> Any:
    """Return the forces at rest (1, na, n) of several forms."""
    rest = as_expression_array(np.zeros(np.shape(q)))
    return as_expression_array(np.stack([np.asarray(form.inverse_dynamics(q, rest, rest)) for form in forms], axis=2))


def _refuse(what: str) -> Any:
    """Return a method that raises `TypeError` with this message."""

    def refuse(self: Mechanism, *_: Any) -> NoReturn:
        raise TypeError(what)

    return refuse


class TreeForm(Mechanism):
    """A tree without loops on expressions."""

    def __init__(self, model: Model, tree: Tree) -> None:
        """Take the tree, its parameters numbers or expressions."""
        super().__init__(model.robot)
        self.tree = tree
        self.order = model.robot.active_v.tolist()
        tree_model = model.robot.model
        self._followers = {j: tree_model.joints[tree_model.getJointId(j)].idx_v for j in model.robot.mimics}

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def place(self, q: Any) -> list[Any]:
        """Return the position of each joint of the tree from those of the drives (na,)."""
        offset = self.robot.coupling[1]
        return [x + float(c) if c else x for x, c in zip(self._spread(q), offset, strict=True)]

    def _spread(self, v: Any) -> list[Any]:
        """Return the speed or acceleration of each joint from the drives' (na,): followers in proportion, others zero."""
        out = []
        for row in self.robot.coupling[0]:
            driving = np.flatnonzero(row)
            k = int(driving[0]) if driving.size else -1
            out.append(0.0 if k < 0 else v[k] if row[k] == 1.0 else v[k] * float(row[k]))
        return out

    def _forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        """Return the drives' forces (na,) without their inertia, and the force (3,) from beyond each drive's link in its axes."""
        tau, beyond = self.tree.forces(self.place(q[0]), self._spread(v[0]), self._spread(a[0]))
        felt = [tau[k] for k in self.order]
        for joint, mimic in self.robot.mimics.items():
            if mimic.joint in self.robot.actuated:
                own = self.robot.actuated.index(mimic.joint)
                felt[own] = felt[own] + tau[self._followers[joint]] * mimic.multiplier
        return felt, [beyond[k] for k in self.order]

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample, drive inertia included."""
        drive = [self.tree.armature[name] for name in self.robot.actuated]
        return as_expression_array([[x + m * y for x, m, y in zip(self._forces(q, v, a)[0], drive, a[0], strict=True)]])

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` (na, na), its columns the forces of unit accelerations without weight, and `h` (na,)."""
        n, light = self.robot.na, copy(self)
        light.tree = self.tree.under(np.zeros(3))
        rest = as_expression_array(np.zeros((1, n)))
        columns = [light.inverse_dynamics(q[None], rest, as_expression_array(unit[None]))[0] for unit in np.eye(n)]
        return as_expression_array(np.array(columns, dtype=object).T), self.inverse_dynamics(q[None], v[None], rest)[0]

    def gravity_turn(self, q: np.ndarray) -> np.ndarray:
        """Return how the forces at rest change per turn of gravity (1, na, 2); see `Mechanism.gravity_turn`."""
        gravity, turned = self.tree.gravity, [copy(self) for _ in range(2)]
        for form, axis in zip(turned, compute_perpendicular_axes(gravity), strict=True):
            form.tree = self.tree.under(np.cross(axis, gravity))
        return _rest_forces(turned, q)

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (1, 3) [m]."""
        engine = TreePose(self.robot)
        return as_expression_array(engine.place_of(trace_frames(engine.joints, self.place(q[0]))).T)

    def guide_load(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the load of each guide or reducer (1, na), loops included; see `Mechanism.guide_load`."""
        felt, beyond = self._forces(q, v, a)
        load = []
        for k, place in enumerate(self.order):
            joint = self.tree.joints[place]
            across = beyond[k] - joint.axis * (joint.axis @ beyond[k])
            load.append(np.sqrt(as_expression_array([across @ across]))[0] if joint.slides else abs(felt[k]))
        return as_expression_array([load])

    def reducer_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force that each drive's reducer transmits (1, na), loops included; see `Mechanism.reducer_torque`."""
        return as_expression_array([self._forces(q, v, a)[0]])

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return no bearings: there are no loops."""
        return (), as_expression_array(np.zeros((1, 0, 3, self.robot.na)))

    regressor = _refuse("the regressor of a tree")
    tool_jacobian = _refuse("the tool's Jacobian on a tree")
    cart_sensitivity = _refuse("the tool's sensitivity on a tree")
    condition = _refuse("the conditioning of a tree")
    guide_force = _refuse("the force that presses on each guide of a tree")


class LoopForm(TreeForm):
    """A tree with loops on expressions, its passive joints given."""

    def __init__(self, model: Model, tree: Tree, loops: Loops, graph: Graph, passive: Any) -> None:
        """Take the passive joints' positions as expressions."""
        super().__init__(model, tree)
        self.loops, self.graph, self.passive = loops, graph, passive

    def place(self, q: Any) -> list[Any]:
        """Return one position a joint, of the drives' (na,) and the passive joints' own."""
        return self.loops.full(q, self.passive)

    def _forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        """Return the same as `TreeForm._forces`, from the passive joints' motion, the open tree's forces and virtual work."""
        loops, graph, at = self.loops, self.graph, self.loops.frames(q[0], self.passive)
        J = loops.closure(at)[1][loops.rows]
        J_a, factor = J[:, loops.active], graph.factored(J[:, loops.passive])
        speeds = loops.rates(v[0], graph.solved(factor, -(J_a @ v[0])))
        drift = loops.drift(at, speeds)[loops.rows]
        change = loops.rates(a[0], graph.solved(factor, -(J_a @ a[0] + drift)))
        tau, beyond = self.tree.forces(self.place(q[0]), speeds, change)
        held = np.array(graph.solved(factor, [tau[k] for k in loops.passive], transposed=True), dtype=object)
        felt = np.array([tau[k] for k in loops.active], dtype=object) - J_a.T @ held
        pulls = [loops.carried_force(held, self.tree.joints[k].index) for k in self.order]
        turned = [at.rotation[self.tree.joints[k].index][:, :, 0].T @ x for k, x in zip(self.order, pulls, strict=True)]
        return list(felt), [np.asarray(beyond[k] + x, dtype=object) for k, x in zip(self.order, turned, strict=True)]

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn per actuated speed (1, n, 3, na); see `Mechanism.passive_rates`."""
        loops, graph, n = self.loops, self.graph, self.robot.na
        at = loops.frames(q[0], self.passive)
        J = loops.closure(at)[1][loops.rows]
        J_a, factor = J[:, loops.active], graph.factored(J[:, loops.passive])
        G = np.array(
            [loops.rates(list(unit), graph.solved(factor, list(-(J_a @ unit)))) for unit in np.eye(n)], dtype=object
        ).T
        pairs = find_passive_pairs(self.robot, self.robot.model)
        rates = compute_turning_rates(pairs, self.tree.joints, at, as_expression_array(G)[:, :, None])
        return tuple(pair.name for pair in pairs), as_expression_array(np.moveaxis(rates, -1, 0))


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
        tree = Tree(robot, self.value)
        if self.loops is None:
            return TreeForm(self.model, tree)
        return LoopForm(self.model, tree, self.loops, self.graph, self.passive)


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
