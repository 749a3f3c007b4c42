"""The force baseline fitted to logs: filters chosen, parameters refitted with physical consistency, data checked.

Positions are smoothed before columns are made of them (`smooth_cutoffs`): above the cutoff, a spectrum in time shows only
noise. An encoder's periodic error, or a motion disturbed by cogging, may be located there: a few micrometres, spread over many
frequencies by the changing speed, but at one line in a spectrum over the position. Such positions are not smoothed: the error
would be removed from speeds and accelerations before the search, and the force of a true motion would be mistaken for an error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.signal import butter, sosfiltfilt

from tau_dyn.diagnose.force_channel import (
    ForceChannel,
    add_reported_channel,
    build_force_channel,
    build_force_regression,
    compute_determined_rank,
    prepare_segments,
    replace_measurements,
)
from tau_dyn.diagnose.noise_only_log import (
    NoiseOnlyLog,
)
from tau_dyn.diagnose.payload import find_end_link
from tau_dyn.diagnose.periodogram import build_force_terms, compute_period_statistics
from tau_dyn.diagnose.preparation import (
    choose_diagnosis_preparation,
    clear_cutoff,
    decimate_log,
    keep_diagnosable,
    smooth_cutoffs,
)
from tau_dyn.effects import TransmissionError
from tau_dyn.estimate import PhysicalConstraints, Regression, solve_least_squares
from tau_dyn.evidence import (
    TRAIN,
    Channel,
    compute_overfit_factor,
)
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import (
    EXPERIMENT,
    Preparation,
    PreparedSegment,
    build_physical_constraints,
    check_integrity,
    choose_preparation,
    count_information,
    cut_into_pieces,
    list_crumbs,
    list_information_warnings,
    list_resting_warnings,
    log_warnings,
    name_apart,
    select_long,
)
from tau_dyn.log import Log, compute_edge_samples, decimate, find_motion_band, lowpass
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import INERTIAL

Progress = Callable[[str], None]
_WAVE_DRAWS = 8  # of white noise, by which the level of a peak is set
_MIN_BAND_RATIO = 1.25  # least ratio of the upper to the lower end of the band
_HIGHPASS_ORDER = 8
"""Order of the high-pass, run forwards and backwards: it leaves 1e-8 of an amplitude at a third of its cutoff."""
_EDGE_FACTOR = 3
"""Edges left out, as a multiple of those of the usual low-pass, which rings for a third of the time."""
_WAVE_LEVEL = 1e-6
"""Significance level of any wave in positions that hold noise alone; true waves exceed its threshold by far, since positions
are hardly noisy."""


AnyChannel = TypeVar("AnyChannel", bound=Channel)
CarriedLoad = tuple[tuple[str, ...], Parameters]
"""Names of logs, and the ten inertial numbers of the body that they carry."""


def name_load(logs: Sequence[str]) -> str:
    """Return the label of a body that some logs carry."""
    return "+".join(logs)


def compute_load_columns(model: Model, prepared: Sequence[PreparedSegment]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return columns (n, na, 10) of a body fixed to the end link, of each piece, with the masks of forces and without masks."""
    body = find_end_link(model.robot)
    assert body is not None  # a robot with several ends has no loads
    ten = [f"{body.link}.{quantity}" for quantity in INERTIAL]
    wide = replace(model, robot=model.robot.untied(ten))
    places = [wide.robot.parameters.names.index(name) for name in ten]
    found = []
    for piece in prepared:
        Y = wide.mechanism.regressor(piece.motion.q, piece.motion.v, piece.motion.a)[:, :, places]
        found.append((piece.columns(Y), piece.columns(Y, gated=False)))
    return found


