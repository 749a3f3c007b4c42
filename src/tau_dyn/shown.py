"""The former place of `results.Shown`."""

from tau_dyn.results import Shown as Shown
