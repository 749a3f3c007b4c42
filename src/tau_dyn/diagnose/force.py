"""The force channel: measured actuated forces against those that the model predicts from measured motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.diagnose.channel import Channel, refuse_scarce
from tau_dyn.diagnose.data_split import TEST, TRAIN, VALIDATION, split_by_blocks
from tau_dyn.diagnose.filters import compute_border_gap_s
from tau_dyn.diagnose.force_timing import ForceTiming, find_timing
from tau_dyn.diagnose.noise import WHOLE_TIME
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.periodogram import (
    LONG,
    build_displacement_terms,
    build_force_terms,
    compute_period_statistics,
    select_output_rows,
)
from tau_dyn.diagnose.plausibility import measure_scales
from tau_dyn.diagnose.scenes import build_scene, find_shared_signals
from tau_dyn.effects import EFFECTS, GRAVITY_TURN, DisplacementEffect, Effect, Motion, Scene
from tau_dyn.estimate import Regression, RegressionRun
from tau_dyn.identify import Preparation, PreparedSegment, prepare_segment
from tau_dyn.log import Log, decimate, lowpass
from tau_dyn.model import COMPUTED, Model

VALUES_PER_COMBINATION = 3
"""Usable values for each base parameter that the training part determines; with fewer, a third of the noise is fitted."""
MIN_VALUES = 10
"""Usable values of each output in the other parts, which are compared with a fit and fit little: an rms is known to 22 %."""
_INDEPENDENT = 1e-9
"""Smallest eigenvalue of the unit columns' Gram matrix that counts as another combination."""

_MAX_ROWS = 8000
"""Samples from which values are made: many times the number of parameters."""
_MIN_RELATIVE_NORM = 1e-7
"""Size of a column, relative to the largest, below which it is a rounding of the robot file."""
_WEIGHING = ("mass", "mx", "my", "mz")
_STIFFNESS = 30.0
"""How much less of a misfit masses and first moments take than inertias, where either can: a drive's inertia that nobody gave
is in the bodies' inertia, and the robot file knows masses better."""
_SIGNALS = ("inertia", "weight_gradient", "load", "passive")


@dataclass(frozen=True, eq=False)
class ForceChannel(Channel):
    """Actuated forces.

    Attributes:
        prepared: The stretches at their logs' own rate.
        thinned: Their motions at the regression's rate, for quick scans.
        preparation: Filters and masks.
    """

    prepared: tuple[PreparedSegment, ...]
    thinned: tuple[Motion, ...]
    preparation: Preparation

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run; see `Channel.run_columns`."""
        piece = self.prepared[run]
        return piece.columns(effect.columns(piece.motion))

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns without any sample left out, for drawing."""
        return [piece.columns(effect.columns(piece.motion), gated=False) for piece in self.prepared]

    def scan(self, effects: Sequence[Effect], ground: NullModel, both: np.ndarray) -> np.ndarray | None:
        """Scan periods by Fourier transforms over the position; long ones are left open (nan). See `periodogram.py`."""
        first = effects[0]
        if not first.dense:
            return None
        joint = self.scene.index(first.joints[0])
        u, mask = select_output_rows(ground.whiten, joint, both)
        q, v, a = (np.concatenate([getattr(m, key)[:, joint] for m in self.thinned]) for key in ("q", "v", "a"))
        terms = build_force_terms(q)
        if isinstance(first, DisplacementEffect):
            u = u * np.concatenate([m.signals["inertia"][:, joint, joint] for m in self.thinned])[:, None]
            terms = build_displacement_terms(v, a)
        periods = np.array([effect.settings["period"] for effect in effects])
        explained = compute_period_statistics(q, v, u, mask, periods, self.preparation.force_cutoff_hz, terms)
        explained[periods > np.ptp(q) / LONG] = np.nan
        return explained

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds, accelerations, time and temperature of each run."""
        found, begin = [], self._begins()
        for motion, start in zip(self.thinned, begin, strict=True):
            row = {
                f"{key}_{j}": getattr(motion, key)[:, k] for key in ("q", "v", "a") for k, j in enumerate(motion.joints)
            }
            row["t"] = np.asarray(motion.t)
            if max(begin) > 0:
                row[WHOLE_TIME] = row["t"] + start
            for k, j in enumerate(motion.joints):
                if "temperature" in motion.signals:
                    row[f"temp_{j}"] = motion.signals["temperature"][:, k]
            found.append(row)
        return found

    def _begins(self) -> list[float]:
        """Return when each run's log begins [s] if the logs follow one another."""
        ends: dict[str, float] = {}
        for piece in self.prepared:
            ends[piece.log.name] = max(ends.get(piece.log.name, 0.0), float(piece.log.t[-1]))
        begin = dict(zip(ends, np.cumsum([0.0, *ends.values()]), strict=False))
        return [float(begin[piece.log.name]) for piece in self.prepared]


