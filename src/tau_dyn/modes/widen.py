r"""Standard errors that allow for what the model's own covariance does not know: missing modes, a loop that may be closed.

The covariance of an estimate assumes that its model holds the truth. Where another defensible model of the same data (a
neighbouring order that simulates as well; the other method where feedback cannot be excluded) puts a mode elsewhere by d,

    s^2 = s_0^2 + max(0, d^2 - 4 |s_1^2 - s_0^2|)

with s_1 the other's standard error: if both models hold the truth, the difference has the variance s_1^2 - s_0^2 (Hausman
1978), and nothing is added in 95 % of cases. What lies beyond is model error and counts in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import qr

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.record import Record
from tau_dyn.modes.refinement import RefinedModel, refine
from tau_dyn.modes.residuals import PREDICTED

MODE_EQUALITY_TOLERANCE = 0.05
"""Relative difference in frequency up to which modes of two models are one and the same."""

MAX_PREDICTOR_OUTPUTS = 6
"""Outputs of a predictor, whose inputs they are too: its free numbers grow with their square."""
PREDICTOR_ROUNDS = 15  # steps of its refinement, which begins near its end


def refine_predictor(refined: RefinedModel, records: Sequence[Record]) -> RefinedModel:
    """Return the model that minimises one-step prediction errors, which holds under feedback; of the outputs that show the modes.

    Args:
        refined: Where to start.
        records: Training records.
    """
    sizes = np.std(np.vstack(refined.residuals), axis=0)
    seen = np.array([m.shape / sizes for m in refined.modes]).reshape(-1, len(sizes))
    pivots = np.asarray(qr(np.vstack([seen.real, seen.imag]), mode="r", pivoting=True)[-1])
    some = sorted(int(o) for o in pivots[:MAX_PREDICTOR_OUTPUTS])
    whole = refined.model
    noise = None if whole.noise is None else whole.noise[np.ix_(some, some)]
    model = replace(whole, C=whole.C[some], D=whole.D[some], K=whole.K[:, some], noise=noise)
    fewer = [replace(r, y=r.y[:, some], outputs=tuple(r.outputs[o] for o in some)) for r in records]
    return refine(model, fewer, kind=PREDICTED, maximum_rounds=PREDICTOR_ROUNDS)


def widen_modes(modes: Sequence[Mode], pairs: Sequence[tuple[Sequence[Mode], Sequence[Mode]]]) -> tuple[Mode, ...]:
    """Return modes with standard errors that cover the differences between other models.

    Args:
        modes: Modes with their own standard errors.
        pairs: Modes of two models of the same data, such as those of two orders.
    """
    return tuple(_widen(mode, pairs) for mode in modes)


def _widen(mode: Mode, pairs: Sequence[tuple[Sequence[Mode], Sequence[Mode]]]) -> Mode:
    extra = np.zeros(2)
    for one, other in pairs:
        a, b = _near(mode, one), _near(mode, other)
        if a is not None and b is not None:
            extra = np.maximum(extra, _excess(a, b))
    if not extra.any():
        return mode
    s = np.sqrt(np.array([mode.frequency_stderr, mode.damping_stderr]) ** 2 + extra)
    kept = mode.frequency_stderr * mode.damping_stderr / max(float(s.prod()), 1e-300)
    return replace(
        mode, frequency_stderr=float(s[0]), damping_stderr=float(s[1]), correlation=float(mode.correlation * kept)
    )


def _near(mode: Mode, others: Sequence[Mode]) -> Mode | None:
    """Return the mode of another model that is the same one; None where there is none."""
    close = [m for m in others if abs(m.frequency_hz - mode.frequency_hz) < MODE_EQUALITY_TOLERANCE * mode.frequency_hz]
    close = [m for m in close if m.damping_ratio < 10 * max(mode.damping_ratio, 1e-4)]
    return min(close, key=lambda m: abs(m.frequency_hz - mode.frequency_hz), default=None)


def _excess(a: Mode, b: Mode) -> np.ndarray:
    """Return what of the squared differences (2,) in frequency and damping chance does not explain."""
    d = np.array([a.frequency_hz - b.frequency_hz, a.damping_ratio - b.damping_ratio])
    s = np.array([[m.frequency_stderr, m.damping_stderr] for m in (a, b)])
    s = np.nan_to_num(s)
    return np.maximum(d**2 - 4 * np.maximum(np.abs(s[1] ** 2 - s[0] ** 2), 0.1 * np.max(s, axis=0) ** 2), 0.0)
