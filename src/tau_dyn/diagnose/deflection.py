r"""The deflection channel: a motor-side encoder, divided by the gear, against an encoder on the load side of the same joint.

    q - q_link = zero + sum of effects' displacements + noise

Each joint of each log has a zero of its own, as encoders are referenced anew. The force that an elastic joint feels is the
measured one, low-passed like the deflection, and not a model's. It is the motor's: what friction and inertia on the motor's
side of the spring take of it is not subtracted, as nothing measured here tells where the friction sits; they make a spring look
stiffer than it is. A compliance is quasi-static: it holds below the resonance of load and spring.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.channel import Channel, refuse_scarce
from tau_dyn.diagnose.channel_diagnosis import diagnose_channel
from tau_dyn.diagnose.data_split import split_by_blocks
from tau_dyn.diagnose.deflection_clock import ClockOffset
from tau_dyn.diagnose.deflection_pieces import DeflectionSegment, build_deflection_segment, list_encoder_pairs
from tau_dyn.diagnose.filters import choose_diagnosis_preparation, compute_border_gap_s
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.periodogram import build_force_terms, compute_period_statistics, select_output_rows
from tau_dyn.diagnose.result import Diagnosis
from tau_dyn.diagnose.scenes import build_scene, find_shared_signals
from tau_dyn.effects import EFFECTS, Effect, JointwiseDisplacement, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Preparation, drop_repeated_logs
from tau_dyn.log import Log, decimate, resample_segments
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot


@dataclass(frozen=True, eq=False)
class DeflectionChannel(Channel):
    """Deflections; outputs are the joints that have two encoders [m or rad].

    Attributes:
        pieces: The stretches.
        preparation: Filters.
    """

    pieces: tuple[DeflectionSegment, ...]
    preparation: Preparation

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run; see `Channel.run_columns`."""
        if not isinstance(effect, JointwiseDisplacement):
            raise InputError("unsupported", f"effect {effect.name} does not come between two encoders of a joint")
        return self.pieces[run].passed(effect.displacement(self.pieces[run].motion))

    def scan(self, effects: Sequence[Effect], ground: NullModel, both: np.ndarray) -> np.ndarray | None:
        """Scan periods by Fourier transforms over the position; see `periodogram.py`."""
        if not effects[0].dense:
            return None
        joint = self.scene.index(effects[0].joints[0])
        u, mask = select_output_rows(ground.whiten, joint, both)
        q, v = (np.concatenate([run.signals[key][:, joint] for run in self.runs]) for key in ("q", "v"))
        periods = np.array([effect.settings["period"] for effect in effects])
        return compute_period_statistics(q, v, u, mask, periods, self.preparation.force_cutoff_hz, build_force_terms(q))

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds, accelerations, forces and time of each run."""
        found = []
        for piece in self.pieces:
            m = piece.motion
            kinds = {
                key: piece.passed(x) for key, x in (("q", m.q), ("v", m.v), ("a", m.a), ("tau", m.signal("force")))
            }
            row = {f"{key}_{j}": x[:, k] for key, x in kinds.items() for k, j in enumerate(m.joints)}
            found.append(row | {"t": decimate(piece.log.t, piece.factor)})
        return found


def _all() -> list[type[Effect]]:
    return [ClockOffset, *(e for e in EFFECTS.values() if e.cause and issubclass(e, JointwiseDisplacement))]


def build_deflection_channel(
    robot: Robot, train: Sequence[Log], held: Sequence[Log] = (), causes: Sequence[type[Effect]] | None = None
) -> DeflectionChannel:
    """Build the channel.

    Args:
        robot: Names the joints.
        train: Logs with `q_J`, `tau_J` and `q_link_J` of the same joints.
        held: Held-out logs.
        causes: Causes that may be found.

    Raises:
        InputError: No joint has two encoders, or a log lacks one of them.
        CannotAnswer: Too few measurements for three parts.
    """
    stretches = [
        (p, out) for logs, out in ((train, False), (held, True)) for log in logs for p in resample_segments(log)
    ]
    joints = list_encoder_pairs(robot, [log for log, _ in stretches])
    preparation = choose_diagnosis_preparation(robot, [log for log, out in stretches if not out], ())
    where = [robot.actuated.index(j) for j in joints]
    preparation = replace(preparation, speed_threshold=preparation.speed_threshold[where])
    pieces = tuple(build_deflection_segment(joints, log, preparation) for log, _ in stretches)
    units = tuple(robot.force_units[k] for k in where)
    lengths = tuple("m" if unit == "N" else "rad" for unit in units)
    parameters, columns = _zeros(pieces, joints, lengths)
    runs = tuple(piece.run(W) for piece, W in zip(pieces, columns, strict=True))
    gap = compute_border_gap_s(preparation.force_cutoff_hz, pieces[0].log.rate_hz)
    parts = split_by_blocks(runs, [out for _, out in stretches], bool(held), gap)
    scene = _scene(joints, units, pieces, preparation)
    channel = DeflectionChannel(
        "deflection",
        joints,
        lengths,
        parameters,
        runs,
        tuple(parts),
        scene,
        tuple(_all() if causes is None else causes),
        pieces,
        preparation,
    )
    refuse_scarce(
        channel,
        10 * len(parameters),
        "too little is left",
        f"the logs hold {sum(p.log.duration for p in pieces):.3g} s",
        "record a minute of motion in both directions, over several speeds and loads",
    )
    return channel


def diagnose_deflection(
    robot: Robot,
    logs: Log | Iterable[Log],
    *,
    holdout: Log | Iterable[Log] = (),
    causes: Sequence[type[Effect]] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Diagnosis:
    """Find out what comes between the two encoders of a joint.

    Args:
        robot: Names the joints; its masses play no part.
        logs: Logs to train on, with `q_J`, `tau_J` and `q_link_J` of the same joints.
        holdout: Logs for confirming and for measuring the gain; without any, blocks of the logs are set aside (60/20/20).
        causes: Causes that may be found; by default all that come between two encoders.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.

    Raises:
        InputError: A log lacks a column.
        CannotAnswer: The logs are too short for three parts.
    """
    given, judged = ([x] if isinstance(x, Log) else list(x) for x in (logs, holdout))
    train, held, warnings = drop_repeated_logs(given, judged)
    if not train:
        raise InputError("missing_input", "no log was given")
    progress("columns")
    channel = build_deflection_channel(robot, train, held, causes)
    return diagnose_channel(channel, Model.of(robot), seed=seed, progress=progress, warnings=warnings, held=bool(held))


def _zeros(
    pieces: Sequence[DeflectionSegment], joints: tuple[str, ...], units: tuple[str, ...]
) -> tuple[Parameters, list[np.ndarray]]:
    """Return a zero of each joint in each log, and their columns (n, m, p) of each run."""
    logs = list(dict.fromkeys(piece.log.name for piece in pieces))
    ends = [""] if len(logs) == 1 else [f"_{k}" for k in range(1, len(logs) + 1)]
    rows = [
        Parameter(f"{j}.zero{e}", 0.0, u, origin="baseline") for e in ends for j, u in zip(joints, units, strict=True)
    ]
    found = []
    for piece in pieces:
        n, m, start = len(piece.log.t[:: piece.factor]), len(joints), len(joints) * logs.index(piece.log.name)
        W = np.zeros((n, m, len(rows)))
        W[:, np.arange(m), start + np.arange(m)] = 1.0
        found.append(W)
    return Parameters(rows), found


def _scene(
    joints: tuple[str, ...], units: tuple[str, ...], pieces: Sequence[DeflectionSegment], preparation: Preparation
) -> Scene:
    motions = [p.motion for p in pieces]
    return build_scene(
        motions,
        joints,
        units,
        slow=preparation.speed_threshold,
        cutoff_hz=preparation.force_cutoff_hz,
        duration=sum(p.log.duration for p in pieces),
        signals=find_shared_signals(motions) | {"load_side"},
    )
