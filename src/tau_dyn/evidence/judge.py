"""The judge: hypotheses about one channel are selected, confirmed, measured, and given a status and a verdict.

    channel -> null model, candidate scan, stepwise selection -> confirmation -> claims with their gain -> findings, verdict

A selected cause that the validation data show, but whose amplitude or setting is implausible for any machine, is listed as
rejected, and the selection is repeated without it: another cause may explain the same residual. That other cause has to leave a
residual that is consistent with the noise, since the better fit was rejected. The same holds for a cause that the validation data
reject, if another one explains as much of the training data. A cause that is confirmed with the rejected one
in the model and without it, with about the same amplitude, explains another part of the residual, and needs no such residual;
its standard errors contain the difference of the amplitudes.

`nothing_found` is a test result. The residual of every output is consistent with its noise (`unexplained.py`), and no rejected
candidate is shown by the validation data or by the training data at the level of a single data set; otherwise the verdict is
`unexplained`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.effects import Effect
from tau_dyn.estimate import PhysicalConstraints
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, N_NULL_DRAWS
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.claims import Claims, Waterfall, select_confirmed, select_supported
from tau_dyn.evidence.confirmation import Confirmation, confirm
from tau_dyn.evidence.detection_limits import compute_finding_limit, find_alias_periods, leave_period_open
from tau_dyn.evidence.extended_fit import fit_extended_model
from tau_dyn.evidence.findings import MAX_CHANGE_STDERR, build_findings, build_rejected_finding
from tau_dyn.evidence.measurements import HELD_OUT, TRAIN, divide_training
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap
from tau_dyn.evidence.null_model import NullModel
from tau_dyn.evidence.plausibility import Implausible, find_companion
from tau_dyn.evidence.result import Finding, Progress, Unexplained, Verdict
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection, build_effects, select_causes
from tau_dyn.evidence.unexplained import NoiseConsistency, add_inconsistent, assess_noise_consistency, build_unexplained
from tau_dyn.evidence.unknown_structure import Structure, compute_structure_p_value, find_structure
from tau_dyn.evidence.validation import ConfirmationResults, confirm_all, confirm_within_training
from tau_dyn.message_codes import get_code
from tau_dyn.parameters import Parameters

MAX_SEARCHES = 3
"""Largest number of selections of one channel: each one after the first leaves out the rejected causes."""
_LEAVES_STRUCTURE = "a cause outside of its plausible range fits better, and this one leaves a residual above the noise"
MAX_CHANGE_SHARE = 2.0
"""Largest ratio of the amplitudes with and without a rejected cause, and of those without and with it. A cause that loses more
than half of its amplitude to the rejected one may replace it."""
_DEPENDS = "its amplitude becomes {:.2g} times as large with the rejected {} in the model"


@dataclass(frozen=True, eq=False)
class ExaminationOptions:
    """Options of an examination.

    Attributes:
        rng: Random numbers for noise draws and intervals.
        progress: Called with a word for each step.
        noise: Forces due to encoder noise alone.
        physics: Physical consistency of the baseline's values.
        nominal: The baseline's values before any fit (p,); by default its parameters' own.
        gap_s: Memory of the filters [s], if causes may be confirmed within the training logs.
        doubt: The reason why no cause may be confirmed; empty if causes may be confirmed.
    """

    rng: np.random.Generator
    progress: Progress = lambda step: None
    noise: NoiseOnlyBootstrap | None = None
    physics: PhysicalConstraints | None = None
    nominal: np.ndarray | None = None
    gap_s: float | None = None
    doubt: str = ""


@dataclass(frozen=True, eq=False)
class Examination:
    """Selected causes of a channel with their evidence.

    Attributes:
        selection: The selection.
        claims: The selected causes with their status.
        waterfall: The waterfall with the gains.
        tests: Tests on the validation data.
        periods: Periods that fit each selected cause equally, for static poses.
        consistency: Test of each output's residual against its noise; empty if a cause is confirmed.
        findings: The selected and the rejected causes as findings.
        unexplained: Structure without a known cause.
        aliased: Findings whose period is open.
        remark: A fact about the nominal values for the reader, as a sentence.
    """

    selection: StepwiseSelection
    claims: Claims
    waterfall: Waterfall
    tests: ConfirmationResults
    periods: tuple[tuple[float, ...], ...]
    consistency: tuple[NoiseConsistency, ...] = ()
    findings: tuple[Finding, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    aliased: tuple[Finding, ...] = ()
    remark: str = ""


Selection = tuple[StepwiseSelection, Structure | None]
"""Causes that the training data show, and unexplained structure with these in the model."""


def examine_channel(channel: Channel, options: ExaminationOptions, first: Selection | None = None) -> Examination:
    """Select, confirm and measure causes on a channel, and test its residual against the noise.

    Args:
        channel: The measurements.
        options: The options.
        first: Result of `search_channel` for the same data; None to search.
    """
    excluded: set[tuple[str, tuple[str, ...]]] = set()
    rejected: list[Finding] = []
    earlier: list[AmplitudesWithRejected] = []
    for search in range(MAX_SEARCHES):
        found = _examine_once(channel, options, excluded, None if search else first)
        if search:
            found = _require_consistency(found, options, earlier)
        replaceable = _list_replaceable(found)
        if not replaceable or options.doubt or search + 1 == MAX_SEARCHES:
            break
        findings = build_findings(found.selection, found.claims, found.waterfall, options.rng)
        rejected += [findings[k] for k in replaceable]
        turned_down = [found.claims.found[k] for k in replaceable]
        excluded |= {_identify(effect) for effect in build_effects(turned_down)}
        earlier.append(_measure_with_rejected(found, turned_down, options))
    return _with_findings(found, options, rejected, measure_changes(found, earlier))


def _examine_once(
    channel: Channel,
    options: ExaminationOptions,
    excluded: set[tuple[str, tuple[str, ...]]],
    given: Selection | None,
) -> Examination:
    """Select causes, confirm them and measure their gain."""
    noise, rng = options.noise, options.rng
    selection, structure = given or search_channel(channel, options, excluded)
    options.progress("confirming")
    tests = confirm_all(selection, structure)
    inner_parts: Sequence[np.ndarray] = ()
    if noise and options.gap_s is not None:
        tests = confirm_within_training(selection, tests, options.gap_s, rng, noise)
        inner_parts = divide_training(channel.runs, channel.parts, options.gap_s)
    periods = tuple(find_alias_periods(selection))
    claims = _doubt(select_confirmed(selection, tests.causes, options.physics), periods, options.doubt)
    options.progress("measuring the gain")
    claims, waterfall = select_supported(selection, claims, rng, options.nominal, options.physics, inner_parts)
    return Examination(selection, claims, waterfall, tests, periods)


def search_channel(
    channel: Channel, options: ExaminationOptions, excluded: Collection[tuple[str, tuple[str, ...]]] = ()
) -> Selection:
    """Return the causes that the training data show, and unexplained structure with these in the model."""
    options.progress("looking for causes")
    noise = options.noise
    artefact_filter = noise.reject_artefacts if noise else None
    selection = select_causes(
        channel, options.rng, options.progress, artefact_filter=artefact_filter, excluded=excluded
    )
    structure = None
    if channel.has_unnamed_structures:
        draws = selection.null_model.draw_null_residuals(N_NULL_DRAWS, options.rng)
        structure = find_structure(selection.null_model, draws, FAMILY_LEVEL)
    return _reject_artefacts(noise, selection, structure) if noise else (selection, structure)


def _reject_artefacts(
    noise: NoiseOnlyBootstrap, selection: StepwiseSelection, structure: Structure | None
) -> tuple[StepwiseSelection, Structure | None]:
    """Leave out the causes and the structure that encoder noise alone may have made, all others in the model."""
    kept = []
    for one in selection.found:
        left = noise.reject_artefacts(selection.null_model, one.candidate, selection.others(one), len(selection.last))
        if left is not None:
            kept.append(replace(one, candidate=left))
    if structure is not None:
        chance = compute_structure_p_value(noise, selection.null_model, structure, build_effects(selection.found))
        structure = structure if chance <= FAMILY_LEVEL else None
    return replace(selection, found=tuple(kept)), structure


def _doubt(claims: Claims, periods: Sequence[tuple[float, ...]], doubt: str) -> Claims:
    """Return the claims without those that a problem of the data or a period that is not identifiable excludes."""
    claims = claims.reject_all(doubt) if doubt else claims
    for k, fitting in enumerate(periods):
        claims = claims.judge(k, "several periods fit equally") if len(fitting) > 1 else claims
    return claims


def _list_replaceable(found: Examination) -> list[int]:
    """Return the indices of causes in whose place another one may be found.

    These are implausible causes that the validation data show, and causes that these data reject, if another cause explains as
    much of the training data.
    """
    claims = zip(found.claims.found, found.claims.why_not, found.tests.causes, strict=True)
    return [
        k
        for k, (one, why, test) in enumerate(claims)
        if (isinstance(why, Implausible) if test.is_confirmed else not test.is_inconclusive and one.rivals)
    ]


class AmplitudesWithRejected(NamedTuple):
    """Rejected causes, and the amplitudes of the other confirmed effects in a fit with them, by cause and joints."""

    rejected: tuple[SelectedCause, ...]
    amplitudes: dict[tuple[str, tuple[str, ...]], np.ndarray]

    @property
    def words(self) -> str:
        """The names of the rejected causes."""
        return " and ".join(one.candidate.cause for one in self.rejected)


def _identify(effect: Effect) -> tuple[str, tuple[str, ...]]:
    """Return an effect's cause and joints."""
    return effect.name, effect.joints


