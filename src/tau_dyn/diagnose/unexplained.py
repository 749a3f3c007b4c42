"""What is said of a structure without a name: which variables it depends on, and whether other data bear it out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.diagnose.candidate_scan import get_columns
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation, confirm, detect_effect
from tau_dyn.diagnose.data_split import TEST, TRAIN, VALIDATION
from tau_dyn.diagnose.result import Unexplained
from tau_dyn.diagnose.stepwise_selection import StepwiseSelection, build_effects
from tau_dyn.diagnose.unknown_structure import MIN_2LOGL_DIFFERENCE, Structure, list_indistinguishable

MIN_GAINING_SHARE = 0.5
"""Share of a predicted force that must be true for its prediction to lower the error."""
Z95 = 1.959964  # 97.5 % quantile of the normal distribution


@dataclass(frozen=True, eq=False)
class StructureTest:
    """A structure and its test.

    Attributes:
        structure: The structure.
        test: Its test on the confirmation part.
        alike: Other sets of variables that both parts together do not tell apart from it.
    """

    structure: Structure
    test: Confirmation
    alike: tuple[tuple[str, ...], ...] = ()


def discriminate_structures(channel: Channel, hunt: StepwiseSelection, structure: Structure) -> StructureTest:
    """Return which of the sets of variables that explain as much on the training part it is by the confirmation part as well.

    As many of them as are tried count in its chance.
    """
    several = [structure, *list_indistinguishable(channel, hunt.ground, structure)]
    tests = [confirm_structure(channel, hunt, one) for one in several]
    worth = [one.penalised_statistic + _evidence(test) for one, test in zip(several, tests, strict=True)]
    k = int(np.argmax(worth))
    near = (one.variables for one, x in zip(several, worth, strict=True) if x > worth[k] - MIN_2LOGL_DIFFERENCE)
    alike = dict.fromkeys(v for v in near if set(v) != set(several[k].variables))
    return StructureTest(several[k], replace(tests[k], p_value=min(1.0, len(several) * tests[k].p_value)), tuple(alike))


def _evidence(test: Confirmation) -> float:
    """Return what a test says for a structure, in twice the log-likelihood."""
    return max(0.0, float(stats.norm.isf(max(test.p_value, 1e-300)))) ** 2


def confirm_structure(channel: Channel, hunt: StepwiseSelection, structure: Structure) -> Confirmation:
    """Test a structure on the confirmation part, all causes found accounted for.

    A drift in time is another one in another log; there it only has to be present, not to be the same.
    """
    others = get_columns(hunt.library, build_effects(hunt.found))
    test = detect_effect if _drifts_anew(channel, structure) else confirm
    return test(channel, hunt.noise, [structure.columns], others)


def _drifts_anew(channel: Channel, structure: Structure) -> bool:
    """Tell whether a structure drifts in time, and the confirmation part lies in logs of its own."""
    shared = any(np.any(part == TRAIN) and np.any(part == VALIDATION) for part in channel.parts)
    return "t" in structure.variables and not shared


def build_unexplained(channel: Channel, hunt: StepwiseSelection, told: StructureTest | None) -> tuple[Unexplained, ...]:
    """Return the structure, confirmed or not."""
    if told is None:
        return ()
    s = told.structure
    status = "confirmed" if told.test.is_confirmed and _borne_out(channel, hunt, told) else "suspected"
    return (
        Unexplained(s.output, s.variables, s.share, s.formula, s.p_value, status, indistinguishable_from=told.alike),
    )


def _borne_out(channel: Channel, hunt: StepwiseSelection, told: StructureTest) -> bool:
    """Tell whether the last part is predicted better, with the 95 % interval above zero, as it has to be with a cause.

    Of another log's drift, it has to show what the confirmation part of that log says.
    """
    others = get_columns(hunt.library, build_effects(hunt.found))
    known = VALIDATION if _drifts_anew(channel, told.structure) else TRAIN
    shown = confirm(channel, hunt.noise, [told.structure.columns], others, TEST, fitted_on=(known,))
    return shown.share - Z95 * shown.stderr > MIN_GAINING_SHARE
