"""Which causes a search takes in together, from where it looks for them, and steps that keep bodies such as may exist."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.servo import cause_search, data as servo_data, fit
from tau_dyn.servo.by_gain import RESONANCES_HZ, list_starts
from tau_dyn.servo.cause_search import LoopSearch, TriedCause, search_causes
from tau_dyn.servo.data import BASELINE, LOADS_ANEW, MAX_SETTLINGS, fit_coupled, fit_precisely, keep_kinds
from tau_dyn.servo.fit import LoopPrior, _compute_covariance, _step
from tau_dyn.servo.preparation import prepare_loop, read_loop_logs
from tau_dyn.servo.waves import SPRING_STEP_S

from .arms import build_arm, build_law, build_truth, record
from .test_consistent_bodies import build_bodies


def search(
    monkeypatch: pytest.MonkeyPatch,
    rounds: list[dict[str, tuple[list[float], list[float]]]],
    hear: Callable[[str], None] = lambda step: None,
) -> list[set]:
    """Return what is taken in round by round at two joints, where causes have these scores and shares in each round."""
    taken: list[set] = []

    def answer(data: Any, u: Any, fit: Any, cause: str, *more: Any) -> TriedCause:
        now = rounds[len(taken)] if len(taken) < len(rounds) else {}
        return TriedCause(*map(np.array, now.get(cause, ([0.0, 0.0], [0.0, 0.0]))), {})

    def free(data: Any, u: Any, fit: Any, chosen: list, starts: Any) -> str:
        taken.append(set(chosen))
        return "unknowns"

    monkeypatch.setattr(cause_search, "_find_coloured", lambda *_: np.array([True, True]))
    monkeypatch.setattr(cause_search, "_try", answer)
    monkeypatch.setattr(cause_search, "list_starts", lambda *_: [])
    monkeypatch.setattr(cause_search, "free_causes", free)
    fit: Any = SimpleNamespace(x=None)
    monkeypatch.setattr(cause_search, "fit_precisely", lambda *_: fit)
    monkeypatch.setattr(cause_search, "_drop_superfluous", lambda *_: ("unknowns", fit, set()))
    problem = SimpleNamespace(keep_inertial=lambda x: None)
    data: Any = SimpleNamespace(
        unknowns="unknowns", law=SimpleNamespace(joints=("a", "b")), build_problem=lambda u: problem
    )
    data.with_fine_steps = lambda fit: data
    found = search_causes(data, fit, hear)
    assert set(found.taken) == set().union(*taken)
    return taken


def test_a_joint_waits_for_what_shakes_it(monkeypatch):
    """A joint whose cause takes off 30 % waits beside one whose cause takes off 90 %, and needs none once that is in."""
    shaken = search(monkeypatch, [{"delay": ([50.0, 20.0], [0.9, 0.3])}, {}])
    assert shaken == [{("delay", 0)}]


def test_a_joint_that_waited_tries_its_best_causes_alone(monkeypatch):
    """After the other joint got its cause, the one that waited tries again what came near its best, before a round of all."""
    steps: list[str] = []
    late, loose = ([50.0, 20.0], [0.9, 0.3]), ([0.0, 20.0], [0.0, 0.29])
    rest = {"delay": ([0.0, 20.0], [0.0, 0.3]), "backlash": loose, "stiction": ([0.0, 20.0], [0.0, 0.1])}
    found = search(monkeypatch, [{**rest, "delay": late}, rest], steps.append)
    assert found == [{("delay", 0)}, {("delay", 1)}]
    assert steps.count("round 1: delay") == steps.count("round 1: stiction") == 1
    assert [step for step in steps if step.endswith("again")] == ["round 1: delay again", "round 1: backlash again"]
    assert len([step for step in steps if step.startswith("round 2")]) == len(LOOP_CAUSES)


def test_joints_that_miss_as_much_need_not_wait(monkeypatch):
    """Two joints with causes of 90 and 60 % get them in one round, each its own."""
    both = search(monkeypatch, [{"delay": ([50.0, 0.0], [0.9, 0.0]), "backlash": ([0.0, 30.0], [0.0, 0.6])}])
    assert both == [{("delay", 0), ("backlash", 1)}]


@pytest.mark.parametrize(("share", "taken"), [(0.6, [{("delay", 0)}]), (0.4, [])])
def test_most_of_a_residual_counts_however_uncertain_the_number(monkeypatch, share, taken):
    """A number of two standard errors is a cause where it takes off more than half of the residual, and chance where less."""
    assert search(monkeypatch, [{"delay": ([2.0, 0.0], [share, 0.0])}]) == taken


class Causes(frozenset):
    """Causes of one joint, which stand for the unknowns and for the problem of their fit."""

    count, used = 1000, np.ones(1)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return one sample."""
        return np.ones((1, 1, 1))