def _measure_with_rejected(
    found: Examination, turned_down: Sequence[SelectedCause], options: ExaminationOptions
) -> AmplitudesWithRejected:
    """Return the amplitudes of the confirmed causes in a fit with the rejected ones, without possible companions of these."""
    selection, kept = found.selection, found.claims.kept
    effects = build_effects([*kept, *turned_down])
    values = fit_extended_model(selection.channel, effects, options.physics, options.rng).parameters
    alone = [one for one in kept if not _is_companion(selection, one, turned_down, values)]
    amplitudes = {_identify(e): values.select(e.parameters.names).values for e in build_effects(alone)}
    return AmplitudesWithRejected(tuple(turned_down), amplitudes)


def _is_companion(
    selection: StepwiseSelection, one: SelectedCause, others: Sequence[SelectedCause], values: Parameters
) -> bool:
    """Return whether a cause is no larger than the inexactness of other causes' laws."""
    companion = find_companion(selection.library, [one, *others], values)
    return companion is not None and companion[0] == 0


def explain_dependence(one: SelectedCause, values: Parameters, earlier: Sequence[AmplitudesWithRejected]) -> str:
    """Return the reason why a cause of a repeated selection may replace a rejected one; empty if it does not."""
    for fit in earlier:
        pairs = []
        for effect in one.candidate.effects:
            before = fit.amplitudes.get(_identify(effect))
            own = values.select(effect.parameters.names)
            if before is None or len(before) != len(own):
                return _LEAVES_STRUCTURE
            pairs += [(p.value / p.stderr, x / p.stderr) for p, x in zip(own, before, strict=True) if p.stderr]
        if not pairs:
            continue
        now, then = np.transpose(pairs)
        if np.sqrt(np.mean((now - then) ** 2)) > MAX_CHANGE_STDERR:
            share = float(now @ then / (now @ now))
            if not 1 / MAX_CHANGE_SHARE <= share <= MAX_CHANGE_SHARE:
                return _DEPENDS.format(share, fit.words)
    return ""


