"""The covariance of one modal form from that of another: after a change of units, or from a predictor to its model.

First-order propagation with central differences; the change of form itself is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form, flatten_form, free_numbers, step_form
from tau_dyn.modes.state_space import StateSpace

OF_STDERR = 1e-3  # step of the derivative, as a part of the standard error ...
OF_VALUE = 1e-6  # ... and at least this part of the number, where rounding would drown it


def propagate_covariance(
    form: ModalForm, covariance: np.ndarray, direct: np.ndarray, change: Callable[[ModalForm], StateSpace]
) -> np.ndarray:
    """Return the covariance (size, size) of the full vector of `build_modal_form(change(form))`.

    Rows of a mode that cannot be followed (two poles about to meet on the real axis) are nan.

    Args:
        form: The form that was estimated.
        covariance: Of its free numbers (f, f).
        direct: Which entries of its D are free.
        change: Makes the wanted model of a form.
    """
    reference = build_modal_form(change(form))
    free = np.flatnonzero(free_numbers(form, direct))
    values = flatten_form(form)[free]
    steps = np.maximum(
        OF_STDERR * np.sqrt(np.maximum(np.diag(covariance), 0)), OF_VALUE * np.maximum(abs(values), 1e-3)
    )
    jacobian = np.zeros((build_layout(reference).size, len(free)))
    for column, (index, h) in enumerate(zip(free, steps, strict=True)):
        step = np.zeros(build_layout(form).size)
        step[index] = h
        with np.errstate(all="ignore"):  # a mode that is lost on the way may divide by zero; it is nan in the end
            ahead, behind = (_followed(build_modal_form(change(step_form(form, s))), reference) for s in (step, -step))
        jacobian[:, column] = (ahead - behind) / (2 * h)
    lost = ~np.isfinite(jacobian).all(axis=1)
    jacobian[lost] = 0.0
    out = jacobian @ covariance @ jacobian.T
    out[lost], out[:, lost] = np.nan, np.nan
    return out


def _followed(form: ModalForm, reference: ModalForm) -> np.ndarray:
    """The full vector of a form with its modes ordered and normalised like those of a neighbour; nan where one is lost."""
    order = [int(np.argmin(np.abs(form.poles - pole))) for pole in reference.poles]
    lost = [
        order.count(k) > 1 or form.oscillates[k] != pair for k, pair in zip(order, reference.oscillates, strict=True)
    ]
    c, b = form.c[:, order], form.b[order]
    factor = c[reference.pivots, np.arange(len(order))]
    factor = np.where((factor == 0) | np.array(lost), 1.0, factor)
    alike = replace(form, poles=form.poles[order], c=c / factor, b=b * factor[:, None], oscillates=reference.oscillates)
    out = flatten_form(alike)
    width = build_layout(alike).width
    for k in np.flatnonzero(lost):
        out[k * width : (k + 1) * width] = np.nan
    return out
