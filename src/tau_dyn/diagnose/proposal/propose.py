"""The motion that answers the open questions of a diagnosis, within the robot's limits.

Random pieces of every kind of motion are judged by `design.py`; the proposal is the combination of pieces, found by exchanging
one at a time, whose smallest lambda over all pairs of causes is largest (Atkinson & Fedorov 1975; exchange: Fedorov 1972). Each
cause of a pair is taken as true in turn: the one that was found at its fitted amplitude, its alternative at the amplitude at
which it imitates the first on the measured motion.

If no causes are confused, each undetected cause is rated by its information along a motion divided by the most that any piece
has (standardised maximin, Dette 1997), and the worst cause decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from tau_dyn.diagnose.proposal.design import DesignMotion, Setting, build_measured_motions, build_planned_motion
from tau_dyn.diagnose.proposal.plan import (
    Contrast,
    DesignGoal,
    DiscriminationDesign,
    add_mirrored_contrasts,
    build_design_scene,
    build_detection_plan,
    build_discrimination_plan,
    build_refusal,
    find_design_goal,
    find_other_experiment,
    get_required_signals,
)
from tau_dyn.evidence import (
    FAMILY_LEVEL,
    MIN_2LOGL_DIFFERENCE,
    Diagnosis,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.excitation import choose_by_exchange
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.simulate import (
    Trajectory,
    build_fourier_motion,
    build_multisine_on_stroke,
    build_random_binary_motion,
    build_slow_motion,
    build_stroke_motion,
    compute_top_speed,
    concatenate,
)

_N_KINDS = 6  # of motions that are proposed and compared


def _build_piece(kind: int, model: Model, duration: float, rng: np.random.Generator) -> Trajectory:
    """Return a random motion of a kind, at other speeds and frequencies each time."""
    seed = int(rng.integers(2**31))
    if kind == 0:  # sines, the lowest 0.05 to 0.2 Hz, the highest 0.4 to 3 Hz
        slow, fast = 0.05 * 4 ** rng.uniform(), 0.4 * 7.5 ** rng.uniform()
        harmonics = int(rng.integers(3, 8))
        return build_fourier_motion(model, duration, seed, harmonics=harmonics, slow_hz=slow, fast_hz=fast)
    if kind == 1:  # strokes of 0.3 to 6 % of the highest speed
        speeds = np.geomspace(0.003, 0.06, 6) * rng.uniform(0.7, 1.4, 6)
        return build_stroke_motion(model, duration, seed, speeds=tuple(speeds))
    if kind == 2:  # strokes from slow to full speed
        lowest = 0.01 * 20 ** rng.uniform()
        speeds = np.geomspace(lowest, 1.0, int(rng.integers(4, 9)))
        return build_stroke_motion(model, duration, seed, speeds=tuple(speeds))
    if kind == 3:  # random binary speeds of 10 to 90 %
        return build_random_binary_motion(model, duration, seed, share=0.1 * 9 ** rng.uniform())
    if kind == 4:  # slow circles of 1 to 30 % of the highest speed, a reversal a second
        speed = float(compute_top_speed(model).min()) * 0.01 * 30 ** rng.uniform()
        return build_slow_motion(model, duration, seed, speed=speed)
    low = rng.uniform(1.0, 4.0)  # strokes with a multisine of a band between 1 and 14 Hz riding on them
    return build_multisine_on_stroke(model, duration, seed, band_hz=(low, rng.uniform(low + 3, 14.0)))


def build_candidate_pieces(model: Model, duration: float, count: int, rng: np.random.Generator) -> list[Trajectory]:
    """Return `count` motions of this length [s], kinds in turn; those that the robot's limits forbid are left out.

    Raises:
        InputError: The limits forbid all of them, or they are too short.
    """
    found, fault = [], None
    for k in range(count):
        try:
            found.append(_build_piece(k % _N_KINDS, model, duration, rng))
        except InputError as error:
            fault = error
    if not found:
        raise fault or InputError("invalid_value", "a motion is chosen among at least one trial")
    return found


TRAINED = 0.6
"""Share of a log that is searched for causes; the rest confirms and measures."""
_N_TRIALS = 300  # random outcomes; a probability is known to 3 %
_FRESH = 20.0
"""Ratio of detection limits above which the measured motion hardly excited an effect."""


def estimate_identification_probability(strength: float, rival: bool = True) -> float:
    """Return the probability that a search on a log of this lambda ranks the true cause clearly above its alternative.

    Twice the log-likelihood ratio of the two is normal about lambda with variance 4 lambda (Cox 1962); the causes are
    distinguished from `MIN_2LOGL_DIFFERENCE` up. Without an alternative it is the power of the search itself, which counts
    about `_N_TRIALS` tries.
    """
    trained = TRAINED * strength
    if not rival:
        return float(stats.ncx2.sf(stats.chi2.isf(FAMILY_LEVEL / _N_TRIALS, 1), 1, trained))
    return float(stats.norm.cdf((trained - MIN_2LOGL_DIFFERENCE) / (2 * np.sqrt(trained)))) if trained > 0 else 0.0


def list_motion_notes(
    plan: DiscriminationDesign, question: DesignGoal, new: np.ndarray, old: np.ndarray | None
) -> list[str]:
    """Return the expected results of a motion.

    Args:
        plan: The plan that was judged.
        question: The open question.
        new: Strength of each line along the proposed motion.
        old: The same along the measured motion, in the same time; None if unknown.
    """
    if not question.pairs:
        return _sight(plan, new, old)
    notes = []
    for k, line in enumerate(plan.lines):
        against = f"from {line.rival}" if line.rival else "from noise"
        text = f"if {line.cause} is the cause, this motion separates it {against}: noncentrality {_sure(new[k], line)}"
        notes.append(text if old is None else f"{text}; the measured motion, in the same time: {_sure(old[k], line)}")
    told = {name for line in plan.lines for name in (line.cause, line.rival)}
    cause = question.pairs[0][0].cause
    lost = [(r, find_other_experiment(cause, r)) for _, r in question.pairs if r and r not in told]
    return [*notes, *(f"no motion separates {cause} from {twin}: {how}" for twin, how in (*lost, *question.beyond))]


def _sight(plan: DiscriminationDesign, new: np.ndarray, old: np.ndarray | None) -> list[str]:
    """Return the ratio of detection limits to those of the measured motion; the joint that gains least counts for each cause."""
    causes = dict.fromkeys(line.cause for line in plan.lines)
    if old is None:
        return [f"this motion excites {', '.join(causes)}"]
    left = np.sqrt(np.maximum(old, 0.0) / np.maximum(new, 1e-300))
    ratio = {c: max(x for x, line in zip(left, plan.lines, strict=True) if line.cause == c) for c in causes}
    fresh = [c for c in causes if ratio[c] < 1 / _FRESH]
    before = sorted((x, c) for c, x in ratio.items() if c not in fresh)
    notes = [f"this motion excites causes that the measured one hardly excites: {', '.join(fresh)}"] if fresh else []
    if before:
        (low, best), (high, worst) = before[0], before[-1]
        middle = float(np.median([x for x, _ in before]))
        notes.append(
            f"detection limits, relative to those of the measured motion in the same time: {middle:.2g} in the median of "
            f"{len(before)} cause(s), from {low:.2g} ({best}) to {high:.2g} ({worst})"
        )
    return notes


def _sure(strength: float, line: Contrast) -> str:
    chance = 100 * estimate_identification_probability(strength, bool(line.rival))
    size = "over 99 %" if chance > 99 else "under 1 %" if chance < 1 else f"{chance:.0f} %"
    return f"{strength:.3g} (probability of correct identification {size})"


PIECE_S = 14.0
"""Length of a piece, about [s]."""
_MIN_DURATION_S = 6.0  # [s], the shortest proposed motion
_REST_S = 0.5  # [s] of rest between two motions
_STILL_S = 0.1  # the move between two pieces that end and start at home


def propose_motion(
    diagnosis: Diagnosis,
    logs: Iterable[Log] = (),
    *,
    duration: float = 60.0,
    trials: int = 24,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Trajectory:
    """Return the motion that best distinguishes the causes that a diagnosis could not, with notes on the expected certainty.

    Args:
        diagnosis: Diagnosis of measured forces.
        logs: The diagnosed logs; with them each alternative is taken as true in turn, and the notes compare with the measured
            motion.
        duration: Length [s], at least 6.
        trials: Random pieces to choose from.
        seed: Seed of the pieces.
        progress: Called with a word for each step.

    Returns:
        A motion of about this length that starts and ends at rest at home; its notes state the expected lambda.

    Raises:
        CannotAnswer: No motion can answer the open question; the message names the experiment that would.
        InputError: The motion is too short, or the robot's limits permit no motion.
    """
    if not _MIN_DURATION_S <= duration <= 3600:
        raise InputError(
            "invalid_value", f"a proposed motion takes between {_MIN_DURATION_S:g} s and an hour, not {duration:g} s"
        )
    if trials < 1:
        raise InputError("invalid_value", f"a motion is chosen among at least one trial, not {trials}")
    signals = _signals(diagnosis.model)
    question = find_design_goal(diagnosis, signals)
    setting, rng = Setting.of(diagnosis), np.random.default_rng(seed)
    number = max(1, round(duration / PIECE_S))
    length = (duration - (number - 1) * (_REST_S + _STILL_S)) / number
    progress("motions to choose from")
    pieces = build_candidate_pieces(diagnosis.extended_model, length, trials, rng)
    progress("their effects")
    needs = get_required_signals(question)
    recorded = build_measured_motions(setting, logs, needs)
    offered = [build_planned_motion(setting, piece, needs) for piece in pieces]
    scene = build_design_scene(setting, [*(p.motion for p in offered), *(p.motion for p in recorded)], signals)
    plan = (
        build_discrimination_plan(setting, question, scene)
        if question.pairs
        else build_detection_plan(setting, question, scene)
    )
    if recorded:
        plan = add_mirrored_contrasts(plan, recorded)
    grams = np.array([plan.gram([piece]) for piece in offered])
    plan = _answerable(plan, grams, question)
    progress("choosing")
    most = number * plan.most(grams)
    chosen = sorted(choose_by_exchange(lambda total: plan.merit(total, most), grams, number))
    motion = concatenate([pieces[k] for k in chosen], rest=_REST_S, rate_hz=1000.0, name="proposed")
    new = plan.strengths(plan.gram([build_planned_motion(setting, motion, needs)]))
    old = _of_measured(plan, recorded, motion.duration)
    kinds = ", ".join(pieces[k].name for k in chosen)
    made = f"put together of {kinds}, the best of {len(pieces)} random pieces by exchange"
    return replace(motion, notes=(*list_motion_notes(plan, question, new, old), made))


def _signals(model: Model) -> frozenset[str]:
    """Return the signals of a motion that are available to effects without further sensors."""
    return frozenset(
        {"force", "rigid_force", "inertia", "weight_gradient", "load", "reducer_torque", "reversal"}
        | ({"passive"} if model.robot.loops else set())
    )


def _of_measured(plan: DiscriminationDesign, recorded: Sequence[DesignMotion], duration: float) -> np.ndarray | None:
    """Return strengths of the measured motion, scaled to the duration of the proposal [s]."""
    if not recorded:
        return None
    took = sum(float(motion.t[-1] - motion.t[0]) for motion, _ in recorded if motion.t is not None)
    return plan.strengths(plan.gram(recorded) * (duration / took))


def _answerable(plan: DiscriminationDesign, grams: np.ndarray, question: DesignGoal) -> DiscriminationDesign:
    """Leave out causes that no motion excites, or raise if no cause remains."""
    kept = plan.showing(grams.sum(axis=0))
    if kept.lines:
        return kept
    if not question.pairs:
        names = ", ".join(c.name for c in question.causes)
        raise CannotAnswer(
            "no_solution",
            f"no motion of this robot shows {names} with this model",
            "; ".join(dict.fromkeys(c.reveals for c in question.causes)),
        )
    cause = question.pairs[0][0].cause
    twins = dict.fromkeys(rival for _, rival in question.pairs if rival and rival != cause)
    raise build_refusal(cause, [*((t, find_other_experiment(cause, t)) for t in twins), *question.beyond])
