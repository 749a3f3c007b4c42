"""Torque logs -> masses and friction."""

from .choices import Choices as Choices
from .errors import ForceErrors as ForceErrors, build_force_errors as build_force_errors
from .estimate_warnings import (
    MAX_HELD_OUT_RATIO as MAX_HELD_OUT_RATIO,
    describe_foreign_joints as describe_foreign_joints,
)
from .identification import build_model as build_model, identify as identify
from .log_inputs import (
    drop_duplicate_logs as drop_duplicate_logs,
    drop_trained_logs as drop_trained_logs,
    get_log_list as get_log_list,
    log_warnings as log_warnings,
    require_forces as require_forces,
)
from .log_integrity import (
    check_against_robot as check_against_robot,
    check_integrity as check_integrity,
    is_diagnosis_invalid as is_diagnosis_invalid,
)
from .preparation import (
    MIN_RATE_HZ as MIN_RATE_HZ,
    NOISE_FACTOR as NOISE_FACTOR,
    RATE_FACTOR as RATE_FACTOR,
    Preparation as Preparation,
    choose_preparation as choose_preparation,
)
from .regression import (
    PreparedSegment as PreparedSegment,
    build_regression as build_regression,
    prepare_segment as prepare_segment,
)
from .resting import list_resting_warnings as list_resting_warnings
from .result import Identification as Identification
from .short_pieces import (
    CODE as CODE,
    EXPERIMENT as EXPERIMENT,
    Kept as Kept,
    TooShort as TooShort,
    choose_from_long as choose_from_long,
    count_information as count_information,
    keep_long as keep_long,
    list_crumbs as list_crumbs,
    list_information_warnings as list_information_warnings,
    refuse_short as refuse_short,
)
from .signals import get_measured_signals as get_measured_signals
from .streaming import BlockExecutor as BlockExecutor
from .structural_identifiability import build_physical_constraints as build_physical_constraints
