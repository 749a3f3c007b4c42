"""The engines that torque, pose and vibration share: linear regressions, noise, base parameters, physics."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.estimate.autoregression import Autoregression, fit_autoregression
from tau_dyn.estimate.base_parameters import BaseParameters, find_base
from tau_dyn.estimate.estimate import MAX_RELATIVE_STDERR, Estimate
from tau_dyn.estimate.least_squares import solve_least_squares
from tau_dyn.estimate.parameter_combination import ParameterSum, combine_parameters
from tau_dyn.estimate.physical_consistency import solve_consistent
from tau_dyn.estimate.physics import InertialBody, PhysicalConstraints, pseudo_inertia
from tau_dyn.estimate.regression import Regression, RegressionRows, RegressionRun, StreamedData
from tau_dyn.estimate.scaled import scale_columns, solve_scaled
from tau_dyn.estimate.sufficient_statistics import SufficientStatistics
from tau_dyn.estimate.whitening import Whitener

__all__ = [
    "MAX_RELATIVE_STDERR",
    "Autoregression",
    "BaseParameters",
    "Estimate",
    "InertialBody",
    "ParameterSum",
    "PhysicalConstraints",
    "Regression",
    "RegressionRows",
    "RegressionRun",
    "StreamedData",
    "SufficientStatistics",
    "Whitener",
    "combine_parameters",
    "find_base",
    "fit_autoregression",
    "pseudo_inertia",
    "scale_columns",
    "solve_consistent",
    "solve_least_squares",
    "solve_scaled",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
