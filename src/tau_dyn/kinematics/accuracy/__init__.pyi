"""How far the tool may be from where it should be, for stated errors of actuators, rods and joints (thesis 4.3, Appendix A)."""

from .error_bounds import (
    ActuatorError as ActuatorError,
    ErrorBounds as ErrorBounds,
    RodError as RodError,
    build_isotropic_error as build_isotropic_error,
    read_actuator_errors as read_actuator_errors,
    read_errors_file as read_errors_file,
)
from .result import (
    AccuracyResult as AccuracyResult,
    Body as Body,
    Measured as Measured,
    study_accuracy as study_accuracy,
)
from .section import (
    Grid as Grid,
    Section as Section,
    choose_default_section as choose_default_section,
    lay_default_grid as lay_default_grid,
    lay_grid as lay_grid,
    read_section as read_section,
    sample_default_motion as sample_default_motion,
)
from .study import (
    METHODS as METHODS,
    Accuracy as Accuracy,
    Growth as Growth,
    build_device as build_device,
    compute_positioning_errors as compute_positioning_errors,
    scale_errors as scale_errors,
)
