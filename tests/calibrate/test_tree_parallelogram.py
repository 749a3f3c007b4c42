"""The calibration paper's parallelogram (Savoure et al. 2006, III): engine against closed form, and what methods leave."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.calibrate.unknowns import find_identifiable

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from parallelogram_parts import methods
from parallelogram_parts.explicit import ERRORS, NAMES, NOMINAL, forward, printed_sensitivity, sensitivity


@pytest.mark.parametrize("h", [0.0, 0.1, 0.2])
def test_engine_is_the_closed_form(h: float) -> None:
    """The robot file with Table 2's errors is where circles that meet put it, whatever h: (48)'s h belongs in no closure."""
    _, geometry = methods.machine(h)
    k = NOMINAL + ERRORS
    found, at = geometry.forward(k, methods.CHECKED[:, None]), forward(methods.CHECKED, k, h)
    assert np.abs(found.poses.position - np.stack([at.x, 0 * at.x, at.y], axis=1)).max() < 1e-12
    turn = np.arctan2(found.poses.rotation[:, 0, 2], found.poses.rotation[:, 0, 0])
    assert np.abs(turn + at.alpha).max() < 1e-12
    assert np.abs(at.alpha).max() > 1e-3


def test_closed_form_closes() -> None:
    """The closed form's second rod has its length: both of the paper's closures hold."""
    k = NOMINAL + ERRORS
    a1x, a2x, a2y, b1x, b2x, b2y, l2 = k[[1, 2, 3, 4, 5, 6, 8]]
    at = forward(methods.CHECKED, k, 0.1)
    c, s = np.cos(at.alpha), np.sin(at.alpha)
    middle = np.stack([at.x, at.y]) - 0.1 * np.stack([s, -c])
    second = middle + np.stack([c * b2x - s * b2y, s * b2x + c * b2y])
    assert np.abs(np.hypot(second[0] - a2x, second[1] - a2y) - l2).max() < 1e-12
    first = middle - b1x * np.stack([c, s])
    assert np.abs(first[0] - (-a1x + k[7] * np.sin(methods.CHECKED + k[0]))).max() < 1e-12


def test_six_of_nine_and_the_papers_regrouping() -> None:
    """6 of the 9 errors can be told, and the other three join them as (70) to (72) say."""
    _, geometry = methods.machine(0.1)
    columns = geometry.tool_by_parameter(NOMINAL, methods.MEASURED[:, None], None)  # type: ignore[arg-type]
    flat = columns[:, [0, 2, 4]].reshape(-1, 9)
    found = find_identifiable(flat / methods.NOISE[0], NAMES, np.full(9, 1e-3), geometry.priority)
    assert tuple(NAMES[k] for k in found.kept) == ("q0", "a2x", "a2y", "b1x", "l1", "l2")
    regrouped = {
        (NAMES[d], NAMES[found.kept[r]]): round(float(found.factors[r, c]), 9)
        for c, d in enumerate(found.dropped)
        for r in range(6)
        if abs(found.factors[r, c]) > 1e-9
    }
    assert regrouped == {("b2x", "a2x"): -1.0, ("b2y", "a2y"): -1.0, ("a1x", "b1x"): -1.0}


def test_sensitivity_as_derived_and_as_printed() -> None:
    """Equations (63) to (67), derived anew, are the engine's derivatives and of rank 6; as printed (65) has rank 7."""
    _, geometry = methods.machine(0.1)
    columns = geometry.tool_by_parameter(NOMINAL, methods.MEASURED[:, None], None)  # type: ignore[arg-type]
    own = sensitivity(methods.MEASURED, 0.1) * np.array([1, 1, -1])[None, :, None]
    assert np.abs(columns[:, [0, 2, 4]] - own).max() < 1e-12
    ranks = [np.linalg.matrix_rank(x.reshape(-1, 9), 1e-8) for x in (own, printed_sensitivity(methods.MEASURED, 0.1))]
    assert ranks == [6, 7]


def test_what_each_method_leaves() -> None:
    """With Table 2's errors: linear below 150 um, six parameters below 20 um, nine with their prior a few um."""
    _, geometry = methods.machine(0.1)
    left: dict[str, list[list[float]]] = {"linear": [], "six": [], "nine": []}
    for rng in np.random.default_rng(5).spawn(3):
        poses = methods.measure(rng)
        weights = (1 / methods.NOISE[0], 1 / methods.NOISE[1])
        k = {
            "linear": methods.linear(geometry, poses, weights),
            "six": methods.six(geometry, poses).theta,
            "nine": methods.nine(geometry, poses, methods.PRIOR).theta,
        }
        for name, values in k.items():
            how = "linear" if name == "linear" else "exact"
            errors = [methods.tcp_error(h, methods.compensated(h, values, how)) for h in (0.0, 0.2)]
            left[name].append([float(np.abs(e).max()) for e in errors])
    worst = {name: np.median(values, axis=0) for name, values in left.items()}
    assert (worst["linear"] < 150e-6).all() and (worst["linear"] > 20e-6).all()
    assert (worst["six"] < 20e-6).all() and (worst["six"] > 8e-6).all()
    assert worst["nine"][0] < 5e-6 and worst["nine"][1] < 8e-6


def test_uncompensated_and_classical() -> None:
    """Without calibration Table 2's errors cost 1.7 mm at h = 0; the classical method is worse than none there."""
    none = np.abs(methods.tcp_error(0.0, methods.CHECKED)).max()
    q0, length = methods.classical(methods.measure(np.random.default_rng(6)))
    simple = np.arcsin(np.clip(0.95 * np.sin(methods.CHECKED) / length, -1, 1)) - q0
    assert none == pytest.approx(1.67e-3, rel=0.01)
    assert np.abs(methods.tcp_error(0.0, simple)).max() == pytest.approx(3.0e-3, rel=0.02)
