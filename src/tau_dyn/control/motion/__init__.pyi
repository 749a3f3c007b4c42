"""Motions in the shortest time or with less effort, within the limits of the drives (needs casadi: `tau_dyn[motion]`)."""

from .limits import (
    MotionLimits as MotionLimits,
    compute_feedback_margin as compute_feedback_margin,
    estimate_feedback_noise as estimate_feedback_noise,
)
from .plan import Binding as Binding, MotionPlan as MotionPlan, plan_motion as plan_motion
