"""The poses to measure among candidates, how accurate a calibration with them will be, and how many are enough.

The tool's error at a place is `D dp` with `dp ~ N(0, P)`, so its mean square over the workspace has

    mean  tr(P L),     variance  2 tr(P L P L),     L = mean of D' D.

With twice the information this part `s` of the held-out error falls to `s / sqrt(2)` while the device's noise `w` stays. Poses
are enough where `1 - sqrt(s^2 / 2 + w^2) / sqrt(s^2 + w^2)` falls below a threshold, or where `s` reaches a required
accuracy. Fewer poses than the rank requires cannot be fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import count_required_poses
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.poses.criteria import SMOOTH, PoseExchange, build_criterion, compute_observability_indices
from tau_dyn.calibrate.poses.design import PoseDesign, build_design
from tau_dyn.exceptions import InputError
from tau_dyn.message_codes import CodedWarning


class CalibrationPrediction(NamedTuple):
    """Predicted accuracy of a calibration with a set of poses.

    Attributes:
        poses: Number of poses.
        rms: Root mean square error of the tool's position over the workspace [m], from the parameters' uncertainty.
        scatter: Standard deviation of that from campaign to campaign [m].
        worst: The same root mean square at the worst place [m].
        held_out: Root mean square of measured minus predicted at other poses [m]: `rms` and the device's noise.
        turn: Root mean square orientation error [rad], nan if the tool does not turn.
        stderr: Standard errors of the identifiable parameters (r,), each in its unit.
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
    """Return the predicted accuracy of a fit to some of the candidates.

    Args:
        design: Candidates.
        index: Indices of the measured candidates (n,).
    """
    p = design.covariance(index)
    weight = np.einsum("nir,nis->rs", design.places, design.places) / len(design.places)
    square = float(np.trace(p @ weight))
    half = p @ weight
    scatter = float(np.sqrt(2 * np.trace(half @ half)))
    each = np.einsum("nir,rs,nis->n", design.places, p, design.places, optimize=True)
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
        float(np.sqrt(square + design.variance)),
        turn,
        np.sqrt(np.diag(p)) * design.scales,
    )


_SIZE_UNDETERMINED = (
    "touches at unknown places and angles of passive joints do not show how large the robot is; the accuracy is that of its "
    "shape, at the size of the robot file; plan one distance as well (kind: distance)"
)
MIN_DOUBLING_GAIN = 0.03
"""Share by which twice as many poses must make the held-out error smaller to be worth it."""
_UNKNOWN = 1.0
"""Standard error, in scales, from which a parameter is practically unknown."""


def compute_min_poses(design: PoseDesign) -> int:
    """Return the smallest number of poses with which the model can be fitted and its noise estimated."""
    rank = design.found.rank
    if rank >= design.n * design.per_pose:  # the candidates are too few to show the information of more of them
        rank = len(design.found.names)
    return count_required_poses(rank, design.per_pose)


def compute_doubling_gain(made: CalibrationPrediction) -> float:
    """Return the share by which twice as many poses would make the held-out error smaller."""
    noise = made.held_out**2 - made.rms**2
    return 1.0 - float(np.sqrt((0.5 * made.rms**2 + noise) / made.held_out**2))


def add_poses_until_enough(
    design: PoseDesign, search: PoseExchange, *, gain: float, target: float | None, most: int
) -> tuple[np.ndarray, list[CalibrationPrediction]]:
    """Pick poses until they are enough, and return them with the accuracy predicted on the way.

    Args:
        design: Candidates.
        search: Search that picks them.
        gain: Threshold of `compute_doubling_gain`.
        target: Required accuracy [m]; replaces the threshold.
        most: Largest number of poses.
    """
    least, chosen, curve = compute_min_poses(design), [], []
    for k in search.pick():
        chosen.append(k)
        if len(chosen) < least:
            continue
        curve.append(predict(design, np.array(chosen)))
        if _enough(design, curve[-1], gain, target) or len(chosen) >= most:
            break
    return np.array(chosen), curve


def _enough(design: PoseDesign, made: CalibrationPrediction, gain: float, target: float | None) -> bool:
    if target is not None:
        return made.rms <= target
    known = made.stderr < _UNKNOWN * design.scales
    return compute_doubling_gain(made) < gain and bool(known[design.counts].all())