def prepare_segments(
    model: Model, pieces: Sequence[Log], preparation: Preparation, smooth_hz: Sequence[float]
) -> tuple[PreparedSegment, ...]:
    """Return all pieces ready for making columns, in their order; `smooth_hz` is the low-pass of each one's positions."""
    names = list(dict.fromkeys(piece.name for piece in pieces))
    found = []
    for piece, smooth in zip(pieces, smooth_hz, strict=True):
        campaign = {"campaign": np.full(piece.n_samples, float(names.index(piece.name)))} if len(names) > 1 else {}
        found.append(prepare_segment(model, piece, preparation, signals=campaign, smooth_hz=smooth))
    return tuple(found)


def build_force_regression(model: Model, prepared: Sequence[PreparedSegment], preparation: Preparation) -> Regression:
    """Return the baseline's regression on prepared pieces."""
    runs, robot = tuple(piece.run(model) for piece in prepared), model.robot
    return Regression(model.parameters, robot.actuated, robot.force_units, runs, preparation)


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
        CannotAnswer: Too little is left of the data for three parts.
    """
    needs = [s for s in _SIGNALS if s != "passive" or model.robot.loops]
    prepared, regression, timing = _with_timing(model, prepared, held, preparation, regression)
    turns = _gravity_turns(model, regression.parameters.values, prepared, regression.runs, [not out for out in held])
    prepared = [
        _with_signals(piece, model, {GRAVITY_TURN: turn}, needs, clear_hz, timing)
        for piece, turn in zip(prepared, turns, strict=True)
    ]
    parts = split_by_blocks(
        regression.runs, held, any(held), compute_border_gap_s(preparation.force_cutoff_hz, prepared[0].log.rate_hz)
    )
    campaigns = len({piece.log.name for piece, out in zip(prepared, held, strict=True) if not out})
    thinned = tuple(_thinned(piece) for piece in prepared)
    channel = ForceChannel(
        "force",
        regression.outputs,
        regression.units,
        model.parameters,
        regression.runs,
        tuple(parts),
        replace(
            _scene(model, thinned, regression.runs, parts, preparation, campaigns), timing=_by_joint(model, timing)
        ),
        tuple(cls for cls in EFFECTS.values() if cls.cause),
        tuple(prepared),
        thinned,
        preparation,
    )
    refuse_scarce(
        channel,
        _needed(regression, parts),
        "too little usable data is left",
        f"the logs hold {sum(p.log.duration for p in prepared):.3g} s",
        "record a minute or more of motion in both directions, over several speeds",
    )
    return channel


def _with_timing(
    model: Model,
    prepared: Sequence[PreparedSegment],
    held: Sequence[bool],
    preparation: Preparation,
    regression: Regression,
) -> tuple[Sequence[PreparedSegment], Regression, ForceTiming | None]:
    """Return the pieces and their regression without the samples into which late forces bring a reversal, and the timing."""

    def find(one: Regression) -> ForceTiming | None:
        trained = [run for run, out in zip(one.runs, held, strict=True) if not out]
        return find_timing(trained, model.parameters.values, np.asarray(one.parameters.free))

    timing = find(regression)
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


def _needed(regression: Regression, parts: Sequence[np.ndarray]) -> dict[int, int]:
    """Return how many usable values each part needs."""
    rank = max(1, compute_determined_rank(regression, parts))
    others = MIN_VALUES * len(regression.outputs)
    return {TRAIN: VALUES_PER_COMBINATION * rank, VALIDATION: others, TEST: others}


def _with_signals(
    piece: PreparedSegment,
    model: Model,
    given: Mapping[str, np.ndarray],
    needs: Sequence[str],
    clear_hz: float,
    timing: ForceTiming | None = None,
) -> PreparedSegment:
    """Return a piece whose motion has what a fitted model says of it: loads, inertia, predicted forces.

    Loads and inertia are smooth, so they are computed at the regression's rate and interpolated; forces are not. `force` is
    that of the values with the recording's timing taken out; see `force_timing.py`.
    """
    m, t = piece.motion, piece.log.t
    few = np.unique(np.append(np.arange(0, len(t), piece.factor), len(t) - 1))
    q, v, a = m.q[few], m.v[few], m.a[few]
    coarse = {name: COMPUTED[name](model.mechanism, q, v, a) for name in needs}
    found = {**given, **{name: np.asarray(CubicSpline(t[few], x)(t)) for name, x in coarse.items()}}
    whole = model.motion(m.q, m.v, m.a, m.sign, t=t, signals={**m.signals, **found})
    friction = model.effect_force(whole)
    Y = model.mechanism.regressor(m.q, m.v, m.a)
    rigid = Y @ model.robot.parameters.values  # holds with a mass of zero
    carried = lowpass(rigid, min(clear_hz, 0.4 * piece.log.rate_hz), piece.log.rate_hz)
    signals = {
        **m.signals,
        **found,
        "force": rigid + friction + _changed(model, Y, whole, timing),
        "rigid_force": carried,
        "damping": model.damping(whole),
    }
    signals |= {
        "wide_force": rigid,
        "clear_hz": np.full(len(t), clear_hz),
    }  # a mode in the clear band passes no noise on
    return replace(piece, motion=replace(m, signals=signals))


def _gravity_turns(
    model: Model,
    nominal: np.ndarray,
    prepared: Sequence[PreparedSegment],
    runs: Sequence[RegressionRun],
    trained: Sequence[bool],
) -> list[np.ndarray]:
    """Return what a turn of gravity does to the forces at rest (N, na, 2) of each piece.

    A turned gravity feels combinations of masses that no force under the nominal one shows, and a fit that knows of no turn moves
    weakly determined ones to explain it. So the values are refitted beside the turn, as near the nominal ones (p,) as the data
    let them be.
    """
    turns = [_at_rest(model, piece) for piece in prepared]
    rows, y = [], []
    for piece, run, turn, mine in zip(prepared, runs, turns, trained, strict=True):
        if mine:
            columns = np.concatenate([run.W_all, piece.columns(turn, gated=False)], axis=2)
            rows.append(columns[run.usable])
            y.append((run.y_all - run.W_all @ nominal)[run.usable])
    W, e = np.concatenate(rows), np.concatenate(y)
    every = 1 + len(W) // _MAX_ROWS
    W, e = W[::every], e[::every]
    free = np.append(model.parameters.free, [True, True])
    norm = np.linalg.norm(W, axis=0) * free
    unit = np.where(norm > _MIN_RELATIVE_NORM * norm.max(initial=0.0), norm, np.inf)
    unit[:-2] *= np.where([n.rsplit(".", 1)[-1] in _WEIGHING for n in model.parameters.names], _STIFFNESS, 1.0)
    change = (np.linalg.lstsq(W / unit, e, rcond=1e-4)[0] / unit)[:-2]
    near = model.with_parameters(model.parameters.with_values(nominal + change))
    return [_at_rest(near, piece) for piece in prepared]


def _at_rest(model: Model, piece: PreparedSegment) -> np.ndarray:
    """Return the change of a piece's forces at rest (N, na, 2) per turn of gravity; smooth, so made at the regression's rate."""
    t = piece.log.t
    few = np.unique(np.append(np.arange(0, len(t), piece.factor), len(t) - 1))
    return np.asarray(CubicSpline(t[few], model.mechanism.gravity_turn(piece.motion.q[few]))(t))


def _by_joint(model: Model, timing: ForceTiming | None) -> dict[str, tuple[float, float]]:
    """Return each joint's delay and time constant [s]; empty where there is none."""
    if timing is None:
        return {}
    each = zip(model.robot.actuated, timing.delays, timing.lags, strict=True)
    return {joint: (float(delay), float(lag)) for joint, delay, lag in each}


