"""The force channel: measured actuated forces against those that the model predicts from measured motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.ground import Ground
from tau_dyn.diagnose.parts import divide
from tau_dyn.diagnose.periodogram import (
    LONG,
    carried_back,
    explained_by_periods,
    of_displacement,
    of_force,
)
from tau_dyn.effects import EFFECTS, Effect, Motion, Scene
from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.estimate import Regression, Run
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify.preparation import (
    NOISE_FACTOR,
    RATE_FACTOR,
    Preparation,
    choose_preparation,
)
from tau_dyn.identify.regression import Prepared, prepare
from tau_dyn.log import Log, decimate, differentiate, edge_samples, encoder_noise, lowpass, motion_band, noise_gain
from tau_dyn.model import COMPUTED, Model
from tau_dyn.robot import Robot

BAND_FACTOR = 20.0
"""Highest frequency looked at, in edges of the motion's own band; a tooth passes many times in one stroke."""
SLOW_SHARE = 0.01
SURE = 5.0
"""Speeds whose direction is sure, in the velocity's noise."""
NEAR = 1.0
"""Time gated out beside a reversal, in periods of the position filter: a joint may rest for half a period unseen, its friction
anywhere between both directions, and the filter spreads the start over as much again. Rests passed for hysteresis and delays."""
OVERSAMPLING = 5.0
"""Rate of a log that is worth keeping, in cutoffs of the position filter."""
SMOOTH_FACTOR = 2.0
"""Of the frequency up to which the motion stands above the encoder's noise; a wider filter lets noise into the columns."""
_SIGNALS = ("inertia", "weight_gradient", "load", "passive")
_FASTEST = 0.98


@dataclass(frozen=True, eq=False)
class ForceChannel(Channel):
    """Actuated forces.

    Attributes:
        prepared: The stretches at their logs' own rate.
        thinned: Their motions at the regression's rate, for quick scans.
        preparation: Filters and masks.
    """

    prepared: tuple[Prepared, ...]
    thinned: tuple[Motion, ...]
    preparation: Preparation

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's columns (n, m, k) of each run; see `Channel.columns`."""
        return [piece.columns(effect.columns(piece.motion)) for piece in self.prepared]

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns without any sample left out, for drawing."""
        return [piece.columns(effect.columns(piece.motion), gated=False) for piece in self.prepared]

    def scan(self, effects: Sequence[Effect], ground: Ground, both: np.ndarray) -> np.ndarray | None:
        """Scan periods by Fourier transforms over the position; long ones are left open (nan). See `periodogram.py`."""
        first = effects[0]
        if not getattr(first, "dense", False):
            return None
        joint = self.scene.index(first.joints[0])
        rows = np.flatnonzero(ground.whiten.index == joint)
        matrices = ground.whiten.rows[joint :: ground.whiten.n_outputs]
        u = np.concatenate(carried_back(matrices, both[rows]))
        q, v, a = (np.concatenate([getattr(m, key)[:, joint] for m in self.thinned]) for key in ("q", "v", "a"))
        mask = np.concatenate([np.asarray(abs(L).sum(axis=0)).ravel() > 0 for L in matrices])
        terms = of_force(q)
        if isinstance(first, DisplacementEffect):
            u = u * np.concatenate([m.signals["inertia"][:, joint, joint] for m in self.thinned])[:, None]
            terms = of_displacement(v, a)
        periods = np.array([effect.settings["period"] for effect in effects])
        explained = explained_by_periods(q, v, u, mask, periods, self.preparation.force_cutoff_hz, terms)
        explained[periods > np.ptp(q) / LONG] = np.nan
        return explained

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds, accelerations, time and temperature of each run."""
        found = []
        for motion in self.thinned:
            row = {
                f"{key}_{j}": getattr(motion, key)[:, k] for key in ("q", "v", "a") for k, j in enumerate(motion.joints)
            }
            row["t"] = np.asarray(motion.t)
            for k, j in enumerate(motion.joints):
                if "temperature" in motion.signals:
                    row[f"temp_{j}"] = motion.signals["temperature"][:, k]
            found.append(row)
        return found


