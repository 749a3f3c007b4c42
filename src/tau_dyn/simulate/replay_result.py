"""What a replay answers: each signal simulated beside measured, and how far apart they are, for each joint.

    error = 100 |simulated - measured| / |measured| [%],

norms over all samples, nothing masked, as the published errors of EMPS are given (Janot, Gautier & Brunot 2019).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.log import differentiate, lowpass
from tau_dyn.message_codes import format_warnings

SIGNALS = ("position", "speed", "acceleration", "force", "following")
"""What is compared; `following` is the reference minus the position."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A simulated repetition beside its recording.

    Attributes:
        joints: Actuated joints, in the order of the columns.
        units: Unit of each joint's position and of its force, as pairs.
        t: Time (N,) [s], the log's.
        measured: By signal (`SIGNALS`), what the log says (N, na); [m or rad], per s, per s^2, [N or N m].
        simulated: The same of the simulation.
        cutoff_hz: Zero-phase low-pass on positions before speeds and accelerations are taken [Hz]; inf for none.
        rate_hz: Rate of the simulated control loop [Hz].
        at_limit: Share of the samples in which the controller's limit held (na,).
        stuck: Share of the samples in which friction held a joint (na,).
        warnings: What is doubtful, one sentence each.
    """

    joints: tuple[str, ...]
    units: tuple[tuple[str, str], ...]
    t: np.ndarray
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]
    cutoff_hz: float
    rate_hz: float
    at_limit: np.ndarray
    stuck: np.ndarray
    warnings: tuple[str, ...] = ()

    def residual(self, signal: str) -> np.ndarray:
        """Return measured minus simulated (N, na) of a signal."""
        return self.measured[signal] - self.simulated[signal]

    def relative_error_percent(self, signal: str) -> np.ndarray:
        """Return `100 |simulated - measured| / |measured|` (na,) [%]; nan where nothing but zeros was measured.

        A position's error is relative to the distance from the joint's zero, so it says little about a joint that works far
        from it; `following` does not depend on where zero is.
        """
        size = np.linalg.norm(self.measured[signal], axis=0)
        away = np.linalg.norm(self.residual(signal), axis=0)
        return np.divide(100 * away, size, out=np.full(len(size), np.nan), where=size > 0)

    def with_cutoff(self, cutoff_hz: float) -> Replay:
        """Return the same replay with speeds and accelerations behind another low-pass [Hz], or none (inf)."""
        sides = []
        for side in (self.measured, self.simulated):
            q = side["position"]
            sides.append(get_signals(self.t, side["following"] + q, q, side["force"], cutoff_hz))
        return replace(self, measured=sides[0], simulated=sides[1], cutoff_hz=cutoff_hz)

    def to_dict(self) -> dict[str, Any]:
        """Return errors and how they were found, as plain numbers for JSON; null where nothing but zeros was measured."""
        errors: dict[str, Any] = {}
        for signal in SIGNALS:
            rms = np.sqrt(np.mean(self.residual(signal) ** 2, axis=0))
            rows = zip(self.joints, self.relative_error_percent(signal), rms, self.units, strict=True)
            errors[signal] = {
                joint: {
                    "relative_error_percent": None if np.isnan(percent) else float(percent),
                    "rms": float(size),
                    "unit": _unit(signal, *unit),
                }
                for joint, percent, size, unit in rows
            }
        return {
            "errors": errors,
            "cutoff_hz": self.cutoff_hz if np.isfinite(self.cutoff_hz) else None,
            "control_rate_hz": self.rate_hz,
            "seconds": float(self.t[-1] - self.t[0]),
            "share_at_limit": dict(zip(self.joints, self.at_limit.tolist(), strict=True)),
            "share_stuck": dict(zip(self.joints, self.stuck.tolist(), strict=True)),
            **format_warnings(self.warnings),
        }


def get_signals(
    t: np.ndarray, q_ref: np.ndarray, q: np.ndarray, tau: np.ndarray, cutoff_hz: float
) -> dict[str, np.ndarray]:
    """Return all signals of one side, in the order of `SIGNALS`.

    Args:
        t: Even times (N,) [s].
        q_ref: References (N, na) [m or rad].
        q: Positions (N, na) [m or rad].
        tau: Forces (N, na) [N or N m].
        cutoff_hz: Zero-phase low-pass on positions before central differences give speeds and accelerations; inf for none.
    """
    dt = (t[-1] - t[0]) / (len(t) - 1)
    v = differentiate(lowpass(q, cutoff_hz, 1 / dt) if np.isfinite(cutoff_hz) else q, dt)
    return dict(zip(SIGNALS, (q, v, differentiate(v, dt), tau, q_ref - q), strict=True))


def _unit(signal: str, position: str, force: str) -> str:
    suffix = {"speed": "/s", "acceleration": "/s^2"}.get(signal, "")
    return force if signal == "force" else position + suffix
