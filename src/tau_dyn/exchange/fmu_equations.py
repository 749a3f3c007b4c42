r"""A model's forward dynamics as expressions: what one step of the simulator asks for, with the parameters left open.

    M(q, theta) a + h(q, v, theta) = tau - f,   lower(q, v, a, theta) <= f <= upper(..)

`M` and `h` are the mechanism's, its columns taken from inverse dynamics where it has no closed form; `lower` and `upper` are the
effects' forces at `sign` -1 and +1, as `simulate/forces.py` asks for them, and what effects add to `M` stands beside it. All are
traced from the code that simulation runs (`control/graph.py`); `fmu_check.py` compares them with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.control import (
    ClosedForm,
    ExpressionArray,
    Graph,
    LoopForm,
    Loops,
    Node,
    Tree,
    TreeForm,
    as_expression_array,
    build_inputs,
    draw_random_states,
)
from tau_dyn.effects import Motion, acts_on_recording
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import GantryTauMechanism, Mechanism
from tau_dyn.model import BY_STATE, COMPUTED, Model


class EquationFunction(NamedTuple):
    """One function to be written: its graph, the arrays it takes, and what it computes, by array."""

    graph: Graph
    takes: tuple[str, ...]
    gives: dict[str, tuple[Any, ...]]

    @property
    def outputs(self) -> tuple[Any, ...]:
        """All that it computes, in order."""
        return tuple(x for values in self.gives.values() for x in values)


@dataclass(frozen=True, eq=False)
class Equations:
    """The parts of one model.

    Attributes:
        model: The model, with the effects that are in the equations.
        dynamics: `M` (na * na,) and `h` (na,).
        friction: `lower`, `upper` (na,) and `added` (na * na,) to the mass matrix; None where there are no effects.
        tool: `x` (3,), the tool's position [m]; None where the robot file has no tool.
        loops: The loops that are solved numerically before each part, or None.
        closure: With loops, `gap` and `J`.
        parameters: Places in `model.parameters` of those that matter.
    """

    model: Model
    dynamics: EquationFunction
    friction: EquationFunction | None
    tool: EquationFunction | None
    loops: Loops | None
    closure: EquationFunction | None
    parameters: tuple[int, ...]


def build_equations(model: Model) -> Equations:
    """Return the equations of a model.

    Raises:
        InputError: Something of the model cannot be written as expressions of a state.
    """
    try:
        return _built(model)
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(
            "unsupported", f"{model.robot.source} with {names} cannot be written as an FMU: it uses {fault}"
        ) from fault


def _built(model: Model) -> Equations:
    robot = model.robot
    closed = isinstance(model.mechanism, GantryTauMechanism)
    loops = Loops(robot, Tree(robot)) if robot.loops and not closed else None
    dynamics = _dynamics(_Inputs(model, loops))
    friction = _friction(_Inputs(model, loops)) if any(not acts_on_recording(e) for e in model.effects) else None
    tool = _tool(_Inputs(model, loops)) if robot.tool_frame is not None else None
    closure = _closure(_Inputs(model, loops)) if loops is not None else None
    parts = [part for part in (dynamics, friction, tool) if part is not None]
    used = {
        int(node.args[0].removeprefix("theta"))
        for part in parts
        for node in part.graph.needed(part.outputs)
        if node.op == "input" and node.args[0].startswith("theta")
    }
    return Equations(model, dynamics, friction, tool, loops, closure, tuple(sorted(used)))


class _Inputs:
    """A graph with its inputs, and the model's mechanism on them."""

    def __init__(self, model: Model, loops: Loops | None) -> None:
        self.model, self.loops, self.graph = model, loops, Graph()
        q, v, a = (x[0] for x in draw_random_states(model, 1, np.random.default_rng(1)))
        self.q, self.v, self.a = (build_inputs(self.graph, n, x)[None] for n, x in zip("qva", (q, v, a), strict=True))
        self.rest = as_expression_array(np.zeros((1, model.robot.na)))
        self.theta = build_inputs(self.graph, "theta", model.parameters.values)
        self.passive = build_inputs(self.graph, "p", loops.closed(q)[loops.passive]) if loops is not None else None
        self.takes = ("q", "p") if loops is not None else ("q",)

    def value(self, name: str) -> Node:
        """Return a parameter."""
        return self.theta[self.model.parameters.names.index(name)]

    def form(self) -> Mechanism:
        """Return the mechanism on expressions, its parameters open."""
        robot = self.model.robot
        if isinstance(self.model.mechanism, GantryTauMechanism):
            return _open_closed_form(ClosedForm(robot), self)
        form = LoopForm(self.model, self.loops, self.graph, self.passive) if self.loops else TreeForm(self.model)
        form.tree = self.tree()
        return form

    def tree(self) -> Tree:
        """Return the tree with open parameters."""
        robot = self.model.robot
        tree = Tree(robot)
        open_ = {j: as_expression_array(np.zeros(10)) for j in range(1, robot.model.njoints)}
        for link in robot.links:
            own = as_expression_array([self.value(name) for name in link.names])
            open_[link.joint_id] = open_[link.joint_id] + link.map @ own
        tree.joints = tuple(replace(joint, pi=open_[k + 1]) for k, joint in enumerate(tree.joints))
        tree.armature = {j: self.value(f"{j}.armature") for j in robot.actuated}
        frames = robot.model.frames
        tree.weights = [
            (frames[robot.model.getFrameId(name.rsplit(".", 1)[0])], self.value(name))
            for name in robot.parameters.names
            if name.endswith(".gravity_mass")
        ]
        return tree