@dataclass(frozen=True)
class Data:
    """Logs of one joint."""

    unknowns: Causes = Causes()
    law: ClassVar = SimpleNamespace(joints=("a",), values={"command_delay": np.zeros(1), "torque_delay": np.zeros(1)})
    is_shaken: ClassVar = False

    def build_problem(self, causes: Any = None) -> Any:
        """Return what is free."""
        return self.unknowns if causes is None else causes


def leave(monkeypatch: pytest.MonkeyPatch, sigmas: dict[str, float]) -> Callable[[str], Any]:
    """Let fits with these causes leave these residuals, all others 9; return how they are built."""

    def fit(causes: Iterable[str]) -> Any:
        return SimpleNamespace(sigma=np.array([sigmas.get(" ".join(sorted(causes)), 9.0)]), x=np.zeros(1), u=causes)

    replacements = {
        "fit_precisely": lambda causes, *_: fit(causes),
        "refit_again": lambda causes, old, progress: fit(old.u),
        "_refit_baseline": lambda data, base, search, progress: base,
        "start_best": lambda data, causes, old, starts, joints: Causes(causes | set(starts)),
        "_hold_null": lambda data, causes, old, places: (Causes(causes - {c for c, _ in places}), old),
        "list_starts": lambda *_: [{}],
        "count_worth": lambda *_: 1.0,
        "_find_coloured": lambda data, causes, old: old.sigma > 1.0,
        "_drop_superfluous": lambda data, causes, old, taken, progress: (causes, old, set()),
    }
    for name, instead in replacements.items():
        monkeypatch.setattr(cause_search, name, instead)
    return lambda causes: fit(Causes(causes.split()))


def quiet(step: str) -> None:
    """Hear no progress."""


@pytest.mark.parametrize(("late", "wrong"), [("delay", "command_delay"), ("command_delay", "delay")])
@pytest.mark.parametrize(("left", "better"), [(1.0, True), (2.98, False)])
def test_a_spring_that_leaves_colour_is_looked_for_with_a_delay(monkeypatch, late, wrong, left, better):
    """A spring and what comes late replace all that a joint had where they leave less by three percent of its variance."""
    had = "gain_error joint_compliance"
    pairs = {" ".join(sorted((late, "joint_compliance"))): left, " ".join(sorted((wrong, "joint_compliance"))): 2.99}
    fit = leave(monkeypatch, {had: 3.0} | pairs)
    taken: dict = {(cause, 0): (9.0, ()) for cause in had.split()}
    found = cause_search._restart_springs(Data(), Causes(had.split()), fit(had), taken, quiet)  # type: ignore[arg-type]
    assert (found is not None) == better
    assert {cause for cause, _ in taken} == ({"joint_compliance", late} if better else set(had.split()))


@pytest.mark.parametrize(("alone", "left"), [(1.01, "joint_compliance"), (1.02, "delay joint_compliance")])
def test_a_cause_that_others_leave_little_of_is_taken_out_at_the_end(monkeypatch, alone, left):
    """Beside the others, too, a cause takes off three percent of its joint's variance, or it goes."""
    both = "delay joint_compliance"
    fit = leave(monkeypatch, {both: 1.0, "joint_compliance": alone})
    search = LoopSearch(Causes(both.split()), fit(both), {("joint_compliance", 0): (20.0, ()), ("delay", 0): (9.0, ())})  # type: ignore[arg-type]
    _, after = cause_search.check_steps(Data(), fit(""), search, quiet)  # type: ignore[arg-type]
    assert sorted(cause for cause, _ in after.taken) == sorted(after.unknowns) == left.split()  # type: ignore[arg-type]


