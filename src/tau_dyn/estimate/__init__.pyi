"""The engines that torque, pose and vibration share: linear regressions, noise, base parameters, physics."""

from .autoregression import (
    REACH as REACH,
    Autoregression as Autoregression,
    PositionNoise as PositionNoise,
    build_position_noise as build_position_noise,
    compute_accelerations as compute_accelerations,
    fit_autoregression as fit_autoregression,
)
from .base_parameters import (
    BaseParameters as BaseParameters,
    find_base as find_base,
    read_expression as read_expression,
)
from .covariance import BLOCK_S as BLOCK_S, Whitener as Whitener, assign_blocks as assign_blocks
from .estimate import (
    MAX_RELATIVE_STDERR as MAX_RELATIVE_STDERR,
    DeterminedCombinations as DeterminedCombinations,
    Estimate as Estimate,
    ParameterSum as ParameterSum,
    combine_parameters as combine_parameters,
    find_determined_combinations as find_determined_combinations,
)
from .instrumental_variables import (
    InstrumentalSolution as InstrumentalSolution,
    WhiteRows as WhiteRows,
    estimate_of as estimate_of,
    solve_instrumental_variables as solve_instrumental_variables,
)
from .least_squares import solve_least_squares as solve_least_squares
from .nonlinear import (
    Descent as Descent,
    DescentRules as DescentRules,
    LeastSquaresProblem as LeastSquaresProblem,
    LinearSystem as LinearSystem,
    descend as descend,
    factor_system as factor_system,
)
from .physical_consistency import (
    InertialBody as InertialBody,
    PhysicalConstraints as PhysicalConstraints,
    pseudo_inertia as pseudo_inertia,
    solve_consistent as solve_consistent,
)
from .regression import (
    ROUNDING as ROUNDING,
    Preparation as Preparation,
    Regression as Regression,
    RegressionRows as RegressionRows,
    RegressionRun as RegressionRun,
    StoredRows as StoredRows,
    StreamedData as StreamedData,
    SufficientStatistics as SufficientStatistics,
)
from .truncated_normal import ConvexSet as ConvexSet, sample_truncated_normal as sample_truncated_normal
from .weights import (
    LOSSES as LOSSES,
    build_prior_rows as build_prior_rows,
    compute_bisquare_weights as compute_bisquare_weights,
    compute_robust_covariance_factor as compute_robust_covariance_factor,
    compute_robust_weights as compute_robust_weights,
    compute_tuning_constant as compute_tuning_constant,
    estimate_distance_scale as estimate_distance_scale,
    estimate_robust_scale as estimate_robust_scale,
    scale_columns as scale_columns,
    solve_scaled as solve_scaled,
)