def diagnosis_preparation(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...]) -> Preparation:
    """Choose filters for finding causes, which may act far above the motion's own band.

    The band of the forces is as wide as encoder noise allows: above it, that noise times a mass is all there is to see, and a
    noise model spends itself on it. Positions are low-passed as widely as leaves ten times the velocity's noise below 1 % of
    the fast speeds, so that reversals are seen sharply.
    """
    plain = choose_preparation(robot, logs, exclude)
    rate = min(log.rate_hz for log in logs)
    q = [log.joint("q", robot.actuated) for log in logs]
    noise = np.max([encoder_noise(x) for x in q], axis=0)
    fast = np.max([_fast(x, plain.position_cutoff_hz, log) for x, log in zip(q, logs, strict=True)], axis=0)
    moving = fast > plain.speed_threshold
    cutoffs = np.geomspace(min(2 * plain.force_cutoff_hz, 0.4 * rate), 0.4 * rate, 40)
    gains = np.array([noise_gain(rate, f) for f in cutoffs])
    allowed = SLOW_SHARE * fast[moving] / np.maximum(NOISE_FACTOR * noise[moving], 1e-300)
    within = gains <= allowed.min() if moving.any() else np.ones(1, bool)
    position_cutoff = float(cutoffs[max(0, int(within.sum()) - 1)])
    bands = [motion_band(x, log.rate_hz) for x, log in zip(q, logs, strict=True)]
    edge = max(float(band.edge_hz.max()) for band in bands)
    noise_edge = min((float(e) for b in bands for e in b.noise_edge_hz[b.edge_hz > 0]), default=rate)
    force_cutoff = max(plain.force_cutoff_hz, min(0.16 * rate, BAND_FACTOR * edge, noise_edge))
    threshold = SURE * noise * noise_gain(rate, position_cutoff)
    return Preparation(
        position_cutoff, force_cutoff, RATE_FACTOR * force_cutoff, threshold, NEAR / position_cutoff, exclude
    )


def _fast(q: np.ndarray, cutoff_hz: float, log: Log) -> np.ndarray:
    """Return the speed that each joint exceeds in 2 % of the samples (na,)."""
    v = differentiate(lowpass(q, cutoff_hz, log.rate_hz), log.dt)
    return np.quantile(np.abs(v), _FASTEST, axis=0)


def thinned_log(log: Log, cutoff_hz: float) -> Log:
    """Return a log at a lower rate, where it is sampled far faster than a low-pass at `cutoff_hz` needs."""
    factor = int(log.rate_hz // (OVERSAMPLING * cutoff_hz))
    if factor < 2:
        return log
    safe = 0.4 * log.rate_hz / factor
    channels = {
        key: decimate(lowpass(x, safe, log.rate_hz) if key.startswith(("q_", "tau_")) else x, factor)
        for key, x in log.channels.items()
    }
    return replace(log, t=decimate(log.t, factor), channels=channels)


def smooth_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] that keeps of positions what stands above the encoder's noise, for making columns.

    Noise in the columns is noise in the residual, times a mass: a cause whose column has the same noise, or lacks it where
    the baseline has it, would be found in it.
    """
    edges = [motion_band(log.joint("q", robot.actuated), log.rate_hz).signal_edge_hz.max() for log in logs]
    return SMOOTH_FACTOR * float(max(edges))


def smooth_cutoffs(robot: Robot, train: Sequence[Log], held: Sequence[Log]) -> tuple[float, ...]:
    """Return that low-pass [Hz] of each log: one for all that trains, at least as wide for what is held out.

    A held-out log may move more sharply than those trained on; cut like them, it would lose acceleration that the robot had.
    """
    shared = smooth_cutoff(robot, train)
    return (*[shared] * len(train), *[max(shared, smooth_cutoff(robot, [log])) for log in held])


def clear_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] of the forces that springs carry.

    A spring's force on the load is the fourth derivative of a position: above this, its column would be encoder noise, and the
    residual, which holds the same noise times a mass, would speak against any spring.
    """
    bands = [motion_band(log.joint("q", robot.actuated), log.rate_hz) for log in logs]
    return float(max(max(band.clear_edge_hz.max(), band.edge_hz.max()) for band in bands))


def prepared_pieces(
    model: Model, pieces: Sequence[Log], preparation: Preparation, smooth_hz: Sequence[float]
) -> tuple[Prepared, ...]:
    """Return all pieces ready for making columns, in their order; `smooth_hz` is the low-pass of each one's positions."""
    names = list(dict.fromkeys(piece.name for piece in pieces))
    found = []
    for piece, smooth in zip(pieces, smooth_hz, strict=True):
        campaign = {"campaign": np.full(piece.n_samples, float(names.index(piece.name)))} if len(names) > 1 else {}
        found.append(prepare(model, piece, preparation, signals=campaign, smooth_hz=smooth))
    return tuple(found)