@pytest.mark.parametrize(("beside", "least"), [(1.0, 1.0), (9.0, 2.0)])
def test_a_gain_is_held_against_the_best_that_a_baseline_reaches(monkeypatch, beside, least):
    """A baseline that was stuck is fitted from the extended model's end, too, and the one that leaves less counts."""
    stuck, other = (SimpleNamespace(sigma=np.array([x]), x=None) for x in (2.0, beside))
    problem = SimpleNamespace(with_finer_differences=lambda: None)
    data: Any = SimpleNamespace(unknowns=Causes(), build_problem=lambda: problem)
    monkeypatch.setattr(cause_search, "refit_again", lambda *_: stuck)
    monkeypatch.setattr(cause_search, "_hold_null", lambda *_: (None, stuck))
    monkeypatch.setattr(cause_search, "fit_loop", lambda *_, **__: other)
    found: Any = LoopSearch(Causes(["delay"]), stuck, {("delay", 0): (9.0, ())})  # type: ignore[arg-type]
    assert cause_search._refit_baseline(data, stuck, found, quiet).sigma == least  # type: ignore[arg-type]


@pytest.mark.parametrize(("late_torque", "named"), [(0.9, "delay"), (1.1, "command_delay")])
def test_what_a_cause_is_mistaken_for_is_fitted_in_its_place(monkeypatch, late_torque, named):
    """A late torque is mistaken for a late command, and the likelihood decides, though the search had found no twin."""
    fit = leave(monkeypatch, {"command_delay": 1.0, "delay": late_torque})
    search = LoopSearch(Causes(["command_delay"]), fit("command_delay"), {("command_delay", 0): (9.0, ())})  # type: ignore[arg-type]
    after = cause_search.part_twins(Data(), search, quiet)  # type: ignore[arg-type]
    assert list(after.taken) == [(named, 0)] and set(after.unknowns) == {named}  # type: ignore[arg-type]


