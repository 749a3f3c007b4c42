"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.workspace.catalogue import Catalogue, build_catalogue
from tau_dyn.kinematics.workspace.find import find_workspace
from tau_dyn.kinematics.workspace.maps import QUANTITIES, Elasticity, Quality, build_elasticity
from tau_dyn.kinematics.workspace.orientations import Tilt, measure_tilt, turns_freely
from tau_dyn.kinematics.workspace.pose_requirements import PoseRequirements
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.kinematics.workspace.sections import Section, choose_usual_sections, judge_section, parse_section

__all__ = [
    "QUANTITIES",
    "Catalogue",
    "Elasticity",
    "PoseRequirements",
    "Quality",
    "Section",
    "Tilt",
    "Workspace",
    "build_catalogue",
    "build_elasticity",
    "choose_usual_sections",
    "find_workspace",
    "judge_section",
    "measure_tilt",
    "parse_section",
    "turns_freely",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
