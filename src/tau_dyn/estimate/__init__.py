"""The engines that torque, pose and vibration share: linear regressions, noise, base parameters, physics."""

from tau_dyn.estimate.autoregression import Autoregression, fit_autoregression
from tau_dyn.estimate.base import BaseParameters, find_base
from tau_dyn.estimate.combination import Combination, combination
from tau_dyn.estimate.consistent import solve_consistent
from tau_dyn.estimate.estimate import DETERMINED, Estimate
from tau_dyn.estimate.least_squares import solve_least_squares
from tau_dyn.estimate.physics import Body, Physics, pseudo_inertia
from tau_dyn.estimate.regression import Everything, Regression, Rows, Run
from tau_dyn.estimate.scaled import solve_scaled, unit_columns
from tau_dyn.estimate.totals import Totals
from tau_dyn.estimate.whitening import Whitener

__all__ = [
    "DETERMINED",
    "Autoregression",
    "BaseParameters",
    "Body",
    "Combination",
    "Estimate",
    "Everything",
    "Physics",
    "Regression",
    "Rows",
    "Run",
    "Totals",
    "Whitener",
    "combination",
    "find_base",
    "fit_autoregression",
    "pseudo_inertia",
    "solve_consistent",
    "solve_least_squares",
    "solve_scaled",
    "unit_columns",
]
