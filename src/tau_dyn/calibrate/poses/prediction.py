r"""How accurate a calibration with given poses will be, before anything is measured.

The tool's error at a place is `D dp` with `dp ~ N(0, P)`, so its mean square over the workspace has

    mean  tr(P L),     variance  2 tr(P L P L),     L = mean of D' D,

the second telling how much one campaign may differ from the average one. Held out means measured: the device's noise
comes on top.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.poses.design import PoseDesign


class CalibrationPrediction(NamedTuple):
    """What a set of poses will give.

    Attributes:
        poses: Number of poses.
        rms: Root mean square error of the tool's position over the workspace [m], from the parameters' uncertainty.
        scatter: Standard deviation of that from campaign to campaign [m].
        worst: The same root mean square at the worst place [m].
        held_out: Root mean square of measured minus predicted positions at other poses [m]: `rms` and the device's
            noise.
        turn: Root mean square orientation error [rad], nan where the tool does not turn.
        stderr: Standard errors of the parameters that can be told (r,), each in its unit.
    """

    poses: int
    rms: float
    scatter: float
    worst: float
    held_out: float
    turn: float
    stderr: np.ndarray

    def to_dict(self, names: tuple[str, ...]) -> dict[str, object]:
        """Return it for a JSON result."""
        return {
            "poses": self.poses,
            "position": {"rms": self.rms, "scatter": self.scatter, "worst": self.worst, "held_out": self.held_out},
            "orientation": {"rms": self.turn},
            "stderr": dict(zip(names, self.stderr.tolist(), strict=True)),
        }


def predict(design: PoseDesign, index: np.ndarray) -> CalibrationPrediction:
    """Return what a fit to some of the candidates will give.

    Args:
        design: Candidates.
        index: Those that are measured (n,).
    """
    p = design.covariance(index)
    weight = np.einsum("nir,nis->rs", design.places, design.places) / len(design.places)
    square = float(np.trace(p @ weight))
    half = p @ weight
    scatter = float(np.sqrt(2 * np.trace(half @ half)))
    each = np.einsum("nir,rs,nis->n", design.places, p, design.places, optimize=True)
    noise = float(np.trace(design.noise[:, :3, :3].mean(axis=0)))
    turn = float("nan")
    if design.turns.shape[1]:
        turned = np.einsum("nir,rs,nis->n", design.turns, p, design.turns, optimize=True)
        turn = float(np.sqrt(turned.mean()))
    rms = float(np.sqrt(max(square, 0.0)))
    return CalibrationPrediction(
        len(index),
        rms,
        scatter / max(2 * rms, 1e-300),
        float(np.sqrt(each.max())),
        float(np.sqrt(square + noise)),
        turn,
        np.sqrt(np.diag(p)) * design.scales,
    )
