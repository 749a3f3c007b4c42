"""Verdicts from one body of evidence: hypotheses, null model, selection, confirmation, gain, detection limits, structure."""

from .candidate_scan import (
    FAMILY_LEVEL as FAMILY_LEVEL,
    N_NULL_DRAWS as N_NULL_DRAWS,
    find_nonnegative as find_nonnegative,
)
from .channel import (
    EVERY as EVERY,
    TRAIN as TRAIN,
    VALIDATION as VALIDATION,
    Channel as Channel,
    build_scene as build_scene,
    compute_fast_speeds as compute_fast_speeds,
    divide_training as divide_training,
    find_shared_signals as find_shared_signals,
    name_by_joint as name_by_joint,
    refuse_scarce as refuse_scarce,
    split_by_blocks as split_by_blocks,
)
from .claims import (
    MAX_HELD_OUT_RATIO as MAX_HELD_OUT_RATIO,
    Claims as Claims,
    Recommendation as Recommendation,
    Waterfall as Waterfall,
    describe_foreign_joints as describe_foreign_joints,
    recommend as recommend,
    select_confirmed as select_confirmed,
    select_supported as select_supported,
)
from .confirmation import (
    ConfirmationResults as ConfirmationResults,
    build_unexplained as build_unexplained,
    confirm_all as confirm_all,
    confirm_within_training as confirm_within_training,
)
from .detection_limits import (
    compute_detection_limits as compute_detection_limits,
    find_alias_periods as find_alias_periods,
    leave_period_open as leave_period_open,
)
from .extended_fit import (
    EvaluatedFit as EvaluatedFit,
    build_extended_regression as build_extended_regression,
    estimate_noise_floor as estimate_noise_floor,
    fit_extended_model as fit_extended_model,
    restrict_to_parts as restrict_to_parts,
)
from .findings import (
    build_findings as build_findings,
    describe_diagnosis as describe_diagnosis,
)
from .noise_only_bootstrap import (
    N_BOOTSTRAP_DRAWS as N_BOOTSTRAP_DRAWS,
    NoiseOnlyBootstrap as NoiseOnlyBootstrap,
)
from .null_model import (
    LONG as LONG,
    MIN_UNABSORBED_SHARE as MIN_UNABSORBED_SHARE,
    WHOLE_TIME as WHOLE_TIME,
    build_displacement_terms as build_displacement_terms,
    build_force_terms as build_force_terms,
    compute_period_statistics as compute_period_statistics,
    compute_score_statistics as compute_score_statistics,
    orthonormalise as orthonormalise,
    scan_periods as scan_periods,
)
from .plausibility import (
    MAX_LAW_ERROR as MAX_LAW_ERROR,
    MIN_FORCE_SHARE as MIN_FORCE_SHARE,
    compute_least_forces as compute_least_forces,
    demote_small as demote_small,
    measure_net_forces as measure_net_forces,
    measure_scales as measure_scales,
)
from .readings import (
    find_equivalent as find_equivalent,
    prefer_reading as prefer_reading,
)
from .result import (
    Choice as Choice,
    Finding as Finding,
    Gain as Gain,
    Limit as Limit,
    OutputErrors as OutputErrors,
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
    StepwiseSelection as StepwiseSelection,
    build_effects as build_effects,
    select_causes as select_causes,
)
from .unknown_structure import (
    MIN_2LOGL_DIFFERENCE as MIN_2LOGL_DIFFERENCE,
    Structure as Structure,
    compute_structure_p_value as compute_structure_p_value,
    find_structure as find_structure,
)
