"""A model's feedforward as an expression graph: the mechanism, its effects and the smoothed signs, traced as they stand.

The closed form of the simplified Gantry-Tau and all effects are the very code that identification and simulation run, fed with
expressions instead of numbers (`expression_arrays.py`). Trees come from `export_tree.py`, as Pinocchio's code cannot be
traced; loops from
`export_loops.py`. The finished graph is compared with the feedforward in Python before anything is written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.control.export_check import draw_random_states
from tau_dyn.control.export_forms import ClosedForm, LoopForm, TracedModel, TreeForm
from tau_dyn.control.export_loops import Loops
from tau_dyn.control.export_tree import Tree
from tau_dyn.control.expression_arrays import build_inputs
from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.graph import Graph, evaluate_graph
from tau_dyn.effects import describe_missing_state
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import GantryTauMechanism, Mechanism
from tau_dyn.model import BY_STATE

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


def build_program(feedforward: Feedforward) -> Program:
    """Return a feedforward as straight-line code, compared with Python over random states.

    Raises:
        InputError: An effect needs a history, or something of this model cannot be written out.
    """
    model = feedforward.model
    for effect in model.effects:
        why = describe_missing_state(effect, BY_STATE | set(ARGUMENTS))
        if why:
            raise InputError(
                "unsupported", f"effect {effect.name} cannot be exported: {why}; --steady leaves such effects out"
            )
    signals = tuple(n for n in ARGUMENTS if any(n in effect.needs for effect in model.effects))
    robot = model.robot
    closed = isinstance(model.mechanism, GantryTauMechanism)
    loops = Loops(robot, Tree(robot)) if robot.loops and not closed else None
    graph, rng = Graph(), np.random.default_rng(_SEED)
    q, v, a = (
        build_inputs(graph, name, x[0])[None] for name, x in zip("qva", draw_random_states(model, 1, rng), strict=True)
    )
    felt = {name: build_inputs(graph, name, np.full(robot.na, 25.0))[None] for name in signals}
    if closed:
        form: Mechanism = ClosedForm(robot)
    elif loops is None:
        form = TreeForm(model)
    else:
        start = loops.closed(np.array([x.value for x in q[0]]))[loops.passive]
        form = LoopForm(model, loops, graph, build_inputs(graph, "p", start))
    outputs = _forces(feedforward, form, (q, v, a), felt)
    program = Program(feedforward, graph, outputs, signals, loops)
    if loops is not None:
        program = _with_closure(program, loops, np.array([x.value for x in q[0]]))
    return replace(program, difference=_compared(program))


def _forces(feedforward: Feedforward, form: Mechanism, state: tuple, felt: dict[str, Any]) -> tuple[Any, ...]:
    model = feedforward.model
    fields = (model.robot, model.effects, model.effect_parameters, model.provenance)
    twin = Feedforward(TracedModel(*fields, stand_in=form), width=feedforward.width, shape=feedforward.shape)
    try:
        q, v, a = state
        return tuple(twin.forces(q, v, a, felt)[0])
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(
            "unsupported", f"{model.robot.source} with {names} cannot be exported: it uses {fault}"
        ) from fault


def _with_closure(program: Program, loops: Loops, q: np.ndarray) -> Program:
    graph = Graph()
    place = loops.full(build_inputs(graph, "q", q), build_inputs(graph, "p", loops.closed(q)[loops.passive]))
    closure = loops.closure(place)
    jacobian = tuple(tuple(row) for row in closure.jacobian[np.ix_(loops.rows, loops.passive)])
    return replace(program, closure=graph, gap=tuple(closure.gap), jacobian=jacobian)


def _compared(program: Program) -> float:
    """Return the largest difference between graph and Python over random states, relative to the largest force.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    feedforward, rng = program.feedforward, np.random.default_rng(_SEED + 1)
    q, v, a = draw_random_states(feedforward.model, _STATES, rng)
    felt = {name: rng.uniform(10, 60, q.shape) for name in program.signals}
    passive = None
    if program.loops is not None:
        passive = np.array([program.loops.closed(x) for x in q])[:, program.loops.passive]
    known = {"q": q, "v": v, "a": a, **felt, **({} if passive is None else {"p": passive})}
    found, fine = evaluate_graph(program.graph, program.outputs, known)
    expected = feedforward(q, v, a, signals=felt)
    difference = np.max(np.abs(found - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
    if not difference < AGREEMENT or not fine.all():
        raise InputError(
            "unsupported",
            f"{feedforward.model.robot.source}: the traced feedforward differs from Python's by {difference:.2g}, so it is not "
            "exported",
        )
    return float(difference)