@dataclass(frozen=True, eq=False)
class FittedBaseline:
    """A baseline fitted to logs, ready for the search of causes.

    Attributes:
        nominal: The baseline before the fit.
        model: The baseline at fitted values.
        channel: All data, with the baseline's columns.
        physics: Physical consistency of the baseline's values.
        preparation: Filters and masks.
        smooth_hz: Low-pass of each piece's positions [Hz].
        clear_hz: Low-pass of the forces that springs carry [Hz].
        held: Whether a piece belongs to a held-out log.
        pieces: Even stretches of the training logs, then of the held-out logs, as they were logged.
        warnings: Warnings about the logs.
        loads: Bodies that some logs carry at the tool beyond the others.
        overfit: Held-out over training rms that the number of parameters explains.
    """

    nominal: Model
    model: Model
    channel: ForceChannel
    physics: PhysicalConstraints
    preparation: Preparation
    smooth_hz: tuple[float, ...]
    clear_hz: float
    held: tuple[bool, ...]
    pieces: tuple[Log, ...]
    warnings: tuple[str, ...] = ()
    loads: tuple[CarriedLoad, ...] = ()
    overfit: float = 1.0

    @cached_property
    def _noise_only_logs(self) -> list[NoiseOnlyLog]:
        """The baseline's prediction of every piece."""
        pieces = zip(self.channel.prepared, self.pieces, self.smooth_hz, strict=True)
        return [NoiseOnlyLog.of(piece, self.model, log, smooth) for piece, log, smooth in pieces]

    def noise_only(self, rng: np.random.Generator) -> Channel:
        """Return the channel of logs that hold only the baseline and encoder noise."""
        logs = [log.draw(rng) for log in self._noise_only_logs]
        prepared = prepare_segments(self.nominal, logs, self.preparation, self.smooth_hz)
        regression = build_force_regression(self.nominal, prepared, self.preparation)
        drawn = replace_measurements(self.channel, self.model, prepared, self.held, regression, self.clear_hz)
        return self.carry_loads(drawn, drawn.prepared, known=True)

    @property
    def has_known_load(self) -> bool:
        """Whether a load is known from a model file alone: all logs carry it."""
        return any(not parameters.free.any() for _, parameters in self.loads)

    def pad_nominal(self) -> np.ndarray:
        """Return the nominal values with those of the loads, zero (p,)."""
        return np.concatenate([self.nominal.parameters.values, *(np.zeros(len(p)) for _, p in self.loads)])

    def carry_loads(
        self, channel: AnyChannel, prepared: Sequence[PreparedSegment], *, known: bool = False
    ) -> AnyChannel:
        """Return a channel with the columns of the loads.

        Args:
            channel: The measurements without loads.
            prepared: Its pieces.
            known: Whether forces of a load that a model file alone determines are added to the measurements.
        """
        if not self.loads:
            return channel
        runs = list(channel.runs)
        loads = compute_load_columns(self.nominal, prepared)
        for logs, parameters in self.loads:
            for k, (run, (W, W_all)) in enumerate(zip(runs, loads, strict=True)):
                here = float(run.name in logs)
                force = parameters.values * here if known and not parameters.free.any() else np.zeros(len(parameters))
                runs[k] = replace(
                    run,
                    W=np.concatenate([run.W, W * here], axis=2),
                    W_all=np.concatenate([run.W_all, W_all * here], axis=2),
                    y=run.y + W @ force,
                    y_all=run.y_all + W_all @ force,
                )
        more = [p for _, parameters in self.loads for p in parameters]
        found = replace(channel, parameters=channel.parameters + Parameters(more), runs=tuple(runs))
        shown = channel.report()
        if shown is channel or not isinstance(shown, ForceChannel):
            return found
        return replace(found, reported=self.carry_loads(shown, shown.prepared, known=known))