def test_springs_are_looked_for_at_resonances_an_octave_apart():
    """Each start rings with its link at its frequency, the motor held, with a twentieth of critical damping."""
    inertia, viscous, armature = 0.02, 0.4, 1e-3
    values = {"armature": np.array([armature]), "viscous": np.array([viscous])}
    unknowns: Any = SimpleNamespace(n=0, with_values=lambda x: values)
    data: Any = SimpleNamespace(
        law=SimpleNamespace(joints=("a",)), space=SimpleNamespace(n_unknowns=0), records=[SimpleNamespace(interval=0.02)],
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


@pytest.fixture(scope="module")
def three():
    """Return three joints' data, as they are before any cause."""
    arm = build_arm(3)
    law = build_law(arm)
    given = read_loop_logs(arm, record(arm, build_truth(arm), law, 0, 8.0), {"law": law})
    data = prepare_loop(given, given.kept)
    return replace(data, unknowns=keep_kinds(data, BASELINE), whole=True)


def test_goal_profiles_start_from_two_accelerations_unless_the_law_has_one(three):
    """10 and 20 rad/s^2, each with steps that pass and that do not; a law's own limit is the only start."""
    fit: Any = SimpleNamespace(x=three.unknowns.pack())
    starts = list_starts(three, three.unknowns, fit, "goal_profile")
    found = {(float(s["acceleration_limit"][0]), float(s["steps_pass"][0])) for s in starts}
    assert found == {(10.0, 0.0), (10.0, 1.0), (20.0, 0.0), (20.0, 1.0)} and len(starts) == 4
    known = replace(three, law=three.law.with_values(acceleration_limit=np.full(3, 40.0)))
    (start,) = list_starts(known, three.unknowns, fit, "goal_profile")
    assert start["acceleration_limit"].tolist() == [40.0] * 3


def test_trials_keep_what_bodies_do_to_a_motion(three, monkeypatch):
    """Kept where they were simulated, sensitivities to bodies and the others are the same as new ones; elsewhere nearly."""
    problem, x = three.build_problem(), three.unknowns.pack()
    trial = problem.with_inertial(problem.keep_inertial(x))
    for a, b in zip(trial.differentiate(x)[1].rows, problem.differentiate(x)[1].rows, strict=True):
        np.testing.assert_array_equal(a, b)
    x[:3] *= 1.05  # drive inertias
    for a, b in zip(trial.differentiate(x)[1].rows, problem.differentiate(x)[1].rows, strict=True):
        assert 0 < np.linalg.norm(a - b) < 0.2 * np.linalg.norm(b)
    monkeypatch.setattr(fit, "MANY", 3)
    assert problem.keep_inertial(x) is None


def test_steps_of_a_search_are_as_short_as_its_residual_asks(three):
    """Steps fall with the root of the residual, as their error does with their square, and never grow again."""
    fits = [SimpleNamespace(sigma=np.full(3, x)) for x in (1e-2, 2.5e-3, 1e-5)]
    one, two, three_ = (three.with_fine_steps(fit) for fit in fits)
    assert one.step == pytest.approx(2 * two.step) and three_.step == SPRING_STEP_S
    assert three_.with_fine_steps(fits[0]) is three_


@pytest.mark.parametrize(("residual", "enough", "parts"), [(5e-3, True, 1), (5e-3, False, 2), (1e-4, True, 2)])
def test_small_differences_are_spared_where_the_residual_is_large_and_the_answer_there(
    monkeypatch, residual, enough, parts
):
    """Large differences miss less than a millirad: what they say of residuals of five stands, of a tenth it does not."""
    ends: list = []
    problem: Any = SimpleNamespace(with_finer_differences=lambda: "fine")
    answer = SimpleNamespace(sigma=np.full(3, residual), x=np.zeros(1))
    monkeypatch.setattr(servo_data, "fit_loop", lambda *_, **__: ends.append(1) or answer)
    fit_precisely(problem, quiet, lambda near: enough)
    assert len(ends) == parts


@pytest.mark.parametrize(("residual", "fits"), [(5e-3, LOADS_ANEW), (1e-3, MAX_SETTLINGS)])
def test_exact_motions_are_not_sought_beyond_what_a_model_misses(monkeypatch, residual, fits):
    """Fits that never settle end after two where five millirad are missed, and only after all where one is."""
    ends: list = []

    def wander(*_: Any, **__: Any) -> Any:
        ends.append(1)
        return SimpleNamespace(sigma=residual * (1 + 0.01 * np.array([(-1) ** len(ends)])), x=np.array([9.0 * len(ends)]),
                               covariance=np.eye(1))  # fmt: skip

    monkeypatch.setattr(servo_data, "fit_loop", wander)
    monkeypatch.setattr(servo_data, "replace", lambda fit, **_: fit)
    problem: Any = SimpleNamespace(unknowns=SimpleNamespace(clip=lambda x: x), take_slopes=lambda last: problem)
    data: Any = SimpleNamespace(unknowns=SimpleNamespace(is_flexible=True), is_shaken=False, whole=False)
    data.build_problem, data.with_exact_motions = lambda: problem, lambda fit, with_loads: data
    fit_coupled(data, quiet, SimpleNamespace(sigma=np.array([residual]), x=np.zeros(1)))  # type: ignore[arg-type]
    assert len(ends) == fits


@pytest.mark.parametrize(("scatter", "variance"), [(0.01, 1.0), (4.0, 4.0)])
def test_standard_errors_are_at_least_those_of_stationary_noise(scatter, variance):
    """Blocks whose gradients scatter less than white noise's do not shrink an interval; blocks that scatter more widen it."""
    H = np.array([[4.0, 1.0], [1.0, 9.0]])
    found = _compute_covariance(H, scatter * H, np.zeros(2, bool))
    assert np.allclose(found, variance * np.linalg.inv(H))


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


def test_causes_in_long_logs_are_looked_for_in_pieces_from_all_over_them(three):
    """Of two logs of 170 s some 150 s are searched in pieces of 10 s, half of each log, its end too; of commanded speeds all."""
    arm = build_arm(1)
    truth, law = build_truth(arm), build_law(arm)
    logs = [replace(record(arm, truth, law, k, 170.0), name=name) for k, name in enumerate("ab")]
    given = read_loop_logs(arm, logs, {"law": law})
    data = prepare_loop(given, given.kept)
    pieces = data.shorten().records
    spans = {name: [(r.t[0], r.t[-1]) for r in pieces if r.name == name] for name in "ab"}
    for one in spans.values():
        assert sum(end - start for start, end in one) == pytest.approx(75, rel=0.25)
    assert all(end - start < 12 for one in spans.values() for start, end in one)
    assert spans["a"][0][0] == 0 and spans["b"][-1][1] > 169
    speed = replace(data, law=build_law(arm, command="speed"))
    assert speed.shorten() is speed
    assert three.shorten() is three
