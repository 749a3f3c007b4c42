"""Kinematic calibration: geometry with uncertainty from measured poses, the model that they support, the gain of each step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tau_dyn.calibrate.addition_tests import find_move_within, find_unit_coupling
from tau_dyn.calibrate.causes import (
    as_finding,
    as_reading_findings,
    build_rejected_findings,
    find_causes,
    suspect_all,
    suspect_laws,
)
from tau_dyn.calibrate.conventions import (
    FoundReading,
    build_pose_proposal,
    find_reading,
    is_explained,
    measure_as_written,
)
from tau_dyn.calibrate.device_noise import weigh_devices
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import (
    PoseSet,
    as_poses,
    check_units,
    estimate_measurement_noise,
    join_pose_sets,
    number_alike,
    read_encoders_as_meant,
)
from tau_dyn.calibrate.model_family import OF_WHOLE, Family, Spec
from tau_dyn.calibrate.model_selection import (
    CandidateModel,
    Options,
    check_patterns,
    describe_implausible,
    fit_models,
    fit_widest,
)
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.outliers import (
    MovedFrame,
    check_spread,
    drop_duplicate_poses,
    find_moved_frames,
    fit_robustly,
    leave_out_held_outliers,
    leave_out_late_outliers,
    leave_out_outliers,
    undo_moves,
)
from tau_dyn.calibrate.result import Calibration
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import ColumnProposal, format_names
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot, as_robot

_ENOUGH_TO_SPLIT = 40  # poses; with fewer, a held-out part is too small for an rms error
_HELD_OUT = 0.25  # share of the poses
_SIZE_UNDETERMINED = (
    "{}: {} do not show how large the robot is; its size is that of the robot file, and angles and ratios of lengths are "
    "calibrated; measure one distance as well (distance_tool)"
)
_MAX_RELATIVE_MISFIT = 0.05
"""Rms error of a fit, relative to the spread of the poses, above which robot and poses do not belong together."""


def calibrate(
    robot: Robot | str | Path,
    poses: PoseSet | str | Path,
    holdout: PoseSet | str | Path | None = None,
    model: str = "auto",
    *,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    residual: str = "forward",
    robust: str = "none",
    device: bool = True,
    tool: bool = True,
    accuracy: tuple[float, ...] = (),
    prior: tuple[float, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find a robot's geometry from measured poses.

    Args:
        robot: The robot with its nominal dimensions, or its file.
        poses: Measured poses to fit, or their file.
        holdout: Measured poses used only for the final errors; without them a quarter of the poses is held out if there are many.
        model: `auto`, or a model's name, such as `nonparallel` or `complete+periodic:cart2`.
        fix: Names or patterns of parameters that are fixed at nominal.
        free: Names or patterns of parameters that are free although they are fixed by default.
        residual: `forward`, `closure` or `inverse`.
        robust: Weights against bad poses: `none`, `huber` or `biweight`; gross outliers are left out in any case.
        device: Whether the measuring device's frame is unknown.
        tool: Whether the target's place on the tool is unknown.
        accuracy: Standard errors of a measured coordinate [m] and perhaps of an orientation about an axis [rad], against which
            the held-out error is judged; by default from the poses' columns of standard errors, or from repeated poses.
        prior: Prior standard deviations of the robot's lengths [m] and perhaps angles [rad] from its file; 10 mm and 10 mrad by
            default.
        seed: Seed of folds, splits and bootstrap.
        progress: Called with a description of each step.

    Raises:
        InputError: The poses cannot be used; the message gives the reason.
        CannotAnswer: The poses lie in one plane, or the robot cannot reach them.

    Example:
        >>> from tau_dyn.calibrate import PoseSet
        >>> rng, robot = np.random.default_rng(0), td.load_robot("gantry_tau")
        >>> built = td.load_robot("gantry_tau", **{"simplified.arms.1.rods.1.length": 2.053})  # 3 mm too long
        >>> q = robot.home + rng.uniform(-0.3, 0.3, (20, 3))
        >>> measured = td.forward_kinematics(built, q).poses.position + 1e-5 * rng.standard_normal((20, 3))
        >>> found = td.calibrate(robot, PoseSet(q, measured), model="ideal", device=False, tool=False)
        >>> [round(row["value"], 3) for row in found.parameter_rows() if row["name"] == "arm1.length"]
        [2.053]
    """
    robot = as_robot(robot)
    poses, holdout = as_poses(poses, robot), None if holdout is None else as_poses(holdout, robot)
    for one in (poses, *([holdout] if holdout is not None else [])):
        _require_place(robot, one)
    options = Options(tuple(fix), tuple(free), residual, robust, device, tool, seed, prior=tuple(prior))
    progress("checking conventions of the pose file")
    poses, holdout, dropped = _drop_constant_orientations(robot, poses, holdout)
    poses, holdout, reading, reread = _reread(robot, poses, holdout, options)
    reread = (*dropped, *reread)
    poses, turned = read_encoders_as_meant(robot, poses)
    reread = (*reread, *turned)
    if holdout is not None:
        holdout, turned = read_encoders_as_meant(robot, holdout)
        reread = (*reread, *turned)
    poses, said = drop_duplicate_poses(poses)
    said = (*said, *_check_size(robot, poses))
    measured = estimate_measurement_noise(poses, accuracy)
    holdout = None if holdout is None else number_alike(poses, holdout)
    family = get_family(robot, poses)
    asked = Spec("") if model == "auto" else family.spec(model)  # reports an unknown name before a long step starts
    check_patterns(family, (*fix, *free), model)
    check_spread(family, poses)
    coupling = find_unit_coupling(family, poses)
    if coupling and "coupling" not in asked.additions:
        said = (*said, coupling.describe(poses.source, model))
        options = replace(options, additions={"coupling": (coupling.name,)} if model == "auto" else {})
    progress("looking for outliers")
    poses = weigh_devices(family, poses, options)
    poses, named = leave_out_outliers(family, poses, options, None if model == "auto" else model)
    poses = weigh_devices(family, poses, options)
    holdout = None if holdout is None else holdout.with_devices_of(poses)
    poses, holdout, split = _split(poses, holdout, seed)
    family = get_family(robot, poses)
    models, steps, more = fit_models(family, poses, model, options, progress)
    kept, late = leave_out_late_outliers(models[-1], options)
    if late:
        poses, family = kept, get_family(robot, kept)
        models, steps, more = fit_models(family, poses, model, options, progress)
    progress("looking for causes")
    chosen = models[-1]
    plain = next((one for one in reversed(models) if set(one.spec.additions) <= set(OF_WHOLE)), chosen)
    within = find_move_within(plain.fit, family, plain.spec)
    odd = describe_implausible(steps)
    holdout, still, moved, held = _settle_holdout(family, chosen, options, holdout, split)
    found = Calibration(
        robot=robot,
        poses=poses,
        holdout=holdout,
        split=split,
        models=tuple(models),
        steps=tuple(steps),
        findings=(
            *(as_reading_findings(reading, seed) if reading else ()),
            *find_causes(family, chosen, still, options),
            *build_rejected_findings(steps),
            *(as_finding(one) for one in moved),
        ),
        warnings=tuple(
            dict.fromkeys(
                (
                    *(
                        *poses.warnings,
                        *(() if holdout is None else holdout.warnings),
                        *reread,
                        *said,
                        *named,
                        *late,
                        *held,
                        *more,
                        *odd,
                    ),
                    *(one.describe() for one in moved),
                    *([within.describe()] if within else []),
                    *_doubts(chosen.fit),
                )
            )
        ),
        seed=seed,
        measured=measured,
    )
    misses = replace(found, holdout=still).misses_poses
    if odd:
        found = replace(found, findings=suspect_laws(found.findings))
    return replace(found, findings=suspect_all(found.findings)) if misses or within else found


