"""All samples at once give what Pinocchio gives one by one: columns, forces, mass matrix, guide forces, bearings, tool."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.equations import tape
from tau_dyn.mechanism import TreeMechanism, build_mechanism
from tau_dyn.mechanism.tree import MAX_ONE_BY_ONE, SamplewiseTree

KINDS = ["two_link", "turning", "telescope", "block", "pendulum", "tx40", "ur5", "panda", "four_bar",
         "l1 simplified uniform", "d1 simplified point", "l1 complete uniform"]  # fmt: skip
N = 30


def pair(robot, rng):
    """Return both paths of a robot whose every drive and weight counts."""
    extra = {
        p.name: p.value + rng.uniform(0.1, 1) for p in robot.parameters if p.name.endswith(("armature", "gravity_mass"))
    }
    robot = robot.with_parameters(robot.parameters.with_values(extra))
    return SamplewiseTree(robot), TreeMechanism(robot)


def same(one: np.ndarray, other: np.ndarray) -> None:
    assert_allclose(other, one, rtol=0, atol=1e-10 * max(1.0, float(np.abs(one).max(initial=0.0))))


@pytest.mark.parametrize("kind", KINDS)
def test_many_samples_at_once_equal_pinocchio_one_by_one(robots, motion, rng, kind: str) -> None:
    """Kane's virtual work over bodies equals `G' Y_tree` of Pinocchio to 1e-10, for every quantity a mechanism answers."""
    each, many = pair(robots(kind), rng)
    assert many.batched is not None and N > MAX_ONE_BY_ONE  # else the samplewise answers twice
    q, v, a = motion(each.robot, N)
    for name in ("regressor", "inverse_dynamics", "guide_force", "guide_load"):
        same(getattr(each, name)(q, v, a), getattr(many, name)(q, v, a))
    same(each.inertia(q), many.inertia(q))
    same(each.condition(q), many.condition(q))
    assert each.passive_rates(q)[0] == many.passive_rates(q)[0]
    same(each.passive_rates(q)[1], many.passive_rates(q)[1])
    if each.robot.tool_frame is not None:
        same(each.tool_position(q), many.tool_position(q))
        same(each.tool_jacobian(q), many.tool_jacobian(q))


@pytest.mark.parametrize("compiles", ["0", "1"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_tape_gives_the_columns_of_the_array_code(robots, motion, rng, monkeypatch, kind: str, compiles: str) -> None:
    """Columns from a tape are those of the array code to the last bit, with a compiler and without, for other values too."""
    q, v, a = motion(pair(robots(kind), rng)[1].robot, 1100)
    many = pair(robots(kind), rng)[1]
    monkeypatch.setattr(tape, "TRACE_FROM", np.inf)
    arrays = many.regressor(q, v, a)
    monkeypatch.setattr(tape, "TRACE_FROM", 0)
    monkeypatch.setattr(tape, "BUILD_FROM", 0)
    monkeypatch.setattr(tape, "_TAPES", {})
    monkeypatch.setenv("TAU_DYN_COMPILE", compiles)
    assert_array_equal(many.regressor(q, v, a), arrays)
    assert [found is not None for found in tape._TAPES.values()] == [True]
    other = many.robot.with_parameters(many.robot.parameters.with_values({many.robot.parameters.names[0]: 1.25}))
    assert_array_equal(TreeMechanism(other).regressor(q, v, a), arrays)
    assert len(tape._TAPES) == 1


def test_robots_that_differ_have_different_tapes(robots, motion, rng, monkeypatch) -> None:
    """Another gravity is another computation: the columns follow it."""
    monkeypatch.setattr(tape, "TRACE_FROM", 0)
    robot = robots("two_link")
    turned = robot.model.copy()
    turned.gravity.linear = np.array([3.0, 0.0, -9.0])
    q, v, a = motion(robot, N)
    for each in (robot, replace(robot, model=turned)):
        same(SamplewiseTree(each).regressor(q, v, a), TreeMechanism(each).regressor(q, v, a))


@pytest.mark.parametrize("kind", ["l1 simplified uniform", "l1 complete uniform", "four_bar"])
def test_a_closure_does_not_depend_on_what_came_before(robots, motion, rng, kind: str) -> None:
    """A loop closes by its own positions: reversed order, another block and a fresh mechanism give the same columns."""
    robot = robots(kind)
    q, v, a = motion(robot, 1500)
    first = TreeMechanism(robot)
    Y = first.regressor(q, v, a)
    same(Y[::-1], first.regressor(q[::-1], v[::-1], a[::-1]))
    same(Y[700:740], TreeMechanism(robot).regressor(q[700:740], v[700:740], a[700:740]))


def test_the_closed_form_equals_its_tree_on_a_long_path(robots, rng) -> None:
    """Spheres intersected and loops solved agree over the whole workspace of the simplified Gantry-Tau."""
    robot = robots("l1 simplified uniform")
    q = robot.home + 0.3 * np.sin(np.linspace(0, 20, 400)[:, None] * [1.0, 1.7, 2.3])
    v, a = rng.standard_normal((2, *q.shape))
    same(build_mechanism(robot).regressor(q, v, a), TreeMechanism(robot).regressor(q, v, a))


def test_one_sample_out_of_reach_is_named(robots) -> None:
    """Where one of many positions cannot be closed, the answer is the sentence that one by one gives, not a number."""
    mechanism = TreeMechanism(robots("l1 simplified uniform"))
    q = np.repeat(mechanism.robot.home[None], 40, axis=0)
    q[17, 0] += 5.0
    with raises_code("loop_not_closed"):
        mechanism.regressor(q, 0 * q, 0 * q)


def test_no_samples_give_no_rows(robots) -> None:
    """An empty motion has an empty regressor, not a fault."""
    mechanism = TreeMechanism(robots("two_link"))
    assert mechanism.regressor(*np.zeros((3, 0, 2))).shape == (0, 2, len(mechanism.robot.parameters))
