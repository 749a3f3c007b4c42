"""A model's feedforward as an expression graph: the mechanism, its effects and the smoothed signs, traced as they stand.

The closed form of the simplified Gantry-Tau and all effects are the very code that identification and simulation run, fed with
expressions instead of numbers (`traced.py`). Trees come from `export_tree.py`, as Pinocchio's code cannot be traced; loops from
`export_loops.py`. The finished graph is compared with the feedforward in Python before anything is written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.control.export_loops import Loops
from tau_dyn.control.export_tree import Tree
from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.graph import Graph, Node
from tau_dyn.control.traced import inputs, traced
from tau_dyn.dynamics import GantryTauMechanism, Mechanism
from tau_dyn.effects.state import beyond_a_state
from tau_dyn.exceptions import InputError
from tau_dyn.model import BY_STATE, Model

ARGUMENTS = ("temperature",)
"""Signals that become an argument of the written function where an effect feels them."""

_SEED, _STATES = 1, 60
AGREEMENT = 1e-10
"""Largest difference from Python, relative to the largest force."""


@dataclass(frozen=True, eq=False)
class Program:
    """A feedforward as straight-line code.

    Attributes:
        feedforward: Where it came from.
        graph: Its expressions.
        outputs: The forces (na,): nodes or numbers.
        signals: Further arguments, each (na,), in order.
        loops: The loops that are solved numerically before, or None.
        closure: With loops: a graph of its own.
        gap: With loops: all equations of `closure`.
        jacobian: With loops: derivative of the chosen equations by the solved joints.
        difference: Largest difference from Python over random states, relative to the largest force.
    """

    feedforward: Feedforward
    graph: Graph
    outputs: tuple[Any, ...]
    signals: tuple[str, ...]
    loops: Loops | None = None
    closure: Graph | None = None
    gap: tuple[Any, ...] = ()
    jacobian: tuple[tuple[Any, ...], ...] = ()
    difference: float = 0.0


class _Kinematics(NamedTuple):
    rods: np.ndarray
    inverse: np.ndarray
    J: np.ndarray
    tool_acceleration: np.ndarray


class _ClosedForm(GantryTauMechanism):
    """The simplified Gantry-Tau on expressions."""

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def _kinematics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Any:
        """Return the same as the arrays' code, whose buffers of floats hold no expressions: `D T'' = b a - |T' - e v|^2`."""
        D = traced(self._rods(q, self._trilaterate(q)))
        along, inverse = np.einsum("nij,ij->ni", D, self.direction), np.linalg.inv(D)
        J = inverse * along[:, None, :]
        relative = (J @ v[0])[:, None, :] - v[:, :, None] * self.direction
        gained = along * a - np.sum(relative**2, axis=2)
        return _Kinematics(D, inverse, J, np.einsum("nij,nj->ni", inverse, gained))

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample from mass matrix and bias."""
        M, h = self.mass_and_bias(q[0], v[0])
        return traced((M @ a[0] + h)[None])


class _TreeForm(Mechanism):
    """A tree without loops on expressions."""

    def __init__(self, model: Model) -> None:
        super().__init__(model.robot)
        self.tree = Tree(model.robot)
        self.order = [self.tree.index(name) for name in model.robot.actuated]

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def _forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        many = [[x[0][self.order.index(k)] for k in range(len(self.order))] for x in (q, v, a)]
        tau, beyond = self.tree.forces(*many)
        return [tau[k] for k in self.order], [beyond[k] for k in self.order]

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample, drive inertia included."""
        drive = [self.tree.armature[name] for name in self.robot.actuated]
        return traced([[x + m * y for x, m, y in zip(self._forces(q, v, a)[0], drive, a[0], strict=True)]])

    def guide_load(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return what each guide or reducer carries (1, na); see `Mechanism.guide_load`."""
        tau, beyond = self._forces(q, v, a)
        load = []
        for k, place in enumerate(self.order):
            u = self.tree.joints[place].axis
            across = beyond[k] - u * (u @ beyond[k])
            load.append(across @ across if self.tree.joints[place].slides else tau[k])
        rooted = [np.sqrt(traced([x]))[0] if self.tree.joints[p].slides else abs(x)
                  for x, p in zip(load, self.order, strict=True)]  # fmt: skip
        return traced([rooted])

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return no bearings: there are no loops."""
        return (), traced(np.zeros((1, 0, 3, self.robot.na)))

    def regressor(self, q, v, a):
        raise TypeError("the regressor of a tree")

    def mass_and_bias(self, q, v):
        raise TypeError("the mass matrix of a tree")

    def tool_position(self, q):
        raise TypeError("the tool's position on a tree")

    def tool_jacobian(self, q):
        raise TypeError("the tool's Jacobian on a tree")

    def cart_sensitivity(self, q):
        raise TypeError("the tool's sensitivity on a tree")

    def condition(self, q):
        raise TypeError("the conditioning of a tree")

    def guide_force(self, q, v, a):
        raise TypeError("the guides' forces on a tree with loops")


class _LoopForm(_TreeForm):
    """A tree with loops on expressions, its passive joints given."""

    def __init__(self, model: Model, loops: Loops, graph: Graph, passive: Any) -> None:
        super().__init__(model)
        self.loops, self.graph, self.passive = loops, graph, passive

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample: the passive joints' motion, the tree's forces, virtual work."""
        loops, graph = self.loops, self.graph
        place = loops.full(q[0], self.passive)
        J = loops.closure(place).jacobian[loops.rows]
        J_a, factor = J[:, loops.active], graph.factored(J[:, loops.passive])
        speeds = loops.rates(v[0], graph.solved(factor, -(J_a @ v[0])))
        drift = loops.closure(place, speeds).drift[loops.rows]
        change = loops.rates(a[0], graph.solved(factor, -(J_a @ a[0] + drift)))
        tau, _ = self.tree.forces(place, speeds, change)
        held = np.array(graph.solved(factor, [tau[k] for k in loops.passive], transposed=True), dtype=object)
        driven = [self.tree.armature[n] * x for n, x in zip(self.robot.actuated, a[0], strict=True)]
        felt = np.array([tau[k] for k in loops.active], dtype=object) - J_a.T @ held + np.array(driven, dtype=object)
        return traced(felt[None])

    def guide_load(self, q, v, a):
        raise TypeError("what its guides carry, on a robot whose loops are solved numerically")

    def passive_rates(self, q):
        raise TypeError("passive joints' friction, on a robot whose loops are solved numerically")


@dataclass(frozen=True, eq=False)
class _TracedModel(Model):
    """A model whose mechanism is another one's tracing."""

    stand_in: Mechanism | None = None

    @property
    def mechanism(self) -> Mechanism:  # type: ignore[override]
        """Return the stand-in."""
        assert self.stand_in is not None
        return self.stand_in


def build_program(feedforward: Feedforward) -> Program:
    """Return a feedforward as straight-line code, compared with Python over random states.

    Raises:
        InputError: An effect needs a history, or something of this model cannot be written out.
    """
    model = feedforward.model
    for effect in model.effects:
        why = beyond_a_state(effect, BY_STATE | set(ARGUMENTS))
        if why:
            raise InputError(f"effect {effect.name} cannot be exported: {why}; --steady leaves such effects out")
    signals = tuple(n for n in ARGUMENTS if any(n in effect.needs for effect in model.effects))
    robot = model.robot
    closed = isinstance(model.mechanism, GantryTauMechanism)
    loops = Loops(robot, Tree(robot)) if robot.loops and not closed else None
    graph, rng = Graph(), np.random.default_rng(_SEED)
    q, v, a = (inputs(graph, name, x[0])[None] for name, x in zip("qva", random_states(model, 1, rng), strict=True))
    felt = {name: inputs(graph, name, np.full(robot.na, 25.0))[None] for name in signals}
    if closed:
        form: Mechanism = _ClosedForm(robot)
    elif loops is None:
        form = _TreeForm(model)
    else:
        start = loops.closed(np.array([x.value for x in q[0]]))[loops.passive]
        form = _LoopForm(model, loops, graph, inputs(graph, "p", start))
    outputs = _forces(feedforward, form, (q, v, a), felt)
    program = Program(feedforward, graph, outputs, signals, loops)
    if loops is not None:
        program = _with_closure(program, loops, np.array([x.value for x in q[0]]))
    return replace(program, difference=_compared(program))


def _forces(feedforward: Feedforward, form: Mechanism, state: tuple, felt: dict[str, Any]) -> tuple[Any, ...]:
    model = feedforward.model
    fields = (model.robot, model.effects, model.effect_parameters, model.provenance)
    twin = Feedforward(_TracedModel(*fields, stand_in=form), width=feedforward.width, shape=feedforward.shape)
    try:
        q, v, a = state
        return tuple(twin.forces(q, v, a, felt)[0])
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(f"{model.robot.source} with {names} cannot be exported: it uses {fault}") from fault


def _with_closure(program: Program, loops: Loops, q: np.ndarray) -> Program:
    graph = Graph()
    place = loops.full(inputs(graph, "q", q), inputs(graph, "p", loops.closed(q)[loops.passive]))
    closure = loops.closure(place)
    jacobian = tuple(tuple(row) for row in closure.jacobian[np.ix_(loops.rows, loops.passive)])
    return replace(program, closure=graph, gap=tuple(closure.gap), jacobian=jacobian)


def random_states(model: Model, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random states (n, na) around home that the robot can reach, slow and fast ones."""
    robot, found = model.robot, []
    room = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    room = np.where(np.isfinite(room), 0.8 * room, 1.0)
    for _ in range(50 * n):
        q = robot.home + rng.uniform(-1, 1, robot.na) * room
        if len(found) < n and model.mechanism.reachable(q):
            found.append(q)
    if not found:
        raise InputError(f"{robot.source}: no position around home can be reached, so nothing can be exported")
    shape = (len(found), robot.na)
    v = rng.choice([-1, 1], shape) * 10 ** rng.uniform(-3, 0.3, shape)
    return np.array(found), v, 3 * rng.standard_normal(shape)


def _compared(program: Program) -> float:
    """Return the largest difference between graph and Python over random states, relative to the largest force.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    feedforward, rng = program.feedforward, np.random.default_rng(_SEED + 1)
    q, v, a = random_states(feedforward.model, _STATES, rng)
    felt = {name: rng.uniform(10, 60, q.shape) for name in program.signals}
    passive = None
    if program.loops is not None:
        passive = np.array([program.loops.closed(x) for x in q])[:, program.loops.passive]
    found, fine = evaluate(program, q, v, a, felt, passive)
    expected = feedforward(q, v, a, signals=felt)
    difference = np.max(np.abs(found - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
    if not difference < AGREEMENT or not fine.all():
        raise InputError(
            f"{feedforward.model.robot.source}: the traced feedforward differs from Python's by {difference:.2g}, so it is not "
            "exported"
        )
    return float(difference)


def evaluate(
    program: Program,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    felt: dict[str, np.ndarray],
    passive: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, na) and whether every guard holds (N,), by walking through the graph."""
    known = {"q": q, "v": v, "a": a, **felt, **({} if passive is None else {"p": passive})}
    values: dict[int, Any] = {}
    for node in program.graph.needed(program.outputs):
        values[node.index] = _value(node, values, known)
    shown = [values[x.index] if isinstance(x, Node) else x for x in program.outputs]
    fine = np.ones(len(q), bool)
    for index, answer in program.graph.guards.items():
        fine &= values[index] == answer
    return np.column_stack([np.broadcast_to(x, len(q)) for x in shown]), fine


def _value(node: Node, values: dict[int, Any], known: dict[str, np.ndarray]) -> Any:
    if node.op == "const":
        return node.args[0]
    if node.op == "input":
        name = node.args[0].rstrip("0123456789")
        return known[name][:, int(node.args[0][len(name) :])]
    if node.op == "item":
        return values[node.args[0]][:, node.args[1]]
    args = [values[k] for k in node.args]
    n = len(known["q"])
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
