"""Given A and C, the rest is linear: B, D and the records' initial states by least squares on the simulated output.

Reference: Ljung 1999, (10.128); Verhaegen & Verdult 2007, 9.2.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.modes.gauss_newton import FitPoint, apply_step, assemble_normal_equations, evaluate
from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form, free_numbers
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace

OUTERMOST = 1 - 1e-7  # a pole estimated on or outside the unit circle is put here


def fit_input_matrices(A: np.ndarray, C: np.ndarray, records: Sequence[Record], direct: bool | None) -> FitPoint:
    """Return the modal form of A, C with the B, D and initial states that fit records (aligned and scaled) best.

    Args:
        A: (n, n); poles outside the unit circle are mirrored into it.
        C: (p, n).
        records: The records.
        direct: Whether D may differ from zero; None lets the data choose (Bayes' information criterion).
    """
    p, m = C.shape[0], records[0].u.shape[1]
    model = StateSpace(A, np.zeros((len(A), m)), C, np.zeros((p, m)), np.zeros((len(A), p)), records[0].dt)
    form = mirror_unstable_poles(build_modal_form(model))
    point = evaluate(form, np.zeros((len(records), len(form.poles)), dtype=complex), records)
    if direct is not None:
        return solve_input_matrices(point, records, direct)
    without, whole = solve_input_matrices(point, records, False), solve_input_matrices(point, records, True)
    gain = whole.n_samples * (without.loss - whole.loss)
    return whole if gain > p * m * np.log(whole.n_samples) else without


def solve_input_matrices(point: FitPoint, records: Sequence[Record], direct: np.ndarray | bool) -> FitPoint:
    """Return the point with its B, D and initial states, and nothing else, fitted anew."""
    layout = build_layout(point.form)
    free = free_numbers(point.form, np.asarray(direct))
    for k in range(layout.n_modes):
        free[layout.pole(k)] = False
        free[layout.c(k)] = False
    weight = np.diag(1 / np.maximum(point.power, 1e-300))
    for _ in range(2):  # the problem is linear; the second pass weighs the outputs by their errors
        form, x0 = apply_step(point, assemble_normal_equations(point, free, weight).solve())
        point, weight = evaluate(form, x0, records), None
    return point


def mirror_unstable_poles(form: ModalForm) -> ModalForm:
    """Return a stable form: poles outside the unit circle mirrored, those on it moved just inside."""
    size = np.abs(form.poles)
    inside = np.where(size > 1, 1 / np.maximum(size, 1e-300), size)
    inside = np.minimum(inside, OUTERMOST)
    return replace(form, poles=form.poles * inside / np.where(size > 0, size, 1.0))
