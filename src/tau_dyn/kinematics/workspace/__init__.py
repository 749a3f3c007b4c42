"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from tau_dyn.kinematics.workspace.catalogue import Catalogue, catalogue
from tau_dyn.kinematics.workspace.demands import Demands
from tau_dyn.kinematics.workspace.find import find_workspace
from tau_dyn.kinematics.workspace.maps import QUANTITIES, Elasticity, Quality, elasticity
from tau_dyn.kinematics.workspace.orientations import Tilt, tilt, turns_freely
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.kinematics.workspace.sections import Section, parse_section, section, usual_sections

__all__ = [
    "QUANTITIES",
    "Catalogue",
    "Demands",
    "Elasticity",
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
