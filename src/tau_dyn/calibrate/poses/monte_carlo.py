"""Simulated calibrations before the real one: convergence of the fit, and comparison with the predicted and required accuracy.

Robots are drawn whose dimensions are off by the parameters' scales (as measured with a tape), their poses measured by
the device, fitted, and evaluated at other places of the workspace without noise (thesis 5.6, "Simulation and
experiment").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tau_dyn.calibrate.frames import DeviceFrames, align
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import GeometryFit, fit_geometry_to_poses
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.poses.choice import PoseChoice, compute_doubling_gain, predict
from tau_dyn.calibrate.poses.design import PoseDesign, refine
from tau_dyn.calibrate.poses.devices import MeasuringDevice, transform_to_device
from tau_dyn.calibrate.poses.fixtures import FixtureSet
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError

_MAX_ERROR_RATIO = 2.0
"""Largest accepted ratio of the simulated error to the predicted one."""
_MAX_NOISE_RATIO = 3.0
"""Ratio of a fit's noise to the true one above which it converged to another solution; sampling of twenty poses gives 1.5."""
_N_TRIALS = 20  # simulated calibrations; their rms error is known to 16 %


@dataclass(frozen=True, eq=False)
class MonteCarloCalibration:
    """Results of simulated calibrations.

    Attributes:
        before: Root mean square error of the nominal robots, frames fitted, at other places (runs,) [m].
        after: The same after calibration (runs,) [m].
        predicted: Root mean square error predicted [m].
        failures: Reasons of the runs that failed.
        restarted: Runs that found fixtures only from their planned places.
    """

    before: np.ndarray
    after: np.ndarray
    predicted: float
    failures: tuple[str, ...]
    restarted: int = 0

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
        CannotAnswer: No robot drawn reaches all positions.
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
    """Return the simulated measurements of a robot with parameters `theta` at positions (N, na)."""
    tool = geometry.forward(theta, q).poses
    found = device.measure(tool, rng)
    rotation = found.rotation if device.turned else None
    return PoseSet(q, found.position, rotation, kinds=(device.kind,), source="simulated measurement")


def simulate_calibrations(
    choice: PoseChoice,
    device: MeasuringDevice | FixtureSet,
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
        device: Device that measures them.
        runs: Number of robots.
        seed: Seed of the robots and the noise.
        fix: Names or patterns that stay, as in the choice.
        free: Names or patterns freed, as in the choice.
        known: `device`, `tool`: frames that are not fitted.
        progress: Called with a description of each run.

    Raises:
        InputError: No runs.
    """
    if runs < 1:
        raise InputError("invalid_value", f"a simulated calibration needs at least one run, not {runs}")
    geometry, design = choice.design.geometry, choice.design
    p = len(geometry.parameters)
    device_free, tool_free = "device" not in known, "tool" not in known
    before, after, failures, restarted = [], [], [], 0
    for k, rng in enumerate(np.random.default_rng(seed).spawn(runs), start=1):
        progress(f"simulated calibration {k} of {runs}")
        theta = draw_robot(geometry, np.vstack([choice.q, design.workspace]), design.unknowns.scales[:p], rng)
        start = None if device_free and tool_free else device.frames
        fit = partial(fit_geometry_to_poses, geometry, device=device_free, tool=tool_free)
        try:
            if isinstance(device, FixtureSet):
                poses = device.simulate(geometry, theta, choice.poses, rng)
            else:
                poses = simulate_measurement(device, geometry, theta, choice.q, rng)
            fitted = fit(poses, fix=fix, free=free, frames=start)
            if isinstance(device, FixtureSet) and start is None and not _is_at_noise(fitted, device):
                start, restarted = device.frames, restarted + 1
                fitted = fit(poses, fix=fix, free=free, frames=start)
            plain = fit(poses, fix=[*geometry.parameters.names], frames=start)
            if design.weighted:
                fitted = refine(fitted, design.noise[choice.index])
        except TauDynError as fault:
            failures.append(str(fault))
            continue
        if not fitted.converged:
            failures.append("the fit did not converge")
            continue
        before.append(compute_tool_error(plain, design, device.frames, theta))
        after.append(compute_tool_error(fitted, design, device.frames, theta))
    return MonteCarloCalibration(np.array(before), np.array(after), choice.predicted.rms, tuple(failures), restarted)


def _is_at_noise(fitted: GeometryFit, device: FixtureSet) -> bool:
    """Return whether a fit explains its measurements; otherwise it found a wrong fixture position, such as a ball from inside."""
    return fitted.converged and fitted.noise[0] < _MAX_NOISE_RATIO * device.fixtures[0].noise


def compute_tool_error(fitted: GeometryFit, design: PoseDesign, frames: DeviceFrames, theta: np.ndarray) -> float:
    """Return the root mean square error [m] of a fit over the workspace of a robot with parameters `theta` (p,) and true frames.

    Positions are compared in the frame that the device shows; with distances and touches after the motion of the whole robot that
    fits best, and after the change of its size if only touches are measured.
    """
    true = design.geometry.forward(theta, design.workspace).poses
    if design.poses.shows_frames:
        return fitted.errors(PoseSet(design.workspace, transform_to_device(frames, true).position)).position_size.rms
    found, setup = design.geometry.forward(fitted.theta, design.workspace).poses, np.zeros(len(design.workspace), int)
    a, b = (
        DeviceFrames(tool=own.tool[:1]).measured(base, setup).position
        for own, base in ((frames, true), (fitted.frames, found))
    )
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    b = b @ align(a, b).rotation.T
    hidden = design.poses.hides_size(design.geometry.position_units)
    size = float(np.sum(a * b) / np.sum(b * b)) if hidden else 1.0
    return float(np.sqrt(np.mean(np.sum((a - size * b) ** 2, axis=1))))


def require_accuracy(choice: PoseChoice, rehearsal: MonteCarloCalibration, required: float | None = None) -> None:
    """Refuse a campaign that will not be accurate enough.

    Args:
        choice: The poses.
        rehearsal: Simulated calibrations with them.
        required: Required accuracy, root mean square over the workspace [m].

    Raises:
        CannotAnswer: The campaign will not be accurate enough; the message names the reason and a remedy.
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
    expected = made.rms + 3 * made.scatter / np.sqrt(max(len(rehearsal.after), 1))
    missed = rehearsal.achieved > _MAX_ERROR_RATIO * expected
    untold = float(np.sqrt(sum(shift**2 for _, shift in design.untold)))
    asked = untold > expected if required is None else max((s for _, s in design.untold), default=0.0) > required
    if design.untold and asked and (missed or required is not None):
        name, shift = max(design.untold, key=lambda row: row[1])
        raise CannotAnswer(
            "not_identifiable",
            f"no candidate shows {name}, and an error of its usual size leaves {1e3 * shift:.3g} mm "
            "elsewhere in the workspace",
            "candidates over the whole workspace: another place for the device, fewer obstacles, or one more device",
        )
    if missed:
        raise CannotAnswer(
            "not_accurate_enough",
            f"simulated calibrations reach {1e3 * rehearsal.achieved:.3g} mm where "
            f"{1e3 * made.rms:.3g} mm were predicted, so errors of the usual "
            "size are too large for one step from the nominal dimensions",
            "measure the dimensions better beforehand, or take more poses",
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
    """Return a remedy that would reach the required accuracy."""
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