def _require_place(robot: Robot, poses: PoseSet) -> None:
    """Refuse loads at the tool of a robot whose file has no place for it.

    Raises:
        InputError: There are loads and no frame of the tool.
    """
    if poses.loads.any() and robot.tool_frame is None:
        raise InputError(
            "unsupported",
            f"{poses.source} has loads at the tool, and {robot.source} no frame named tool where they act; add one to the file",
        )


_MIN_TURN_RAD = 0.05
"""Rms turn of the tool by the robot file from which equal orientations of all poses were not measured."""


def _drop_constant_orientations(
    robot: Robot, poses: PoseSet, holdout: PoseSet | None
) -> tuple[PoseSet, PoseSet | None, tuple[str, ...]]:
    """Return poses without orientations that stay the same although the tool turns, and sentences about them."""
    if not any(one is not None and _has_constant_orientation(robot, one) for one in (poses, holdout)):
        return poses, holdout, ()
    names = " and ".join(
        one.source for one in (poses, holdout) if one is not None and _has_constant_orientation(robot, one)
    )
    said = CodedWarning(
        "orientation_unused",
        f"{names}: the orientation is the same in all poses although the tool turns by the robot file, so it was not "
        "measured; positions alone are used. Leave its columns out, or measure it",
    )
    return poses.without_rotation(), None if holdout is None else holdout.without_rotation(), (said,)


