r"""Confirmation: is the effect that was fitted on the training data present in the held-out data, in the predicted size?

With `C gamma` the effect fitted on the training data and `B` everything else, the misfit predicted on other data is

    x = C gamma - B (B_t^+ C_t gamma),

what the baseline's training refit leaves of it. The held-out residual of the baseline's training fit is regressed on `x`, with
`B` free to move as far as the training fit was uncertain (its information as prior rows), and freely back by what the effect
shifted it: if the effect were in the training data alone, that shift would be in the residual and resemble a part of `x`. The
coefficient is 1 if all of the effect is there and 0 if none; a one-sided t-test. Its variance counts how blocks scatter, in the
held-out data and, with the weight of at most ten blocks, in the training data: a misfit that changes along the way is no noise.

A law of many amplitudes may be known badly just where the held-out data go: its `x` would be mostly error. With information
`G` on `gamma` in the training data and `H` in the held-out ones, the two estimates of a direction agree as far as both know it,
with the weight `1 / (1/g + 1/h)`; so the residual is regressed on `x~`, made of `(G + H)^-1 G gamma`, and the share is that of
`x` still (`x~` as its instrument).

Held-out logs may move in a way that does not show a cause at all; this is no evidence against it. Then a quarter of the blocks
of the training logs is held out, the selection is repeated on the rest, and a cause that it selects again, at the same
family-wise level, must be present in these blocks in the predicted size. On clean data that is as rare as the first procedure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.estimate import Whitener, scale_columns
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, N_NULL_DRAWS
from tau_dyn.evidence.channel import TEST, TRAIN, VALIDATION, Channel, divide_training
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap
from tau_dyn.evidence.null_model import (
    MIN_UNABSORBED_SHARE,
    PRIOR_WEIGHT_BLOCKS,
    NullModel,
    compute_score_test,
)
from tau_dyn.evidence.result import Unexplained
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection, build_effects, select_causes
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE, Structure, find_structure, list_indistinguishable
from tau_dyn.results import Z95

SIGNIFICANCE_LEVEL = 0.02  # of a confirmation, one test on data not used by the selection
_MIN_EXPECTED_Z = 4.0
"""Standard errors that the whole of an effect has to amount to for its absence to count against it."""
_LEFT = 0.01
"""Part of a column that everything else must leave for it to count."""


@dataclass(frozen=True)
class Confirmation:
    """Share of a predicted effect seen on held-out data, its standard error, and the chance of it by noise.

    `within` says that the data were blocks of the training logs, set aside because the held-out logs could not show it.
    """

    share: float
    stderr: float
    p_value: float
    within: bool = False

    @property
    def is_confirmed(self) -> bool:
        """Whether held-out data agree."""
        return self.p_value < SIGNIFICANCE_LEVEL

    @property
    def is_inconclusive(self) -> bool:
        """Whether these data neither show the effect nor could have been relied on to show it."""
        return not self.is_confirmed and not self.stderr < 1 / _MIN_EXPECTED_Z

    @property
    def leaves_gain_open(self) -> bool:
        """Whether its 95 % interval holds the share from which the effect lowers the error."""
        return not abs(self.share - MIN_GAINING_SHARE) > Z95 * self.stderr


def confirm(
    ground: NullModel,
    columns: Sequence[Sequence[np.ndarray]],
    others: Sequence[Effect],
    parts: tuple[int, ...] = (VALIDATION,),
    fitted_on: tuple[int, ...] = (TRAIN,),
) -> Confirmation:
    """Test columns (lists over runs of (n, m, k)) beside other effects on parts of the data, under the ground's noise."""
    channel, beside = ground.channel, [ground.library.columns(effect) for effect in others]
    train, held = (Whitener.of(channel.runs, channel.masks(*which), ground.noise) for which in (fitted_on, parts))
    prior_rows, prior_y = channel.prior
    B_t, B_c = (np.concatenate([w(channel.free_columns), *(w(c) for c in beside)], axis=1) for w in (train, held))
    C_t, C_c = (np.concatenate([w(c) for c in columns], axis=1) for w in (train, held))
    y_t, y_c = train(channel.target), held(channel.target)
    k = B_t.shape[1]
    prior = np.concatenate([prior_rows, np.zeros((len(prior_y), k - prior_rows.shape[1]))], axis=1)
    B_all = np.concatenate([B_t, prior])
    unit, norm = scale_columns(B_all)
    inverse = np.linalg.pinv(unit, rcond=1e-7) / norm[:, None]
    moved = inverse @ np.concatenate([C_t, np.zeros((len(prior_y), C_t.shape[1]))])
    theta = inverse @ np.concatenate([y_t, prior_y])
    left = B_c, np.asarray(np.linalg.qr(B_all, mode="r"))
    H = _information(C_c, B_c @ moved, *left)
    alone, r_t = C_t - B_t @ moved, y_t - B_t @ theta
    whole, shrunk = _amplitudes(alone, r_t, np.linalg.norm(C_t, axis=0), H)
    scatter = _Scatter.of(train.block, alone @ shrunk, r_t - alone @ whole)
    shift = moved @ shrunk
    x, predicted = C_c @ shrunk - B_c @ shift, C_c @ whole - B_c @ (moved @ whole)
    return _regress(np.column_stack([x, B_c @ shift]), predicted, y_c - B_c @ theta, *left, held.block, scatter)


