"""Result of a calibration: models with their errors, the chosen model's parameters, causes; also as JSON of the contract."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.crossvalidation import compute_rms_interval
from tau_dyn.calibrate.geometry import expand_constraints
from tau_dyn.calibrate.geometry_fit import GeometryFit, compute_sensitivities
from tau_dyn.calibrate.measured import KINDS, MeasurementNoise, PoseErrors, PoseSet
from tau_dyn.calibrate.model_selection import CandidateModel, SelectionStep
from tau_dyn.evidence import Finding
from tau_dyn.results import Shown, plot_pose_errors, to_plain
from tau_dyn.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_RELATIVE_ERROR = 0.01
"""Held-out rms error over the poses' rms distance from their middle above which units, joints or frames are wrong; an arm out of
the box reaches 0.002."""
_MAX_ORIENTATION_ERROR = 0.02
"""Held-out rms orientation error [rad] above which the same is true."""
_MIN_NAMED_CORRELATION = 0.9  # correlation from which two parameters are named as one


@dataclass(frozen=True, eq=False)
class Calibration(Shown):
    """A robot's geometry from measured poses.

    Attributes:
        robot: The robot.
        poses: Fitted poses, without outliers and held-out poses.
        holdout: Poses used only for the final errors, None if errors are cross-validated.
        split: Origin of the held-out poses: `given`, `split` or `cross-validated`.
        models: The ladder, smallest first; the last one is the chosen one, the first has the robot file's dimensions.
        steps: All steps that were tried.
        findings: Causes, costliest first; then rejected candidates and moves.
        warnings: Sentences.
        seed: Seed of folds and bootstrap.
        measured: Accuracy of the measured poses, known independently of the fit.
    """

    robot: Robot
    poses: PoseSet
    holdout: PoseSet | None
    split: str
    models: tuple[CandidateModel, ...]
    steps: tuple[SelectionStep, ...]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    seed: int
    measured: MeasurementNoise = MeasurementNoise("unknown")

    @property
    def misses_poses(self) -> bool:
        """Whether the held-out error is so large that units, joints or frames are wrong, or the robot is a different one."""
        errors = self.errors(self.chosen)
        turned = errors.orientation_size
        near = errors.position_size.rms < _MAX_RELATIVE_ERROR * self.fit.spread
        return not near or (turned is not None and not turned.rms < _MAX_ORIENTATION_ERROR)

    @property
    def chosen(self) -> CandidateModel:
        """The chosen model."""
        return self.models[-1]

    @property
    def fit(self) -> GeometryFit:
        """Its fit."""
        return self.chosen.fit

    def errors(self, model: CandidateModel) -> PoseErrors:
        """Return a model's errors at unseen poses: held-out ones, or training poses predicted without their fold."""
        return model.unseen if self.holdout is None else model.fit.errors(self.holdout)

    def at(self) -> PoseSet:
        """Return the poses at which unseen errors are evaluated."""
        return self.poses if self.holdout is None else self.holdout

    def predicted_error(self) -> float | None:
        """Return the rms position error [m] expected from the measurement noise and the parameters' uncertainty.

        None if the measurement noise is not known independently of the fit, or if only encoders were measured.
        """
        if self.measured.position is None:
            return None
        at, encoders = self.at(), self.at().of_encoders
        if encoders.all():
            return None
        at = at.take(~encoders)
        stated, model = at.position_stderr, self.fit.model_error(at.q, at.loads)
        share = at.numbers / 3
        noise = 3 * self.measured.position**2 * float(np.mean(share))
        if self.measured.source == "columns" and stated is not None:
            noise = float(np.mean(np.sum(stated**2, axis=1) * share))
        return float(np.sqrt(np.nanmean(model**2) + noise))

    def parameter_rows(self) -> list[dict[str, object]]:
        """Return the chosen model's free unknowns with uncertainty, in the contract's format."""
        return build_parameter_rows(self.fit)

    def plot(self) -> Figure:
        """Return a Matplotlib figure of the position errors at unseen poses, of the robot file and of the chosen model.

        Raises:
            InputError: Matplotlib is not installed.
        """
        shown = {"robot file": self.models[0], self.chosen.name: self.chosen}
        return plot_pose_errors({name: np.linalg.norm(self.errors(m).position, axis=1) for name, m in shown.items()})

    def to_dict(self) -> dict[str, object]:
        """Return the contract's result."""
        told = {
            "robot": self.robot.source,
            "n_poses": self.poses.n,
            "n_holdout": 0 if self.holdout is None else self.holdout.n,
            "holdout_is": self.split,
            "models": [self._model(m) for m in self.models],
            "chosen": self.chosen.name,
            "steps": [{"model": s.name, "over": s.over, "gain": s.gain, "taken": s.taken} for s in self.steps],
            "waterfall": self._waterfall(),
            "findings": self.findings,
            "noise": self._noise(),
            "measurement_noise": self.measured,
            "predicted_rms": self.predicted_error(),
            "identifiability": self.fit.identifiability,
            "condition_number": self.fit.identifiability.condition_number,
            "weak": list_weak_parameters(self.fit),
            "correlated": list_correlated_pairs(self.fit),
            "frames": build_frame_rows(self.fit),
            "devices": build_device_rows(self),
            "orientations": turn_rows(self.fit),
            "sensitivity": compute_sensitivities(self.fit),
            "errors_at_poses": self._errors_at_poses(),
        }
        return to_plain(told)

    def locate_errors(self, model: CandidateModel) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of unseen errors and a model's errors there, (N, 3) each [m] in the robot's base frame.

        The target's point in a distance or touch measurement is that of the chosen model. Errors of encoders are nan.
        """
        at, fitted = self.at(), self.fit
        base = fitted.predict(at).base
        turn, shift = fitted.find_devices(at, base)
        _, _, target_turn, arm = fitted.frames.of_each(at.setup)
        known = at.as_poses()
        sees = np.array([kind == "pose" for kind in known.kinds])[at.device]
        measured = np.einsum("nji,nj->ni", turn, known.position - shift)
        predicted = base.position + np.einsum("nij,nj->ni", base.rotation, arm)
        error = np.where(at.of_encoders[:, None], np.nan, self.errors(model).position)
        from_camera = -np.einsum("nij,nj->ni", turn @ base.rotation @ target_turn, error)  # the opposite sign
        error = np.where(at.from_tool[:, None], from_camera, error)
        return np.where(sees[:, None], measured, predicted), np.einsum("nji,nj->ni", turn, error)

    def _errors_at_poses(self) -> dict[str, object]:
        """Return the points of unseen errors and every model's errors there [m], in the robot's base frame, for a viewer.

        Errors of encoders are left out.
        """
        of_tool = ~self.at().of_encoders
        models = {m.name: self.locate_errors(m)[1][of_tool] for m in self.models}
        return {"points": self.locate_errors(self.chosen)[0][of_tool], "models": models}

    def _model(self, model: CandidateModel) -> dict[str, object]:
        return {
            "name": model.name,
            "parameters": build_parameter_rows(model.fit),
            "n_estimated": model.fit.n_estimated,
            "train": model.fit.errors(self.poses),
            "holdout": self.errors(model),
        }

    def _noise(self) -> dict[str, float | None]:
        noise = self.fit.noise
        if self.fit.kind != "forward":
            return {"residual": noise[0]}
        return {"position": noise[0], "orientation": noise[1] if len(noise) > 1 else None}

    def _waterfall(self) -> list[dict[str, object]]:
        rows = []
        for model in self.models:
            errors = self.errors(model)
            interval = list(compute_rms_interval(errors, self.seed))
            rows.append({"step": model.name, "rms": errors.position_size.rms, "ci95": interval})
        return rows


def build_parameter_rows(fitted: GeometryFit) -> list[dict[str, object]]:
    """Return free unknowns of a fit: value, unit, standard error, interval, nominal value."""
    nominal = {p.name: p.value for p in fitted.geometry.parameters}
    free = set(fitted.identifiability.names)
    loose = set(list_weak_parameters(fitted))
    rows = []
    for p in fitted.parameters:
        if p.name not in free:
            continue
        interval = fitted.interval(p)
        rows.append(
            {
                "name": p.name,
                "value": p.value,
                "unit": p.unit,
                "stderr": p.stderr,
                "ci95": None if interval is None else list(interval),
                "identifiable": p.stderr is not None,
                "determined": p.stderr is not None and p.name not in loose,
                "nominal": nominal.get(p.name),
            }
        )
    return rows


def list_weak_parameters(fitted: GeometryFit) -> list[str]:
    """Return identifiable parameters that these poses determine no better than the robot file's tolerance."""
    scale = dict(zip(fitted.unknowns.names, fitted.unknowns.scales.tolist(), strict=True))
    frame = ("device", "tool")
    return [
        p.name
        for p in fitted.parameters
        if p.stderr is not None and p.stderr > 0.5 * scale[p.name] and not p.name.startswith(frame)
    ]


