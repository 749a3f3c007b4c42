"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from .channel_health import (
    ChannelFault as ChannelFault,
    find_channel_faults as find_channel_faults,
    split_at_faults as split_at_faults,
)
from .check import (
    check_log as check_log,
    describe_other_scale as describe_other_scale,
    list_unit_warnings as list_unit_warnings,
)
from .check_motion import find_moving_samples as find_moving_samples
from .column_map import ColumnMap as ColumnMap, Source as Source
from .column_names import (
    ROOM_TEMPERATURE as ROOM_TEMPERATURE,
    describe_missing_column as describe_missing_column,
    format_names as format_names,
    is_blank as is_blank,
    split_words as split_words,
)
from .data_integrity import list_data_warnings as list_data_warnings, mend_log as mend_log
from .delimited import parse_delimited as parse_delimited
from .even_segments import (
    EvenSegment as EvenSegment,
    InMemorySegment as InMemorySegment,
    split_even_segments as split_even_segments,
)
from .filtering import (
    FORCE_BAND_FACTOR as FORCE_BAND_FACTOR,
    SPEED_NOISE_FACTOR as SPEED_NOISE_FACTOR,
    MotionBand as MotionBand,
    choose_force_cutoff as choose_force_cutoff,
    compute_attenuation as compute_attenuation,
    compute_edge_samples as compute_edge_samples,
    compute_noise_gain as compute_noise_gain,
    compute_rest_speed as compute_rest_speed,
    decimate as decimate,
    differentiate as differentiate,
    estimate_encoder_noise as estimate_encoder_noise,
    estimate_quantisation_step as estimate_quantisation_step,
    find_motion_band as find_motion_band,
    find_reversals as find_reversals,
    lowpass as lowpass,
    lowpass_and_decimate as lowpass_and_decimate,
)
from .log import Log as Log
from .proposals.columns import ColumnProposal as ColumnProposal
from .proposals.folder import propose_columns as propose_columns
from .read import (
    compute_mapped_columns as compute_mapped_columns,
    read_any as read_any,
    read_log as read_log,
    read_measured as read_measured,
)
from .recording import (
    DataTable as DataTable,
    LogSource as LogSource,
    Recording as Recording,
    as_log as as_log,
    as_logs as as_logs,
    open_log as open_log,
)
from .resample import (
    MIN_SEGMENT_SAMPLES as MIN_SEGMENT_SAMPLES,
    count_short_segments as count_short_segments,
    ensure_even as ensure_even,
    examine_clock as examine_clock,
    find_true_runs as find_true_runs,
    mend_rounded_stamps as mend_rounded_stamps,
    resample_segments as resample_segments,
    split_at_gaps as split_at_gaps,
    split_by_motion as split_by_motion,
)
from .signal_checks import (
    CheckFinding as CheckFinding,
    LogCheck as LogCheck,
    check_jumps as check_jumps,
    check_signals as check_signals,
    list_long_runs as list_long_runs,
)
from .table import MAX_MAGNITUDE as MAX_MAGNITUDE, Table as Table, read_table as read_table
