"""Unexplained structure, confirmed like a cause, and the test of each residual against its noise.

A structure that the training data show has to be present in the validation data and to predict the test data better.

**Is the residual of each output consistent with its noise?** This is the condition of the verdict `nothing_found`. The
alternative hypothesis is a smooth dependence of the residual on the output's own variables (position, speed, acceleration,
force, temperature, time) and the same times the direction of motion: the columns of the noise model (`null_model.py`). Its
amplitudes are fitted separately to the training and to the held-out data, so a dependence that differs between logs counts as
well. Each score statistic is divided by its overdispersion, and the part that encoder noise alone explains is allowed for by
the parametric bootstrap. An output is inconsistent with its noise if both p-values are below the significance level; the two
data sets are independent, so the level of the test is at most its square. A deviation in one data set alone, such as a load in
one log or a change within a log, is not repeated by the other set, so an output is also inconsistent if either p-value is below
a much smaller level. Reference: Draper & Smith 1998, ch. 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, N_NULL_DRAWS, compute_fit_overdispersion
from tau_dyn.evidence.confirmation import MIN_GAINING_SHARE, Confirmation, confirm_columns
from tau_dyn.evidence.measurements import HELD_OUT, TEST, TRAIN, VALIDATION, Measurements
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap, compute_artefact_chance
from tau_dyn.evidence.null_model import (
    WHOLE_TIME,
    WhiteResidual,
    build_smooth_columns,
    compute_robust_chance,
    compute_score_test,
    fit_noise_models,
)
from tau_dyn.evidence.result import SINGLE_SET_LEVEL, Unexplained
from tau_dyn.evidence.unknown_structure import (
    MIN_2LOGL_DIFFERENCE,
    MIN_LEFT_SHARE,
    Structure,
    find_structure,
    list_indistinguishable,
    place_columns,
)
from tau_dyn.results import Z95

Columns = Sequence[Sequence[np.ndarray]]
"""Columns (n, m, k) of each run, of several effects."""


@dataclass(frozen=True, eq=False)
class StructureTest:
    """A structure and its test.

    Attributes:
        structure: The structure.
        test: Its test on the validation data.
        alike: Other sets of variables that both parts together do not distinguish from it.
    """

    structure: Structure
    test: Confirmation
    alike: tuple[tuple[str, ...], ...] = ()


def find_unexplained(measurements: Measurements, rng: np.random.Generator) -> tuple[Unexplained, ...]:
    """Return the structure in measurements for which no cause is tried, and the outputs that are not consistent with their noise.

    Args:
        measurements: Residuals of a model, with the columns that its fit may change.
        rng: For noise draws.
    """
    noise = fit_noise_models(measurements, (TRAIN,))
    null_models = [WhiteResidual.of_columns(measurements, parts, noise) for parts in ((TRAIN,), HELD_OUT)]
    structure = find_structure(null_models[0], null_models[0].draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
    found = build_unexplained(null_models[0], (), structure and discriminate_structures(null_models[0], (), structure))
    return add_inconsistent(found, assess_noise_consistency(null_models), measurements)


def add_inconsistent(
    found: Sequence[Unexplained], tests: Sequence[NoiseConsistency], measurements: Measurements
) -> tuple[Unexplained, ...]:
    """Return structures and all other outputs with a residual above the noise."""
    known = {u.joint for u in found if u.status == "confirmed"}
    return (*found, *(u for u in list_inconsistent(tests, measurements) if u.joint not in known))


def discriminate_structures(null_model: WhiteResidual, others: Columns, structure: Structure) -> StructureTest:
    """Return the set of variables that the validation data prefer among those that explain as much on the training data.

    The p-value is corrected for all sets that are tried.

    Args:
        null_model: The training data with the causes found in the model.
        others: Columns of these causes.
        structure: The structure.
    """
    several = [structure, *list_indistinguishable(null_model, structure)]
    tests = [confirm_structure(null_model, others, one) for one in several]
    evidence = [
        max(0.0, float(stats.norm.isf(max(test.p_value, 1e-300)))) ** 2 for test in tests
    ]  # twice the log-likelihood
    worth = [one.penalised_statistic + x for one, x in zip(several, evidence, strict=True)]
    k = int(np.argmax(worth))
    near = (one.variables for one, x in zip(several, worth, strict=True) if x > worth[k] - MIN_2LOGL_DIFFERENCE)
    alike = dict.fromkeys(v for v in near if set(v) != set(several[k].variables))
    return StructureTest(several[k], replace(tests[k], p_value=min(1.0, len(several) * tests[k].p_value)), tuple(alike))


def confirm_structure(null_model: WhiteResidual, others: Columns, structure: Structure) -> Confirmation:
    """Test a structure on the validation data, with all causes found in the model.

    A drift in time differs between logs; in another log it only has to be present, not to be the same.
    """
    if _differs_between_logs(null_model.measurements, structure):
        return detect_columns(null_model, structure.columns, others)
    return confirm_columns(null_model, [structure.columns], others)


def detect_columns(null_model: WhiteResidual, columns: Sequence[np.ndarray], others: Columns) -> Confirmation:
    """Test whether columns explain a part of the validation data, with separate amplitudes there."""
    null_model = WhiteResidual.of_columns(null_model.measurements, (VALIDATION,), null_model.noise, others)
    C = null_model.whiten_columns(columns)
    T, _, _ = compute_score_test(null_model, C, np.zeros(C.shape[1], bool), MIN_LEFT_SHARE)
    return Confirmation(1.0, np.nan, float(stats.chi2.sf(T, C.shape[1])))


def _differs_between_logs(measurements: Measurements, structure: Structure) -> bool:
    """Return whether a structure drifts in time, and the validation data are in separate logs."""
    shared = any(np.any(part == TRAIN) and np.any(part == VALIDATION) for part in measurements.parts)
    return "t" in structure.variables and not shared


def build_unexplained(
    null_model: WhiteResidual, others: Columns, tested: StructureTest | None
) -> tuple[Unexplained, ...]:
    """Return the structure, confirmed or suspected."""
    if tested is None:
        return ()
    s = tested.structure
    status = "confirmed" if tested.test.is_confirmed and _gains(null_model, others, s) else "suspected"
    return (
        Unexplained(s.output, s.variables, s.share, s.formula, s.p_value, status, indistinguishable_from=tested.alike),
    )


def _gains(null_model: WhiteResidual, others: Columns, structure: Structure) -> bool:
    """Return whether the test data are predicted better, with the 95 % interval above zero, as with a cause.

    For a drift of another log, the test data have to show the dependence that the validation data of that log show.
    """
    known = VALIDATION if _differs_between_logs(null_model.measurements, structure) else TRAIN
    shown = confirm_columns(null_model, [structure.columns], others, (TEST,), fitted_on=(known,))
    return shown.share - Z95 * shown.stderr > MIN_GAINING_SHARE


CONSISTENCY_LEVEL = 0.01
"""Significance level of each of the two tests of an output, over all outputs (Bonferroni); together at most 1e-4."""


@dataclass(frozen=True)
class NoiseConsistency:
    """Test of one output's residual against its noise.

    Attributes:
        output: The output.
        p_value: Probability of both statistics under noise: the largest p-value of training and held-out data, by the noise model
            and by the scatter of blocks, over all outputs.
        share: Part of the residual's variance that the smooth functions explain: of the held-out data if both sets are
            inconsistent, else of the set with the smaller p-value.
        p_single: The smaller of both p-values by the noise model, over all outputs and both sets.
    """

    output: str
    p_value: float
    share: float
    p_single: float = 1.0

    @property
    def is_repeated(self) -> bool:
        """Whether both data sets are inconsistent with the noise."""
        return self.p_value < CONSISTENCY_LEVEL

    @property
    def is_consistent(self) -> bool:
        """Whether the residual is consistent with the noise."""
        return not self.is_repeated and self.p_single >= SINGLE_SET_LEVEL


def assess_noise_consistency(
    null_models: Sequence[WhiteResidual], effects: Sequence[Effect] = (), noise: NoiseOnlyBootstrap | None = None
) -> tuple[NoiseConsistency, ...]:
    """Test the residual of each output against its noise.

    Args:
        null_models: The training and the held-out data with the confirmed effects in the model, under one noise model.
        effects: The confirmed effects.
        noise: Forces due to encoder noise alone; None for other measurements.
    """
    found = []
    outputs = null_models[0].measurements.outputs
    for k, output in enumerate(outputs):
        tests = [_test(null_model, k, effects, noise) for null_model in null_models]
        both, single = max(max(p) for p, _ in tests), min((p[0], share) for p, share in tests)
        p_value = min(1.0, len(outputs) * both)
        share = tests[1][1] if p_value < CONSISTENCY_LEVEL else single[1]
        found.append(NoiseConsistency(output, p_value, share, min(1.0, len(tests) * len(outputs) * single[0])))
    return tuple(found)


def _test(
    null_model: WhiteResidual, output: int, effects: Sequence[Effect], noise: NoiseOnlyBootstrap | None
) -> tuple[tuple[float, float], float]:
    """Return p-values of the smooth functions of one output's variables, and their share of its residual's variance.

    The first p-value is by the noise model. The second one, by the scatter of blocks, cannot be very small for few of them; a
    data set alone is judged by the first, at a level that leaves room for errors of the model.
    """
    rows = np.flatnonzero(null_model.whiten.index == output)
    power = float(null_model.e[rows] @ null_model.e[rows])
    if not power > 0:
        return (1.0, 1.0), 0.0
    C = null_model.whiten_columns(_build_columns(null_model.measurements, output))
    free = np.zeros(C.shape[1], bool)
    statistic, s, G = compute_score_test(null_model, C, free, MIN_LEFT_SHARE)
    statistic /= compute_fit_overdispersion(null_model, C, s, G)
    share = min(1.0, statistic / power)
    by_blocks = compute_robust_chance(null_model, C, MIN_LEFT_SHARE)
    if noise is None:
        return (float(stats.chi2.sf(statistic, len(free))), by_blocks), share
    made = [_build_columns(clean, output) for clean in noise.channels]
    noise_only_models = noise.fit_null_models(null_model, effects)
    by_noise = compute_artefact_chance(statistic, noise_only_models, null_model, made, free, MIN_LEFT_SHARE)
    return (by_noise, by_blocks), share


def _build_columns(measurements: Measurements, output: int) -> list[np.ndarray]:
    """Return the smooth functions of an output's own variables as columns (n, m, k) of each run."""
    n_outputs = len(measurements.outputs)
    bases = build_smooth_columns(measurements.variables(), measurements.outputs[output])
    return [place_columns(basis, output, n_outputs) for basis in bases]


def list_inconsistent(tests: Sequence[NoiseConsistency], measurements: Measurements) -> tuple[Unexplained, ...]:
    """Return the outputs with a residual above the noise as unexplained structure over their variables, largest share first."""
    names = [name for name in measurements.variables()[0] if name != WHOLE_TIME]
    inconsistent = sorted((test for test in tests if not test.is_consistent), key=lambda test: -test.share)
    return tuple(
        Unexplained(
            test.output,
            tuple(name for name in names if name.split("_", 1)[-1] == test.output),
            test.share,
            "",
            test.p_value if test.is_repeated else test.p_single,
            "confirmed",
        )
        for test in inconsistent
    )
