"""The force channel: measured actuated forces compared with the model's prediction from measured motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from tau_dyn.diagnose.periodogram import LONG_PERIODS, build_displacement_terms, scan_periods
from tau_dyn.diagnose.preparation import REVERSAL_GAP_PERIODS, ForceTiming, compute_border_gap_s, find_timing
from tau_dyn.diagnose.refitted_signals import RefittedModel, interpolate_smooth
from tau_dyn.diagnose.walking import IMU_TURN, list_walking_causes
from tau_dyn.effects import (
    DELIVERED,
    EFFECTS,
    GRAVITY_TURN,
    REPORTED,
    SHIFTED_FORCE,
    DisplacementEffect,
    Effect,
    LazySignals,
    Motion,
    Scene,
)
from tau_dyn.estimate import Regression, RegressionRun, Whitener
from tau_dyn.evidence import (
    EVERY,
    TRAIN,
    WHOLE_TIME,
    Channel,
    build_scene,
    find_shared_signals,
    measure_scales,
    name_by_joint,
    refuse_scarce,
    split_by_blocks,
)
from tau_dyn.identify import Preparation, PreparedSegment, leave_out_rare_joints, prepare_segment
from tau_dyn.log import Log, decimate, lowpass
from tau_dyn.model import COMPUTED, Model

VALUES_PER_COMBINATION = 3
"""Usable values for each base parameter that the training part determines; with fewer, a third of the noise is fitted."""
VALUES_PER_WALKING_COLUMN = 5
"""Usable values of each equation of a walking robot for each column of the baseline, most of which act in every equation. The
noise of an equation is that of a fit of its own values to them; few values, such as a foot's short flights, seem free of it."""
MIN_VALUES = 10
"""Usable values of each output in the other parts, which are compared with a fit and fit little: an rms is known to 22 %."""
_INDEPENDENT = 1e-9
"""Smallest eigenvalue of the unit columns' Gram matrix that counts as a separate combination."""

_SIGNALS = ("inertia", "weight_gradient", "load", "reducer_torque", "passive")


@dataclass(frozen=True, eq=False)
class ForceChannel(Channel):
    """Actuated forces.

    Attributes:
        prepared: The stretches at their logs' own rate.
        thinned: Their motions at the regression's rate, for quick scans.
        preparation: Filters and masks.
        reported: The same logs, filtered and masked as an identification does; None if too few test data are left of them.
    """

    prepared: tuple[PreparedSegment, ...]
    thinned: tuple[Motion, ...]
    preparation: Preparation
    reported: ForceChannel | None = None

    def report(self) -> Channel:
        """Return the logs as an identification filters and masks them, so that both report the same errors of a model."""
        return self.reported or self

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run; see `Channel.run_columns`."""
        return self.prepared[run].columns_of([effect])[0]

    def run_columns_together(self, effects: Sequence[Effect], run: int) -> list[np.ndarray]:
        """Return the columns (n, m, k) of several effects of one run."""
        return self.prepared[run].columns_of(effects)

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns of all samples, for drawing."""
        return [piece.columns(effect.columns(piece.motion), gated=False) for piece in self.prepared]

    def scan(self, effects: Sequence[Effect], whiten: Whitener, both: np.ndarray) -> np.ndarray | None:
        """Scan periods by Fourier transforms over the position; long ones are left open (nan). See `null_model.py`."""
        first, joint = effects[0], self.scene.index(effects[0].joints[0])
        q, v, a = (np.concatenate([getattr(m, key)[:, joint] for m in self.thinned]) for key in ("q", "v", "a"))
        terms, scale = None, 1.0
        if isinstance(first, DisplacementEffect):
            terms = build_displacement_terms(v, a)
            scale = np.concatenate([m.signals["inertia"][:, joint, joint] for m in self.thinned])[:, None]
        found = scan_periods(effects, whiten, joint, both, q, v, self.preparation.force_cutoff_hz, terms, scale)
        found[np.array([effect.settings["period"] for effect in effects]) > np.ptp(q) / LONG_PERIODS] = np.nan
        return found

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds, accelerations, predicted forces, time and temperature of each run.

        Forces are predicted by the fitted baseline: measured ones would share their noise with the residual.
        """
        found, begin = [], self._begins()
        for motion, start in zip(self.thinned, begin, strict=True):
            row = name_by_joint(motion.joints, q=motion.q, v=motion.v, a=motion.a, **_get_forces(motion))
            row["t"] = np.asarray(motion.t)
            if max(begin) > 0:
                row[WHOLE_TIME] = row["t"] + start
            if "temperature" in motion.signals:
                row |= name_by_joint(motion.joints, temp=motion.signals["temperature"])
            found.append(row)
        return found

    def _begins(self) -> list[float]:
        """Return the start time of each run's log [s] if the logs follow one another."""
        ends: dict[str, float] = {}
        for piece in self.prepared:
            ends[piece.log.name] = max(ends.get(piece.log.name, 0.0), float(piece.log.t[-1]))
        begin = dict(zip(ends, np.cumsum([0.0, *ends.values()]), strict=False))
        return [float(begin[piece.log.name]) for piece in self.prepared]


