"""Motions in the shortest time or with less effort, within the limits of the drives (needs casadi: `tau_dyn[motion]`)."""

from tau_dyn.control.motion.feedback import feedback_noise, margin_for
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.plan import plan_motion
from tau_dyn.control.motion.result import Binding, MotionPlan

__all__ = ["Binding", "MotionLimits", "MotionPlan", "feedback_noise", "margin_for", "plan_motion"]
