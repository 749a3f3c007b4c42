"""An FMU's equations against the simulator's own at random states; a difference refuses the export."""

from __future__ import annotations

from typing import Any

import numpy as np

from tau_dyn.control import draw_random_states, evaluate_graph
from tau_dyn.exceptions import InputError
from tau_dyn.exchange.fmu_equations import EquationFunction, Equations
from tau_dyn.simulate import SampledForces

STATES, AGREEMENT = 15, 1e-9
"""Random states, and how far expressions and simulator may differ there, relative to the largest value."""


def compute_largest_difference(equations: Equations) -> float:
    """Return how far an FMU's equations are from the simulator's, relative to the largest value.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    model, worst = equations.model, 0.0
    q, v, a = draw_random_states(model, STATES, np.random.default_rng(2))
    known = {"q": q, "v": v, "a": a, "theta": np.tile(model.parameters.values, (len(q), 1))}
    if equations.loops is not None:
        known["p"] = np.array([equations.loops.closed(x) for x in q])[:, equations.loops.passive]
    for part, expected in _expected(equations, q, v, a):
        found, fine = evaluate_graph(part.graph, part.outputs, known)
        difference = np.max(np.abs(found - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
        if not difference < AGREEMENT or not fine.all():
            raise InputError(
                "unsupported",
                f"{model.robot.source}: the traced {' and '.join(part.gives)} differ from the simulator's by {difference:.2g}, "
                "so no FMU is written",
            )
        worst = max(worst, float(difference))
    return worst


def _expected(
    equations: Equations, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> list[tuple[EquationFunction, np.ndarray]]:
    model, n = equations.model, equations.model.robot.na
    pairs = [model.mechanism.mass_and_bias(x, y) for x, y in zip(q, v, strict=True)]
    found = [(equations.dynamics, np.array([[*M.ravel(), *h] for M, h in pairs]))]
    if equations.tool is not None:
        found.append((equations.tool, model.mechanism.tool_position(q)))
    if equations.friction is not None:
        forces, rows = SampledForces(model), []
        for state in zip(q, v, a, strict=True):
            added = forces.mass(*state[:2])
            rows.append([*np.ravel(forces.bounds(*state)), *np.ravel(np.zeros((n, n)) if added is None else added)])
        part = equations.friction
        gives = {"lower": _sorted(part, True), "upper": _sorted(part, False), "added": part.gives["added"]}
        found.append((EquationFunction(part.graph, part.takes, gives), np.array(rows)))
    return found


def _sorted(part: EquationFunction, low: bool) -> tuple[Any, ...]:
    """Return the friction's lower or upper bound as the simulator gives it where an effect pushes forwards."""
    graph, out = part.graph, []
    for k, (x, y) in enumerate(zip(part.gives["lower"], part.gives["upper"], strict=True)):
        now = graph.apply("select", graph.apply("lt", 0.0, graph.input(f"v{k}", 0.0)), y, x)
        out.append(graph.apply("select", graph.apply("lt", y, x), now, x if low else y))
    return tuple(out)