def fit_baseline(
    model: Model,
    train_logs: list[Log],
    held_logs: list[Log],
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    progress: Progress,
) -> FittedBaseline:
    """Return the baseline fitted to the training logs, with all of the data.

    Args:
        model: The baseline at its nominal values.
        train_logs: Logs to train on.
        held_logs: Held-out logs.
        preparation: Filters and masks; None to choose them.
        exclude: Log columns whose nonzero samples are left out.
        progress: Called with a word for each step.

    Raises:
        CannotAnswer: The logs determine no parameter, or are too short for three parts; its warnings describe the problems.
    """
    robot, logs = model.robot, name_apart([*train_logs, *held_logs])
    train_logs, held_logs = logs[: len(train_logs)], logs[len(train_logs) :]
    train, held = (
        [piece for log in some for piece in cut_into_pieces(log, robot, exclude)] for some in (train_logs, held_logs)
    )
    warnings = [*check_integrity(robot, logs, exclude), *robot.warnings]
    warnings += [*log_warnings(robot, [*train, *held]), *list_crumbs(logs)]
    try:
        train, held, left_out = keep_diagnosable(robot, train_logs, train, held, exclude)
        warnings += left_out
        filters = preparation or choose_diagnosis_preparation(robot, train, exclude)
        pieces, is_held = (*train, *held), (*[False] * len(train), *[True] * len(held))
        smooth_hz, clear_hz = smooth_cutoffs(robot, train, held), clear_cutoff(robot, train)
        if robot.base_coordinates:  # an identification's positions, as they are
            smooth_hz = (filters.position_cutoff_hz,) * len(pieces)
        reported = preparation or choose_preparation(robot, select_long(train), exclude)
        case = _fitted(model, pieces, is_held, (filters, reported), smooth_hz, clear_hz, progress)
        if detect_position_periodicity(case.channel, smooth_hz):
            smooth_hz = (filters.position_cutoff_hz,) * len(pieces)  # as they are
            case = _fitted(model, pieces, is_held, (filters, reported), smooth_hz, clear_hz, progress)
        return _examine_information(replace(case, warnings=tuple(warnings)), train)
    except CannotAnswer as fault:
        fault.warnings = (*warnings, *fault.warnings)
        raise


def _examine_information(case: FittedBaseline, train: Sequence[Log]) -> FittedBaseline:
    """Return the case with warnings if the training part holds little information for the baseline, or joints mostly rest.

    Raises:
        CannotAnswer: It holds fewer independent values than the baseline has unknowns: causes would be fitted to chance errors.
    """
    channel = case.channel
    masks = channel.masks(TRAIN)
    runs = tuple(replace(run, usable=m) for run, m in zip(channel.runs, masks, strict=True))
    used = Regression(channel.parameters, channel.outputs, channel.units, runs, case.preparation)
    bands = [find_motion_band(log.joint("q", case.model.robot.actuated), log.rate_hz).edge_hz.max() for log in train]
    rank, band_hz = compute_determined_rank(used, channel.parts), float(max(bands))
    held = count_information(used, band_hz)
    if held < rank:
        raise CannotAnswer(
            "too_little_data",
            f"the part that is trained on holds about {held:.0f} independent values for {rank} parameters and combinations "
            f"({sum(log.duration for log in train):.3g} s of motion up to {band_hz:.2g} Hz)",
            EXPERIMENT,
        )
    more = [*list_information_warnings(used, rank, band_hz), *list_resting_warnings(used)]
    return replace(case, warnings=(*case.warnings, *more), overfit=compute_overfit_factor(held, rank))


