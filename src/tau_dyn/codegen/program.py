"""A feedforward as an expression graph: the mechanism, its effects and the smoothed signs, traced without change.

Effects and closed forms are the very code that identification and simulation run, fed with expressions instead of numbers
(`tracing.py`, `forms.py`). The finished graph is compared with the feedforward in Python before anything is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np

from tau_dyn.codegen.forms import TracedModel, TracingInputs, draw_random_states, find_loops
from tau_dyn.codegen.loops import Loops
from tau_dyn.effects import describe_missing_state
from tau_dyn.equations import Graph, TracedFunction, build_inputs, evaluate_graph
from tau_dyn.exceptions import InputError
from tau_dyn.model import BY_STATE, Model
from tau_dyn.version import __version__

ARGUMENTS = ("temperature",)
"""Signals that become an argument of the written function where an effect feels them."""

_SEED, _STATES = 2, 60

AGREEMENT = 1e-10
"""Largest difference from Python, relative to the largest force."""


class TraceableForces(Protocol):
    """Forces of a model at states, as `control.Feedforward` gives them."""

    model: Model
    width: np.ndarray
    shape: str

    def __call__(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, *, signals: Mapping[str, Any] | None = None) -> Any:
        """Return forces (N, na) at checked states."""
        ...

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, felt: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return forces (N, na) at states as they are."""
        ...

    def with_model(self, model: Model) -> Self:
        """Return the same law of another model."""
        ...


@dataclass(frozen=True, eq=False)
class Program:
    """A feedforward as straight-line code.

    Attributes:
        feedforward: The feedforward that was traced.
        graph: Its expressions.
        outputs: The forces (na,): nodes or numbers.
        signals: Further arguments, each (na,), in order.
        loops: The loops that are solved numerically before, or None.
        closure: With loops: all their equations, `gap`, and `J`; see `Loops.trace_closure`.
        difference: Largest difference from Python over random states, relative to the largest force.
    """

    feedforward: TraceableForces
    graph: Graph
    outputs: tuple[Any, ...]
    signals: tuple[str, ...]
    loops: Loops | None = None
    closure: TracedFunction | None = None
    difference: float = 0.0


def build_program(feedforward: TraceableForces) -> Program:
    """Return a feedforward as straight-line code, compared with Python over random states.

    Args:
        feedforward: A `control.Feedforward`.

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
    loops = find_loops(model)
    at = TracingInputs(model, loops)
    felt = {name: build_inputs(at.graph, name, np.full(model.robot.na, 25.0))[None] for name in signals}
    closure = None if loops is None else loops.trace_closure(np.array([x.value for x in at.q[0]]))
    program = Program(feedforward, at.graph, _trace_forces(feedforward, at, felt), signals, loops, closure)
    return replace(program, difference=_compare_with_python(program))


def _trace_forces(feedforward: TraceableForces, at: TracingInputs, felt: dict[str, Any]) -> tuple[Any, ...]:
    model = feedforward.model
    fields = (model.robot, model.effects, model.effect_parameters, model.provenance)
    try:
        return tuple(feedforward.with_model(TracedModel(*fields, stand_in=at.form)).forces(at.q, at.v, at.a, felt)[0])
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(
            "unsupported", f"{model.robot.source} with {names} cannot be exported: it uses {fault}"
        ) from fault


def _compare_with_python(program: Program) -> float:
    """Return the largest difference between graph and Python over random states, relative to the largest force.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    feedforward, rng = program.feedforward, np.random.default_rng(_SEED)
    q, v, a = draw_random_states(feedforward.model, _STATES, rng)
    felt = {name: rng.uniform(10, 60, q.shape) for name in program.signals}
    known = {"q": q, "v": v, "a": a, **felt}
    if program.loops is not None:
        known["p"] = np.array([program.loops.closed(x) for x in q])[:, program.loops.passive]
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


def yield_description(program: Program) -> Iterator[str]:
    """Yield the description of an exported feedforward for any language: provenance, joints, units, effects, parameters."""
    feedforward = program.feedforward
    model, robot = feedforward.model, feedforward.model.robot
    yield f"Feedforward forces of {robot.name}, written by tau-dyn {__version__}."
    yield f"Robot: {robot.source}" + (f", sha256 {robot.sha256}" if robot.sha256 else "")
    for key, value in model.provenance.items():
        yield f"{key}: {value}"
    yield ""
    yield "Joints, in the order of all arrays; positions, speeds, accelerations and forces in"
    rows = zip(
        robot.actuated, robot.position_units, robot.force_units, feedforward.width, robot.effort_limit, strict=True
    )
    for k, (joint, place, force, width, limit) in enumerate(rows):
        most = f", at most {limit:g} {force}" if np.isfinite(limit) else ""
        yield f"  [{k}] {joint}: {place}, {place}/s, {place}/s^2, {force}{most}; sign smoothed within {width:g} {place}/s"
    yield f"Shape of the smoothed sign: {feedforward.shape}."
    for name in program.signals:
        yield f"Further argument {name}, one a joint" + (
            " [degC], past the lag of its effect" if name == "temperature" else ""
        )
    yield ""
    yield "Effects:" if model.effects else "No effects: the rigid robot alone."
    for effect in model.effects:
        settings = "".join(f", {k} = {x:g}" for k, x in effect.settings.items())
        yield f"  {effect.name} ({', '.join(effect.joints)}{settings}): {effect.equation}"
    yield "Parameters (their values are folded into the code):"
    for p in model.parameters:
        error = f" +- {p.stderr:.2g}" if p.stderr is not None else ""
        yield f"  {p.name} = {p.value:.9g}{error} {p.unit}"
    yield ""
    yield f"Checked when it was written: within {max(program.difference, 1e-16):.1g} of Python's, relative to the largest force."
