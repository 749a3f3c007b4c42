"""How a pose file counts, orders and turns its numbers: readings without parameters, tried before any geometry is fitted."""

from .proposal import build_pose_proposal as build_pose_proposal
from .readings import ANGLE_KINDS as ANGLE_KINDS, Reading as Reading, apply_reading as apply_reading
from .rigid_fit import Misfit as Misfit, measure_misfit as measure_misfit
from .search import (
    FoundReading as FoundReading,
    find_reading as find_reading,
    is_explained as is_explained,
    measure_as_written as measure_as_written,
)
