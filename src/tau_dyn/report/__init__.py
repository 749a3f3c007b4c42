"""Results -> tables, figures, one page; reads results, computes nothing new."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.report.accuracy_page import build_accuracy_page
from tau_dyn.report.accuracy_terminal import print_accuracy
from tau_dyn.report.check_page import check_page
from tau_dyn.report.check_terminal import print_check
from tau_dyn.report.diagnosis_page import build_diagnosis_page
from tau_dyn.report.diagnosis_terminal import print_diagnosis
from tau_dyn.report.identification_page import build_identification_page
from tau_dyn.report.identification_terminal import print_identification
from tau_dyn.report.modes_page import build_modes_page
from tau_dyn.report.modes_terminal import print_modes, print_operational_modes
from tau_dyn.report.motion_pages import build_excitation_page, build_simulation_page
from tau_dyn.report.operational_page import build_operational_modes_page
from tau_dyn.report.write import write_report

__all__ = [
    "build_accuracy_page",
    "build_diagnosis_page",
    "build_excitation_page",
    "build_identification_page",
    "build_modes_page",
    "build_operational_modes_page",
    "build_simulation_page",
    "check_page",
    "print_accuracy",
    "print_check",
    "print_diagnosis",
    "print_identification",
    "print_modes",
    "print_operational_modes",
    "write_report",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