def _has_constant_orientation(robot: Robot, poses: PoseSet) -> bool:
    """Return whether all measured orientations are equal although the joints turn the tool by the robot file."""
    if poses.rotation is None or poses.n < 2 or np.ptp(poses.rotation, axis=0).max() > 1e-9:
        return False
    geometry = get_family(robot, poses).build(Spec("frames"))
    at = geometry.forward(geometry.parameters.values, poses.q)
    turned = at.poses.rotation[at.ok]
    return bool(geometry.orients and len(turned) > 1 and np.sqrt(np.sum(np.var(turned, axis=0))) > _MIN_TURN_RAD)


def _check_size(robot: Robot, poses: PoseSet) -> tuple[str, ...]:
    """Return a warning if the measurements do not determine the robot's size: touches, or angles between rotary drives."""
    if not poses.hides_size(robot.position_units):
        return ()
    told = {"holes, planes and balls at unknown places": poses.touches, "angles of passive joints": poses.of_encoders}
    what = " and ".join(words for words, rows in told.items() if rows.any())
    return (CodedWarning("size_undetermined", _SIZE_UNDETERMINED.format(poses.source, what)),)


def propose_pose_columns(path: str | Path, robot: Robot) -> ColumnProposal | None:
    """Return the column map proposed for a pose file, None if a file holds no poses of a robot.

    Args:
        path: A text table or Parquet.
        robot: The robot.

    Raises:
        InputError: A pose file with cells that are no numbers.
    """

    def explains(poses: PoseSet) -> bool:
        found, geometry, limits = _find_convention(robot, poses, Options())
        return found is not None or is_explained(measure_as_written(geometry, poses, limits))

    return build_pose_proposal(path, robot, lambda poses: _find_convention(robot, poses, Options())[0], explains)


def _find_convention(
    robot: Robot, poses: PoseSet, options: Options
) -> tuple[FoundReading | None, Geometry, tuple[np.ndarray, np.ndarray]]:
    """Return the conventions of poses, the geometry of the robot file, and the joints' limits."""
    geometry, limits = get_family(robot, poses).build(Spec("frames")), (robot.lower, robot.upper)
    return find_reading(geometry, poses, limits, lambda some: _measure_left(robot, some, options)), geometry, limits


