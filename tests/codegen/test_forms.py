"""Forces, mass matrices and loads of a tree on expressions equal those of its mechanism, as exported code needs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.codegen import draw_random_states, find_loops
from tau_dyn.codegen.forms import TracingInputs
from tau_dyn.equations import evaluate_graph
from tau_dyn.mechanism import TreeMechanism
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf


def load(kind: str, write):
    """Return a robot whose drives all have inertia."""
    text = getattr(write, kind, None)
    robot = load_robot("gantry_tau", arms="complete") if text is None else load_robot_from_urdf(text(), kind)
    heavy = {p.name: 0.7 for p in robot.parameters if p.name.endswith("armature")}
    return robot.with_parameters(robot.parameters.with_values(heavy))


@pytest.mark.parametrize("kind", ["two_link", "block", "four_bar", "gantry_tau"])
def test_a_tree_on_expressions_answers_as_its_mechanism(write, kind: str) -> None:
    """Forces, masses, loads of guides and reducers, bearings, tool and turned gravity agree to 1e-9, parameters as inputs."""
    model = Model.of(load(kind, write), [])
    loops = find_loops(model)
    given = TracingInputs(model, loops, open_parameters=True)
    form, mechanism = given.form, TreeMechanism(model.robot)
    q, v, a = draw_random_states(model, 3, np.random.default_rng(3))
    known = {"q": q, "v": v, "a": a, "theta": np.tile(model.parameters.values, (3, 1))}
    if loops is not None:
        known["p"] = np.array([loops.closed(x) for x in q])[:, loops.passive]

    def value(made) -> np.ndarray:
        return evaluate_graph(given.graph, list(np.ravel(np.asarray(made))), known)[0]

    for name in ("inverse_dynamics", "guide_force", "guide_load", "reducer_torque"):
        wanted = getattr(mechanism, name)(q, v, a)
        assert_allclose(
            value(getattr(form, name)(given.q, given.v, given.a)), wanted.reshape(3, -1), rtol=1e-9, atol=1e-8
        )
    assert_allclose(value(form.gravity_turn(given.q)), mechanism.gravity_turn(q).reshape(3, -1), rtol=1e-9, atol=1e-8)
    if loops is not None:
        assert_allclose(value(form.passive_rates(given.q)[1]), mechanism.passive_rates(q)[1].reshape(3, -1), atol=1e-9)
    M, h = form.mass_and_bias(given.q[0], given.v[0])
    wanted = [mechanism.mass_and_bias(x, y) for x, y in zip(q, v, strict=True)]
    assert_allclose(value(M), [M.ravel() for M, _ in wanted], rtol=1e-9, atol=1e-8)
    assert_allclose(value(h), [h for _, h in wanted], rtol=1e-9, atol=1e-8)
    if model.robot.tool_frame is not None:
        assert_allclose(value(form.tool_position(given.q)), mechanism.tool_position(q), atol=1e-9)
        assert_allclose(value(form.tool_jacobian(given.q)), mechanism.tool_jacobian(q).reshape(3, -1), atol=1e-9)