class WalkingForceChannel(ForceChannel):
    """Forces of a walking robot: equations of its base, which hold the torques of all legs, and of lifted legs."""

    has_unnamed_structures = False  # of an equation, which no single joint moves


def _get_forces(motion: Motion) -> dict[str, np.ndarray]:
    """Return the predicted forces (n, na) of a motion by the name of the variable; an empty dict without a fitted model."""
    return {"tau": motion.signals["force"]} if "force" in motion.signals else {}


def prepare_segments(
    model: Model, pieces: Sequence[Log], preparation: Preparation, smooth_hz: Sequence[float | None]
) -> tuple[PreparedSegment, ...]:
    """Return all pieces ready for making columns, in their order.

    Args:
        model: The baseline.
        pieces: Even stretches of logs.
        preparation: Filters and masks.
        smooth_hz: Low-pass of each piece's positions [Hz]; None for that of an identification.
    """
    names = list(dict.fromkeys(piece.name for piece in pieces))
    found = []
    for piece, smooth in zip(pieces, smooth_hz, strict=True):
        campaign = {"campaign": np.full(piece.n_samples, float(names.index(piece.name)))} if len(names) > 1 else {}
        found.append(prepare_segment(model, piece, preparation, signals=campaign, smooth_hz=smooth))
    return tuple(found)


def build_force_regression(model: Model, prepared: Sequence[PreparedSegment], preparation: Preparation) -> Regression:
    """Return the baseline's regression on prepared pieces; equations of a walking robot's legs are named apart from joints."""
    runs, robot = [piece.run(model) for piece in prepared], model.robot
    least = VALUES_PER_WALKING_COLUMN * int(model.parameters.free.sum())
    runs = tuple(leave_out_rare_joints(runs, len(robot.base_coordinates), least))
    outputs = robot.actuated
    if robot.base_coordinates:
        outputs = (*robot.base_coordinates, *(f"{joint} (leg in the air)" for joint in robot.driven))
    return Regression(model.parameters, outputs, robot.force_units, runs, preparation)


