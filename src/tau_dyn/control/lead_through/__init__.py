"""Lead-through programming with two force sensors: Dressler 2012, chapter 8."""

from tau_dyn.control.lead_through.lead_through import LeadThrough
from tau_dyn.control.lead_through.sensor import ForceSensor
from tau_dyn.control.lead_through.settings import LeadThroughSettings
from tau_dyn.control.lead_through.stability import ForceLoop, StabilityLimit
from tau_dyn.deprecated_names import get_deprecated

__all__ = ["ForceLoop", "ForceSensor", "LeadThrough", "LeadThroughSettings", "StabilityLimit"]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