def _reread(
    robot: Robot, poses: PoseSet, holdout: PoseSet | None, options: Options
) -> tuple[PoseSet, PoseSet | None, FoundReading | None, tuple[str, ...]]:
    """Return training and held-out poses in the conventions of their file, the evidence for these, and sentences."""
    said: list[str] = []
    if holdout is not None and poses.rotation is None and holdout.rotation is not None:
        said.append(_describe_unused_orientation(poses, holdout))
        holdout = holdout.without_rotation()
    if poses.of_encoders.any():
        return _reread_beside_encoders(robot, poses, holdout, options)
    if not poses.measures_poses:
        return poses, holdout, None, tuple(said)
    found, geometry, limits = _find_convention(robot, poses, options)
    if found is None and len(np.unique(poses.campaign)) > 1:
        if not is_explained(measure_as_written(geometry, poses, limits)):
            poses, one, more = _reread_campaigns(robot, poses, options)
            return poses, holdout, one, (*said, *more)
    said += [found.describe(poses.source)] if found else []
    if holdout is not None:
        holdout, more = _reread_holdout(robot, poses.source, holdout, found, (geometry, limits), options)
        said += more
    poses = found.apply(poses) if found else poses
    if found and "inverse_poses" in {change.cause for change in found.reading}:
        poses, holdout = _see_from_tool(robot, poses, holdout, options)
    for one in (poses, *([holdout] if holdout is not None else [])):
        check_units(one)
    return poses, holdout, found, tuple(said)


_MIN_POSES_OF_CAMPAIGN = 8
"""Poses of a campaign from which its own convention is searched: four frames of six numbers have half of theirs."""


def _reread_campaigns(
    robot: Robot, poses: PoseSet, options: Options
) -> tuple[PoseSet, FoundReading | None, tuple[str, ...]]:
    """Return poses with each campaign in the convention in which it was written, the evidence for one, and sentences."""
    parts, all_found, said = [], [], []
    for k in np.unique(poses.campaign):
        part = poses.take(poses.campaign == k)
        found = _find_convention(robot, part, options)[0] if part.n >= _MIN_POSES_OF_CAMPAIGN else None
        parts.append(found.apply(part) if found else part)
        if found:
            all_found.append(found)
            said.append(found.describe(f"{poses.source}, campaign {poses.campaigns[k]}"))
    if not all_found:
        return poses, None, ()
    joined = replace(join_pose_sets(parts), source=poses.source, sha256=poses.sha256, warnings=poses.warnings)
    return joined, all_found[0], tuple(said)


def _reread_holdout(
    robot: Robot,
    trained: str,
    holdout: PoseSet,
    found: FoundReading | None,
    file: tuple[Geometry, tuple[np.ndarray, np.ndarray]],
    options: Options,
) -> tuple[PoseSet, list[str]]:
    """Return held-out poses in the training file's convention, as written, or in their own, and sentences.

    Args:
        robot: The robot.
        trained: Name of the training file.
        holdout: Held-out poses.
        found: Convention of the training file.
        file: Geometry of the robot file, and the joints' limits.
        options: How the dimensions are fitted.
    """
    meant = found.apply_alike(holdout) if found else holdout
    if not holdout.measures_poses:
        return meant, []  # distances and touches show no convention by themselves
    written, read = (measure_as_written(file[0], some, file[1]) for some in (holdout, meant))
    if is_explained(min(written, read, key=lambda misfit: misfit.value)):
        if read.value <= written.value:
            return meant, []
        return holdout, [
            f"{holdout.source} follows the documented convention, unlike {trained}, and is read as written"
        ]
    own = _find_convention(robot, holdout, options)[0]
    if own is None:
        return (meant if read.value <= written.value else holdout), []
    return own.apply(holdout), [own.describe(holdout.source)]


def _reread_beside_encoders(
    robot: Robot, poses: PoseSet, holdout: PoseSet | None, options: Options
) -> tuple[PoseSet, PoseSet | None, FoundReading | None, tuple[str, ...]]:
    """Return the result of `_reread` for the tool measurements, with the same joint convention applied to the encoders."""
    tool, encoders = poses.split_encoders()
    if tool is None:
        return poses, holdout, None, ()
    held, beside = (None, None) if holdout is None else holdout.split_encoders()
    tool, held, found, said = _reread(robot, tool, held, options)

    def join(tool: PoseSet | None, encoders: PoseSet) -> PoseSet:
        encoders = found.apply_alike(encoders) if found else encoders
        parts = [part for part in (tool, encoders) if part is not None and part.n]
        return replace(join_pose_sets(parts), source=parts[0].source, sha256=parts[0].sha256)

    return join(tool, encoders), None if beside is None else join(held, beside), found, said