def _information(C: np.ndarray, shifts: np.ndarray, B: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return what columns (n, k) leave beside free `shifts` (n, k) and `B` (n, p) with prior `R`: their Gram matrix (k, k)."""
    rows = np.concatenate([np.column_stack([shifts, B]), np.column_stack([np.zeros((len(R), shifts.shape[1])), R])])
    own, (unit, _) = np.concatenate([C, np.zeros((len(R), C.shape[1]))]), scale_columns(rows)
    rest = own - unit @ np.linalg.lstsq(unit, own, rcond=1e-9)[0]
    return rest.T @ rest


def _amplitudes(left: np.ndarray, r: np.ndarray, own: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return amplitudes (k,) of columns of which the baseline leaves `left` (n, k), and those weighed by what `H` knows.

    Only in the directions that the baseline does not absorb: gains of all drives, say, are the masses; a sum that only the
    encoders' noise keeps apart would be fitted to that noise.
    """
    scale = np.where(own > 0, own, 1.0)
    values, vectors = np.linalg.eigh((left / scale).T @ (left / scale))
    values, vectors = values[values > MIN_UNABSORBED_SHARE], vectors[:, values > MIN_UNABSORBED_SHARE]
    s = vectors.T @ ((left / scale).T @ r)
    both = np.diag(values) + vectors.T @ (H / np.outer(scale, scale)) @ vectors
    return vectors @ (s / values) / scale, vectors @ np.linalg.solve(both, s) / scale


@dataclass(frozen=True)
class _Scatter:
    """Variance of blocks' scores over what white rows of the same variance give, and how many blocks that is worth."""

    ratio: float
    count: float

    @classmethod
    def of(cls, block: np.ndarray, x: np.ndarray, rest: np.ndarray) -> _Scatter:
        """Measure it along a direction (R,) whose coefficient the residual `rest` (R,) was fitted with, in blocks of rows (R,).

        The fit takes each block's leverage from its score (Bell and McCaffrey, 2002). A misfit along the direction that changes
        from block to block makes scores in proportion to the blocks' squares; the count is that of Satterthwaite (1946) for them.
        """
        _, block = np.unique(block, return_inverse=True)
        square = np.bincount(block, x**2)
        left = 1 - square / max(float(x @ x), 1e-300)
        square, left, scores = (z[left > _LEFT] for z in (square, left, np.bincount(block, x * rest)))
        variance = float(rest @ rest) / max(1, len(rest) - 1)
        expected = variance * float(np.sum(square))
        if expected <= 0:
            return cls(1.0, 0.0)
        return cls(float(np.sum(scores**2 / left)) / expected, float(np.sum(square**2) ** 2 / np.sum(square**4)))


def _regress(
    free: np.ndarray,
    predicted: np.ndarray,
    r: np.ndarray,
    B: np.ndarray,
    R: np.ndarray,
    block: np.ndarray,
    trained: _Scatter,
) -> Confirmation:
    """Regress `r` (n,) on free columns (n, 2), the first an instrument for `predicted` (n,), and on `B` (n, k) with prior `R`."""
    rows = np.concatenate([np.column_stack([free, B]), np.column_stack([np.zeros((len(R), 2)), R])])
    y = np.concatenate([r, np.zeros(len(R))])
    unit, norm = scale_columns(rows)
    solution = np.linalg.lstsq(unit, y, rcond=1e-9)[0] / norm
    rest = (y - rows @ solution)[: len(r)]
    others = rows[:, 1:] / norm[1:]
    along = rows[:, 0] - others @ np.linalg.lstsq(others, rows[:, 0], rcond=1e-9)[0]
    square, seen = float(along @ along), float(along[: len(r)] @ predicted)
    if square <= 0 or seen <= 0:
        return Confirmation(0.0, np.inf, 1.0)
    variance = max(float(rest @ rest) / max(1, len(r) - 1), 1e-300)
    scatter = _Scatter.of(block, along[: len(r)], rest)
    weight = min(trained.count, PRIOR_WEIGHT_BLOCKS)
    inflation = max(1.0, (scatter.count * scatter.ratio + weight * trained.ratio) / (scatter.count + weight))
    share, stderr = float(solution[0]) * square / seen, float(np.sqrt(inflation * variance * square)) / seen
    dof = max(2.0, scatter.count + weight - 1)
    return Confirmation(share, stderr, float(stats.t.sf(share / stderr, dof)))


def detect_effect(ground: NullModel, columns: Sequence[Sequence[np.ndarray]], others: Sequence[Effect]) -> Confirmation:
    """Test whether columns explain anything of the held-out data, with amplitudes of their own there."""
    ground = NullModel.of(ground.library, (VALIDATION,), ground.noise, others)
    C = np.concatenate([ground.whiten_columns(c) for c in columns], axis=1)
    T, _, _ = compute_score_test(ground, C, np.zeros(C.shape[1], bool), _LEFT)
    return Confirmation(1.0, np.nan, float(stats.chi2.sf(T, C.shape[1])))


MIN_GAINING_SHARE = 0.5
"""Share of a predicted force that must be true for its prediction to lower the error."""


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


def discriminate_structures(hunt: StepwiseSelection, structure: Structure) -> StructureTest:
    """Return which of the sets of variables that explain as much on the training data it is by the validation data as well.

    As many of them as are tried count in its chance.
    """
    several = [structure, *list_indistinguishable(hunt.ground, structure)]
    tests = [confirm_structure(hunt, one) for one in several]
    evidence = [
        max(0.0, float(stats.norm.isf(max(test.p_value, 1e-300)))) ** 2 for test in tests
    ]  # twice the log-likelihood
    worth = [one.penalised_statistic + x for one, x in zip(several, evidence, strict=True)]
    k = int(np.argmax(worth))
    near = (one.variables for one, x in zip(several, worth, strict=True) if x > worth[k] - MIN_2LOGL_DIFFERENCE)
    alike = dict.fromkeys(v for v in near if set(v) != set(several[k].variables))
    return StructureTest(several[k], replace(tests[k], p_value=min(1.0, len(several) * tests[k].p_value)), tuple(alike))


def confirm_structure(hunt: StepwiseSelection, structure: Structure) -> Confirmation:
    """Test a structure on the validation data, all causes found accounted for.

    A drift in time is another one in another log; there it only has to be present, not to be the same.
    """
    test = detect_effect if _drifts_anew(hunt.channel, structure) else confirm
    return test(hunt.ground, [structure.columns], build_effects(hunt.found))


def _drifts_anew(channel: Channel, structure: Structure) -> bool:
    """Tell whether a structure drifts in time, and the validation data are in logs of their own."""
    shared = any(np.any(part == TRAIN) and np.any(part == VALIDATION) for part in channel.parts)
    return "t" in structure.variables and not shared


def build_unexplained(hunt: StepwiseSelection, told: StructureTest | None) -> tuple[Unexplained, ...]:
    """Return the structure, confirmed or not."""
    if told is None:
        return ()
    s = told.structure
    status = "confirmed" if told.test.is_confirmed and _borne_out(hunt, told) else "suspected"
    return (
        Unexplained(s.output, s.variables, s.share, s.formula, s.p_value, status, indistinguishable_from=told.alike),
    )


def _borne_out(hunt: StepwiseSelection, told: StructureTest) -> bool:
    """Tell whether the test data are predicted better, with the 95 % interval above zero, as with a cause.

    Of another log's drift, it has to show what the validation data of that log show.
    """
    known = VALIDATION if _drifts_anew(hunt.channel, told.structure) else TRAIN
    others = build_effects(hunt.found)
    shown = confirm(hunt.ground, [told.structure.columns], others, (TEST,), fitted_on=(known,))
    return shown.share - Z95 * shown.stderr > MIN_GAINING_SHARE


@dataclass(frozen=True)
class ConfirmationResults:
    """What held-out data say of each cause found, and of the structure without a name."""

    causes: tuple[Confirmation, ...]
    structure: StructureTest | None


def confirm_cause(hunt: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Test one cause on the validation data, the others accounted for."""
    return confirm(hunt.ground, hunt.columns(one.candidate.effects), hunt.others(one))


def drop_unconfirmed_joints(hunt: StepwiseSelection, one: SelectedCause) -> SelectedCause:
    """Return a confirmed cause without the joints at which the validation data contradict it.

    Each joint is tested with all other causes and the cause's other joints in the model. A joint whose validation data have too
    little power to show the effect stays: its cause is confirmed elsewhere.
    """
    fits = one.candidate.fits
    if len(fits) < 2:
        return one
    kept = []
    for fit in fits:
        rest = [other.effect for other in fits if other is not fit]
        test = confirm(hunt.ground, hunt.columns([fit.effect]), [*hunt.others(one), *rest])
        if test.is_confirmed or test.is_inconclusive:
            kept.append(fit)
    return replace(one, candidate=replace(one.candidate, fits=tuple(kept) or fits))


def confirm_all(hunt: StepwiseSelection, structure: Structure | None) -> ConfirmationResults:
    """Test everything found on the validation data."""
    causes = tuple(confirm_cause(hunt, one) for one in hunt.found)
    return ConfirmationResults(causes, structure and discriminate_structures(hunt, structure))


def confirm_within_training(
    hunt: StepwiseSelection,
    tests: ConfirmationResults,
    gap_s: float,
    rng: np.random.Generator,
    noise: NoiseOnlyBootstrap,
) -> ConfirmationResults:
    """Return the tests, those on which the validation data have too little power are repeated within the training logs.

    Args:
        hunt: The search on all of the training data.
        tests: The tests on the validation data.
        gap_s: Memory of the filters, left out beside a block's border [s].
        rng: For noise draws.
        noise: What encoder noise alone makes.
    """
    every = [*tests.causes, *([tests.structure.test] if tests.structure else [])]
    channel = hunt.channel
    whole = any(np.all(part == TRAIN) for part in channel.parts)
    if not whole or not any(test.is_inconclusive for test in every):
        return tests
    inner = replace(channel, parts=tuple(divide_training(channel.runs, channel.parts, gap_s)))
    again = select_causes(inner, rng, lambda step: None, sift=noise.within(inner.parts).reject_artefacts)
    causes = tuple(
        _confirm_again(test, again, one) if test.is_inconclusive else test
        for one, test in zip(hunt.found, tests.causes, strict=True)
    )
    left = tests.structure
    if left is not None and left.test.is_inconclusive:
        found = find_structure(again.ground, again.ground.draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
        if found and found.output == left.structure.output and set(found.variables) & set(left.structure.variables):
            test = confirm_structure(again, found)
            left = replace(left, test=replace(test, within=True)) if test.is_confirmed else left
    return ConfirmationResults(causes, left)


def _confirm_again(before: Confirmation, again: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Return the test of the same cause, found again on one of its joints, where it confirms; else the one from before."""
    joints = {joint for effect in one.candidate.effects for joint in effect.joints}
    for other in again.found:
        shared = any(joints & set(effect.joints) for effect in other.candidate.effects)
        if other.candidate.cause == one.candidate.cause and shared:
            test = confirm_cause(again, other)
            return replace(test, within=True) if test.is_confirmed else before
    return before
