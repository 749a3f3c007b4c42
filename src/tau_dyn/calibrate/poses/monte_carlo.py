"""A simulated calibration before the real one: does it come to rest, is it as accurate as predicted, is that enough?

Robots are drawn whose dimensions are off by the parameters' scales (as measured with a tape), their poses measured by
the device, fitted, and judged at other places of the workspace without noise (thesis 5.6, "Simulation and
experiment").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import fit_geometry_to_poses
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.poses.choice import PoseChoice, compute_doubling_gain, predict
from tau_dyn.calibrate.poses.design import refine
from tau_dyn.calibrate.poses.devices import MeasuringDevice, transform_to_device
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError

_MAX_ERROR_RATIO = 2.0
"""By how much simulated calibrations may be worse than predicted."""
_N_TRIALS = 20  # simulated calibrations; their rms error is known to 16 %


@dataclass(frozen=True, eq=False)
class MonteCarloCalibration:
    """What simulated calibrations gave.

    Attributes:
        before: Root mean square error of the nominal robots, frames fitted, at other places (runs,) [m].
        after: The same after calibration (runs,) [m].
        predicted: Root mean square error predicted [m].
        failures: What went wrong in runs that gave nothing.
    """

    before: np.ndarray
    after: np.ndarray
    predicted: float
    failures: tuple[str, ...]

    @property
    def achieved(self) -> float:
        """Root mean square over the runs [m]."""
        return float(np.sqrt(np.mean(self.after**2))) if len(self.after) else float("nan")

    def to_dict(self) -> dict[str, Any]:
        """Return it for a JSON result."""
        return {
            "runs": len(self.after) + len(self.failures),
            "failed": len(self.failures),
            "position_rms": {
                "nominal": float(np.sqrt(np.mean(self.before**2))) if len(self.before) else None,
                "calibrated": self.achieved,
                "predicted": self.predicted,
            },
        }


def draw_robot(geometry: Geometry, q: np.ndarray, scales: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return parameters of a robot that is off by `scales` (p,) and still reaches all of `q` (N, na).

    Raises:
        CannotAnswer: None of many does.
    """
    nominal, free = geometry.parameters.values, np.array(geometry.parameters.free, bool)
    for _ in range(_N_TRIALS):
        theta = nominal + scales * free * rng.standard_normal(len(nominal))
        if geometry.forward(theta, q).ok.all():
            return theta
    raise CannotAnswer(
        "no_solution",
        "robots whose dimensions are off by their usual size do not reach the chosen poses",
        "larger safety distances, or dimensions that are known better",
    )


def simulate_measurement(
    device: MeasuringDevice, geometry: Geometry, theta: np.ndarray, q: np.ndarray, rng: np.random.Generator
) -> PoseSet:
    """Return what a device measures of a robot with parameters `theta` at positions (N, na)."""
    tool = geometry.forward(theta, q).poses
    found = device.measure(tool, rng)
    return PoseSet(q, found.position, found.rotation if device.turned else None, source="simulated measurement")