def list_correlated_pairs(fitted: GeometryFit) -> list[dict[str, object]]:
    """Return pairs of highly correlated parameters, highest correlation first."""
    c = np.triu(fitted.correlation, 1)
    names = fitted.identifiability.names
    pairs = np.argwhere(np.abs(c) > _MIN_NAMED_CORRELATION)
    order = np.argsort(-np.abs(c[tuple(pairs.T)])) if len(pairs) else []
    return [
        {"parameters": [names[pairs[k][0]], names[pairs[k][1]]], "correlation": float(c[tuple(pairs[k])])}
        for k in order
    ]


def build_frame_rows(fitted: GeometryFit) -> list[dict[str, object]]:
    """Return device and target as translation [m] and unit quaternion `x y z w`, for a distance or a ball also its length [m].

    An encoder has no frame, but a zero [rad or m].
    """
    rows, targets, devices = [], fitted.poses.targets, fitted.poses.devices
    each = len(fitted.poses.campaigns) if len(devices) > 1 else len(fitted.frames.device)
    for owner, frames in (("device", fitted.frames.device), ("tool", fitted.frames.tool)):
        for k, f in enumerate(frames):
            quaternion = Rotation.from_matrix(f.rotation).as_quat(canonical=True)
            rows.append(
                {
                    "frame": owner,
                    "campaign": k % each + 1 if owner == "device" else k + 1 if len(targets) == 1 else None,
                    "device": devices[k // each] if owner == "device" and len(devices) > 1 else None,
                    "target": targets[k] if owner == "tool" and len(targets) > 1 else None,
                    "translation": f.translation.tolist(),
                    "quaternion": quaternion.tolist(),
                }
            )
    for k in fitted.frames.with_length:
        kind = KINDS[fitted.frames.kinds[k]]
        rows[k] |= {kind.length: fitted.frames.lengths[k], "unit": kind.unit}
    return rows


def build_device_rows(found: Calibration) -> list[dict[str, Any]]:
    """Return name, kind, number of fitted measurements, estimated standard error and its unit of each device or fixture.

    Places that only held-out measurements show have no standard error. The standard error of an angle encoder is in rad, and
    `arc_radius` [m] is the radius at which its errors are converted to arcs.
    """
    fitted, known = found.fit, found.at()
    poses, errors = fitted.poses, fitted.poses.device_errors or (1.0,) * len(fitted.poses.devices)
    noise = [error * fitted.noise[0] if fitted.kind == "forward" else None for error in errors]
    rows: list[dict[str, Any]] = []
    for k, (name, kind) in enumerate(zip(known.devices, known.kinds, strict=True)):
        own, turns = noise[k] if k < len(noise) else None, kind == "angle"
        rows.append(
            {
                "name": name,
                "kind": kind,
                "n": int(np.sum(poses.device == k)),
                "noise": own / known.arc_radius if turns and own is not None else own,
                "unit": "rad" if turns else "m",
                **({"arc_radius": known.arc_radius} if turns else {}),
            }
        )
    return rows


def turn_rows(fitted: GeometryFit) -> list[dict[str, object]]:
    """Return the orientations of turning joints' frames as unit quaternions `x y z w`, in their parents' frames."""
    geometry, (theta,) = expand_constraints(fitted.geometry, fitted.theta)
    return [
        {"joint": name, "quaternion": Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()}
        for name, rotation in geometry.list_turned_joints(theta)
    ]