def _fitted(
    model: Model,
    pieces: tuple[Log, ...],
    is_held: tuple[bool, ...],
    preparations: tuple[Preparation, Preparation],
    smooth_hz: tuple[float, ...],
    clear_hz: float,
    progress: Progress,
) -> FittedBaseline:
    """Return the baseline fitted to pieces whose positions are low-passed at `smooth_hz` [Hz], one cutoff per piece.

    The first of the two preparations is that of the search, the second that of an identification, for which errors are
    reported.
    """
    preparation, reported = preparations
    progress("columns")
    thinned = [decimate_log(piece, preparation.position_cutoff_hz) for piece in pieces]
    prepared = prepare_segments(model, thinned, preparation, smooth_hz)
    regression = build_force_regression(model, prepared, preparation)
    physics = build_physical_constraints(model)
    progress("baseline")
    first = replace(regression, runs=regression.runs[: is_held.count(False)])
    estimate = solve_least_squares(first, physics=physics)
    if freed := [name for name in physics.rotors if estimate.parameters[name].free]:
        model = model.with_parameters(model.parameters.update({name: {"free": True} for name in freed}))
        physics = build_physical_constraints(model)
        regression = replace(regression, parameters=model.parameters)
    fit = model.with_parameters(estimate.parameters)
    channel = build_force_channel(fit, prepared, is_held, preparation, regression, clear_hz)
    scene = replace(channel.scene, step_s=1 / pieces[0].rate_hz)
    channel = replace(channel, parameters=model.parameters, scene=scene)
    if not model.robot.base_coordinates:  # else the same filters
        channel = add_reported_channel(channel, fit, pieces, is_held, reported, clear_hz)
    return FittedBaseline(model, fit, channel, physics, preparation, smooth_hz, clear_hz, is_held, pieces)


def detect_position_periodicity(channel: ForceChannel, smooth_hz: Sequence[float]) -> bool:
    """Return whether positions above `smooth_hz` [Hz] repeat with the position, up to the highest frequency of forces.

    Pieces in which that frequency is hardly above `smooth_hz` are skipped: their columns contain nearly the whole band.
    """
    rng = np.random.default_rng(0)
    return any(_wave(channel, joint, smooth_hz, rng) for joint in channel.scene.joints)


def _wave(channel: ForceChannel, joint: str, smooth_hz: Sequence[float], rng: np.random.Generator) -> bool:
    j, fastest, top = channel.scene.index(joint), 0.0, channel.preparation.force_cutoff_hz
    pieces, lowest = [], top
    for piece, motion, smooth in zip(channel.prepared, channel.thinned, smooth_hz, strict=True):
        if _MIN_BAND_RATIO * smooth >= top:
            continue
        read, rate = piece.log.joint("q", [joint])[:, 0], piece.log.rate_hz
        made = rng.standard_normal((len(read), _WAVE_DRAWS))
        both = np.column_stack([read, made])
        above = _between(both, smooth, top, rate)
        inner = slice(edge := _EDGE_FACTOR * compute_edge_samples(smooth, rate), len(above) - edge)
        if inner.stop - inner.start < 2 * edge:
            continue  # a log that begins in motion makes the filter ring there
        size = np.std(above[inner], axis=0)  # the remaining motion counts as noise
        few = decimate(above / np.where(size > 0, size, 1.0), piece.factor)
        far = slice(-(-inner.start // piece.factor), inner.stop // piece.factor)
        pieces.append((motion.q[far, j], motion.v[far, j], few[far]))
        fastest, lowest = max(fastest, float(np.max(np.abs(motion.v[:, j])))), min(lowest, smooth)
    if not pieces:
        return False
    q, v, u = (np.concatenate(x) for x in zip(*pieces, strict=True))
    periods = np.array([setting["period"] for setting in TransmissionError.grid(channel.scene, (joint,))])
    periods = periods[fastest / periods > lowest]
    if not periods.size:
        return False
    T = compute_period_statistics(q, v, u, np.ones(len(q), bool), periods, top, build_force_terms(q))
    return bool(len(periods) * len(channel.scene.joints) * np.exp(-0.5 * T[:, 0].max()) < _WAVE_LEVEL)


def _between(x: np.ndarray, low_hz: float, high_hz: float, rate_hz: float) -> np.ndarray:
    """Return columns (N, n) band-passed between two frequencies [Hz].

    The high-pass is steep: encoders resolve a millionth of the motion, whose power is an octave or two below.
    """
    steep = butter(_HIGHPASS_ORDER, low_hz, "highpass", fs=rate_hz, output="sos")
    return np.asarray(sosfiltfilt(steep, lowpass(x, high_hz, rate_hz), axis=0))
