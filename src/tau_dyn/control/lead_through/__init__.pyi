"""Lead-through programming with two force sensors: Dressler 2012, chapter 8."""

from .lead_through import LeadThrough as LeadThrough
from .sensing import ForceSensor as ForceSensor
from .settings import LeadThroughSettings as LeadThroughSettings
from .stability import ForceLoop as ForceLoop, StabilityLimit as StabilityLimit
