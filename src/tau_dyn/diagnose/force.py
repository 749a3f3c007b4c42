"""The force channel: measured actuated forces against those that the model predicts from measured motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.ground import Ground
from tau_dyn.diagnose.parts import divide
from tau_dyn.diagnose.periodogram import carried_back, explained_by_periods, lowpassed
from tau_dyn.effects import EFFECTS, Effect, Motion, Scene
from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.estimate import Regression, Run
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify.preparation import Preparation, choose_preparation
from tau_dyn.identify.regression import Prepared, prepare
from tau_dyn.log import Log, decimate, edge_samples, motion_band
from tau_dyn.model import Model
from tau_dyn.robot import Robot

BAND_FACTOR = 20.0
"""A cause may act far above the motion's own band: the filter is as wide as the encoder's noise allows, up to this."""
POSITION_FACTOR = 3.0
SMOOTH_FACTOR = 2.0
"""Of the frequency up to which the motion stands above the encoder's noise; a wider filter lets noise into the columns."""
_SIGNALS = ("force", "inertia", "load", "passive")
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
        """Scan periods by Fourier transforms over the position; see `periodogram.py`."""
        first = effects[0]
        if not getattr(first, "dense", False):
            return None
        joint = self.scene.index(first.joints[0])
        rows = np.flatnonzero(ground.whiten.index == joint)
        matrices = ground.whiten.rows[joint :: ground.whiten.n_outputs]
        u = np.concatenate(carried_back(matrices, both[rows])) / ground.scale
        q, v = (np.concatenate([getattr(m, key)[:, joint] for m in self.thinned]) for key in ("q", "v"))
        mask = np.concatenate([np.asarray(abs(L).sum(axis=0)).ravel() > 0 for L in matrices])
        weight = lowpassed(self.preparation.force_cutoff_hz)
        if isinstance(first, DisplacementEffect):
            inertia = np.concatenate([m.signals["inertia"][:, joint, joint] for m in self.thinned])
            u, typical = u * inertia[:, None], float(np.sqrt(np.mean(inertia[mask] ** 2)))
            plain = weight

            def weight(speed: float, periods: np.ndarray) -> np.ndarray:
                return plain(speed, periods) * (2 * np.pi * speed / periods) ** 2

        else:
            typical = 1.0
        run = self.runs[0]
        periods = np.array([effect.settings["period"] for effect in effects])
        scale = ground.scale
        found = explained_by_periods(
            q, v, u, mask, periods, weight, ground.noise[joint], 1 / float(run.t[1] - run.t[0])
        )
        return found * (scale / typical) ** 2

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
    """Choose filters for finding causes: as wide as encoder noise allows, where identification stays near the motion."""
    return choose_preparation(robot, logs, exclude, band_factor=BAND_FACTOR, position_factor=POSITION_FACTOR)


def smooth_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] that keeps of positions what stands above the encoder's noise, for making columns.

    Noise in the columns is noise in the residual, times a mass: a cause whose column has the same noise, or lacks it where
    the baseline has it, would be found in it.
    """
    edges = [motion_band(log.joint("q", robot.actuated), log.rate_hz).signal_edge_hz.max() for log in logs]
    return SMOOTH_FACTOR * float(max(edges))


def prepared_pieces(
    model: Model, pieces: Sequence[Log], preparation: Preparation, smooth_hz: float
) -> tuple[Prepared, ...]:
    """Return all pieces ready for making columns, in their order."""
    names = list(dict.fromkeys(piece.name for piece in pieces))
    found = []
    for piece in pieces:
        campaign = {"campaign": np.full(piece.n_samples, float(names.index(piece.name)))} if len(names) > 1 else {}
        found.append(prepare(model, piece, preparation, signals=campaign, smooth_hz=smooth_hz))
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
) -> ForceChannel:
    """Build the channel.

    Args:
        model: The baseline at fitted values; signals such as loads and predicted forces are taken from it.
        prepared: Even stretches of the training logs, then of the held-out logs.
        held: Whether a piece belongs to a held-out log.
        preparation: Filters and masks.
        regression: The baseline's regression on these pieces.

    Raises:
        CannotAnswer: Too little is left of the data for three parts.
    """
    needs = [s for s in _SIGNALS if s != "passive" or model.robot.loops]
    prepared = [_with_signals(piece, model, needs) for piece in prepared]
    cutoff, rate = preparation.force_cutoff_hz, prepared[0].log.rate_hz
    gap = 0.5 * edge_samples(cutoff, rate) / rate
    parts = divide(regression.runs, held, any(held), gap)
    thinned = tuple(_thinned(piece) for piece in prepared)
    channel = ForceChannel(
        "force",
        regression.outputs,
        regression.units,
        model.parameters,
        regression.runs,
        tuple(parts),
        _scene(model, thinned, regression.runs, preparation),
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


def _with_signals(piece: Prepared, model: Model, needs: Sequence[str]) -> Prepared:
    """Return a piece whose motion has what a fitted model says of it: loads, inertia, predicted forces."""
    m = piece.motion
    return replace(piece, motion=model.motion(m.q, m.v, m.a, m.sign, t=m.t, signals=m.signals, needs=needs))


def _thinned(piece: Prepared) -> Motion:
    """Return a stretch's motion at the regression's rate."""
    motion, factor = piece.motion, piece.factor
    arrays = [decimate(x, factor) for x in (motion.q, motion.v, motion.a)]
    signals = {key: decimate(x, factor) for key, x in motion.signals.items()}
    return Motion.of(motion.joints, *arrays, t=decimate(piece.log.t, factor), signals=signals)


def _scene(model: Model, motions: Sequence[Motion], runs: Sequence[Run], preparation: Preparation) -> Scene:
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
    )
