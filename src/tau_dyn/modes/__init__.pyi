"""Vibration logs -> resonances -> M, D, K."""

from .actuators import Actuator as Actuator
from .checks import CorrelationTest as CorrelationTest
from .figure import Skeleton as Skeleton
from .find import find_modes as find_modes
from .methods import stabilise_poles as stabilise_poles
from .modal import Z95 as Z95, Mode as Mode
from .model_file import (
    ModelFile as ModelFile,
    load_state_space as load_state_space,
    save_state_space as save_state_space,
)
from .on_robot import (
    ModePair as ModePair,
    ModeShape as ModeShape,
    ShapesOnRobot as ShapesOnRobot,
    project_shapes_on_robot as project_shapes_on_robot,
)
from .operational import find_operational_modes as find_operational_modes
from .operational_result import REASON_WITHOUT_SCALE as REASON_WITHOUT_SCALE, OperationalModes as OperationalModes
from .record import Record as Record
from .refinement import RefinedModel as RefinedModel, refine as refine
from .residuals import (
    compute_aic_bic as compute_aic_bic,
    compute_log_det_loss as compute_log_det_loss,
    count_free_parameters as count_free_parameters,
)
from .result import Modes as Modes, Trace as Trace
from .stabilisation import StabilityPoint as StabilityPoint
from .state_space import StateSpace as StateSpace
from .subspace import compress_subspace_data as compress_subspace_data
