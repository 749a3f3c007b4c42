"""Iterative learning control: filters, stability before anything moves, and learning itself."""

from .actuator_models import (
    ActuatorModels as ActuatorModels,
    SavedActuators as SavedActuators,
    fit_actuator_models as fit_actuator_models,
    read_actuators as read_actuators,
    read_saved_actuators as read_saved_actuators,
)
from .filters import (
    TimeShift as TimeShift,
    ZeroPhase as ZeroPhase,
    build_notch as build_notch,
    chain_filters as chain_filters,
    design_band_stop as design_band_stop,
    design_low_pass as design_low_pass,
)
from .joint_learning import JointLearning as JointLearning, LawChoice as LawChoice
from .laws import (
    LearningLaw as LearningLaw,
    NormOptimalLaw as NormOptimalLaw,
    UpdateLaw as UpdateLaw,
    design_robust_filter as design_robust_filter,
)
from .learned_outputs import MotorSide as MotorSide, Reference as Reference, ToolSide as ToolSide
from .learning_step import (
    LearningOptions as LearningOptions,
    LearningStep as LearningStep,
    compute_learning_step as compute_learning_step,
)
from .lifted_system import (
    Operator as Operator,
    build_convolution as build_convolution,
    build_signal_operator as build_signal_operator,
    compute_pulse_response as compute_pulse_response,
    stack_controlled_actuators as stack_controlled_actuators,
)
from .resonant_drive import (
    ResonantDrive as ResonantDrive,
    ResponseInverse as ResponseInverse,
    read_resonant_drives as read_resonant_drives,
)
from .tool_axes import ToolAxes as ToolAxes
from .trial_loop import (
    Convergence as Convergence,
    FrequencyCondition as FrequencyCondition,
    LearningHistory as LearningHistory,
    TrialPlant as TrialPlant,
    analyse_convergence as analyse_convergence,
    build_iteration_operator as build_iteration_operator,
    compute_frequency_condition as compute_frequency_condition,
    learn as learn,
    require_convergence as require_convergence,
)
from .trial_response import Forecast as Forecast, TrialResponse as TrialResponse
