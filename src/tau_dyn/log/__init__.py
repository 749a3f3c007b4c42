"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.log.band import MotionBand, find_motion_band
from tau_dyn.log.check import check_log
from tau_dyn.log.check_result import CheckFinding, LogCheck
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.data_integrity import list_data_warnings, mend_log
from tau_dyn.log.even_segments import EvenSegment, split_even_segments
from tau_dyn.log.filtering import (
    compute_attenuation,
    compute_edge_samples,
    decimate,
    differentiate,
    find_reversals,
    lowpass,
)
from tau_dyn.log.log import Log
from tau_dyn.log.log_opening import open_log
from tau_dyn.log.masks import find_true_runs
from tau_dyn.log.motions import split_by_motion
from tau_dyn.log.noise_estimation import (
    compute_noise_gain,
    compute_velocity_noise,
    estimate_encoder_noise,
    estimate_quantisation_step,
)
from tau_dyn.log.read import read_log
from tau_dyn.log.recording import Recording
from tau_dyn.log.resample import count_short_segments, ensure_even, examine_clock, resample_segments, split_at_gaps
from tau_dyn.log.table import Table, read_table
from tau_dyn.log.units import list_unit_warnings

__all__ = [
    "CheckFinding",
    "ColumnMap",
    "EvenSegment",
    "Log",
    "LogCheck",
    "MotionBand",
    "Recording",
    "Table",
    "check_log",
    "compute_attenuation",
    "compute_edge_samples",
    "compute_noise_gain",
    "compute_velocity_noise",
    "count_short_segments",
    "decimate",
    "differentiate",
    "ensure_even",
    "estimate_encoder_noise",
    "estimate_quantisation_step",
    "resample_segments",
    "examine_clock",
    "find_motion_band",
    "find_reversals",
    "find_true_runs",
    "list_data_warnings",
    "list_unit_warnings",
    "lowpass",
    "mend_log",
    "open_log",
    "read_log",
    "read_table",
    "split_at_gaps",
    "split_by_motion",
    "split_even_segments",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
