"""Settings of lead-through from a YAML file: what the command `lead-through` has no option for.

Each key is a field of `LeadThroughSettings`, or `filter_hz`. A sensor is a map of the fields of `ForceSensor`:

    task: surface
    press: 2.0
    tool_sensor: {position: [0, 0, -0.1], mass: 0.8, centre: [0, 0, 0.05], largest_force: 60}
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.control.lead_through.sensing import ForceSensor
from tau_dyn.control.lead_through.settings import LeadThroughSettings
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml

_BY_COMMAND = {"contact_stiffness", "mass", "damping", "force_gain", "hand_stiffness", "loop"}  # options of the command
_SENSORS = ("handle_sensor", "tool_sensor")


@dataclass(frozen=True)
class LeadThroughOptions:
    """Settings beyond those of the stability limit.

    Attributes:
        filter_hz: Corner of the low-pass on the tool force [Hz].
        values: Fields of `LeadThroughSettings`.
    """

    filter_hz: float = np.inf
    values: dict[str, Any] = field(default_factory=dict)


def read_lead_through_options(path: str | Path) -> LeadThroughOptions:
    """Return the settings of a file.

    Raises:
        InputError: It is no map of known names, or a value is of the wrong kind.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError("file_format", f"{path}: settings are a map of names and values")
    known = {f.name for f in fields(LeadThroughSettings)} - _BY_COMMAND
    given = {str(key): value for key, value in content.items()}
    filter_hz = given.pop("filter_hz", np.inf)
    for name in given:
        if name not in known:
            raise UnknownName("setting of lead-through", name, sorted({*known, "filter_hz"}), str(path))
    try:
        values = {name: _read_value(name, value) for name, value in given.items()}
        return LeadThroughOptions(float(filter_hz), values)
    except (TypeError, ValueError) as fault:
        if isinstance(fault, InputError):
            raise InputError(fault.code, f"{path}: {fault}") from fault
        raise InputError("file_format", f"{path}: a setting has a value of the wrong kind ({fault})") from fault


def _read_value(name: str, value: Any) -> Any:
    """Return a value of a file as the settings take it."""
    if name in _SENSORS:
        given: dict[str, Any] = {str(k): np.array(x, float) if np.ndim(x) else float(x) for k, x in dict(value).items()}
        return ForceSensor(**given)
    if isinstance(value, bool | str) or value is None:
        return value
    return np.array(value, float) if np.ndim(value) else float(value)
