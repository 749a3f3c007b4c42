"""Which causes a search takes in together, from where it looks for them, and steps that keep bodies such as may exist."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tau_dyn.servo import cause_search
from tau_dyn.servo.cause_search import RESONANCES_HZ, TriedCause, list_starts, search_causes
from tau_dyn.servo.fit import LoopPrior, _step

from .test_consistent_bodies import build_bodies


def search(monkeypatch: pytest.MonkeyPatch, rounds: list[dict[str, tuple[list[float], list[float]]]]) -> list[set]:
    """Return what is taken in round by round at two joints, where causes have these scores and shares in each round."""
    taken: list[set] = []

    def weigh(data: Any, u: Any, fit: Any, cause: str) -> TriedCause:
        now = rounds[len(taken)] if len(taken) < len(rounds) else {}
        return TriedCause(*map(np.array, now.get(cause, ([0.0, 0.0], [0.0, 0.0]))), {})

    def free(data: Any, u: Any, fit: Any, chosen: list, starts: Any) -> str:
        taken.append(set(chosen))
        return "unknowns"

    monkeypatch.setattr(cause_search, "_find_coloured", lambda *_: np.array([True, True]))
    monkeypatch.setattr(cause_search, "_try", weigh)
    monkeypatch.setattr(cause_search, "free_causes", free)
    monkeypatch.setattr(cause_search, "fit_precisely", lambda *_: "fit")
    monkeypatch.setattr(cause_search, "_drop_superfluous", lambda *_: ("unknowns", "fit", set()))
    law = SimpleNamespace(joints=("a", "b"))
    data: Any = SimpleNamespace(unknowns="unknowns", law=law, build_problem=lambda u: u)
    found = search_causes(data, "fit", lambda step: None)  # type: ignore[arg-type]
    assert set(found.taken) == set().union(*taken)
    return taken


def test_a_joint_waits_for_what_shakes_it(monkeypatch):
    """A joint whose cause takes off 30 % waits beside one whose cause takes off 90 %, and needs none once that is in."""
    shaken = search(monkeypatch, [{"delay": ([50.0, 20.0], [0.9, 0.3])}, {}])
    assert shaken == [{("delay", 0)}]


def test_joints_that_miss_as_much_need_not_wait(monkeypatch):
    """Two joints with causes of 90 and 60 % get them in one round, each its own."""
    both = search(monkeypatch, [{"delay": ([50.0, 0.0], [0.9, 0.0]), "backlash": ([0.0, 30.0], [0.0, 0.6])}])
    assert both == [{("delay", 0), ("backlash", 1)}]


@pytest.mark.parametrize(("share", "taken"), [(0.6, [{("delay", 0)}]), (0.4, [])])
def test_most_of_a_residual_counts_however_uncertain_the_number(monkeypatch, share, taken):
    """A number of two standard errors is a cause where it takes off more than half of the residual, and chance where less."""
    assert search(monkeypatch, [{"delay": ([2.0, 0.0], [share, 0.0])}]) == taken


def test_springs_are_looked_for_at_resonances_an_octave_apart():
    """Each start rings with its link at its frequency, the motor held, with a twentieth of critical damping."""
    inertia, viscous, armature = 0.02, 0.4, 1e-3
    values = {"armature": np.array([armature]), "viscous": np.array([viscous])}
    unknowns: Any = SimpleNamespace(n=0, with_values=lambda x: values)
    data: Any = SimpleNamespace(
        law=SimpleNamespace(joints=("a",)), space=SimpleNamespace(n_unknowns=0), records=[SimpleNamespace(dt=0.02)],
        loads=[SimpleNamespace(inertia=np.full((5, 1, 1), inertia))],
    )  # fmt: skip
    starts = list_starts(data, unknowns, SimpleNamespace(x=np.zeros(0)), "joint_compliance")  # type: ignore[arg-type]
    turn = np.array([float(1 / np.sqrt(s["joint_compliance"][0] * inertia)) for s in starts])
    damping = np.array([float(s["joint_damping"][0]) for s in starts])
    below = [f for f in RESONANCES_HZ if f < 25]  # Nyquist's frequency
    np.testing.assert_allclose(turn / (2 * np.pi), below * 2)
    np.testing.assert_allclose(damping / (2 * inertia * turn), 0.05)
    friction = [float(s["viscous"][0]) for s in starts]
    assert friction == pytest.approx([viscous] * len(below) + [0.1 * viscous] * len(below))
    assert starts[-1]["armature"][0] == pytest.approx(0.1 * inertia)


def test_a_step_ends_before_bodies_that_cannot_exist():
    """However far a fit is pulled, its next bodies may exist, and a start that could not is moved towards the file's."""
    bodies = build_bodies(None)
    n = bodies._k
    unknowns: Any = SimpleNamespace(
        n=n, prior=np.ones(0), free=np.zeros(0, bool), pack=lambda: np.zeros(n), clip=lambda x: x,
        space=SimpleNamespace(n_unknowns=n, bodies=bodies),
    )  # fmt: skip
    prior, pull = LoopPrior(unknowns), np.zeros(n)
    pull[0] = -40.0  # ten times the mass of the first link, whose moments stay
    after = _step(np.eye(n), pull, 0.0, np.zeros(n, bool), prior, np.zeros(n))
    assert np.isinf(prior.compute_cost(pull)) and np.isfinite(prior.compute_cost(after)) and after[0] < -0.3
    moved = prior.enter(pull)
    assert np.isfinite(prior.compute_cost(moved)) and moved[0] < -0.3
