"""A sum of parameters that the data tell, though they may tell none of its terms: `w' theta` with its standard error.

`w' theta` is seen if and only if `w` lies in the row space of the columns, that is if `w_D = K' w_B`; then it equals
`w_B' beta`. So a published base parameter, or a total mass, can be compared whatever base either side has chosen.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tau_dyn.estimate.estimate import Estimate
from tau_dyn.exceptions import CannotAnswer, UnknownName

_TOLERANCE = 1e-6
"""Relative part of a weight that may be off: base combinations are known to about 1e-9, published ones are often rounded."""


class ParameterSum(NamedTuple):
    """The value of a sum of parameters and its standard error."""

    value: float
    stderr: float


def combine_parameters(estimate: Estimate, weights: Mapping[str, float]) -> ParameterSum:
    """Return `sum of weight * parameter` as plain least squares sees it, before bounds and physics, which the error is for.

    Args:
        estimate: A solved regression.
        weights: Factor of each parameter, by name; a fixed parameter counts with its value, as exact.

    Raises:
        UnknownName: A name that is no parameter.
        CannotAnswer: The data do not identify this sum.
    """
    base, parameters = estimate.base, estimate.parameters
    for name in weights:
        if name not in parameters:
            raise UnknownName("parameter", name, parameters.names)
    w = np.array([weights.get(name, 0.0) for name in base.names])
    kept, dropped = w[base.kept], w[base.dropped]
    off = np.abs(dropped - base.K.T @ kept)
    unseen = off > _TOLERANCE * (np.abs(dropped) + np.abs(base.K.T) @ np.abs(kept))
    if unseen.any():
        names = [base.names[c] for c in base.dropped[unseen]]
        text = " + ".join(f"{x:g}*{name}" for name, x in weights.items())
        raise CannotAnswer(
            "not_identifiable",
            f"the data do not identify {text}; what they see holds other shares of {', '.join(names)}",
            "ask for a base parameter's expression, or record a motion that tells these apart",
        )
    fixed = sum(x * parameters[name].value for name, x in weights.items() if name not in base.names)
    return ParameterSum(float(kept @ estimate.beta_plain) + fixed, estimate.stderr_of(kept))
