"""What a log alone tells of losses on its way to the file: one list of coded warnings for `check`, `identify` and `diagnose`.

All tests look at raw stamps and raw columns: interpolation and filters hide what they look for.
"""

from __future__ import annotations

from collections.abc import Sequence

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.log.log import Log
from tau_dyn.log.lost_samples import list_sample_warnings, mend_clock
from tau_dyn.log.zero_force import list_dropout_warnings

MIN_SAMPLES = 50
"""Shorter logs show no pattern."""


def list_data_warnings(log: Log, joints: Sequence[str] = ()) -> list[CodedWarning]:
    """Return lost, repeated, zeroed and held samples of a log as read; sound logs give none.

    Args:
        log: A log as read, before any interpolation.
        joints: The joints that count; by default all that are logged.
    """
    if log.n_samples < MIN_SAMPLES:
        return []
    joints = [joint for joint in joints if log.has("q", [joint])] or log.joints("q")
    return [*list_sample_warnings(log, joints), *list_dropout_warnings(log, joints)]


def mend_log(log: Log, joints: Sequence[str] = ()) -> Log:
    """Return a log whose few lost samples are gaps in its clock and whose repeated lines are left out; else the log itself."""
    joints = [joint for joint in joints if log.has("q", [joint])] or log.joints("q")
    return mend_clock(log, joints) or log