def _see_from_tool(
    robot: Robot, poses: PoseSet, holdout: PoseSet | None, options: Options
) -> tuple[PoseSet, PoseSet | None]:
    """Return inverse poses as a camera on the tool measures them, where their errors are equal in its frame."""
    if holdout is not None and holdout.rotation is None:
        return poses, holdout
    from_tool = poses.as_seen_from_tool()
    if not _measure_left(robot, from_tool, options) < _measure_left(robot, poses, options):
        return poses, holdout
    return from_tool, None if holdout is None else holdout.as_seen_from_tool()


def _describe_unused_orientation(poses: PoseSet, holdout: PoseSet) -> str:
    sentence = (
        f"{holdout.source} has orientations and {poses.source} has none, so that the target's own orientation is unknown; "
        "positions alone are compared"
    )
    return CodedWarning("orientation_unused", sentence)


def _measure_left(robot: Robot, poses: PoseSet, options: Options) -> float:
    """Return the error level of poses after a fit of all dimensions, positions and orientations together."""
    try:
        fitted = fit_robustly(get_family(robot, poses), poses, options, None)
    except (InputError, CannotAnswer):
        return float("inf")
    return float(np.exp(np.mean(np.log(fitted.noise))))


def _settle_holdout(
    family: Family, chosen: CandidateModel, options: Options, holdout: PoseSet | None, split: str
) -> tuple[PoseSet | None, PoseSet | None, list[MovedFrame], tuple[str, ...]]:
    """Return held-out poses without outliers, the same without moves before them, these moves, and sentences of outliers.

    Moves are searched for again without the outliers, which would bias them.
    """
    if holdout is None:
        return None, None, [], ()
    widest = fit_widest(family, chosen, options) if split == "given" else chosen.fit
    moved, said = find_moved_frames(widest, holdout) if split == "given" else ([], ())
    kept, more = leave_out_held_outliers(chosen.fit, holdout, undo_moves(moved, holdout))
    if kept is not holdout and split == "given":
        moved, said = find_moved_frames(widest, kept)
    return kept, undo_moves(moved, kept), moved, (*more, *said)


def _split(poses: PoseSet, holdout: PoseSet | None, seed: int) -> tuple[PoseSet, PoseSet | None, str]:
    """Return training and held-out poses, and the kind of the split."""
    if holdout is not None:
        return poses, holdout, "given"
    if poses.n < _ENOUGH_TO_SPLIT:
        return poses, None, "cross-validated"
    configuration = poses.configuration
    n = int(configuration.max()) + 1
    order = np.random.default_rng(seed).permutation(n)
    held = np.flatnonzero(np.isin(configuration, order[: int(round(_HELD_OUT * n))]))
    return poses.take(np.setdiff1d(np.arange(poses.n), held)), poses.take(held), "split"


def _doubts(fitted: GeometryFit) -> tuple[str, ...]:
    said = []
    if not fitted.converged:
        said.append("the fit did not converge; its last values are given")
    missed = int((~fitted.state.ok).sum())
    if missed:
        said.append(f"{missed} poses are out of the fitted model's reach and were not used")
    off, wide = fitted.noise[0], fitted.spread
    if fitted.kind == "forward" and off > _MAX_RELATIVE_MISFIT * wide:
        said.append(
            f"the robot misses its own poses by {off:.2g} m, while they spread over {wide:.2g} m; "
            f"{_describe_constant_columns(fitted)}were two joints' or two axes' columns exchanged, or is this another robot's "
            "file?"
        )
    return tuple(said)


def _describe_constant_columns(fitted: GeometryFit) -> str:
    """Return the columns that keep one value in all poses, as the first cause of a misfit; empty without any."""
    poses, joints = fitted.poses, fitted.geometry.actuated
    q = [f"q_{joint}" for joint, x in zip(joints, poses.q.T, strict=True) if not np.ptp(x)]
    position = [name for name, x in zip(("x_tool", "y_tool", "z_tool"), poses.position.T, strict=True) if not np.ptp(x)]
    if not q and not position:
        return ""
    return f"{format_names([*q, *position])} keep one value in all poses: was it logged? Else "
