"""Public names of packages: bound from a package's stub `__init__.pyi`, loaded on first use; former names warn."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

from lazy_loader import attach_stub

DEPRECATED: dict[str, dict[str, str]] = {
    "tau_dyn.calibrate": {
        "CAUSE_EQUATIONS": "tau_dyn.effects.GEOMETRY_CAUSES",
        "CalibrationFinding": "tau_dyn.evidence.Finding",
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
        "write_c_source": "tau_dyn.codegen.write_c_source",
        "write_kinematics_source": "tau_dyn.codegen.write_kinematics_source",
        "write_learning_source": "tau_dyn.codegen.write_learning_source",
        "write_observer_source": "tau_dyn.codegen.write_observer_source",
        "write_python_source": "tau_dyn.codegen.write_python_source",
        "build_program": "tau_dyn.codegen.build_program",
        "Program": "tau_dyn.codegen.Program",
        "ARGUMENTS": "tau_dyn.codegen.ARGUMENTS",
        "build_kinematics": "tau_dyn.codegen.build_kinematics",
        "KinematicsProgram": "tau_dyn.codegen.KinematicsProgram",
        "Graph": "tau_dyn.codegen.Graph",
        "Node": "tau_dyn.codegen.Node",
        "ExpressionArray": "tau_dyn.codegen.ExpressionArray",
        "as_expression_array": "tau_dyn.codegen.as_expression_array",
        "build_inputs": "tau_dyn.codegen.build_inputs",
        "build_identifiers": "tau_dyn.codegen.build_identifiers",
        "include_header": "tau_dyn.codegen.include_header",
        "locate_header": "tau_dyn.codegen.locate_header",
        "draw_random_states": "tau_dyn.codegen.draw_random_states",
        "Learning": "LearningHistory",
        "band_stop": "design_band_stop",
        "c_source": "tau_dyn.codegen.write_c_source",
        "controlled_actuators": "stack_controlled_actuators",
        "convergence": "analyse_convergence",
        "corrected": "apply_correction",
        "correction_of": "build_correction",
        "dip": "build_notch",
        "kinematics_source": "tau_dyn.codegen.write_kinematics_source",
        "learning_source": "tau_dyn.codegen.write_learning_source",
        "low_pass": "design_low_pass",
        "observer_source": "tau_dyn.codegen.write_observer_source",
        "picture": "compute_frequency_condition",
        "product": "chain_filters",
        "python_source": "tau_dyn.codegen.write_python_source",
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
        "Diagnosis": "tau_dyn.evidence.Diagnosis",
        "Finding": "tau_dyn.evidence.Finding",
        "Gain": "tau_dyn.evidence.Gain",
        "Limit": "tau_dyn.evidence.Limit",
        "OutputErrors": "tau_dyn.evidence.OutputErrors",
        "Signature": "tau_dyn.evidence.Signature",
        "Status": "tau_dyn.evidence.Status",
        "Step": "tau_dyn.evidence.Step",
        "TimeTrace": "tau_dyn.evidence.TimeTrace",
        "Unexplained": "tau_dyn.evidence.Unexplained",
        "Untestable": "tau_dyn.evidence.Untestable",
        "Errors": "tau_dyn.evidence.OutputErrors",
        "PARAMETER_CAUSES": "tau_dyn.effects.PARAMETER_CAUSES",
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
        "Forward": "tau_dyn.mechanism.ForwardResult",
        "ForwardResult": "tau_dyn.mechanism.ForwardResult",
        "Inverse": "tau_dyn.mechanism.InverseResult",
        "InverseResult": "tau_dyn.mechanism.InverseResult",
        "LoopSolver": "tau_dyn.mechanism.LoopSolver",
        "NotRods": "tau_dyn.mechanism.NotRods",
        "Poses": "tau_dyn.mechanism.Poses",
        "Rods": "tau_dyn.mechanism.Rods",
        "Singularity": "tau_dyn.mechanism.Singularity",
        "TreeState": "tau_dyn.mechanism.TreeState",
        "acceleration_bias": "tau_dyn.mechanism.compute_acceleration_bias",
        "build_rods": "tau_dyn.mechanism.build_rods",
        "compute_acceleration_bias": "tau_dyn.mechanism.compute_acceleration_bias",
        "compute_inverse_jacobian": "tau_dyn.mechanism.compute_inverse_jacobian",
        "configurations": "tau_dyn.mechanism.list_configurations",
        "convert_from_quaternions": "tau_dyn.mechanism.convert_from_quaternions",
        "convert_to_quaternions": "tau_dyn.mechanism.convert_to_quaternions",
        "follow": "follow_path",
        "forward_kinematics": "tau_dyn.mechanism.forward_kinematics",
        "forward_solutions": "tau_dyn.mechanism.solve_both_forward",
        "from_quaternions": "tau_dyn.mechanism.convert_from_quaternions",
        "get_home_configuration": "tau_dyn.mechanism.get_home_configuration",
        "home_configuration": "tau_dyn.mechanism.get_home_configuration",
        "inverse_jacobian": "tau_dyn.mechanism.compute_inverse_jacobian",
        "inverse_kinematics": "tau_dyn.mechanism.inverse_kinematics",
        "inverse_solutions": "tau_dyn.mechanism.solve_all_configurations",
        "jacobian": "tau_dyn.mechanism.jacobian",
        "list_configurations": "tau_dyn.mechanism.list_configurations",
        "measure_singularity": "tau_dyn.mechanism.measure_singularity",
        "quaternions": "tau_dyn.mechanism.convert_to_quaternions",
        "singularity": "tau_dyn.mechanism.measure_singularity",
        "solve_all_configurations": "tau_dyn.mechanism.solve_all_configurations",
        "solve_both_forward": "tau_dyn.mechanism.solve_both_forward",
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
        "count": "tau_dyn.results.count",
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
"""Package -> former name -> name, with its package where that is another one. Former names go with the next release."""


def attach_public_names(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return a package's `__getattr__`, `__dir__` and `__all__`: the names of its stub, and its former names.

    Args:
        package: `__name__` of the package.
        file: Its `__file__`; the stub stands beside it.
    """
    load, names, public = attach_stub(package, file)

    def get(name: str) -> Any:
        new = DEPRECATED.get(package, {}).get(name)
        if new is not None:
            return _get_renamed(package, name, new)
        if name not in public:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return load(name)

    return get, names, public


def _get_renamed(package: str, name: str, new: str) -> Any:
    """Return what a former name stands for, with a `DeprecationWarning`."""
    where, leaf = new.rsplit(".", 1) if "." in new else (package, new)
    warnings.warn(f"{package}.{name} is deprecated, use {where}.{leaf}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(where), leaf)
