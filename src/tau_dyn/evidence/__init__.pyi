"""Verdicts from one body of evidence: hypotheses, null model, selection, confirmation, gain, detection limits, structure."""

from .campaigns import (
    MIN_LEFT_P_VALUE as MIN_LEFT_P_VALUE,
    CampaignChange as CampaignChange,
    CampaignChannel as CampaignChannel,
    compute_campaign_gain as compute_campaign_gain,
    confirm_campaign_change as confirm_campaign_change,
    divide_every_log as divide_every_log,
    explain_misfit as explain_misfit,
    select_campaign_changes as select_campaign_changes,
)
from .candidate_scan import (
    FAMILY_LEVEL as FAMILY_LEVEL,
    N_NULL_DRAWS as N_NULL_DRAWS,
    find_nonnegative as find_nonnegative,
)
from .changes import (
    LogChange as LogChange,
    build_shared_columns as build_shared_columns,
    describe_changes as describe_changes,
    find_changes as find_changes,
    list_changes as list_changes,
)
from .channel import (
    Channel as Channel,
    build_scene as build_scene,
    compute_fast_speeds as compute_fast_speeds,
    find_shared_signals as find_shared_signals,
)
from .claims import (
    MAX_HELD_OUT_RATIO as MAX_HELD_OUT_RATIO,
    MAX_OUTPUT_LOSS_PERCENT as MAX_OUTPUT_LOSS_PERCENT,
    PRINTED_DIGITS as PRINTED_DIGITS,
    Claims as Claims,
    Recommendation as Recommendation,
    Waterfall as Waterfall,
    compute_overfit_factor as compute_overfit_factor,
    describe_foreign_joints as describe_foreign_joints,
    explain_gain as explain_gain,
    recommend as recommend,
)
from .detection_limits import (
    compute_detection_limits as compute_detection_limits,
)
from .diagnosis import (
    Diagnosis as Diagnosis,
)
from .extended_fit import (
    EvaluatedFit as EvaluatedFit,
    build_extended_regression as build_extended_regression,
    estimate_noise_floor as estimate_noise_floor,
    fit_extended_model as fit_extended_model,
    restrict_to_parts as restrict_to_parts,
    solve_with_fallback as solve_with_fallback,
)
from .findings import (
    describe_diagnosis as describe_diagnosis,
)
from .judge import (
    Examination as Examination,
    ExaminationOptions as ExaminationOptions,
    decide_verdict as decide_verdict,
    examine_channel as examine_channel,
    list_contradicting as list_contradicting,
    search_channel as search_channel,
)
from .lack_of_fit import (
    MAX_MISSED_SHARE as MAX_MISSED_SHARE,
    MIN_NOISE_RATIO as MIN_NOISE_RATIO,
    MIN_STRUCTURED_SHARE as MIN_STRUCTURED_SHARE,
    PoorFit as PoorFit,
    describe_poor_fits as describe_poor_fits,
    describe_poor_simulations as describe_poor_simulations,
    find_poor_fits as find_poor_fits,
    find_poor_simulations as find_poor_simulations,
)
from .measurements import (
    EVERY as EVERY,
    TEST as TEST,
    TRAIN as TRAIN,
    VALIDATION as VALIDATION,
    Measurements as Measurements,
    describe_split as describe_split,
    name_by_joint as name_by_joint,
    refuse_scarce as refuse_scarce,
    split_by_blocks as split_by_blocks,
)
from .noise_only_bootstrap import (
    N_BOOTSTRAP_DRAWS as N_BOOTSTRAP_DRAWS,
    NoiseOnlyBootstrap as NoiseOnlyBootstrap,
)
from .null_model import (
    MIN_UNABSORBED_SHARE as MIN_UNABSORBED_SHARE,
    WHOLE_TIME as WHOLE_TIME,
    compute_score_statistics as compute_score_statistics,
    orthonormalise as orthonormalise,
)
from .plausibility import (
    MAX_LAW_ERROR as MAX_LAW_ERROR,
    MIN_FORCE_SHARE as MIN_FORCE_SHARE,
    compute_least_forces as compute_least_forces,
    demote_small as demote_small,
    find_out_of_range as find_out_of_range,
    measure_net_forces as measure_net_forces,
    measure_scales as measure_scales,
)
from .readings import (
    ALIAS_NATS as ALIAS_NATS,
    MAX_NUMBER_STDERR as MAX_NUMBER_STDERR,
    MAX_ZERO_MEAN as MAX_ZERO_MEAN,
    MIN_GAIN_NATS as MIN_GAIN_NATS,
    MIN_MODEL_ERROR as MIN_MODEL_ERROR,
    MIN_POWER_DROP as MIN_POWER_DROP,
    NATS_PER_NUMBER as NATS_PER_NUMBER,
    ReadingFit as ReadingFit,
    ReadingTest as ReadingTest,
    compute_zero_mean_nats as compute_zero_mean_nats,
    is_factor_known as is_factor_known,
    is_hopeless as is_hopeless,
    is_part_missing as is_part_missing,
    is_preferred as is_preferred,
    is_preferred_at_each_joint as is_preferred_at_each_joint,
    is_preferred_in_each_half as is_preferred_in_each_half,
    list_aliases as list_aliases,
    permits_size as permits_size,
    permits_speed_scale as permits_speed_scale,
    search_readings as search_readings,
)
from .result import (
    DIFFERENCE_LEVEL as DIFFERENCE_LEVEL,
    Choice as Choice,
    Finding as Finding,
    Gain as Gain,
    Limit as Limit,
    OutputErrors as OutputErrors,
    SearchBand as SearchBand,
    Signature as Signature,
    Status as Status,
    Step as Step,
    TimeTrace as TimeTrace,
    Unexplained as Unexplained,
    Untestable as Untestable,
    Verdict as Verdict,
    WholeErrors as WholeErrors,
)
from .stepwise_selection import (
    build_effects as build_effects,
)
from .unexplained import (
    find_unexplained as find_unexplained,
)
from .unknown_structure import (
    MIN_2LOGL_DIFFERENCE as MIN_2LOGL_DIFFERENCE,
)
