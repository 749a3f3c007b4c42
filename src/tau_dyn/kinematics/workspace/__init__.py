"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.workspace.catalogue import Catalogue, catalogue
from tau_dyn.kinematics.workspace.find import find_workspace
from tau_dyn.kinematics.workspace.maps import QUANTITIES, Elasticity, Quality, elasticity
from tau_dyn.kinematics.workspace.orientations import Tilt, tilt, turns_freely
from tau_dyn.kinematics.workspace.pose_requirements import PoseRequirements
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.kinematics.workspace.sections import Section, parse_section, section, usual_sections

__all__ = [
    "QUANTITIES",
    "Catalogue",
    "Elasticity",
    "PoseRequirements",
    "Quality",
    "Section",
    "Tilt",
    "Workspace",
    "catalogue",
    "elasticity",
    "find_workspace",
    "parse_section",
    "section",
    "tilt",
    "turns_freely",
    "usual_sections",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