def build_force_channel(
    model: Model,
    prepared: Sequence[PreparedSegment],
    held: Sequence[bool],
    preparation: Preparation,
    regression: Regression,
    clear_hz: float,
) -> ForceChannel:
    """Build the channel.

    Args:
        model: The baseline at fitted values; signals such as loads and predicted forces are taken from it.
        prepared: Even stretches of the training logs, then of the held-out logs.
        held: Whether a piece belongs to a held-out log.
        preparation: Filters and masks.
        regression: The baseline's regression on these pieces.
        clear_hz: Low-pass of the forces that springs carry [Hz]; see `clear_cutoff`.

    Raises:
        CannotAnswer: The remaining data are too few for three parts.
    """
    prepared, regression, timing, refitted = _complete(model, prepared, held, regression, clear_hz)
    gap_s = compute_border_gap_s(preparation.force_cutoff_hz, prepared[0].log.rate_hz)
    parts = split_by_blocks(regression.runs, held, gap_s)
    campaigns = len({piece.log.name for piece, out in zip(prepared, held, strict=True) if not out})
    thinned = tuple(_thinned(piece) for piece in prepared)
    scene = _scene(model, thinned, regression.runs, parts, preparation, campaigns)
    if timing is not None:
        each = zip(scene.joints, map(float, timing.delays), map(float, timing.lags), strict=True)
        scene = replace(scene, timing={joint: (delay, lag) for joint, delay, lag in each})
    walks = bool(model.robot.base_coordinates)
    scene = scene if walks else _with_refits(scene, refitted)
    channel = (WalkingForceChannel if walks else ForceChannel)(
        "force",
        regression.outputs,
        regression.units,
        model.parameters,
        regression.runs,
        parts,
        scene,
        list_walking_causes(model.robot) if walks else tuple(cls for cls in EFFECTS.values() if cls.cause),
        tuple(prepared),
        thinned,
        preparation,
    )
    others = MIN_VALUES * len(regression.outputs)
    rank = max(1, compute_determined_rank(regression, parts))
    each = VALUES_PER_WALKING_COLUMN * len(model.robot.base_coordinates) if walks else VALUES_PER_COMBINATION
    seconds, length = sum(p.log.duration for p in prepared), "a minute"
    if walks:
        trained = max(1, sum(int(mask.sum()) for mask in channel.masks(TRAIN)))
        length = f"{10 * np.ceil(0.1 * seconds * each * rank / trained):g} s"  # usable data grow with time
    refuse_scarce(
        channel,
        (each * rank, others, others),
        "too little usable data is left",
        f"the logs hold {seconds:.3g} s",
        f"record {length} or more of motion in both directions, over several speeds",
    )
    return channel


def _with_refits(scene: Scene, refitted: RefittedModel) -> Scene:
    """Return the scene with the joints' zeros that fit best, and the largest forces of a fit with a saturation."""
    zeros = dict(zip(scene.joints, map(float, refitted.zeros), strict=True))
    largest = dict(zip(scene.joints, map(float, refitted.largest), strict=True))
    scales = {joint: {**own, "delivered": largest[joint]} for joint, own in scene.scales.items()}
    return replace(scene, zeros=zeros, scales=scales)


def replace_measurements(
    channel: ForceChannel,
    model: Model,
    prepared: Sequence[PreparedSegment],
    held: Sequence[bool],
    regression: Regression,
    clear_hz: float,
) -> ForceChannel:
    """Return a channel, its parts and its scene, with other measurements at the same times; see `build_force_channel`."""
    prepared, regression, *_ = _complete(model, prepared, held, regression, clear_hz)
    thinned = tuple(_thinned(piece) for piece in prepared)
    return replace(channel, runs=regression.runs, prepared=tuple(prepared), thinned=thinned, reported=None)


def add_reported_channel(
    channel: ForceChannel,
    model: Model,
    pieces: Sequence[Log],
    held: Sequence[bool],
    preparation: Preparation,
    clear_hz: float,
) -> ForceChannel:
    """Return a channel with the same logs as an identification filters and masks them.

    Causes act far above the motion's own band, so a search uses a wider one, in which noise is a larger share of the force.
    Errors are reported in the identification's band. Every sample belongs to the same part as in the search.

    Args:
        channel: The channel in which causes are searched.
        model: The baseline at fitted values.
        pieces: Even stretches of the training logs, then of the held-out logs, as they were logged.
        held: Whether a piece belongs to a held-out log.
        preparation: Filters and masks of an identification of the training logs.
        clear_hz: Low-pass of the forces that springs carry [Hz]; see `clear_cutoff`.
    """
    prepared = prepare_segments(model, pieces, preparation, [None] * len(pieces))
    runs = build_force_regression(model, prepared, preparation).runs
    nominal, trained = channel.parameters.values, tuple(not out for out in held)
    searched = RefittedModel(model, nominal, channel.prepared, channel.runs, trained)  # effects are estimated there
    refitted = RefittedModel(model, nominal, prepared, runs, trained, searched)
    prepared = tuple(_with_signals(piece, refitted, k, clear_hz, None) for k, piece in enumerate(prepared))
    parts = []
    for run, other, part in zip(runs, channel.runs, channel.parts, strict=True):
        middles = (other.t[1:] + other.t[:-1]) / 2
        parts.append(part[np.searchsorted(middles, run.t)])
    found = replace(
        channel,
        runs=runs,
        parts=tuple(parts),
        prepared=prepared,
        thinned=tuple(_thinned(piece) for piece in prepared),
        preparation=preparation,
        reported=None,
    )
    least = MIN_VALUES * len(channel.outputs)
    enough = all(sum(int(mask.sum()) for mask in found.masks(part)) >= least for part in EVERY)
    return replace(channel, reported=found) if enough else channel


