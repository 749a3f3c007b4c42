"""A robot whose springs yield: linearised about a pose, natural modes, linear systems to simulate."""

from .linear_system import (
    L1_DRIVES as L1_DRIVES,
    ContinuousModel as ContinuousModel,
    PositionDrives as PositionDrives,
    SampledModel as SampledModel,
)
from .model import FlexibleModel as FlexibleModel, Linearised as Linearised, NaturalMode as NaturalMode
from .stated_springs import (
    name_rod_spring as name_rod_spring,
    state_springs as state_springs,
    write_springs as write_springs,
)
