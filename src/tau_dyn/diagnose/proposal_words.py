"""How sure a proposed motion's answer will be, in words."""

from __future__ import annotations

import numpy as np
from scipy import stats

from tau_dyn.diagnose.forward_step import MIN_2LOGL_DIFFERENCE
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL
from tau_dyn.diagnose.plan import Contrast, DiscriminationDesign
from tau_dyn.diagnose.question import DesignGoal, find_other_experiment

TRAINED = 0.6
"""Share of a log that is searched for causes; the rest confirms and measures."""
_N_TRIALS = 300  # random outcomes; a probability is known to 3 %
_FRESH = 20.0
"""Times smaller that an effect is seen, above which the measured motion hardly showed it."""


def estimate_identification_probability(strength: float, rival: bool = True) -> float:
    """Return how probably a search on a log of this lambda ranks the true cause clearly above its rival.

    Twice the log-likelihood ratio of the two is normal about lambda with variance 4 lambda (Cox 1962); twins are told apart
    from `MIN_2LOGL_DIFFERENCE` up. Without a rival it is the power of the search itself, about `_N_TRIALS` tries counted.
    """
    trained = TRAINED * strength
    if not rival:
        return float(stats.ncx2.sf(stats.chi2.isf(FAMILY_LEVEL / _N_TRIALS, 1), 1, trained))
    return float(stats.norm.cdf((trained - MIN_2LOGL_DIFFERENCE) / (2 * np.sqrt(trained)))) if trained > 0 else 0.0


def list_motion_notes(
    plan: DiscriminationDesign, question: DesignGoal, new: np.ndarray, old: np.ndarray | None
) -> list[str]:
    """Return what to expect of a motion.

    Args:
        plan: What was judged.
        question: What is open.
        new: Strength of each line along the proposed motion.
        old: The same along the measured motion, in the same time; None where it is not known.
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
    """Return how much smaller effects show than along the measured motion; of each cause the joint that gains least counts."""
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