def _complete(
    model: Model,
    prepared: Sequence[PreparedSegment],
    held: Sequence[bool],
    regression: Regression,
    clear_hz: float,
) -> tuple[Sequence[PreparedSegment], Regression, ForceTiming | None, RefittedModel]:
    """Return the pieces with a fitted model's signals along their motion, their regression, the forces' timing, and refits."""
    prepared, regression, timing = _with_timing(model, prepared, held, regression)
    trained = tuple(not out for out in held)
    refitted = RefittedModel(model, regression.parameters.values, tuple(prepared), regression.runs, trained)
    found = [_with_signals(piece, refitted, k, clear_hz, timing) for k, piece in enumerate(prepared)]
    return found, regression, timing, refitted


def _with_timing(
    model: Model,
    prepared: Sequence[PreparedSegment],
    held: Sequence[bool],
    regression: Regression,
) -> tuple[Sequence[PreparedSegment], Regression, ForceTiming | None]:
    """Return the pieces and their regression without the samples to which late forces shift a reversal, and the timing.

    The equations of a walking robot hold several forces, so none has its own timing.
    """
    if model.robot.base_coordinates:
        return prepared, regression, None
    trained = [run for run, out in zip(regression.runs, held, strict=True) if not out]
    timing = find_timing(trained, model.parameters.values, np.asarray(regression.parameters.free))
    if timing is None:
        return prepared, regression, None
    late = timing.delays + timing.lags
    closed = [piece.close_after(late) for piece in prepared]
    return closed, replace(regression, runs=tuple(piece.run(model) for piece in closed)), timing


def compute_determined_rank(regression: Regression, parts: Sequence[np.ndarray]) -> int:
    """Return how many combinations of parameters the training part determines: the rank of its unit columns."""
    gram = np.zeros((len(regression.parameters),) * 2)
    for run, part in zip(regression.runs, parts, strict=True):
        rows = run.W[run.usable & (part == TRAIN)[:, None]]
        gram += rows.T @ rows
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return int(np.linalg.matrix_rank(gram / np.outer(scale, scale), tol=_INDEPENDENT, hermitian=True))


def _with_signals(
    piece: PreparedSegment,
    refitted: RefittedModel,
    place: int,
    clear_hz: float,
    timing: ForceTiming | None,
) -> PreparedSegment:
    """Return a piece with a fitted model's signals in its motion: loads, inertia, turn of gravity, predicted forces.

    `force` is computed at the values after correction of the recording's timing; see `preparation.py`.
    """
    model = refitted.model
    m, t, mechanism = piece.motion, piece.log.t, model.mechanism
    if model.robot.base_coordinates:
        return _with_turns(piece, refitted, place)
    names = [s for s in _SIGNALS if s != "passive" or model.robot.loops]
    smooth = {name: partial(interpolate_smooth, piece, partial(COMPUTED[name], mechanism)) for name in names}
    known: dict[str, Callable[[], np.ndarray]] = {name: partial(m.signals.__getitem__, name) for name in m.signals}
    known |= smooth
    known[GRAVITY_TURN] = lambda: refitted.gravity_turns[place]
    known[SHIFTED_FORCE] = lambda: refitted.shifted_forces[place]
    found = LazySignals(known)

    @cache
    def find_whole() -> Motion:
        felt = {name for effect in model.effects for name in effect.needs}
        return model.motion(m.q, m.v, m.a, m.sign, t=t, signals={name: found[name] for name in found if name in felt})

    def predict() -> np.ndarray:
        force = signals["wide_force"] + model.effect_force(find_whole())
        return force if timing is None else force + predict_change(timing.change)

    def predict_change(change: np.ndarray) -> np.ndarray:
        parts = (mechanism.regressor(m.q, m.v, m.a), *(effect.columns(find_whole()) for effect in model.effects))
        return np.concatenate(parts, axis=2) @ change

    signals = LazySignals(
        {
            **{name: partial(found.__getitem__, name) for name in found},
            "wide_force": lambda: (
                mechanism.regressor(m.q, m.v, m.a) @ model.robot.parameters.values
            ),  # also without mass
            "rigid_force": lambda: lowpass(
                signals["wide_force"], min(clear_hz, 0.4 * piece.log.rate_hz), piece.log.rate_hz
            ),
            "force": predict,
            DELIVERED: lambda: signals["force"] + predict_change(refitted.delivered),
            "damping": lambda: model.damping(find_whole()),
            "clear_hz": lambda: np.full(len(t), clear_hz),  # a mode in the clear band does not amplify noise
        }
    )
    arrays = {key: _lay_samples_last(getattr(m, key)) for key in ("q", "v", "a", "sign")}
    return replace(piece, motion=replace(m, **arrays, signals=LazySignals.changed(signals, _lay_samples_last)))