def force_regression(model: Model, prepared: Sequence[Prepared], preparation: Preparation) -> Regression:
    """Return the baseline's regression on prepared pieces."""
    runs, robot = tuple(piece.run(model) for piece in prepared), model.robot
    return Regression(model.parameters, robot.actuated, robot.force_units, runs, {"preparation": preparation})


def force_channel(
    model: Model,
    prepared: Sequence[Prepared],
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
    prepared = [_with_signals(piece, model, needs, clear_hz) for piece in prepared]
    parts = divide(regression.runs, held, any(held), border_gap(preparation, prepared[0].log.rate_hz))
    campaigns = len({piece.log.name for piece, out in zip(prepared, held, strict=True) if not out})
    thinned = tuple(_thinned(piece) for piece in prepared)
    channel = ForceChannel(
        "force",
        regression.outputs,
        regression.units,
        model.parameters,
        regression.runs,
        tuple(parts),
        _scene(model, thinned, regression.runs, preparation, campaigns),
        tuple(cls for cls in EFFECTS.values() if cls.cause),
        tuple(prepared),
        thinned,
        preparation,
    )
    for part, what in ((0, "train on"), (1, "confirm on"), (2, "measure the gain on")):
        if sum(int(mask.sum()) for mask in channel.masks(part)) < 3 * len(model.parameters):
            raise CannotAnswer(
                f"too little usable data is left to {what}: the logs hold {sum(p.log.duration for p in prepared):.3g} s",
                "record a minute or more of motion in both directions, over several speeds",
            )
    return channel


def border_gap(preparation: Preparation, rate_hz: float) -> float:
    """Return the time [s] on both sides of a border in which the filter still remembers the other side."""
    return 0.5 * edge_samples(preparation.force_cutoff_hz, rate_hz) / rate_hz


def _with_signals(piece: Prepared, model: Model, needs: Sequence[str], clear_hz: float) -> Prepared:
    """Return a piece whose motion has what a fitted model says of it: loads, inertia, predicted forces.

    Loads and inertia are smooth, so they are computed at the regression's rate and interpolated; forces are not.
    """
    m, t = piece.motion, piece.log.t
    few = np.unique(np.append(np.arange(0, len(t), piece.factor), len(t) - 1))
    q, v, a = m.q[few], m.v[few], m.a[few]
    coarse = {name: COMPUTED[name](model.mechanism, q, v, a) for name in needs}
    found = {name: np.asarray(CubicSpline(t[few], x)(t)) for name, x in coarse.items()}
    whole = model.motion(m.q, m.v, m.a, m.sign, t=t, signals={**m.signals, **found})
    friction = model.effect_force(whole)
    rigid = model.mechanism.regressor(m.q, m.v, m.a) @ model.robot.parameters.values  # holds with a mass of zero
    carried = lowpass(rigid, min(clear_hz, 0.4 * piece.log.rate_hz), piece.log.rate_hz)
    signals = {**m.signals, **found, "force": rigid + friction, "rigid_force": carried, "damping": model.damping(whole)}
    signals |= {
        "wide_force": rigid,
        "clear_hz": np.full(len(t), clear_hz),
    }  # a mode in the clear band passes no noise on
    return replace(piece, motion=replace(m, signals=signals))


def _thinned(piece: Prepared) -> Motion:
    """Return a stretch's motion through the regression's low-pass, at its rate."""
    motion, factor = piece.motion, piece.factor
    arrays = [piece.passed(x) for x in (motion.q, motion.v, motion.a)]
    signals = {key: decimate(x, factor) for key, x in motion.signals.items()}
    return Motion.of(motion.joints, *arrays, t=decimate(piece.log.t, factor), signals=signals)


def _scene(
    model: Model, motions: Sequence[Motion], runs: Sequence[Run], preparation: Preparation, campaigns: int
) -> Scene:
    q, v = (np.concatenate([getattr(m, key) for m in motions]) for key in ("q", "v"))
    signals = frozenset.intersection(*(frozenset(m.signals) for m in motions))
    if "temperature" in signals and max(float(np.ptp(m.signals["temperature"])) for m in motions) < 0.5:
        signals -= {"temperature"}  # it never changed
    return Scene(
        model.robot.actuated,
        model.robot.force_units,
        q.min(axis=0),
        q.max(axis=0),
        preparation.speed_threshold,
        np.quantile(np.abs(v), _FASTEST, axis=0),
        preparation.force_cutoff_hz,
        sum(float(run.t[-1] - run.t[0]) for run in runs),
        signals,
        campaigns,
    )
