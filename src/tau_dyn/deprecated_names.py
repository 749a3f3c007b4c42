"""Public names that have been renamed: the former name stays importable for one release and warns."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

DEPRECATED: dict[str, dict[str, str]] = {
    "tau_dyn.calibrate": {
        "Errors": "PoseErrors",
        "Fit": "GeometryFit",
        "fit": "fit_geometry_to_poses",
        "tie": "constrain_parameters",
    },
    "tau_dyn.calibrate.poses": {
        "Device": "MeasuringDevice",
        "Plan": "CalibrationCampaign",
        "Prediction": "CalibrationPrediction",
    },
    "tau_dyn.compare": {
        "Difference": "CircumstanceDifference",
        "Run": "RecordedRun",
        "Side": "ComparedSide",
    },
    "tau_dyn.control": {
        "Learning": "LearningHistory",
        "band_stop": "design_band_stop",
        "c_source": "write_c_source",
        "controlled_actuators": "stack_controlled_actuators",
        "convergence": "analyse_convergence",
        "corrected": "apply_correction",
        "correction_of": "build_correction",
        "dip": "build_notch",
        "kinematics_source": "write_kinematics_source",
        "learning_source": "write_learning_source",
        "low_pass": "design_low_pass",
        "observer_source": "write_observer_source",
        "picture": "compute_frequency_condition",
        "product": "chain_filters",
        "python_source": "write_python_source",
        "rapid_motion": "format_rapid_motion",
        "reference_of": "build_reference",
        "require": "require_convergence",
        "robust_filter": "design_robust_filter",
    },
    "tau_dyn.control.interface": {
        "PERIOD": "DEFAULT_PERIOD_S",
        "broken_limits": "list_exceeded_limits",
        "corrected": "apply_correction",
        "correction_of": "build_correction",
        "rapid_motion": "format_rapid_motion",
        "reference_of": "build_reference",
    },
    "tau_dyn.control.iterative": {
        "Learning": "LearningHistory",
        "Picture": "FrequencyCondition",
        "Plant": "TrialPlant",
        "band_stop": "design_band_stop",
        "controlled_actuators": "stack_controlled_actuators",
        "convergence": "analyse_convergence",
        "dip": "build_notch",
        "iteration_operator": "build_iteration_operator",
        "lifted": "build_lifted_matrix",
        "low_pass": "design_low_pass",
        "picture": "compute_frequency_condition",
        "product": "chain_filters",
        "pulse_response": "compute_pulse_response",
        "require": "require_convergence",
        "robust_filter": "design_robust_filter",
    },
    "tau_dyn.control.lead_through": {
        "Limit": "StabilityLimit",
    },
    "tau_dyn.control.motion": {
        "feedback_noise": "estimate_feedback_noise",
        "margin_for": "compute_feedback_margin",
    },
    "tau_dyn.control.observers": {
        "Extended": "ExtendedModel",
        "extended": "extend_model",
    },
    "tau_dyn.diagnose": {
        "Errors": "OutputErrors",
        "with_simulation": "add_simulation",
    },
    "tau_dyn.effects": {
        "friction_model": "build_friction_model",
    },
    "tau_dyn.estimate": {
        "Body": "InertialBody",
        "Combination": "ParameterSum",
        "DETERMINED": "MAX_RELATIVE_STDERR",
        "Everything": "StreamedData",
        "Physics": "PhysicalConstraints",
        "Rows": "RegressionRows",
        "Run": "RegressionRun",
        "Totals": "SufficientStatistics",
        "combination": "combine_parameters",
        "unit_columns": "scale_columns",
    },
    "tau_dyn.exchange": {
        "fmu_of": "build_fmu",
        "mjcf_of": "build_mjcf",
        "urdf_of": "build_urdf",
    },
    "tau_dyn.excitation": {
        "Design": "ExcitationDesign",
        "Prediction": "InformationPrediction",
        "noise_of_log": "estimate_log_noise",
    },
    "tau_dyn.identify": {
        "Engine": "BlockExecutor",
        "force_errors": "build_force_errors",
        "spoils_diagnosis": "is_diagnosis_invalid",
    },
    "tau_dyn.kinematics": {
        "Followed": "FollowedPath",
        "Forward": "ForwardResult",
        "Inverse": "InverseResult",
        "acceleration_bias": "compute_acceleration_bias",
        "configurations": "list_configurations",
        "follow": "follow_path",
        "forward_solutions": "solve_both_forward",
        "from_quaternions": "convert_from_quaternions",
        "home_configuration": "get_home_configuration",
        "inverse_jacobian": "compute_inverse_jacobian",
        "inverse_solutions": "solve_all_configurations",
        "quaternions": "convert_to_quaternions",
        "singularity": "measure_singularity",
    },
    "tau_dyn.kinematics.accuracy": {
        "Errors": "ErrorBounds",
        "accuracy_study": "study_accuracy",
        "actuator_errors": "read_actuator_errors",
        "default_section": "choose_default_section",
        "device_of": "build_device",
        "grow": "scale_errors",
        "positioning_errors": "compute_positioning_errors",
        "same_in_all_directions": "build_isotropic_error",
    },
    "tau_dyn.kinematics.assembly": {
        "assembly_modes": "find_assembly_modes",
        "assembly_modes_of": "find_robot_assembly_modes",
        "configuration_states": "solve_configuration_states",
        "reachable_modes": "find_reachable_modes",
    },
    "tau_dyn.kinematics.workspace": {
        "Demands": "PoseRequirements",
        "elasticity": "build_elasticity",
        "section": "judge_section",
        "tilt": "measure_tilt",
        "usual_sections": "choose_usual_sections",
    },
    "tau_dyn.log": {
        "Finding": "CheckFinding",
        "Stretch": "EvenSegment",
        "attenuation": "compute_attenuation",
        "edge_samples": "compute_edge_samples",
        "encoder_noise": "estimate_encoder_noise",
        "motion_band": "find_motion_band",
        "noise_gain": "compute_noise_gain",
        "quantisation_step": "estimate_quantisation_step",
        "reversals": "find_reversals",
        "segments": "split_at_gaps",
        "short_segments": "count_short_segments",
        "stretches": "split_even_segments",
        "unbroken": "find_true_runs",
        "unit_warnings": "list_unit_warnings",
        "velocity_noise": "compute_velocity_noise",
    },
    "tau_dyn.report": {
        "excitation_page": "build_excitation_page",
        "simulation_page": "build_simulation_page",
    },
    "tau_dyn.robot": {
        "robot_from_urdf": "load_robot_from_urdf",
        "short_names": "list_robot_names",
        "stock_names": "list_stock_robots",
    },
    "tau_dyn.simulate": {
        "base_condition": "compute_base_condition",
        "binary_log": "simulate_binary_log",
        "broken_limit": "describe_exceeded_limit",
        "condition_bound": "compute_condition_bound",
        "drive": "simulate_drive",
        "exciting_motion": "build_exciting_motion",
        "fourier_motion": "build_fourier_motion",
        "multisine_on_stroke": "build_multisine_on_stroke",
        "named_motion": "build_named_motion",
        "random_binary_motion": "build_random_binary_motion",
        "slow_motion": "build_slow_motion",
        "stroke_motion": "build_stroke_motion",
        "vibration_log": "simulate_vibration_log",
    },
    "tau_dyn.view": {
        "playback_of": "build_playback",
        "shapes_of": "build_furniture",
    },
    "tau_dyn.vision": {
        "PoseTable": "CameraPoseTable",
        "poses_from_images": "measure_poses_from_images",
    },
}
"""Package -> former name -> name."""


def get_deprecated(package: str, name: str) -> Any:
    """Return what a package's former name stands for, with a `DeprecationWarning`."""
    new = DEPRECATED.get(package, {}).get(name)
    if new is None:
        raise AttributeError(f"module '{package}' has no attribute '{name}'")
    warnings.warn(f"{package}.{name} is deprecated, use {package}.{new}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(package), new)