def _open_closed_form(form: ClosedForm, given: _Inputs) -> ClosedForm:
    """Put expressions in the place of the closed form's masses."""
    robot = given.model.robot
    armature = as_expression_array([given.value(f"{arm.cart_joint}.armature") for arm in robot.arms])
    form.m_cart = as_expression_array([given.value(f"{arm.cart_link}.mass") for arm in robot.arms]) + armature
    form.m_rod = as_expression_array([given.value(f"{arm.rod_link}.mass") for arm in robot.arms])
    form.m_plate = as_expression_array(given.value(f"{robot.plate}.mass"))
    weight = f"{robot.plate}.gravity_mass"
    form.m_gravity = as_expression_array(given.value(weight)) if weight in robot.parameters else 0.0
    form._armature = lambda: armature  # type: ignore[method-assign]
    return form


def _dynamics(given: _Inputs) -> EquationFunction:
    form, n = given.form(), given.model.robot.na
    if isinstance(form, ClosedForm):
        M, h = form.mass_and_bias(given.q[0], given.v[0])
    else:
        h = form.inverse_dynamics(given.q, given.v, given.rest)[0]
        assert isinstance(form, TreeForm)
        form.tree.gravity, form.tree.weights = np.zeros(3), []
        units = (as_expression_array(row[None]) for row in np.eye(n))
        M = np.array([form.inverse_dynamics(given.q, given.rest, unit)[0] for unit in units], dtype=object).T
    gives = {"M": tuple(np.asarray(M, dtype=object).ravel()), "h": tuple(h)}
    return EquationFunction(given.graph, (*given.takes, "v", "theta"), gives)


