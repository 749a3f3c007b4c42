"""Of several sets of variables that explain a force as well, which one is said; and that all parts have to bear it out."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.diagnose.force_channel import ForceChannel
from tau_dyn.effects import Motion
from tau_dyn.evidence.candidate_scan import N_NULL_DRAWS
from tau_dyn.evidence.confirmation import Confirmation
from tau_dyn.evidence.measurements import TEST, TRAIN, VALIDATION
from tau_dyn.evidence.null_model import WHOLE_TIME
from tau_dyn.evidence.unexplained import build_unexplained, discriminate_structures
from tau_dyn.evidence.unknown_structure import Dependence, find_structure, list_dependences

JOINTS = ("one", "two", "three")


def together(make, rng, apart_in):
    """Return a motion whose third joint moves as the second does, but for some parts of the data; and these parts."""
    m, part = make.moving(rng, JOINTS, 9000), make.turns(9000)
    own = np.isin(part, apart_in)
    q, v, a = (np.array(getattr(m, key)) for key in "qva")
    for x in (q, v, a):
        x[:, 2] = np.where(own, x[:, 2], x[:, 1])
    return Motion.of(JOINTS, q, v, a, t=m.t)


def told(make, rng, motion, hidden):
    """Return the structure that a bench with a hidden force shows, and what is said of it."""
    channel = make.bench(rng, hidden, motions=(motion,))
    null_model = make.null_model(channel)
    found = find_structure(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), 0.05)
    said = discriminate_structures(null_model, (), found)
    return found, said, build_unexplained(null_model, (), said)[0]


def by_third(m):
    """Return a force on joint one of the third joint's speed squared."""
    return np.stack([60 * m.v[:, 2] ** 2, 0 * m.v[:, 0], 0 * m.v[:, 0]], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_joints_that_move_as_one_in_training_are_told_apart_where_they_do_not(make, seed):
    """Joints two and three train together and confirm apart: the force of joint three's speed is said to be joint three's."""
    rng = np.random.default_rng(seed)
    found, said, item = told(make, rng, together(make, rng, (VALIDATION, TEST)), by_third)
    assert {on.on.variables for on in found.alike} | {found.variables} >= {("v_two",), ("v_three",)}
    assert item.depends_on == ("v_three",) and item.status == "confirmed"
    assert ("v_two",) not in item.indistinguishable_from


def test_joints_that_always_move_as_one_are_both_named(make):
    """Where no part tells two joints apart, one is said and the other listed as explaining it as well."""
    rng = np.random.default_rng(5)
    _, _, item = told(make, rng, together(make, rng, ()), by_third)
    assert {item.depends_on, *item.indistinguishable_from} >= {("v_two",), ("v_three",)}
    assert item.to_dict()["indistinguishable_from"] == [list(x) for x in item.indistinguishable_from]


@pytest.mark.parametrize(("last", "status"), [(1.0, "confirmed"), (-1.0, "suspected")])
def test_the_last_part_has_a_veto_on_what_has_no_name(make, last, status):
    """A force that turns round where nothing is learnt and nothing confirmed is only suspected."""
    rng = np.random.default_rng(6)

    def hidden(m):
        return np.where(make.turns(len(m.t)) == TEST, last, 1.0)[:, None] * by_third(m)

    _, said, item = told(make, rng, make.moving(rng, JOINTS, 9000), hidden)
    assert said.test.is_confirmed and item.status == status


def drifting(make, rng, motions, drift, parts):
    """Return whether a drift is confirmed, and its status: a force by time and part, in logs divided as `parts` says."""

    def hidden(m):
        return np.repeat(drift(np.asarray(m.t), parts(len(m.t)))[:, None], 3, axis=1)

    channel = make.bench(rng, hidden, motions=motions, parts=parts)
    null_model = make.null_model(channel)
    found = find_structure(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), 0.05)
    assert found is not None and found.variables == ("t",)
    said = discriminate_structures(null_model, (), found)
    return said.test.is_confirmed, build_unexplained(null_model, (), said)[0].status


@pytest.mark.parametrize(("elsewhere", "status"), [(1.0, "confirmed"), (-1.0, "suspected")])
def test_a_drift_is_the_same_wherever_one_log_is_looked_at(make, elsewhere, status):
    """What rises over a log where it trains, and falls where it confirms, is no drift: slow noise, or a motion in sections."""
    rng = np.random.default_rng(8)

    def drift(t, part):
        return np.where(part == VALIDATION, elsewhere, 1.0) * 3 * t / t[-1]

    motions = (make.moving(rng, JOINTS, 9000),)
    assert drifting(make, rng, motions, drift, make.turns) == (status == "confirmed", status)


