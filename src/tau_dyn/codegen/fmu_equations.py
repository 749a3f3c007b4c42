r"""A model's forward dynamics as expressions: what one step of the simulator asks for, with the parameters left open.

    M(q, theta) a + h(q, v, theta) = tau - f,   lower(q, v, a, theta) <= f <= upper(..)

`M` and `h` are the mechanism's; `lower` and `upper` are the effects' forces at `sign` -1 and +1, as `simulate/forces.py` asks for
them, and what effects add to `M` stands beside it. All are traced from the code that simulation runs, and compared with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.codegen.forms import TracingInputs, draw_random_states, find_loops
from tau_dyn.codegen.graph import evaluate_graph
from tau_dyn.codegen.loops import Loops
from tau_dyn.codegen.tracing import TracedFunction, as_expression_array, flatten_outputs
from tau_dyn.effects import Motion, acts_on_recording
from tau_dyn.exceptions import InputError
from tau_dyn.model import BY_STATE, COMPUTED, Model
from tau_dyn.simulate import SampledForces

_STATES, _SEED = 15, 2
AGREEMENT = 1e-9
"""How far expressions and simulator may differ at random states, relative to the largest value."""


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
        difference: Largest difference from the simulator's at random states, relative to the largest value.
    """

    model: Model
    dynamics: TracedFunction
    friction: TracedFunction | None
    tool: TracedFunction | None
    loops: Loops | None
    closure: TracedFunction | None
    parameters: tuple[int, ...]
    difference: float = 0.0


def build_equations(model: Model) -> Equations:
    """Return the equations of a model, compared with the simulator's at random states.

    Raises:
        InputError: Something of the model cannot be written as expressions of a state.
    """
    try:
        equations = _trace_equations(model)
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(
            "unsupported", f"{model.robot.source} with {names} cannot be written as an FMU: it uses {fault}"
        ) from fault
    return replace(equations, difference=_compare_with_simulator(equations))


def list_unsupported_effects(model: Model) -> Sequence[tuple[Any, str]]:
    """Return the effects that a state alone does not determine, each with what it feels."""
    found = []
    for effect in model.effects:
        missing = [name for name in effect.needs if name not in BY_STATE - {"damping"}]
        if missing and not acts_on_recording(effect):
            found.append((effect, missing[0]))
    return found


def _trace_equations(model: Model) -> Equations:
    loops = find_loops(model)

    def inputs() -> TracingInputs:
        return TracingInputs(model, loops, open_parameters=True)

    given = inputs()
    M, h = given.form.mass_and_bias(given.q[0], given.v[0])
    dynamics = _collect(given, "v theta", {"M": M, "h": h})
    friction = trace_effect_bounds(inputs()) if any(not acts_on_recording(e) for e in model.effects) else None
    tool = None
    if model.robot.tool_frame is not None:
        given = inputs()
        tool = _collect(given, "", {"x": given.form.tool_position(given.q)[0]})
    closure = None if loops is None else loops.trace_closure(np.array([x.value for x in inputs().q[0]]))
    used = {
        int(node.args[0].removeprefix("theta"))
        for part in (dynamics, friction, tool)
        if part is not None
        for node in part.graph.needed(part.values)
        if node.op == "input" and node.args[0].startswith("theta")
    }
    return Equations(model, dynamics, friction, tool, loops, closure, tuple(sorted(used)))


def _collect(given: TracingInputs, takes: str, made: dict[str, Any]) -> TracedFunction:
    """Return a function of positions, passive joints where there are loops, and further arrays."""
    na = given.model.robot.na
    sizes = {"v": na, "a": na, "theta": len(given.model.parameters)}
    arguments = {"q": na} | ({} if given.passive is None else {"p": len(given.passive)})
    return TracedFunction(given.graph, arguments | {x: sizes[x] for x in takes.split()}, flatten_outputs(made))


