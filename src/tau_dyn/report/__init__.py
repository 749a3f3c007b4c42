"""Results -> tables, figures, one page; reads results, computes nothing new."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tau_dyn.deprecated_names import get_deprecated

if TYPE_CHECKING:
    from tau_dyn.report.accuracy_page import build_accuracy_page
    from tau_dyn.report.accuracy_terminal import print_accuracy
    from tau_dyn.report.check_terminal import print_check
    from tau_dyn.report.diagnosis_page import build_diagnosis_page
    from tau_dyn.report.diagnosis_terminal import print_diagnosis
    from tau_dyn.report.identification_page import build_identification_page
    from tau_dyn.report.identification_terminal import print_identification
    from tau_dyn.report.log_check_page import check_page
    from tau_dyn.report.modes_page import build_modes_page
    from tau_dyn.report.modes_terminal import print_modes, print_operational_modes
    from tau_dyn.report.motion_pages import build_excitation_page, build_simulation_page
    from tau_dyn.report.operational_page import build_operational_modes_page
    from tau_dyn.report.write import write_report

_MODULE = {
    "build_accuracy_page": "accuracy_page",
    "print_accuracy": "accuracy_terminal",
    "check_page": "log_check_page",
    "print_check": "check_terminal",
    "build_diagnosis_page": "diagnosis_page",
    "print_diagnosis": "diagnosis_terminal",
    "build_identification_page": "identification_page",
    "print_identification": "identification_terminal",
    "build_modes_page": "modes_page",
    "print_modes": "modes_terminal",
    "print_operational_modes": "modes_terminal",
    "build_excitation_page": "motion_pages",
    "build_simulation_page": "motion_pages",
    "build_operational_modes_page": "operational_page",
    "write_report": "write",
}
"""Where each name lives; a page is loaded when it is first asked for."""

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


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        return get_deprecated(__name__, name)
    found = getattr(import_module(f"{__name__}.{_MODULE[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
