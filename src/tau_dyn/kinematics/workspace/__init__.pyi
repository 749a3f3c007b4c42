"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from .elastic_maps import (
    ELASTIC as ELASTIC,
    ELASTIC_MAPS as ELASTIC_MAPS,
    Elasticity as Elasticity,
    build_elasticity as build_elasticity,
    compute_elastic_values as compute_elastic_values,
)
from .find import find_workspace as find_workspace
from .lattice import INSIDE as INSIDE
from .machine import (
    InverseSolution as InverseSolution,
    WorkspaceModel as WorkspaceModel,
    build_machine as build_machine,
    commands_positions as commands_positions,
    get_travel as get_travel,
)
from .maps import (
    QUANTITIES as QUANTITIES,
    Catalogue as Catalogue,
    CatalogueRow as CatalogueRow,
    Quality as Quality,
    build_catalogue as build_catalogue,
)
from .pose_check import KINDS as KINDS, PoseChecker as PoseChecker, PoseRequirements as PoseRequirements
from .result import Workspace as Workspace
from .study import (
    Section as Section,
    Study as Study,
    Tilt as Tilt,
    build_points_table as build_points_table,
    choose_usual_sections as choose_usual_sections,
    judge_section as judge_section,
    measure_tilt as measure_tilt,
    parse_section as parse_section,
    study_workspace as study_workspace,
    turns_freely as turns_freely,
)