@pytest.mark.parametrize(("last", "status"), [(1.0, "confirmed"), (-1.0, "suspected")])
def test_another_log_drifts_its_own_way_in_all_its_parts(make, last, status):
    """It may rise in one log and fall in the next; there, what confirms it and what measures the gain have to agree."""
    rng = np.random.default_rng(9)
    motions = (make.moving(rng, JOINTS, 9000), make.moving(rng, JOINTS, 9001))

    def parts(n):
        turns = make.turns(n)
        return np.full(n, TRAIN) if n == 9000 else np.where(turns == TRAIN, -1, turns)

    def drift(t, part):
        rise = 3 * t / t[-1] if len(t) == 9000 else 3 - 6 * t / t[-1]
        return np.where(part == TEST, last, 1.0) * rise

    assert drifting(make, rng, motions, drift, parts) == (True, status)


def test_as_many_sets_as_are_tried_count_in_the_chance(make, monkeypatch):
    """Confirming the best of k sets of variables is k times as likely by chance as confirming one."""
    module = importlib.import_module("tau_dyn.evidence.unexplained")
    monkeypatch.setattr(module, "confirm_structure", lambda *parts: Confirmation(1.0, 0.3, 1e-3))
    rng = np.random.default_rng(7)
    found, said, _ = told(make, rng, together(make, rng, (VALIDATION,)), by_third)
    assert found.alike and said.test.p_value == pytest.approx(1e-3 * (1 + len(found.alike)))


def test_what_settles_on_through_a_second_log_is_one_drift():
    """A decay that goes on in a second log, whose clock starts anew, is a smooth function of time: 99.9 % of it."""
    t = np.linspace(0, 40, 400)
    runs = [{"t": t, WHOLE_TIME: t}, {"t": t, WHOLE_TIME: t + 40}]
    C = np.concatenate(Dependence("x", ("t",)).bases(runs))
    y = np.exp(-np.linspace(0, 80, 800) / 30)
    y = y - y.mean()
    left = y - C @ np.linalg.lstsq(C, y, rcond=None)[0]
    assert np.sum(left**2) < 1e-3 * np.sum(y**2)


def test_a_direction_of_motion_is_a_speed_that_it_depends_on():
    """What follows the sign of a joint's speed is said to depend on that speed, once."""
    assert Dependence("x", ("q_y",), "x").variables == ("q_y", "v_x")
    assert Dependence("x", ("v_x",), "x").variables == ("v_x",)
    moved = {key: np.linspace(-1, 1, 9) for key in ("q_x", "v_x", "q_y", "v_y", "t")}
    tried = list_dependences([moved | {WHOLE_TIME: np.linspace(0, 1, 9)}], "x")
    assert {d.turns for d in tried if d.names == ("q_y",)} == {"", "x", "y"}
    assert {d.turns for d in tried if len(d.names) == 2} == {"", "x"}
    assert not any(WHOLE_TIME in d.names for d in tried) and not any("t" in d.names for d in tried if len(d.names) == 2)


def test_a_second_variable_and_another_joints_direction_cost_alike():
    """One variable with the own direction is the simplest; what needs more has to explain more."""
    simple = Dependence("x", ("q_y",)), Dependence("x", ("q_y",), "x")
    more = Dependence("x", ("q_y",), "y"), Dependence("x", ("q_y", "v_x")), Dependence("x", ("q_y", "v_x"), "x")
    assert [d.further for d in (*simple, *more)] == [0, 0, 1, 1, 1]


def test_logs_follow_one_another_and_pieces_of_one_log_do_not():
    """The time through all logs goes on in the second log; both pieces of the first begin with that log."""
    logs = [SimpleNamespace(name=name, t=np.array(t)) for name, t in (("a", (0, 10)), ("a", (15, 40)), ("b", (0, 30)))]
    channel = SimpleNamespace(prepared=[SimpleNamespace(log=log) for log in logs])
    assert ForceChannel._begins(channel) == [0.0, 0.0, 40.0]
    still = np.zeros((2, 1))
    channel.thinned = [Motion.of(("x",), still, still, still, t=log.t.astype(float)) for log in logs]
    channel._begins = lambda: [0.0, 0.0, 40.0]
    assert [list(row[WHOLE_TIME]) for row in ForceChannel.variables(channel)] == [[0, 10], [15, 40], [40, 70]]
    channel._begins = lambda: [0.0, 0.0, 0.0]
    assert not any(WHOLE_TIME in row for row in ForceChannel.variables(channel))
