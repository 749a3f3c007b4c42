"""The extended model's parameters beside those of the model without the causes, as lines of the parameter table."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from tau_dyn.diagnose import Diagnosis
from tau_dyn.estimate import MAX_RELATIVE_STDERR
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.report.formatting import Z95, format_with_uncertainty
from tau_dyn.report.parameter_rows import (
    ParameterRow,
    compare_with_nominal,
    compute_bar_scale,
    describe_row,
    explain_unreliable,
    name_group,
)
from tau_dyn.robot import NOMINAL_MASS_STDERR, Robot, load_robot_from_urdf


def build_diagnosed_rows(diagnosis: Diagnosis) -> tuple[list[ParameterRow], float]:
    """Return the table's lines for the extended model, and the bars' half-width as a share of the reference."""
    model, before = diagnosis.extended_model, diagnosis.model.parameters
    nominal = _nominal(model.robot)
    raw = [_raw(p, nominal) for p in model.parameters if p.free]
    scale = compute_bar_scale(raw)
    rows = [describe_row(r, scale, name_group(model, r["name"]), _note(r, before)) for r in raw]
    return [replace(row, before=_before(row.name, before)) for row in rows], scale


def _nominal(robot: Robot) -> Parameters:
    """Return the values of the robot's own file, which the model carries along."""
    return load_robot_from_urdf(robot.urdf, robot.source, actuated=robot.actuated).parameters


def _raw(p: Parameter, nominal: Parameters) -> dict[str, Any]:
    known = nominal[p.name] if p.name in nominal else None
    sigma = p.stderr
    trust = None
    if known is not None:
        mass = NOMINAL_MASS_STDERR * abs(known.value) if p.name.endswith(".mass") else None
        trust = mass if known.prior_stderr is None else known.prior_stderr
    return {
        "name": p.name,
        "value": p.value,
        "unit": p.unit,
        "stderr": sigma,
        "ci95": None if sigma is None else [max(p.lower, p.value - Z95 * sigma), min(p.upper, p.value + Z95 * sigma)],
        "determined": sigma is not None and bool(sigma < MAX_RELATIVE_STDERR * abs(p.value)),
        "nominal": None if known is None else known.value,
        "nominal_stderr": trust,
        "at_bound": sigma is not None and p.at_bound,
    }


def _note(r: dict[str, Any], before: Parameters) -> str:
    if r["stderr"] is None:
        return "identifiable only in combination; the value is one of many with the same forces"
    return explain_unreliable(r) or ("new" if r["name"] not in before else compare_with_nominal(r))


def _before(name: str, before: Parameters) -> str:
    return format_with_uncertainty(before[name].value, before[name].stderr) if name in before else ""
