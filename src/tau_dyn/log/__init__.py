"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.log.band import MotionBand, motion_band
from tau_dyn.log.check import check_log
from tau_dyn.log.check_result import CheckFinding, LogCheck
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.data_integrity import list_data_warnings, mend_log
from tau_dyn.log.even_segments import EvenSegment, split_even_segments
from tau_dyn.log.filtering import attenuation, decimate, differentiate, edge_samples, find_reversals, lowpass
from tau_dyn.log.log import Log
from tau_dyn.log.log_opening import open_log
from tau_dyn.log.masks import find_true_runs
from tau_dyn.log.motions import split_by_motion
from tau_dyn.log.noise_estimation import encoder_noise, noise_gain, quantisation_step, velocity_noise
from tau_dyn.log.read import read_log
from tau_dyn.log.recording import Recording
from tau_dyn.log.resample import ensure_even, even_segments, examine_clock, segments, short_segments
from tau_dyn.log.table import Table, read_table
from tau_dyn.log.units import unit_warnings

__all__ = [
    "CheckFinding",
    "ColumnMap",
    "EvenSegment",
    "Log",
    "LogCheck",
    "MotionBand",
    "Recording",
    "Table",
    "attenuation",
    "check_log",
    "decimate",
    "differentiate",
    "edge_samples",
    "encoder_noise",
    "ensure_even",
    "even_segments",
    "examine_clock",
    "find_reversals",
    "find_true_runs",
    "list_data_warnings",
    "lowpass",
    "mend_log",
    "motion_band",
    "noise_gain",
    "open_log",
    "quantisation_step",
    "read_log",
    "read_table",
    "segments",
    "short_segments",
    "split_by_motion",
    "split_even_segments",
    "unit_warnings",
    "velocity_noise",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
