"""A result's page as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tau_dyn.diagnose import Diagnosis
from tau_dyn.files import write_whole
from tau_dyn.identify import Identification
from tau_dyn.report.diagnosis_page import build_diagnosis_page
from tau_dyn.report.identification_page import build_identification_page


def write_report(path: str | Path, found: Identification | Diagnosis, **options: Any) -> None:
    """Write the page; it appears whole or not at all.

    Options are those of `build_identification_page` or `build_diagnosis_page`.
    """
    made = (
        build_diagnosis_page(found, **options)
        if isinstance(found, Diagnosis)
        else build_identification_page(found, **options)
    )
    write_whole(path, made)
