"""Motions in the shortest time or with less effort, within the limits of the drives (needs casadi: `tau_dyn[motion]`)."""

from tau_dyn.control.motion.feedback import compute_feedback_margin, estimate_feedback_noise
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.plan import plan_motion
from tau_dyn.control.motion.result import Binding, MotionPlan
from tau_dyn.deprecated_names import get_deprecated

__all__ = ["Binding", "MotionLimits", "MotionPlan", "compute_feedback_margin", "estimate_feedback_noise", "plan_motion"]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