def measure_changes(found: Examination, earlier: Sequence[AmplitudesWithRejected]) -> dict[str, float]:
    """Return by amplitude its largest difference from its value with rejected causes in the model."""
    if not found.claims.kept:
        return {}
    values = found.waterfall.fits[-1].parameters
    changes: dict[str, float] = {}
    for effect in build_effects(found.claims.kept):
        own = values.select(effect.parameters.names)
        for fit in earlier:
            before = fit.amplitudes.get(_identify(effect), ())
            if len(before) == len(own):
                changes |= {
                    p.name: max(abs(p.value - x), changes.get(p.name, 0.0)) for p, x in zip(own, before, strict=True)
                }
    return changes


def _require_consistency(
    found: Examination, options: ExaminationOptions, earlier: Sequence[AmplitudesWithRejected]
) -> Examination:
    """Reject confirmed causes of a repeated selection that may replace a rejected one.

    Such a cause is confirmed for the first time, or with another amplitude, and its joints' residual is not consistent with the
    noise, or still contains the rejected cause.
    """
    claims = found.claims
    if not claims.kept:
        return found
    tests = _assess_noise_consistency(found, options)
    inconsistent = {test.output for test in tests if test.is_repeated}
    for one in (one for fit in earlier for one in fit.rejected):
        if _confirm_with_others(found.selection, one, claims.kept).is_confirmed:
            inconsistent |= {joint for effect in one.candidate.effects for joint in effect.joints}
    for k, one in enumerate(claims.found):
        joints = {joint for effect in one.candidate.effects for joint in effect.joints}
        if not claims.why_not[k] and joints & inconsistent:
            claims = claims.judge(k, explain_dependence(one, found.waterfall.fits[-1].parameters, earlier))
    if claims.why_not == found.claims.why_not:
        return found
    claims, waterfall = select_supported(found.selection, claims, options.rng, options.nominal, options.physics)
    return replace(found, claims=claims, waterfall=waterfall)