def trace_effect_bounds(given: TracingInputs) -> TracedFunction:
    """Return the effects' forces at both signs, and what they add to the mass matrix; see `simulate/forces.py`."""
    n, rest = given.model.robot.na, as_expression_array(np.zeros((1, given.model.robot.na)))
    effects = [effect for effect in given.model.effects if not acts_on_recording(effect)]
    plain = [effect for effect in effects if "force" not in effect.needs]
    scaled = [effect for effect in effects if "force" in effect.needs]
    both = []
    for sign in (-1.0, 1.0):
        force = sum(
            (_ask(given, e, given.a if "load" in e.needs else rest, sign) for e in plain),
            start=as_expression_array(np.zeros(n)),
        )
        whole = given.form.inverse_dynamics(given.q, given.v, rest)[0] + force if scaled else None
        for effect in scaled:
            force = force + _ask(given, effect, rest, sign, whole)
        both.append(force)
    added = as_expression_array(np.zeros((n, n)))
    M = given.form.mass_and_bias(given.q[0], given.v[0])[0] if scaled else None
    for k, row in enumerate(np.eye(n)):
        unit = as_expression_array(row[None])
        for effect in plain:
            if "load" not in effect.needs:
                added[:, k] = added[:, k] + _ask(given, effect, unit, 1.0) - _ask(given, effect, rest, 1.0)
        if M is not None:
            whole = M[:, k] + added[:, k]
            for effect in scaled:
                added[:, k] = added[:, k] + _ask(given, effect, unit, 1.0, whole)
    return _collect(given, "v a theta", {"lower": both[0], "upper": both[1], "added": added})


def _ask(given: TracingInputs, effect: Any, a: Any, sign: float, force: Any = None) -> Any:
    """Return an effect's force (na,) at accelerations (1, na), and for effects that feel it at a force (na,)."""
    robot = given.model.robot
    signals = {n: COMPUTED[n](given.form, given.q, given.v, a) for n in effect.needs if n in COMPUTED}
    if force is not None:
        signals["force"] = as_expression_array(force)[None]
    motion = Motion.of(robot.actuated, given.q, given.v, a, np.full((1, robot.na), sign), signals=signals)
    values = as_expression_array([given.value(name) for name in effect.parameters.names])
    return as_expression_array(as_expression_array(effect.columns(motion))[0] @ values)


def _compare_with_simulator(equations: Equations) -> float:
    """Return how far the equations are from the simulator's, relative to the largest value.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    model, worst = equations.model, 0.0
    q, v, a = draw_random_states(model, _STATES, np.random.default_rng(_SEED))
    known = {"q": q, "v": v, "a": a, "theta": np.tile(model.parameters.values, (len(q), 1))}
    if equations.loops is not None:
        known["p"] = np.array([equations.loops.closed(x) for x in q])[:, equations.loops.passive]
    for part, outputs, expected in _list_expected(equations, q, v, a):
        found, fine = evaluate_graph(part.graph, outputs, known)
        difference = np.max(np.abs(found - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
        if not difference < AGREEMENT or not fine.all():
            raise InputError(
                "unsupported",
                f"{model.robot.source}: the traced {' and '.join(part.outputs)} differ from the simulator's by {difference:.2g}, "
                "so no FMU is written",
            )
        worst = max(worst, float(difference))
    return worst


def _list_expected(
    equations: Equations, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> list[tuple[TracedFunction, tuple[Any, ...], np.ndarray]]:
    """Return each part with its outputs and the simulator's values of them."""
    model, n = equations.model, equations.model.robot.na
    pairs = [model.mechanism.mass_and_bias(x, y) for x, y in zip(q, v, strict=True)]
    found = [(equations.dynamics, equations.dynamics.values, np.array([[*M.ravel(), *h] for M, h in pairs]))]
    if equations.tool is not None:
        found.append((equations.tool, equations.tool.values, model.mechanism.tool_position(q)))
    if equations.friction is not None:
        forces, rows = SampledForces(model), []
        for state in zip(q, v, a, strict=True):
            added = forces.mass(*state[:2])
            rows.append([*np.ravel(forces.bounds(*state)), *np.ravel(np.zeros((n, n)) if added is None else added)])
        part = equations.friction
        outputs = (*_sort_bounds(part, True), *_sort_bounds(part, False), *part.outputs["added"])
        found.append((part, outputs, np.array(rows)))
    return found


def _sort_bounds(part: TracedFunction, low: bool) -> tuple[Any, ...]:
    """Return the friction's lower or upper bound as the simulator gives it where an effect pushes forwards."""
    graph, out = part.graph, []
    for k, (x, y) in enumerate(zip(part.outputs["lower"], part.outputs["upper"], strict=True)):
        now = graph.apply("select", graph.apply("lt", 0.0, graph.input(f"v{k}", 0.0)), y, x)
        out.append(graph.apply("select", graph.apply("lt", y, x), now, x if low else y))
    return tuple(out)
