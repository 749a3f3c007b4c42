"""Results -> tables, figures, one page; reads results, computes nothing new."""

from tau_dyn.report.accuracy_page import accuracy_page
from tau_dyn.report.accuracy_terminal import print_accuracy
from tau_dyn.report.check_page import check_page
from tau_dyn.report.check_terminal import print_check
from tau_dyn.report.diagnosis_page import diagnosis_page
from tau_dyn.report.diagnosis_terminal import print_diagnosis
from tau_dyn.report.identification_page import identification_page
from tau_dyn.report.identification_terminal import print_identification
from tau_dyn.report.modes_page import modes_page
from tau_dyn.report.modes_terminal import print_modes
from tau_dyn.report.motion_pages import excitation_page, simulation_page
from tau_dyn.report.write import write_report

__all__ = [
    "accuracy_page",
    "check_page",
    "diagnosis_page",
    "excitation_page",
    "identification_page",
    "modes_page",
    "print_accuracy",
    "print_check",
    "print_diagnosis",
    "print_identification",
    "print_modes",
    "simulation_page",
    "write_report",
]