def _with_turns(piece: PreparedSegment, refitted: RefittedModel, place: int) -> PreparedSegment:
    """Return a piece of a walking robot with the turns of gravity and of its IMU; other forces of a model lack the ground's."""
    known: dict[str, Callable[[], np.ndarray]] = {
        name: partial(piece.motion.signals.__getitem__, name) for name in piece.motion.signals
    }
    known |= {GRAVITY_TURN: lambda: refitted.gravity_turns[place], IMU_TURN: lambda: refitted.imu_turns[place]}
    return replace(piece, motion=replace(piece.motion, signals=LazySignals(known)))


def _lay_samples_last(x: np.ndarray) -> np.ndarray:
    """Return an array (N, ...) with a joint's samples next to each other in memory, as effects and filters read them."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(x, 0, -1)), -1, 0)


def _thinned(piece: PreparedSegment) -> Motion:
    """Return a stretch's motion through the regression's low-pass, at its rate."""
    motion, factor = piece.motion, piece.factor
    arrays = [piece.passed(x) for x in (motion.q, motion.v, motion.a)]
    signals = LazySignals.changed(motion.signals, partial(decimate, factor=factor))
    return Motion.of(motion.joints, *arrays, t=decimate(piece.log.t, factor), signals=signals)


def _scene(
    model: Model,
    motions: Sequence[Motion],
    runs: Sequence[RegressionRun],
    parts: Sequence[np.ndarray],
    preparation: Preparation,
    campaigns: int,
) -> Scene:
    slow, walks = preparation.speed_threshold, bool(model.robot.base_coordinates)
    if (
        walks
    ):  # reversals stay in: no law of a speed that a joint passes within the gap of other robots shows next to them
        hardness = np.sqrt(np.mean(np.concatenate([m.a for m in motions]) ** 2, axis=0))
        slow = np.maximum(slow, hardness * REVERSAL_GAP_PERIODS / preparation.position_cutoff_hz)
    signals = find_shared_signals(motions)
    if "temperature" in signals and max(float(np.ptp(m.signals["temperature"])) for m in motions) < 0.5:
        signals -= {"temperature"}  # it never changed
    scene = build_scene(
        motions,
        model.robot.actuated,
        model.robot.force_units,
        slow=slow,
        cutoff_hz=preparation.force_cutoff_hz,
        duration=sum(float(run.t[-1] - run.t[0]) for run in runs),
        signals=signals,
        campaigns=campaigns,
        trained=[part == TRAIN for part in parts],
        coupled=model.robot.coupled_pairs,
    )
    robot = model.robot
    measured = [m.signals[REPORTED] for m in motions] if walks else [run.y_all for run in runs]
    force = np.max([np.abs(x).max(axis=0) for x in measured], axis=0)
    inertias = [model.mechanism.inertia(m.q) if walks else m.signals["inertia"] for m in motions]
    inertia = np.max([np.diagonal(M, axis1=1, axis2=2).max(axis=0) for M in inertias], axis=0)
    ends = zip(robot.actuated, robot.effort_limit.tolist(), robot.velocity_limit.tolist(), strict=True)
    return replace(
        scene,
        scales=measure_scales(model.parameters, scene, force, inertia),
        ratios=robot.gear_ratios,
        limits={joint: (f, v) for joint, f, v in ends if 0 < f < np.inf and 0 < v < np.inf},
    )
