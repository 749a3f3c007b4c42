"""Lead-through programming with two force sensors: Dressler 2012, chapter 8."""

from .advice import (
    LeadThroughAdvice as LeadThroughAdvice,
    advise_lead_through as advise_lead_through,
    fit_contact_stiffness as fit_contact_stiffness,
)
from .lead_through import LeadThrough as LeadThrough
from .options_file import (
    LeadThroughOptions as LeadThroughOptions,
    read_lead_through_options as read_lead_through_options,
)
from .sensing import ForceSensor as ForceSensor
from .settings import LeadThroughSettings as LeadThroughSettings
from .stability import ForceLoop as ForceLoop, StabilityLimit as StabilityLimit
