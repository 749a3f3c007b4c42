"""The motion that answers what a diagnosis left open, within the robot's limits.

Random pieces of every kind of motion are judged by `design.py`; the proposal is the combination of pieces, found by exchanging
one at a time, whose smallest lambda over all pairs of causes is largest (Atkinson & Fedorov 1975; exchange: Fedorov 1972).
Either cause of a pair is taken as true in turn: the one that was found at its fitted amplitude, its twin at the amplitude with
which it imitates the first on the measured motion.

Where nothing is confused, each cause not seen counts by what a motion shows of it over the most that any piece shows
(standardised maximin, Dette 1997), and the worst cause decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.candidates import build_candidate_pieces
from tau_dyn.diagnose.design import (
    Setting,
    add_computed_signals,
    build_measured_motion,
    build_planned_motion,
    compute_gram_matrix,
)
from tau_dyn.diagnose.filters import smooth_cutoff
from tau_dyn.diagnose.plan import (
    DesignMotion,
    DiscriminationDesign,
    add_mirrored_contrasts,
    build_design_scene,
    build_detection_plan,
    build_discrimination_plan,
    get_required_signals,
)
from tau_dyn.diagnose.proposal_words import list_motion_notes
from tau_dyn.diagnose.question import DesignGoal, build_refusal, find_design_goal, find_other_experiment
from tau_dyn.diagnose.result import Diagnosis
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log, resample_segments
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory, concatenate

PIECE_S = 14.0
"""Length of a piece, about [s]."""
_MIN_DURATION_S = 6.0  # [s] of the shortest motion that is proposed
_REST_S = 0.5  # [s] of rest between two motions
_STILL_S = 0.1  # the move between two pieces that end and start at home
_LOOKED_AT_S = 120.0  # [s] of the logs by which motions are judged; bounds time
_SWEEPS = 5  # of the exchange over all motions; bounds the time


def propose_motion(
    diagnosis: Diagnosis,
    logs: Iterable[Log] = (),
    *,
    duration: float = 60.0,
    trials: int = 24,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Trajectory:
    """Return the motion that best tells apart what a diagnosis could not, with notes on how sure the answer will be.

    Args:
        diagnosis: Of measured forces.
        logs: The diagnosed logs; with them twins are taken as true in turn, and the notes compare with the measured motion.
        duration: Length [s], at least 6.
        trials: Random pieces to choose from.
        seed: Of the pieces.
        progress: Called with a word for each step.

    Returns:
        A motion of about this length that starts and ends at rest at home; its notes say the expected lambda.

    Raises:
        CannotAnswer: What is open is no matter of motion; the experiment that would tell is named.
        InputError: The motion is too short, or the robot's limits leave none.
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
    progress("what they show")
    needs = get_required_signals(question)
    recorded = _measured(setting, logs, needs)
    offered = [_prepared(setting, piece, needs) for piece in pieces]
    scene = build_design_scene(setting, [*(p.motion for p in offered), *(p.motion for p in recorded)], signals)
    plan = (
        build_discrimination_plan(setting, question, scene)
        if question.pairs
        else build_detection_plan(setting, question, scene)
    )
    if recorded:
        plan = add_mirrored_contrasts(plan, recorded)
    grams = np.array([compute_gram_matrix(setting, p.motion, p.counts, plan.things) for p in offered])
    plan = _answerable(plan, grams, question)
    progress("choosing")
    chosen = optimise_by_exchange(plan, grams, number)
    motion = concatenate([pieces[k] for k in sorted(chosen)], rest=_REST_S, rate_hz=1000.0, name="proposed")
    whole = _prepared(setting, motion, needs)
    new = plan.strengths(compute_gram_matrix(setting, whole.motion, whole.counts, plan.things))
    old = _of_measured(setting, plan, recorded, motion.duration)
    kinds = ", ".join(pieces[k].name for k in sorted(chosen))
    made = f"put together of {kinds}, the best of {len(pieces)} random pieces by exchange"
    return replace(motion, notes=(*list_motion_notes(plan, question, new, old), made))


def optimise_by_exchange(plan: DiscriminationDesign, grams: np.ndarray, number: int) -> list[int]:
    """Return the pieces (with repetition) whose sum has the largest merit, by exchanging one at a time until nothing helps."""
    most = number * plan.most(grams)
    merits = [plan.merit(number * one, most) for one in grams]
    chosen = [int(np.argmax(merits))] * number
    best = max(merits)
    for _ in range(_SWEEPS):
        before = best
        for slot in range(number):
            rest = sum((grams[k] for j, k in enumerate(chosen) if j != slot), np.zeros_like(grams[0]))
            found = [plan.merit(rest + one, most) for one in grams]
            if max(found) > best * (1 + 1e-9):
                chosen[slot], best = int(np.argmax(found)), max(found)
        if best <= before * (1 + 1e-3):
            break
    return chosen


def _signals(model: Model) -> frozenset[str]:
    """Return what effects may feel of a motion without further sensors."""
    return frozenset(
        {"force", "rigid_force", "inertia", "weight_gradient", "load", "reversal"}
        | ({"passive"} if model.robot.loops else set())
    )


def _prepared(setting: Setting, trajectory: Trajectory, needs: frozenset[str]) -> DesignMotion:
    motion, counts = build_planned_motion(setting, trajectory)
    return DesignMotion(add_computed_signals(setting, motion, needs), counts)


def _measured(setting: Setting, logs: Iterable[Log], needs: frozenset[str]) -> list[DesignMotion]:
    """Return the measured motions, at most two minutes of them."""
    stretches = [piece for log in logs for piece in resample_segments(log)]
    if not stretches:
        return []
    smooth_hz, found = smooth_cutoff(setting.model.robot, stretches), []
    for log in stretches:
        motion, counts = build_measured_motion(setting, log, smooth_hz)
        n = max(16, int(_LOOKED_AT_S * setting.rate_hz / len(stretches)))
        arrays = {key: x[:n] for key, x in motion.signals.items()}
        part = replace(
            motion, **{key: getattr(motion, key)[:n] for key in ("q", "v", "a", "sign", "t")}, signals=arrays
        )
        found.append(DesignMotion(add_computed_signals(setting, part, needs), counts[:n]))
    return found


def _of_measured(
    setting: Setting, plan: DiscriminationDesign, recorded: Sequence[DesignMotion], duration: float
) -> np.ndarray | None:
    """Return strengths of the measured motion, in the time that the proposal takes [s]."""
    if not recorded:
        return None
    total = np.sum([compute_gram_matrix(setting, p.motion, p.counts, plan.things) for p in recorded], axis=0)
    took = sum(float(p.motion.t[-1] - p.motion.t[0]) for p in recorded if p.motion.t is not None)
    return plan.strengths(total * (duration / took))


def _answerable(plan: DiscriminationDesign, grams: np.ndarray, question: DesignGoal) -> DiscriminationDesign:
    """Leave out what no motion shows, or refuse where nothing is left."""
    kept = plan.showing(grams.sum(axis=0))
    if kept.lines:
        return kept
    if not question.pairs:
        names = ", ".join(c.name for c in question.causes)
        raise CannotAnswer(
            "no_solution",
            f"no motion of this robot shows {names} beside this model",
            "; ".join(dict.fromkeys(c.reveals for c in question.causes)),
        )
    cause = question.pairs[0][0].cause
    twins = dict.fromkeys(rival for _, rival in question.pairs if rival and rival != cause)
    raise build_refusal(cause, [*((t, find_other_experiment(cause, t)) for t in twins), *question.beyond])
