"""Are guideways straight and parallel, does the plate keep its orientation: thesis 4.2's assumptions, on measured points."""

from .guideway import Guideway as Guideway, fit_guideway as fit_guideway, load_shift as load_shift
from .parallelism import (
    Orientation as Orientation,
    Parallelism as Parallelism,
    check_orientation as check_orientation,
    check_parallelism as check_parallelism,
)