def _with_findings(
    found: Examination, options: ExaminationOptions, rejected: Sequence[Finding], changes: Mapping[str, float]
) -> Examination:
    """Return the examination with its findings, the structure without a known cause, and the test of the residual."""
    selection, claims, rng = found.selection, found.claims, options.rng
    findings = [
        leave_period_open(selection.channel, one, finding, fitting)
        if len(fitting) > 1
        else _with_limit(selection, one, finding)
        for one, finding, fitting in zip(
            claims.found, build_findings(selection, claims, found.waterfall, rng, changes), found.periods, strict=True
        )
    ]
    aliased = tuple(f for f, fitting in zip(findings, found.periods, strict=True) if len(fitting) > 1)
    for one in selection.rejected:
        test = _confirm_with_others(selection, one.selected, selection.found)
        findings.append(build_rejected_finding(selection, claims, one.selected, one.why, test, rng))
    known = {(f.cause, f.joints) for f in findings}
    findings += [f for f in rejected if (f.cause, f.joints) not in known]
    unexplained = build_unexplained(selection.null_model, selection.known_columns, found.tests.structure)
    if options.doubt:
        unexplained = tuple(replace(u, status="suspected") for u in unexplained)
    if claims.kept or options.doubt:
        return replace(found, findings=tuple(findings), unexplained=unexplained, aliased=aliased)
    consistency = _assess_noise_consistency(found, options)
    return replace(
        found,
        consistency=consistency,
        findings=tuple(findings),
        unexplained=add_inconsistent(unexplained, consistency, selection.channel),
        aliased=aliased,
    )


def _assess_noise_consistency(found: Examination, options: ExaminationOptions) -> tuple[NoiseConsistency, ...]:
    """Test each output's residual against its noise, with the accepted causes in the model."""
    selection, effects = found.selection, build_effects(found.claims.kept)
    null_models = [
        NullModel.of(selection.library, parts, selection.null_model.noise, effects) for parts in ((TRAIN,), HELD_OUT)
    ]
    return assess_noise_consistency(null_models, effects, options.noise)


def _with_limit(selection: StepwiseSelection, one: SelectedCause, finding: Finding) -> Finding:
    """Return a confirmed finding with its detection limit; a rejected candidate has no limit."""
    if finding.why_not_confirmed:
        return finding
    return replace(finding, detection_limit=compute_finding_limit(selection, one))


def _confirm_with_others(
    selection: StepwiseSelection, one: SelectedCause, others: Sequence[SelectedCause]
) -> Confirmation:
    """Test a rejected candidate on the validation data, other causes in the model."""
    return confirm(selection.null_model, selection.columns(one.candidate.effects), build_effects(others))


def _is_gain_or_body(finding: Finding) -> bool:
    """Return whether a gain of the drives and a body explain the same difference, independent of the reported cause."""
    twins = finding.indistinguishable_from
    return "drive_gain" in twins or (finding.cause == "drive_gain" and bool(twins))


CONTRADICTING = ("changes_within_log", "holdout_differs", "poor_fit")
"""Codes of warnings that no residual consistent with the noise permits: a log that changes, logs that differ, a force missed."""


def decide_verdict(
    findings: Sequence[Finding],
    unexplained: Sequence[Unexplained],
    aliased: Sequence[Finding] = (),
    warnings: Sequence[str] = (),
) -> Verdict:
    """Return the verdict.

    Args:
        findings: All findings, parameters that differ from their nominal values included.
        unexplained: Structure without a name; its confirmed entries forbid `nothing_found`.
        aliased: Findings whose period is open.
        warnings: Warnings about the logs and the fit; those of `CONTRADICTING` forbid `nothing_found`.
    """
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if aliased or any(map(_is_gain_or_body, parameters)):
        return "cannot_tell"
    if parameters:
        return "named"
    shown = any(f.contradicts_noise for f in findings) or any(u.status == "confirmed" for u in unexplained)
    return "unexplained" if shown or list_contradicting(warnings) else "nothing_found"


def list_contradicting(warnings: Sequence[str]) -> list[str]:
    """Return the warnings that contradict a residual consistent with the noise."""
    return [warning for warning in warnings if get_code(warning) in CONTRADICTING]
