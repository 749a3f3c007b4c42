r"""The deflection channel: a motor-side encoder, divided by the gear ratio, minus a load-side encoder of the same joint.

    q - q_link = zero + sum of effects' displacements + noise

Each joint of each log has its own zero, as encoders are referenced again. The force on an elastic joint is the measured one,
low-passed like the deflection, not a model's. It is the motor's force: friction and inertia on the motor's side of the spring
are not subtracted, as these measurements do not show on which side the friction is; they make a spring look stiffer than it is.
A compliance is quasi-static: it holds below the resonance of load and spring.

`estimate_stiffness` estimates a joint's stiffness with and without the causes that resemble it, by regressions of the same
deflections: `deflection = zero + compliance tau [+ loop] [+ clock_offset v]`, where the loop is a play or a hysteresis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.measured_channel import (
    MeasuredChannel,
    MeasuredSegment,
    build_measured_channel,
    build_measured_scene,
    cut_stretches,
    find_directions,
)
from tau_dyn.diagnose.periodogram import scan_periods
from tau_dyn.diagnose.preparation import choose_diagnosis_preparation
from tau_dyn.effects import (
    EFFECTS,
    Backlash,
    Effect,
    Hysteresis,
    JointCompliance,
    JointMotion,
    JointwiseDisplacement,
    Motion,
    PlausibleRange,
    format_amount,
    get_measured_signals,
)
from tau_dyn.estimate import Whitener, solve_least_squares
from tau_dyn.evidence import (
    TRAIN,
    VALIDATION,
    build_extended_regression,
    fit_extended_model,
    name_by_joint,
    restrict_to_parts,
)
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Preparation
from tau_dyn.log import Log, differentiate, lowpass, resample_segments
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

LOAD_SPEED = "load_speed"
"""Signal (N, na): speed of the load-side encoders."""


class ClockOffset(JointwiseDisplacement):
    """A load-side encoder that is read late, or early."""

    name = "clock_offset"
    cause = True
    equation = "encoder - load = clock_offset (v + v_load) / 2"
    reference = "Dressler 2012, 6.3 (delays between channels)"
    reveals = "the same stroke at several constant speeds without a change of load, both encoders logged"
    mistaken_for = ("hysteresis", "joint_compliance", "backlash")
    # Two encoders read by two devices on one bus
    plausible = (PlausibleRange("clock_offset", -0.1, 0.1, "s"),)
    quantities = (("clock_offset", "s"),)
    needs = (LOAD_SPEED,)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the mean speed of both sides."""
        return [0.5 * (joint.v + joint.signal(LOAD_SPEED))]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the side that is late, and its delay."""
        p = values["clock_offset"]
        later, sooner = ("load", "motor") if p.value >= 0 else ("motor", "load")
        size = Parameter(p.name, abs(p.value), p.unit, stderr=p.stderr)
        return f"the {later}-side encoder's reading is {format_amount(size)} older than the {sooner} side's"


def list_encoder_pairs(robot: Robot, logs: Sequence[Log]) -> tuple[str, ...]:
    """Return the joints with two encoders; the first log decides.

    Raises:
        InputError: There is no such joint, or another log lacks `q_J`, `q_link_J` or `tau_J` of one of them.
    """
    found = tuple(j for j in robot.actuated if f"q_link_{j}" in logs[0].channels)
    if not found:
        raise InputError(
            "missing_column",
            f"{logs[0].name} has no column q_link_{robot.actuated[0]}; the deflection channel needs q_link_J [m or rad] of "
            "some joint, the position on the load side",
        )
    for log in logs:
        for signal in ("q", "tau", "q_link"):
            log.joint(signal, found)
    return found


def build_deflection_segment(joints: tuple[str, ...], log: Log, preparation: Preparation) -> MeasuredSegment:
    """Return a stretch with its deflection and the motion of the motor side."""
    read, load, force = (log.joint(key, joints) for key in ("q", "q_link", "tau"))
    for name, x in (("q_link", load), ("tau", force)):
        if not np.isfinite(x).all():
            raise InputError(
                "bad_sample",
                f"{log.name}: {name} is missing in {int(np.sum(~np.isfinite(x)))} samples; cut the log there",
            )
    q, far = (lowpass(x, preparation.position_cutoff_hz, log.rate_hz) for x in (read, load))
    v, load_speed = (differentiate(x, log.dt, accuracy=4) for x in (q, far))
    a = differentiate(v, log.dt, accuracy=4)
    threshold = preparation.speed_threshold
    sign, usable = find_directions(v, threshold)
    signals = get_measured_signals(log, joints, q, v, threshold) | {"force": force, LOAD_SPEED: load_speed}
    motion = Motion.of(joints, q, v, a, sign, t=log.t, signals=signals)
    deflection = read - load
    return MeasuredSegment(
        log,
        motion,
        deflection - deflection.mean(axis=0),
        np.zeros_like(deflection),
        usable,
        preparation.force_cutoff_hz,
        preparation.factor(log.rate_hz),
    )


@dataclass(frozen=True, eq=False)
class DeflectionChannel(MeasuredChannel):
    """Deflections; outputs are the joints that have two encoders [m or rad]."""

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run; see `Channel.run_columns`."""
        if not isinstance(effect, JointwiseDisplacement):
            raise InputError("unsupported", f"effect {effect.name} does not come between two encoders of a joint")
        return self.pieces[run].passed(effect.displacement(self.pieces[run].motion))

    def scan(self, effects: Sequence[Effect], whiten: Whitener, both: np.ndarray) -> np.ndarray | None:
        """Scan periods by Fourier transforms over the position; see `null_model.py`."""
        joint = self.scene.index(effects[0].joints[0])
        q, v = (np.concatenate([run.signals[key][:, joint] for run in self.runs]) for key in ("q", "v"))
        return scan_periods(effects, whiten, joint, both, q, v, self.scene.cutoff_hz)

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds, accelerations, forces and time of each run."""
        found = []
        for piece in self.pieces:
            m = piece.motion
            q, v, a, tau = (piece.passed(x) for x in (m.q, m.v, m.a, m.signal("force")))
            found.append(name_by_joint(m.joints, q=q, v=v, a=a, tau=tau) | {"t": piece.t})
        return found


def _all() -> list[type[Effect]]:
    return [ClockOffset, *(e for e in EFFECTS.values() if e.cause and issubclass(e, JointwiseDisplacement))]


def build_deflection_channel(
    robot: Robot, train: Sequence[Log], held: Sequence[Log] = (), causes: Sequence[type[Effect]] | None = None
) -> DeflectionChannel:
    """Build the channel.

    Args:
        robot: The robot, for the names of its joints.
        train: Logs with `q_J`, `tau_J` and `q_link_J` of the same joints.
        held: Held-out logs.
        causes: Causes that may be found.

    Raises:
        InputError: No joint has two encoders, or a log lacks one of them.
        CannotAnswer: Too few measurements for three parts.
    """
    stretches, held_out = cut_stretches(train, held, resample_segments)
    joints = list_encoder_pairs(robot, stretches)
    trained = [log for log, out in zip(stretches, held_out, strict=True) if not out]
    preparation = choose_diagnosis_preparation(robot, trained, ())
    where = [robot.actuated.index(j) for j in joints]
    preparation = replace(preparation, speed_threshold=preparation.speed_threshold[where])
    pieces = [build_deflection_segment(joints, log, preparation) for log in stretches]
    units = tuple(robot.force_units[k] for k in where)
    lengths = tuple("m" if unit == "N" else "rad" for unit in units)
    return build_measured_channel(
        DeflectionChannel,
        "deflection",
        joints,
        lengths,
        _zeros(pieces, joints, lengths),
        build_measured_scene(joints, units, pieces, preparation.speed_threshold, "load_side"),
        _all() if causes is None else causes,
        pieces,
        held_out,
        per_parameter=10,
        refusal=(
            "too little is left",
            f"the logs hold {sum(p.log.duration for p in pieces):.3g} s",
            "record a minute of motion in both directions, over several speeds and loads",
        ),
    )


def _zeros(
    pieces: Sequence[MeasuredSegment], joints: tuple[str, ...], units: tuple[str, ...]
) -> tuple[Parameters, list[np.ndarray]]:
    """Return a zero of each joint in each log, and their columns (n, m, p) of each run."""
    logs = list(dict.fromkeys(piece.log.name for piece in pieces))
    ends = [""] if len(logs) == 1 else [f"_{k}" for k in range(1, len(logs) + 1)]
    rows = [
        Parameter(f"{j}.zero{e}", 0.0, u, origin="baseline") for e in ends for j, u in zip(joints, units, strict=True)
    ]
    found = []
    for piece in pieces:
        n, m, start = len(piece.t), len(joints), len(joints) * logs.index(piece.log.name)
        W = np.zeros((n, m, len(rows)))
        W[:, np.arange(m), start + np.arange(m)] = 1.0
        found.append(W)
    return Parameters(rows), found


READINGS: tuple[tuple[type[Effect], ...], ...] = (
    (JointCompliance,),
    (JointCompliance, Backlash),
    (JointCompliance, Hysteresis),
    (JointCompliance, ClockOffset),
    (JointCompliance, ClockOffset, Backlash),
    (JointCompliance, ClockOffset, Hysteresis),
)


@dataclass(frozen=True, eq=False)
class Reading:
    """Stiffness estimated together with some causes.

    Attributes:
        causes: Names of the causes of the deflection.
        joints: The joints.
        stiffness: One over the fitted compliance (m,) [N m/rad or N/m]; infinite if no positive compliance fits.
        stderr: Its standard error (m,); infinite in the same case.
        values: All fitted amplitudes by name.
        rms: The rms residual on data that are not used otherwise (m,) [rad or m].
    """

    causes: tuple[str, ...]
    joints: tuple[str, ...]
    stiffness: np.ndarray
    stderr: np.ndarray
    values: dict[str, float]
    rms: np.ndarray


def estimate_stiffness(channel: DeflectionChannel, seed: int = 0) -> list[Reading]:
    """Return all estimates; for a loop, the distance of its grid that fits best on each joint."""
    return [_reading(channel, causes, np.random.default_rng(seed)) for causes in READINGS]


def _reading(channel: DeflectionChannel, causes: Sequence[type[Effect]], rng: np.random.Generator) -> Reading:
    effects = [_on(channel, causes, joint) for joint in channel.outputs]
    fit = fit_extended_model(channel, [e for group in effects for e in group], None, rng)
    assert fit.estimate is not None
    found = fit.estimate.parameters
    values = {p.name: p.value for p in found}
    compliance = [found[f"{joint}.compliance"] for joint in channel.outputs]
    soft = np.array([p.value for p in compliance])
    error = np.array([np.inf if p.stderr is None else p.stderr for p in compliance])
    with np.errstate(divide="ignore", invalid="ignore"):
        stiffness = np.where(soft > 0, 1 / soft, np.inf)
        stderr = np.where(soft > 0, error / soft**2, np.inf)
    names = tuple(cls.name for cls in causes)
    return Reading(names, channel.outputs, stiffness, stderr, values, fit.errors.rms)


def _on(channel: DeflectionChannel, causes: Sequence[type[Effect]], joint: str) -> list[Effect]:
    """Return the causes on one joint, at the grid settings with the least residual on training and confirmation parts."""
    unit = channel.scene.units[channel.scene.index(joint)]
    grids = [cls.grid(channel.scene, (joint,)) or [{}] for cls in causes]
    grids = [grid if cls.refined else grid[:1] for cls, grid in zip(causes, grids, strict=True)]
    first = [cls((joint,), (unit,)).with_settings(**grid[0]) for cls, grid in zip(causes, grids, strict=True)]
    tried = [first]
    for k, grid in enumerate(grids):
        tried += [[*first[:k], first[k].with_settings(**settings), *first[k + 1 :]] for settings in grid[1:]]
    return min(tried, key=lambda effects: _left(channel, effects, joint))


def _left(channel: DeflectionChannel, effects: Sequence[Effect], joint: str) -> float:
    regression = restrict_to_parts(build_extended_regression(channel, effects), channel, TRAIN, VALIDATION)
    k = channel.outputs.index(joint)
    residuals = regression.residuals(solve_least_squares(regression).theta)
    return sum(float(np.sum(e[run.usable[:, k], k] ** 2)) for e, run in zip(residuals, regression.runs, strict=True))