MAX_POSES = 400
"""Poses that `auto` takes at most: a day's work with a tracker."""
_STARTS = 2  # starts of the exchange; the best result is taken


@dataclass(frozen=True, eq=False)
class PoseChoice:
    """Chosen poses.

    Attributes:
        design: All candidates and their information.
        index: Indices of the chosen ones (n,), ascending.
        criterion: Name of the criterion.
        trace: The criterion's value of the set, pose by pose as picked, then after the exchange.
        curve: Predicted accuracy against the number of poses, as picked (before the exchange).
        predicted: Predicted accuracy with the chosen poses.
        at_random: Predicted root mean square [m] with as many poses drawn at random (median of several draws).
        warnings: Sentences.
    """

    design: PoseDesign
    index: np.ndarray
    criterion: str
    trace: tuple[float, ...]
    curve: tuple[CalibrationPrediction, ...]
    predicted: CalibrationPrediction
    at_random: float
    warnings: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of chosen poses."""
        return len(self.index)

    @property
    def q(self) -> np.ndarray:
        """Actuated positions of the chosen poses (n, na)."""
        return self.design.q[self.index]

    @property
    def poses(self) -> PoseSet:
        """The chosen poses, with the device or fixture and the target of each."""
        return self.design.poses.take(self.index)

    @property
    def not_identifiable(self) -> dict[str, tuple[str, ...]]:
        """Parameters that stay at their nominal value, and the other parameters that they depend on."""
        found = self.design.found
        return {found.names[k]: d for k, d in zip(found.dropped, found.depends_on, strict=True)}

    def information(self) -> np.ndarray:
        """Return the information matrix of the chosen poses (r, r), parameters in scales."""
        part = self.design.whitened()[self.index].reshape(-1, self.design.slopes.shape[2])
        return part.T @ part

    def to_dict(self) -> dict[str, Any]:
        """Return it for a JSON result."""
        return {
            "candidates": self.design.n,
            "chosen": self.n,
            "fewest": compute_min_poses(self.design),
            "criterion": {
                "name": self.criterion,
                "trace": list(self.trace),
                **compute_observability_indices(self.information()),
            },
            "predicted": self.predicted.to_dict(self.design.names),
            "predicted_at_random": self.at_random,
            "doubling_gain": compute_doubling_gain(self.predicted),
            "curve": [{"poses": p.poses, "rms": p.rms, "held_out": p.held_out} for p in self.curve],
            "identifiability": self.design.found.to_dict(),
        }


def choose_poses(
    geometry: Geometry,
    candidates: np.ndarray | PoseSet,
    n: int | Literal["auto"] = "auto",
    *,
    criterion: str = "tool",
    noise: tuple[float, ...] | np.ndarray = (1e-4, 1e-4),
    gain: float = MIN_DOUBLING_GAIN,
    target: float | None = None,
    seed: int = 0,
    **known: Any,
) -> PoseChoice:
    """Choose poses for a calibration and predict their accuracy.

    Args:
        geometry: Mechanism at its nominal parameters; those that are not `free` stay.
        candidates: Poses that may be measured, as in `build_design`.
        n: Number of poses, or `auto`: until twice as many would hardly help.
        criterion: `tool` (default), `worst`, `determinant`, `condition`, `smallest` or `amplification`.
        noise: Standard deviations or covariances, as in `build_design`.
        gain: With `auto`, share of the held-out error that twice as many poses must be worth.
        target: With `auto`, accuracy [m] at which to stop instead.
        seed: Seed of the random start that competes with the picked one.
        **known: Arguments of `build_design`: frames, workspace, fix, free, device, tool, weighted.

    Raises:
        InputError: Too few candidates or poses (with the number needed), or an argument out of range.
        UnknownName: No such criterion.
    """
    design = build_design(geometry, candidates, noise, **known)
    return choose_from(design, n, criterion=criterion, gain=gain, target=target, seed=seed)


def choose_from(
    design: PoseDesign,
    n: int | Literal["auto"] = "auto",
    *,
    criterion: str = "tool",
    gain: float = MIN_DOUBLING_GAIN,
    target: float | None = None,
    seed: int = 0,
) -> PoseChoice:
    """Choose among candidates whose information is known already; arguments as in `choose_poses`."""
    require_numbers(design, n, gain, target)
    blocks = design.whitened()
    search = PoseExchange(blocks, build_criterion(criterion, design))
    first = search if criterion in SMOOTH else PoseExchange(blocks, build_criterion("determinant", design))
    rng = np.random.default_rng(seed)
    if n == "auto":
        picked, curve = add_poses_until_enough(design, first, gain=gain, target=target, most=min(MAX_POSES, design.n))
    else:
        picked = np.array([k for k, _ in zip(first.pick(), range(n), strict=False)])
        marks = sorted({*np.unique(np.geomspace(compute_min_poses(design), n, 12).astype(int)).tolist(), n})
        curve = [predict(design, picked[:k]) for k in marks]
    best = search.exchanged(picked)
    for _ in range(_STARTS - 1):
        other = search.exchanged(rng.choice(design.n, len(picked), replace=False))
        best = other if search.value(other) > search.value(best) + 1e-6 else best
    trace = [search.value(picked[: k + 1]) for k in range(len(picked))]
    made = predict(design, best)
    said = _warnings(design, made, n, gain, target)
    if design.poses.hides_size(design.geometry.position_units):
        said = (CodedWarning("size_undetermined", _SIZE_UNDETERMINED), *said)
    at_random = float(
        np.median([predict(design, rng.choice(design.n, len(best), replace=False)).rms for _ in range(9)])
    )
    return PoseChoice(design, best, criterion, (*trace, search.value(best)), tuple(curve), made, at_random, said)


def require_numbers(
    design: PoseDesign, n: int | Literal["auto"], gain: float = MIN_DOUBLING_GAIN, target: float | None = None
) -> None:
    """Refuse numbers with which no poses can be chosen; arguments as in `choose_poses`.

    Raises:
        InputError: Too few candidates or poses, or a gain or an accuracy out of range.
    """
    least = compute_min_poses(design)
    if design.n < least:
        have = "1 candidate pose is" if design.n == 1 else f"{design.n} candidate poses are"
        raise InputError(
            "too_little_data",
            f"{have} too few for {len(design.found.names)} unknowns at {design.per_pose} numbers a pose; at least {least} "
            f"are needed, {3 * least} are sensible",
        )
    if n != "auto" and not least <= n <= design.n:
        raise InputError(
            "too_little_data",
            f"{n} poses cannot be chosen: {design.found.rank} parameters need at least {least}, and "
            f"there are {design.n} candidates",
        )
    if not 0 < gain < 1:
        raise InputError(
            "invalid_value", f"the gain that twice as many poses must bring is a share between 0 and 1, not {gain}"
        )
    if target is not None and not 0 < target < np.inf:
        raise InputError("invalid_value", f"the accuracy asked for must be a length above zero, not {target}")


def _warnings(
    design: PoseDesign, made: CalibrationPrediction, n: int | Literal["auto"], gain: float, target: float | None
) -> tuple[str, ...]:
    said = []
    rows = zip(design.names, made.stderr, design.scales, design.counts, strict=True)
    weak = [name for name, error, scale, counts in rows if counts and error > scale]
    if weak:
        more = f" and {len(weak) - 5} more" if len(weak) > 5 else ""
        said.append(
            f"{', '.join(weak[:5])}{more} will be uncertain by more than 10 mm or 0.6 degrees (or "
            "their like), though not blind"
        )
    for name, shift in design.untold[:3]:
        said.append(
            f"no candidate shows {name}, which moves the tool elsewhere in the workspace: an error "
            f"of its usual size leaves {1e3 * shift:.3g} mm"
        )
    if n == "auto" and target is not None and made.rms > target:
        said.append(
            f"{made.poses} poses bring {1e3 * made.rms:.3g} mm, not the {1e3 * target:.3g} mm asked "
            "for; there are no more to take"
        )
    elif n == "auto" and target is None and compute_doubling_gain(made) > 1.5 * gain:
        said.append(
            f"{made.poses} poses are not enough yet: twice as many would make the held-out error "
            f"{100 * compute_doubling_gain(made):.0f} % smaller"
        )
    return tuple(said)
