"""Are guideways straight and parallel, does the plate keep its orientation: thesis 4.2's assumptions, on measured points."""

from tau_dyn.kinematics.assumptions.guideway import Guideway, fit_guideway, load_shift
from tau_dyn.kinematics.assumptions.orientation import Orientation, check_orientation
from tau_dyn.kinematics.assumptions.parallelism import Parallelism, check_parallelism

__all__ = [
    "Guideway",
    "Orientation",
    "Parallelism",
    "check_orientation",
    "check_parallelism",
    "fit_guideway",
    "load_shift",
]
