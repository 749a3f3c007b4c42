"""Measured forces and a model -> where the simulation is wrong, which cause explains it, and the gain.

Beside what every channel goes through (`channel_pipeline.py`): the baseline stays physical, its parameters are held against
their nominal
values, and a cause has to be more than what encoder noise makes of itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.candidate_scan import N_NULL_DRAWS
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.channel_pipeline import (
    HELD_OUT,
    SHARED,
    Answer,
    build_diagnosis,
    build_findings,
    get_fitted_parameters,
    select_confirmed,
    select_supported,
)
from tau_dyn.diagnose.companions import demote_companions, measure_net_forces
from tau_dyn.diagnose.data_split import TRAIN
from tau_dyn.diagnose.detection_limits import compute_detection_limits
from tau_dyn.diagnose.filters import (
    choose_diagnosis_preparation,
    clear_cutoff,
    compute_border_gap_s,
    decimate_log,
    keep_diagnosable,
    smooth_cutoffs,
)
from tau_dyn.diagnose.force import (
    ForceChannel,
    build_force_channel,
    build_force_regression,
    compute_determined_rank,
    prepare_segments,
)
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL
from tau_dyn.diagnose.internal_validation import confirm_all, confirm_within_training
from tau_dyn.diagnose.noise_only_bootstrap import N_BOOTSTRAP_DRAWS, NoiseOnlyBootstrap, simulate_noise_only_logs
from tau_dyn.diagnose.nominal import find_parameter_changes
from tau_dyn.diagnose.position_periodicity import detect_position_periodicity
from tau_dyn.diagnose.recommendation import Recommendation, recommend
from tau_dyn.diagnose.resonances import add_band_note, add_resonances
from tau_dyn.diagnose.result import Diagnosis, Finding, Unexplained, Untestable, Verdict
from tau_dyn.diagnose.stepwise_selection import StepwiseSelection, build_effects, select_causes
from tau_dyn.diagnose.unexplained import build_unexplained
from tau_dyn.diagnose.unknown_structure import Structure, compute_structure_p_value, find_structure
from tau_dyn.diagnose.words import describe_verdict
from tau_dyn.estimate import PhysicalConstraints, Regression, solve_least_squares
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import (
    EXPERIMENT,
    Preparation,
    build_physical_constraints,
    check_integrity,
    count_information,
    is_diagnosis_invalid,
    list_crumbs,
    list_information_warnings,
    list_resting_warnings,
    log_warnings,
)
from tau_dyn.log import Log, find_motion_band, mend_log, resample_segments
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class FittedBaseline:
    """A baseline fitted to logs, ready to be doubted.

    Attributes:
        nominal: The baseline before the fit.
        model: The baseline at fitted values.
        channel: All data, with the baseline's columns.
        physics: What makes the baseline's values physical.
        preparation: Filters and masks.
        smooth_hz: Low-pass of each piece's positions [Hz].
        clear_hz: Low-pass of the forces that springs carry [Hz].
        held: Whether a piece belongs to a held-out log.
        pieces: Even stretches of the training logs, then of the held-out logs, as they were logged.
        how: How the data are divided, in words.
    """

    nominal: Model
    model: Model
    channel: Channel
    physics: PhysicalConstraints
    preparation: Preparation
    smooth_hz: tuple[float, ...]
    clear_hz: float
    held: tuple[bool, ...]
    pieces: tuple[Log, ...]
    how: str

    def noise_only(self, rng: np.random.Generator) -> Channel:
        """Return the channel of logs that hold nothing but the baseline and encoder noise."""
        assert isinstance(self.channel, ForceChannel)
        logs = simulate_noise_only_logs(self.channel, self.model, self.pieces, self.smooth_hz, rng)
        prepared = prepare_segments(self.nominal, logs, self.preparation, self.smooth_hz)
        regression = build_force_regression(self.nominal, prepared, self.preparation)
        return replace(
            build_force_channel(self.model, prepared, self.held, self.preparation, regression, self.clear_hz),
            parameters=self.nominal.parameters,
        )


def fit_baseline(
    model: Model,
    train_logs: list[Log],
    held_logs: list[Log],
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    progress: Progress,
    warnings: list[str],
) -> FittedBaseline:
    """Return the baseline fitted to the training logs, with all of the data.

    Args:
        model: The baseline at its nominal values.
        train_logs: Logs to train on.
        held_logs: Held-out logs.
        preparation: Filters and masks; None to choose them.
        exclude: Log columns whose nonzero samples are left out.
        progress: Called with a word for each step.
        warnings: What is doubtful is added here.

    Raises:
        CannotAnswer: The logs determine nothing, or are too short for three parts.
    """
    joints = model.robot.actuated
    train, held = (
        [piece for log in logs for piece in resample_segments(mend_log(log, joints))]
        for logs in (train_logs, held_logs)
    )
    warnings += check_integrity(model.robot, [*train_logs, *held_logs], exclude)
    warnings += [*model.robot.warnings, *log_warnings(model.robot, [*train, *held])]
    warnings += list_crumbs([*train_logs, *held_logs])
    train, held, left_out = keep_diagnosable(model.robot, train_logs, train, held, exclude)
    warnings += left_out
    preparation = preparation or choose_diagnosis_preparation(model.robot, train, exclude)
    pieces = (*train, *held)
    is_held = (*[False] * len(train), *[True] * len(held))
    how = (HELD_OUT if held else SHARED).format(what="logs")
    smooth_hz, clear_hz = smooth_cutoffs(model.robot, train, held), clear_cutoff(model.robot, train)
    case = _fitted(model, pieces, is_held, preparation, smooth_hz, clear_hz, how, progress)
    assert isinstance(case.channel, ForceChannel)
    if detect_position_periodicity(case.channel, smooth_hz):
        smooth_hz = (preparation.position_cutoff_hz,) * len(pieces)  # as they are
        case = _fitted(model, pieces, is_held, preparation, smooth_hz, clear_hz, how, progress)
    warnings += _data_warnings(case, train)
    return case


def _data_warnings(case: FittedBaseline, train: Sequence[Log]) -> list[str]:
    """Return warnings where the training part holds little independent information for the baseline, or joints mostly rest.

    Raises:
        CannotAnswer: It holds less than the baseline has unknowns: causes would be fitted to what the baseline fits by chance.
    """
    channel = case.channel
    masks = channel.masks(TRAIN)
    runs = tuple(replace(run, usable=m) for run, m in zip(channel.runs, masks, strict=True))
    used = Regression(channel.parameters, channel.outputs, channel.units, runs, case.preparation)
    bands = [find_motion_band(log.joint("q", case.model.robot.actuated), log.rate_hz).edge_hz.max() for log in train]
    rank, band_hz = compute_determined_rank(used, channel.parts), float(max(bands))
    held = count_information(used, band_hz)
    if held < rank:
        raise CannotAnswer(
            "too_little_data",
            f"the part that is trained on holds about {held:.0f} independent values for {rank} parameters and combinations "
            f"({sum(log.duration for log in train):.3g} s of motion up to {band_hz:.2g} Hz)",
            EXPERIMENT,
        )
    return [*list_information_warnings(used, rank, band_hz), *list_resting_warnings(used)]


def _fitted(
    model: Model,
    pieces: tuple[Log, ...],
    is_held: tuple[bool, ...],
    preparation: Preparation,
    smooth_hz: tuple[float, ...],
    clear_hz: float,
    how: str,
    progress: Progress,
) -> FittedBaseline:
    """Return the baseline fitted to pieces whose positions are low-passed at `smooth_hz` [Hz], each at its own."""
    progress("columns")
    thinned = [decimate_log(piece, preparation.position_cutoff_hz) for piece in pieces]
    prepared = prepare_segments(model, thinned, preparation, smooth_hz)
    regression = build_force_regression(model, prepared, preparation)
    physics = build_physical_constraints(model)
    progress("baseline")
    first = replace(regression, runs=regression.runs[: is_held.count(False)])
    estimate = solve_least_squares(first, physics=physics)
    if freed := [name for name in physics.rotors if estimate.parameters[name].free]:
        model = model.with_parameters(model.parameters.update({name: {"free": True} for name in freed}))
        physics = build_physical_constraints(model)
        regression = replace(regression, parameters=model.parameters)
    fit = model.with_parameters(estimate.parameters)
    channel = build_force_channel(fit, prepared, is_held, preparation, regression, clear_hz)
    scene = replace(channel.scene, step_s=1 / pieces[0].rate_hz)
    channel = replace(channel, parameters=model.parameters, scene=scene)
    return FittedBaseline(model, fit, channel, physics, preparation, smooth_hz, clear_hz, is_held, pieces, how)


def diagnose_forces(case: FittedBaseline, seed: int, progress: Progress, warnings: list[str]) -> Diagnosis:
    """Find causes of what the baseline leaves of the forces."""
    progress("looking for resonances")
    channel, rng = add_resonances(case.channel), np.random.default_rng(seed)
    assert isinstance(channel, ForceChannel)
    progress("looking for causes")
    noise = NoiseOnlyBootstrap(lambda: [case.noise_only(rng) for _ in range(N_BOOTSTRAP_DRAWS)])
    hunt = select_causes(channel, rng, progress, sift=noise.reject_artefacts)
    structure = find_structure(channel, hunt.ground, hunt.ground.draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
    hunt, structure = _sifted(noise, hunt, structure)
    progress("confirming")
    rate = channel.prepared[0].log.rate_hz
    gap = compute_border_gap_s(case.preparation.force_cutoff_hz, rate)
    tests = confirm_within_training(channel, hunt, confirm_all(channel, hunt, structure), gap, rng, noise)
    spoiled = _describe_spoiled(warnings)
    claims = select_confirmed(channel, hunt, tests.causes, physics=case.physics)
    claims = claims.reject_all(spoiled) if spoiled else claims
    progress("measuring the gain")
    nominal = case.nominal.parameters
    claims, bars = select_supported(channel, hunt, claims, rng, nominal=nominal.values, physics=case.physics)
    before, after = bars.judgements[0], bars.judgements[-1]
    findings = [add_band_note(f, case.clear_hz) for f in build_findings(channel, hunt, claims, bars, rng)]
    findings += [
        replace(f, status="suspected", why_not_confirmed=spoiled) if spoiled else f
        for f in find_parameter_changes(case.nominal, nominal, get_fitted_parameters(after), after.estimate)
    ]
    unexplained = build_unexplained(channel, hunt, tests.structure)
    sizes = measure_net_forces(channel, hunt.library, claims.kept, get_fitted_parameters(after))
    largest = sizes.max(axis=0, initial=0.0)
    unexplained = demote_companions(unexplained, channel.outputs, after.errors.rms, largest)
    if spoiled:
        unexplained = tuple(replace(u, status="suspected") for u in unexplained)
    limits, untestable = compute_detection_limits(channel, hunt, [f.cause for f in findings])
    verdict = "cannot_tell" if spoiled else _verdict(findings, unexplained)
    sentence = f"These data name no cause: {spoiled}."
    if not spoiled:
        sentence = describe_verdict(verdict, findings, unexplained, before.errors, after.errors)
    answer = Answer(
        verdict,
        sentence,
        case.how,
        findings,
        unexplained,
        limits,
        _with_drift(untestable, unexplained),
        _MEND if spoiled else _experiment(verdict, findings),
        warnings,
        {"preparation": case.preparation.to_dict()},
    )
    recommendation = Recommendation("neither", spoiled) if spoiled else recommend(channel, hunt, claims, bars, rng)
    return build_diagnosis(channel, hunt, claims, bars, case.nominal, answer, seed, recommendation)


_MEND = "mend the log or its column map as the first warning says, or record it again"


def _describe_spoiled(warnings: Sequence[str]) -> str:
    """Return why nothing may be confirmed from logs that are not what they claim to be; empty where they are."""
    codes = dict.fromkeys(get_code(warning) for warning in warnings if is_diagnosis_invalid([warning]))
    return f"the log is not what it claims to be ({', '.join(codes)}); mend it first" if codes else ""


def _sifted(
    noise: NoiseOnlyBootstrap, hunt: StepwiseSelection, structure: Structure | None
) -> tuple[StepwiseSelection, Structure | None]:
    """Leave out what encoder noise alone could have made, beside all that was found."""
    kept = []
    for one in hunt.found:
        left = noise.reject_artefacts(hunt.ground, one.candidate, hunt.others(one), hunt.n_causes)
        if left is not None:
            kept.append(replace(one, candidate=left))
    if (
        structure is not None
        and compute_structure_p_value(noise, hunt.ground, structure, build_effects(hunt.found)) > FAMILY_LEVEL
    ):
        structure = None
    return replace(hunt, found=tuple(kept)), structure


def _with_drift(untestable: tuple[Untestable, ...], unexplained: tuple[Unexplained, ...]) -> tuple[Untestable, ...]:
    """Say that a residual that drifts in time may be warmth, where no temperature was logged."""
    drifts = [u.joint for u in unexplained if "t" in u.depends_on]
    if not drifts:
        return untestable
    why = f"the residual of {drifts[0]} drifts in time, and the logs give no temperature"
    return tuple(
        replace(u, why=why, experiment="log temp_JOINT or temp_room [degC] and repeat the motion from cold to warm")
        if u.cause == "thermal_drift"
        else u
        for u in untestable
    )


def _verdict(findings: Sequence[Finding], unexplained: tuple[Unexplained, ...]) -> Verdict:
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if parameters:
        return "cannot_tell" if any("drive_gain" in f.indistinguishable_from for f in parameters) else "named"
    return "unexplained" if any(u.status == "confirmed" for u in unexplained) else "nothing_found"


def _experiment(verdict: Verdict, findings: Sequence[Finding]) -> str:
    return next((f.experiment for f in findings if f.experiment), "") if verdict == "cannot_tell" else ""