def _changed(model: Model, Y: np.ndarray, motion: Motion, timing: ForceTiming | None) -> np.ndarray | float:
    """Return the force (N, na) of what a timing changes in the model's values, with the rigid bodies' columns given."""
    if timing is None:
        return 0.0
    columns = [Y, *(effect.columns(motion) for effect in model.effects)]
    return np.concatenate(columns, axis=2) @ timing.change


def _thinned(piece: PreparedSegment) -> Motion:
    """Return a stretch's motion through the regression's low-pass, at its rate."""
    motion, factor = piece.motion, piece.factor
    arrays = [piece.passed(x) for x in (motion.q, motion.v, motion.a)]
    signals = {key: decimate(x, factor) for key, x in motion.signals.items()}
    return Motion.of(motion.joints, *arrays, t=decimate(piece.log.t, factor), signals=signals)


def _scene(
    model: Model,
    motions: Sequence[Motion],
    runs: Sequence[RegressionRun],
    parts: Sequence[np.ndarray],
    preparation: Preparation,
    campaigns: int,
) -> Scene:
    signals = find_shared_signals(motions)
    if "temperature" in signals and max(float(np.ptp(m.signals["temperature"])) for m in motions) < 0.5:
        signals -= {"temperature"}  # it never changed
    scene = build_scene(
        motions,
        model.robot.actuated,
        model.robot.force_units,
        slow=preparation.speed_threshold,
        cutoff_hz=preparation.force_cutoff_hz,
        duration=sum(float(run.t[-1] - run.t[0]) for run in runs),
        signals=signals,
        campaigns=campaigns,
        trained=[part == TRAIN for part in parts],
        coupled=model.robot.coupled_pairs,
    )
    force = np.max([np.abs(run.y_all).max(axis=0) for run in runs], axis=0)
    inertia = np.max([np.diagonal(m.signals["inertia"], axis1=1, axis2=2).max(axis=0) for m in motions], axis=0)
    return replace(scene, scales=measure_scales(model.parameters, scene, force, inertia))
