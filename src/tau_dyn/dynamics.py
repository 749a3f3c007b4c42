"""The former name of `tau_dyn.mechanism`, for one release."""

import warnings
from typing import Any

import tau_dyn.mechanism


def __getattr__(name: str) -> Any:
    warnings.warn(f"tau_dyn.dynamics is deprecated, use tau_dyn.mechanism.{name}", DeprecationWarning, stacklevel=2)
    return getattr(tau_dyn.mechanism, name)
