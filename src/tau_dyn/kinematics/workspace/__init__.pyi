"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from .catalogue import Catalogue as Catalogue, build_catalogue as build_catalogue
from .find import find_workspace as find_workspace
from .lattice import INSIDE as INSIDE
from .machine import InverseSolution as InverseSolution, WorkspaceModel as WorkspaceModel, get_travel as get_travel
from .machines import build_machine as build_machine
from .maps import (
    QUANTITIES as QUANTITIES,
    Elasticity as Elasticity,
    Quality as Quality,
    build_elasticity as build_elasticity,
)
from .orientations import Tilt as Tilt, measure_tilt as measure_tilt, turns_freely as turns_freely
from .pose_check import PoseChecker as PoseChecker
from .pose_requirements import KINDS as KINDS, PoseRequirements as PoseRequirements
from .result import Workspace as Workspace
from .sections import (
    Section as Section,
    choose_usual_sections as choose_usual_sections,
    judge_section as judge_section,
    parse_section as parse_section,
)
from .study import Study as Study, study_workspace as study_workspace
from .table import build_points_table as build_points_table