def _friction(given: _Inputs) -> EquationFunction:
    """Return the effects' forces at both signs, and what they add to the mass matrix; see `simulate/forces.py`."""
    form, n = given.form(), given.model.robot.na
    effects = [effect for effect in given.model.effects if not acts_on_recording(effect)]
    plain = [effect for effect in effects if "force" not in effect.needs]
    scaled = [effect for effect in effects if "force" in effect.needs]
    asked = _Asked(given, form)
    both = []
    for sign in (-1.0, 1.0):
        force = sum((asked(e, given.a if "load" in e.needs else given.rest, sign) for e in plain), start=given.rest[0])
        whole = form.inverse_dynamics(given.q, given.v, given.rest)[0] + force if scaled else None
        for effect in scaled:
            force = force + asked(effect, given.rest, sign, whole)
        both.append(force)
    added = as_expression_array(np.zeros((n, n)))
    for k, unit in enumerate(np.eye(n)):
        for effect in plain:
            if "load" not in effect.needs:
                added[:, k] = (
                    added[:, k] + asked(effect, as_expression_array(unit[None]), 1.0) - asked(effect, given.rest, 1.0)
                )
    if scaled:
        M = np.array(_dynamics(given).gives["M"], dtype=object).reshape(n, n).view(ExpressionArray)
        for k, unit in enumerate(np.eye(n)):
            whole = M[:, k] + added[:, k]
            for effect in scaled:
                added[:, k] = added[:, k] + asked(effect, as_expression_array(unit[None]), 1.0, whole)
    gives = {"lower": tuple(both[0]), "upper": tuple(both[1]), "added": tuple(added.ravel())}
    return EquationFunction(given.graph, (*given.takes, "v", "a", "theta"), gives)


class _Asked:
    """Asks an effect for its force."""

    def __init__(self, given: _Inputs, form: Mechanism) -> None:
        self.given, self.form = given, form
        names = given.model.parameters.names
        self.places = {name: k for k, name in enumerate(names)}

    def __call__(self, effect: Any, a: Any, sign: float, force: Any = None) -> Any:
        """Return the force (na,) at accelerations (1, na), and for effects that feel it at a force (na,)."""
        given = self.given
        signals = {n: COMPUTED[n](self.form, given.q, given.v, a) for n in effect.needs if n in COMPUTED}
        if force is not None:
            signals["force"] = as_expression_array(force)[None]
        signs = np.full((1, given.model.robot.na), sign)
        motion = Motion.of(given.model.robot.actuated, given.q, given.v, a, signs, signals=signals)
        columns = as_expression_array(effect.columns(motion))[0]
        values = as_expression_array([given.theta[self.places[name]] for name in effect.parameters.names])
        return as_expression_array(columns @ values)


def _tool(given: _Inputs) -> EquationFunction:
    form, robot = given.form(), given.model.robot
    if isinstance(form, ClosedForm):
        x = form.tool_position(given.q)[0]
    else:
        assert isinstance(form, TreeForm) and robot.tool_frame is not None
        order = [form.order.index(k) for k in range(len(form.order))] if given.loops is None else []
        q = [given.q[0][k] for k in order] if given.loops is None else given.loops.full(given.q[0], given.passive)
        still = [0.0] * len(form.tree.joints)
        frame = robot.model.frames[robot.tool_frame]
        places = form.tree.places(form.tree.motions(q, still, still, np.zeros(3)))
        R, p = places[frame.parentJoint - 1] if frame.parentJoint > 0 else (np.eye(3), np.zeros(3))
        x = p + R @ frame.placement.translation
    return EquationFunction(given.graph, given.takes, {"x": tuple(x)})


def _closure(given: _Inputs) -> EquationFunction:
    loops = given.loops
    assert loops is not None
    closure = loops.closure(loops.full(given.q[0], given.passive))
    J = closure.jacobian[np.ix_(loops.rows, loops.passive)]
    return EquationFunction(given.graph, ("q", "p"), {"gap": tuple(closure.gap), "J": tuple(J.ravel())})


def list_unsupported_effects(model: Model) -> Sequence[tuple[Any, str]]:
    """Return the effects that a state alone does not determine, each with what it feels."""
    found = []
    for effect in model.effects:
        missing = [name for name in effect.needs if name not in BY_STATE - {"damping"}]
        if missing and not acts_on_recording(effect):
            found.append((effect, missing[0]))
    return found
