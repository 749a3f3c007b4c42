"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from tau_dyn.log.band import MotionBand, motion_band
from tau_dyn.log.check import check_log
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.data_integrity import list_data_warnings, mend_log
from tau_dyn.log.filtering import attenuation, decimate, differentiate, edge_samples, lowpass, reversals
from tau_dyn.log.findings import Finding, LogCheck
from tau_dyn.log.log import Log
from tau_dyn.log.masks import unbroken
from tau_dyn.log.motions import split_by_motion
from tau_dyn.log.noise import encoder_noise, noise_gain, quantisation_step, velocity_noise
from tau_dyn.log.read import read_log
from tau_dyn.log.recording import Recording
from tau_dyn.log.resample import ensure_even, even_segments, examine_clock, segments, short_segments
from tau_dyn.log.stream import open_log
from tau_dyn.log.stretch import Stretch, stretches
from tau_dyn.log.table import Table, read_table
from tau_dyn.log.units import unit_warnings

__all__ = [
    "ColumnMap",
    "Finding",
    "Log",
    "LogCheck",
    "MotionBand",
    "Recording",
    "Stretch",
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
    "lowpass",
    "motion_band",
    "noise_gain",
    "open_log",
    "quantisation_step",
    "read_log",
    "read_table",
    "reversals",
    "segments",
    "short_segments",
    "split_by_motion",
    "stretches",
    "unbroken",
    "list_data_warnings",
    "mend_log",
    "unit_warnings",
    "velocity_noise",
]
