"""Vibration logs -> resonances -> M, D, K."""

from .actuators import Actuator as Actuator, ActuatorFit as ActuatorFit, fit_actuators as fit_actuators
from .find import find_modes as find_modes
from .methods import stabilise_poles as stabilise_poles
from .modal import Z95 as Z95, Mode as Mode, StabilityPoint as StabilityPoint, find_resonances as find_resonances
from .on_robot import (
    ModePair as ModePair,
    ModeShape as ModeShape,
    ShapesOnRobot as ShapesOnRobot,
    Skeleton as Skeleton,
    project_shapes_on_robot as project_shapes_on_robot,
)
from .operational import find_operational_modes as find_operational_modes
from .record import Record as Record, build_records as build_records
from .refinement import (
    RefinedModel as RefinedModel,
    RefinementPath as RefinementPath,
    descend_to_fit as descend_to_fit,
    refine as refine,
)
from .residuals import (
    CorrelationTest as CorrelationTest,
    compute_aic_bic as compute_aic_bic,
    compute_log_det_loss as compute_log_det_loss,
    count_free_parameters as count_free_parameters,
)
from .result import (
    REASON_WITHOUT_SCALE as REASON_WITHOUT_SCALE,
    Modes as Modes,
    OperationalModes as OperationalModes,
    Trace as Trace,
)
from .springs import (
    FittedSpring as FittedSpring,
    RecordFit as RecordFit,
    SpringFit as SpringFit,
    find_springs as find_springs,
)
from .state_space import (
    ModelFile as ModelFile,
    StateSpace as StateSpace,
    load_state_space as load_state_space,
    save_state_space as save_state_space,
    simulate_states as simulate_states,
)
from .subspace import compress_subspace_data as compress_subspace_data
