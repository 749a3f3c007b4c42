"""Torque logs -> masses and friction."""

from .common_samples import has_common_samples as has_common_samples
from .data import (
    Data as Data,
    Logs as Logs,
    cut_into_pieces as cut_into_pieces,
    drop_repeated_logs as drop_repeated_logs,
    get_log_list as get_log_list,
    list_provenance as list_provenance,
    log_warnings as log_warnings,
    require_forces as require_forces,
)
from .estimate_warnings import list_resting_warnings as list_resting_warnings
from .fitted_model import (
    Choices as Choices,
    build_model as build_model,
    build_physical_constraints as build_physical_constraints,
    find_structural_base as find_structural_base,
    read_bound as read_bound,
    read_fixed as read_fixed,
)
from .identification import (
    identify as identify,
    refuse_constant_forces as refuse_constant_forces,
)
from .integrity.log_integrity import (
    check_against_robot as check_against_robot,
    check_integrity as check_integrity,
    is_diagnosis_invalid as is_diagnosis_invalid,
)
from .loop_positions import complete_positions as complete_positions
from .model_fit import ModelFit as ModelFit, compare_fit as compare_fit
from .motor_electrics import RECORDED as RECORDED
from .per_log import (
    LogValue as LogValue,
    PerLogParameter as PerLogParameter,
    compute_contrast_p_value as compute_contrast_p_value,
    name_apart as name_apart,
)
from .posterior import (
    Samples as Samples,
    draw_samples as draw_samples,
)
from .preparation import (
    CODE as CODE,
    EXPERIMENT as EXPERIMENT,
    MIN_RATE_HZ as MIN_RATE_HZ,
    NOISE_FACTOR as NOISE_FACTOR,
    RATE_FACTOR as RATE_FACTOR,
    Kept as Kept,
    Preparation as Preparation,
    TooShort as TooShort,
    choose_preparation as choose_preparation,
    count_information as count_information,
    find_unsure_samples as find_unsure_samples,
    keep_long as keep_long,
    list_crumbs as list_crumbs,
    list_information_warnings as list_information_warnings,
    refuse_short as refuse_short,
    refuse_slow_clocks as refuse_slow_clocks,
    select_long as select_long,
    widen as widen,
)
from .regression import (
    PreparedSegment as PreparedSegment,
    build_regression as build_regression,
    leave_out_rare_joints as leave_out_rare_joints,
    prepare_segment as prepare_segment,
)
from .result import (
    ForceErrors as ForceErrors,
    Identification as Identification,
    build_force_errors as build_force_errors,
)
from .streaming import BlockExecutor as BlockExecutor
from .widening import Widening as Widening, compute_data_covariance as compute_data_covariance