def simulate_calibrations(
    choice: PoseChoice,
    device: MeasuringDevice,
    *,
    runs: int = 5,
    seed: int = 0,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    known: Sequence[str] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> MonteCarloCalibration:
    """Calibrate simulated robots with the chosen poses.

    Args:
        choice: The poses.
        device: What measures them.
        runs: How many robots.
        seed: Of the robots and the noise.
        fix: Names or patterns that stay, as in the choice.
        free: Names or patterns freed, as in the choice.
        known: `device`, `tool`: frames that are not fitted.
        progress: Told how far it is.

    Raises:
        InputError: No runs.
    """
    if runs < 1:
        raise InputError("invalid_value", f"a simulated calibration needs at least one run, not {runs}")
    geometry, design = choice.design.geometry, choice.design
    p = len(geometry.parameters)
    device_free, tool_free = "device" not in known, "tool" not in known
    before, after, failures = [], [], []
    for k, rng in enumerate(np.random.default_rng(seed).spawn(runs), start=1):
        progress(f"simulated calibration {k} of {runs}")
        theta = draw_robot(geometry, np.vstack([choice.q, design.workspace]), design.unknowns.scales[:p], rng)
        poses = simulate_measurement(device, geometry, theta, choice.q, rng)
        places = transform_to_device(device.frames, geometry.forward(theta, design.workspace).poses)
        truth = PoseSet(design.workspace, places.position)
        start = None if device_free else device.frames
        try:
            plain = fit_geometry_to_poses(
                geometry, poses, fix=[*geometry.parameters.names], frames=start, device=device_free, tool=tool_free
            )
            fitted = fit_geometry_to_poses(
                geometry, poses, fix=fix, free=free, frames=start, device=device_free, tool=tool_free
            )
            if design.weighted:
                fitted = refine(fitted, device.covariance(geometry.forward(geometry.parameters.values, choice.q).poses))
        except TauDynError as fault:
            failures.append(str(fault))
            continue
        if not fitted.converged:
            failures.append("the fit did not converge")
            continue
        before.append(plain.errors(truth).position_size.rms)
        after.append(fitted.errors(truth).position_size.rms)
    return MonteCarloCalibration(np.array(before), np.array(after), choice.predicted.rms, tuple(failures))


def require_accuracy(choice: PoseChoice, rehearsal: MonteCarloCalibration, required: float | None = None) -> None:
    """Let a campaign pass that will be accurate enough.

    Args:
        choice: The poses.
        rehearsal: Simulated calibrations with them.
        required: Accuracy asked for, root mean square over the workspace [m].

    Raises:
        CannotAnswer: It will not; says why and what would help.
    """
    made, design = choice.predicted, choice.design
    if rehearsal.failures and len(rehearsal.failures) >= max(1, len(rehearsal.after)):
        raise CannotAnswer(
            "not_accurate_enough",
            f"simulated calibrations with these {choice.n} poses fail ({rehearsal.failures[0]})",
            "more poses spread wider, a device that measures orientation as well, or a robot file "
            "nearer to the machine",
        )
    if required is not None and made.rms > required:
        raise CannotAnswer(
            "not_accurate_enough",
            f"{choice.n} poses will bring {1e3 * made.rms:.3g} mm, not the {1e3 * required:.3g} mm asked for",
            _remedy(choice, required),
        )
    if rehearsal.achieved > _MAX_ERROR_RATIO * (made.rms + 3 * made.scatter / np.sqrt(max(len(rehearsal.after), 1))):
        raise CannotAnswer(
            "not_accurate_enough",
            f"simulated calibrations reach {1e3 * rehearsal.achieved:.3g} mm where "
            f"{1e3 * made.rms:.3g} mm were predicted, so errors of the usual "
            "size are too large for one step from the nominal dimensions",
            "measure the dimensions better beforehand, or take more poses",
        )
    if design.untold and required is not None and design.untold[0][1] > required:
        name, shift = max(design.untold, key=lambda row: row[1])
        raise CannotAnswer(
            "not_identifiable",
            f"no candidate tells {name}, and an error of its usual size leaves {1e3 * shift:.3g} mm "
            "elsewhere in the workspace",
            "candidates over the whole workspace: another place for the device, or fewer obstacles",
        )
    if len(rehearsal.after) and rehearsal.achieved >= float(np.sqrt(np.mean(rehearsal.before**2))):
        raise CannotAnswer(
            "not_accurate_enough",
            "the calibrated robot would be no better than the nominal one "
            f"({1e3 * rehearsal.achieved:.3g} mm): the device's noise is larger than "
            "the errors to be found",
            _remedy(choice, 0.5 * made.rms),
        )


def _remedy(choice: PoseChoice, required: float) -> str:
    """Return what would bring the accuracy asked for."""
    made, design = choice.predicted, choice.design
    factor = made.rms / required
    every = predict(design, np.arange(design.n)).rms
    needed = int(np.ceil(made.poses * factor**2))
    if every <= required:
        return f"about {min(needed, design.n)} poses instead of {made.poses}"
    share = f"all {design.n} candidates bring {1e3 * every:.3g} mm"
    nearer = every / required
    more = (
        f"; twice as many poses make it {100 * compute_doubling_gain(made):.0f} % better"
        if compute_doubling_gain(made) > 0.05
        else ""
    )
    return (
        f"a device {nearer:.2g} times as exact where the tool is (nearer, a larger target, less noise; {share}){more}"
    )
