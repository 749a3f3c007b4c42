"""A robot, logs of commands and positions, and options -> the data from which a fit through the loop starts.

    Records -> contact left out -> screen (equation error) -> directions of the bodies' numbers -> unknowns at their start

`identify_loop` and `diagnose_loop` share it, and their options.

Equation error, a screen and a start: the torque that the law computes from command and position minus the robot's own.

If the servo saturates or its law is incomplete, it is biased; therefore output error follows (`fit.py`).
Reference: Ljung 1999, 7.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypedDict

import numpy as np

from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import Choices, drop_repeated_logs, get_log_list, read_bound, read_fixed, refuse_slow_clocks
from tau_dyn.log import Log, Recording, list_unit_warnings, lowpass, mend_rounded_stamps, split_at_gaps
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.robot import NOT_GIVEN, Robot
from tau_dyn.servo.command_wiring import refuse_odd_commands
from tau_dyn.servo.contact import Contact, find_contacts
from tau_dyn.servo.data import LoopData
from tau_dyn.servo.loads import InertialSpace, compute_load_waves
from tau_dyn.servo.records import MOTION_HZ, WARM_UP_S, LoopRecord, build_records
from tau_dyn.servo.unknowns import FRICTION, JOINT_UNITS, LoopUnknowns, build_unknowns, compute_stiffness
from tau_dyn.servo.waves import MAX_STEP_S, SPRING_STEP_S
from tau_dyn.simulate import COMMANDS, SERVO_ENTRIES, ServoLaw

DELAYS_S = np.arange(0.0, 0.0601, 0.0025)
"""Command delays that the screen tries [s]: from zero to three periods of a 50 Hz bus."""

MOVING = 0.03
"""Speed from which a joint's friction has a direction [rad/s]: twice the speed of one step of a 12 bit encoder in 20 ms."""

MAX_DIRECTIONS = 40
"""Largest number of estimated directions of the inertial numbers; an arm of six joints has some 36."""

MIN_INFORMATION = 1e-5
"""Information of a direction, with prior knowledge as 1, from which it is estimated. It is small: a quantity that a log hardly
shows may compensate another one, as gravity at a joint that barely turns a constant torque."""

INFORMATION_S = 0.02
"""Time between the samples from which directions are chosen [s]: a quarter of a period of the motion's low-pass."""


@dataclass(frozen=True, eq=False)
class EquationError:
    """The screen: start values from the torque of the law.

    Attributes:
        values: Start values of kinds (na,).
        residual: Residual torque, record by record (N, na) [N m]; NaN where a joint rests.
        sigma: Its rms (na,) [N m].
    """

    values: Mapping[str, np.ndarray]
    residual: Sequence[np.ndarray]
    sigma: np.ndarray


def delay_command(command: np.ndarray, dt: float, delay: float) -> np.ndarray:
    """Return held commands (N, na), delayed by a time [s], at the samples, averaged over the previous sample."""
    n = len(command)
    total = np.concatenate([np.zeros((1, command.shape[1])), np.cumsum(command, axis=0)])
    at = np.clip(np.arange(n + 1) - 0.5 - delay / dt, 0, n)
    summed = np.stack([np.interp(at, np.arange(n + 1), column) for column in total.T], axis=1)
    shown = np.diff(summed, axis=0)
    early = np.diff(at) < 1
    shown[early] = command[0]
    return shown


def screen_equation_error(
    law: ServoLaw,
    space: InertialSpace,
    records: Sequence[LoopRecord],
    estimate_gain: bool,
    widest: np.ndarray | None = None,
    beyond: bool = True,
) -> EquationError:
    """Return the best delay, friction and drive inertia of each joint by the law's torque, with the bodies of the file.

    Args:
        law: The law.
        space: Inertial numbers.
        records: The records.
        estimate_gain: Whether the position gain is unknown.
        widest: Position errors beyond which the torque is constant (na,) [rad]; None if there is no limit.
        beyond: Whether samples with larger errors count.
    """
    most = np.full(len(law.joints), np.inf) if widest is None else widest
    na = len(law.joints)
    values = {key: np.array(law.values[key]) for key in ("position_gain", "command_delay")}
    values |= {key: np.zeros(na) for key in JOINT_UNITS}
    residual, sigma = [np.full(r.q.shape, np.nan) for r in records], np.zeros(na)
    mechanism = space.build_mechanism()
    moved = [mechanism.inverse_dynamics(*r.motion) for r in records]
    for j in range(na):
        best = None
        for delay in [float(law.values["command_delay"][j])] if law.values["command_delay"][j] > 0 else DELAYS_S:
            rows = [
                _build_rows(law, r, tau[:, j], j, float(delay), estimate_gain, float(most[j]), beyond)
                for r, tau in zip(records, moved, strict=True)
            ]
            y, X = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
            if len(y) < 10 * X.shape[1]:
                continue
            norm = np.linalg.norm(X, axis=0) + 1e-12
            beta = np.linalg.lstsq(X / norm, y, rcond=None)[0] / norm
            rms = float(np.std(y - X @ beta))
            if best is None or rms < best[0]:
                best = (rms, delay, beta, rows)
        stiff = float(compute_stiffness(law.values)[j])
        if best is None:
            values["coulomb"][j] = 0.01 * stiff
            sigma[j] = 0.01 * stiff
            continue
        rms, delay, beta, rows = best
        values["command_delay"][j] = delay
        scale = 1.0
        if estimate_gain:  # rows in units of position: 1 / gain times torque
            share = beta[4] if beta[4] > 0 else np.nan
            scale = 1.0 / share
            values["position_gain"][j] = scale / law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = (max(0.0, scale * b) for b in beta[:2])
        values["offset"][j], values["armature"][j] = scale * beta[2], max(1e-4, scale * beta[3])
        sigma[j] = rms * (scale if np.isfinite(scale) else 1.0)
        for k, (y, X, where) in enumerate(rows):
            residual[k][where, j] = (y - X @ beta) * (scale if np.isfinite(scale) else 1.0)
    if estimate_gain:
        values = _fill_gains(values, law)
    return EquationError(values, residual, np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0))


def _fill_gains(values: dict[str, np.ndarray], law: ServoLaw) -> dict[str, np.ndarray]:
    """Return the values with gains that gravity does not determine, and their friction, taken from the other joints."""
    gain = values["position_gain"]
    known = np.isfinite(gain) & (gain > 0.05) & (gain < 1e4)
    usual = float(np.median(gain[known])) if known.any() else 5.0
    for j in np.flatnonzero(~known | (gain > 5 * usual) | (gain < usual / 5)):
        gain[j] = usual
        stiff = usual * law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = 0.01 * stiff, 0.07 * stiff
        values["offset"][j], values["armature"][j] = 0.0, 1e-3 * stiff
    return values


def _build_rows(
    law: ServoLaw,
    r: LoopRecord,
    moved: np.ndarray,
    j: int,
    delay: float,
    estimate_gain: bool,
    widest: float,
    beyond: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return torque, columns (sign, speed, one, acceleration) and mask of one joint where it moves and its motor is on."""
    rate, (q, v, a) = 1 / r.dt, r.motion
    goal = delay_command(r.command[:, j : j + 1], r.dt, delay)[:, 0]
    goal = lowpass(goal, MOTION_HZ, rate) if rate > 2.5 * MOTION_HZ else goal
    error = goal - q[:, j]
    where = r.used & (np.abs(v[:, j]) > MOVING) & (r.enabled > 0) & (beyond | (np.abs(error) <= widest))
    edge = round(0.3 * rate)
    where[:edge], where[-edge:] = False, False
    columns = [np.sign(v[:, j]), v[:, j], np.ones(len(v)), a[:, j]]
    if estimate_gain:
        return np.clip(error, -widest, widest)[where], np.stack([*columns, moved], axis=1)[where], where
    entries = r.entries
    u = _rebuild_output(r, j, goal, error)
    tau = entries["force_per_unit"][j] * (u * r.supply - entries["back_emf"][j] * v[:, j])
    return (tau - moved)[where], np.stack(columns, axis=1)[where], where


def _rebuild_output(r: LoopRecord, j: int, goal: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the law's output (N,) along the measured motion."""
    p, v = {key: x[j] for key, x in r.entries.items()}, r.motion[1][:, j]
    u, gain = goal, p["integral_gain"]
    if r.told == "position":
        goal, u = error, p["position_gain"] * error - p["derivative_gain"] * v
    if r.told in ("position", "speed"):
        if p["speed_gain"] > 0:
            goal, gain = np.clip(u, -p["speed_limit"], p["speed_limit"]) - v, p["speed_integral_gain"]
            u = p["speed_gain"] * goal
        u = u + np.clip(gain * np.cumsum(goal) * r.dt, -p["limit"], p["limit"])
    return np.clip(u, -p["limit"], p["limit"])


def choose_directions(space: InertialSpace, records: Sequence[LoopRecord], screen: EquationError) -> InertialSpace:
    """Return the space with the directions on which the logs are more informative than the robot file."""
    p = len(space.nominal)
    information = np.zeros((p, p))
    for r in records:
        every = max(1, int(INFORMATION_S / r.interval + 1e-9))
        some = np.flatnonzero(r.used & (r.enabled > 0))[::every]
        if len(some) < 10:
            continue
        Y = space.model.mechanism.regressor(*(x[some] for x in r.motion)) * space.prior
        worth = max(1.0, 0.5 / r.interval) / every  # samples per independent residual, at half a second
        for j in range(r.q.shape[1]):
            X = np.ascontiguousarray(Y[:, j])
            information += X.T @ X / (screen.sigma[j] ** 2 * worth)
    values, vectors = np.linalg.eigh(information)
    order = np.argsort(values)[::-1][:MAX_DIRECTIONS]
    kept = [k for k in order if values[k] > MIN_INFORMATION]
    return replace(space, directions=space.prior[:, None] * vectors[:, kept])


ALWAYS = ("armature", "command_delay")
"""Entries estimated for every joint in addition to friction, unless the law or `--fix` gives them."""
TORQUE_SWITCH = "torque_enable"
"""Column that servos' registers and their logs name so: zero where the motor is switched off."""
MIN_TRAVEL_OFF = 0.05
"""Travel with the motors off, as a share of that with them on, from which logs tell friction from back EMF."""
MIN_LOG_S = 0.5
"""Shortest log without gaps [s]: a step and its answer."""
MIN_SECONDS = 5.0
"""Shortest data for the identification of a loop [s]: some ten time constants of a servo."""

Progress = Callable[[str], None]


class LoopOptions(TypedDict, total=False):
    """Options of `identify_loop` and `diagnose_loop`; all are optional.

    Attributes:
        law: The servo's law; None to estimate its gains.
        holdout: Held-out logs for evaluation; by default the last 30 % of each log, predicted by a fit of the first 70 %, or
            blocks of the logs for a diagnosis.
        model: `rigid` for no friction; any other name for friction that is the same in both directions.
        choices: Parameters that are fixed, free, bounded or measured beforehand; servo entries by `JOINT.entry`, too.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of all random steps: the structural study, the bootstrap.
        progress: Called with a word for each step.
    """

    law: ServoLaw | None
    holdout: Log | Recording | Iterable[Log | Recording]
    model: str | Path | Model
    choices: Choices | None
    exclude: tuple[str, ...]
    seed: int
    progress: Progress


@dataclass(frozen=True, eq=False)
class LoopLogs:
    """Logs on even clocks, free of contact, with the options given for them.

    Attributes:
        model: Robot and friction, at start values.
        law: The servo's law.
        train: Training logs.
        held: Held-out logs.
        kept: Records of the training logs.
        others: Records of the held-out logs.
        contacts: Contacts of the tool with an object.
        own: Choices for servo entries.
        friction: Name of the friction model; empty for that of a given model.
        warnings: Warnings about the logs.
        seed: Seed of all random steps.
        progress: Called with a word for each step.
    """

    model: Model
    law: ServoLaw
    train: Sequence[Log]
    held: Sequence[Log]
    kept: Sequence[LoopRecord]
    others: Sequence[LoopRecord]
    contacts: Sequence[Contact]
    own: Choices
    friction: str
    warnings: Sequence[str]
    seed: int
    progress: Progress


def is_loop_log(log: Log | Recording, robot: Robot) -> bool:
    """Return whether a log has commands and positions, but no torque."""
    names = robot.actuated
    if not isinstance(log, Log) or not (log.has("q", names) and log.has("cmd", names)):
        return False
    return not any(log.has("tau", [joint]) for joint in names)


def read_loop_logs(robot: Robot, logs: Log | Recording | Iterable[Log | Recording], options: LoopOptions) -> LoopLogs:
    """Return logs in the form that a fit needs.

    Raises:
        InputError: A log, the law or a choice is at fault.
        CannotAnswer: The logs hold no motion.
    """
    train, held, doubled = drop_repeated_logs(get_log_list(logs), get_log_list(options.get("holdout", ())))
    train, held = _require_in_memory(train), _require_in_memory(held)
    refuse_slow_clocks([*train, *held])
    pieces, apart = ([piece for log in logs for piece in _split(log)] for logs in (train, held))
    _refuse_pieces(train, pieces)
    said = list(dict.fromkeys(w for x in (*pieces, *apart) for w in (*x.warnings, *list_unit_warnings(x, robot))))
    model, progress = options.get("model", "asymmetric"), options.get("progress", lambda step: None)
    friction = model if isinstance(model, str) else ""
    law = options.get("law") or _guess_law(robot, pieces, apart)
    own, theirs = _split_choices(options.get("choices") or Choices(), robot)
    started = theirs.apply(_build_start(robot, friction))
    progress("loads")
    read = build_records(started, law, [*pieces, *apart], options.get("exclude", ()))
    refuse_odd_commands(read, robot.actuated)
    contacts, records = find_contacts(started, read)
    kept = records[: len(pieces)]
    _refuse_stillness(kept)
    warnings = [*doubled, *said, *started.robot.warnings, *(CodedWarning("contact", c.describe()) for c in contacts)]
    return LoopLogs(
        started, law, train, held, kept, records[len(pieces) :], contacts, own, friction, warnings, options.get("seed", 0),
        progress,
    )  # fmt: skip


def prepare_loop(
    given: LoopLogs,
    records: Sequence[LoopRecord],
    widest: np.ndarray | None = None,
    *,
    estimate_gain: bool = True,
    beyond: bool = True,
) -> LoopData:
    """Return the start of a fit of some records: the screen's values, and the inertial directions that they inform on.

    Args:
        given: The logs, with their law.
        records: The records to fit.
        widest: Position errors beyond which the screen's torque is constant (na,) [rad]; None if there is no limit.
        estimate_gain: Whether the screen estimates the position gain where the law's is a start value.
        beyond: Whether the screen takes samples with larger position errors than `widest`.
    """
    model, law, space = given.model, given.law, InertialSpace.of(given.model)
    given.progress("equation error")
    estimate_gain = estimate_gain and "position_gain" in law.estimated and not np.any(law.values["speed_gain"])
    screen = screen_equation_error(law, space, records, estimate_gain, widest, beyond)
    space = choose_directions(space, records, screen)
    loads = [compute_load_waves(space, *r.motion, r.dt) for r in records]
    unknowns = _build_unknowns(model, law, space, screen.values, given.own, given.friction)
    springy = any(np.any(law.values[k]) or k in law.estimated for k in ("joint_compliance", "backlash"))
    return LoopData(
        model,
        law,
        space,
        records,
        loads,
        unknowns,
        whole=springy or law.command != COMMANDS[0],
        step=SPRING_STEP_S if springy else MAX_STEP_S,
    )


def _build_unknowns(
    model: Model, law: ServoLaw, space: InertialSpace, found: Mapping[str, np.ndarray], own: Choices, friction: str
) -> LoopUnknowns:
    joints, na = law.joints, len(law.joints)
    kinds = [*ALWAYS, *(FRICTION if friction != "rigid" else ()), *sorted(law.estimated)]
    if "back_emf" in law.estimated and "viscous" in kinds:
        kinds.remove("viscous")  # one parameter until the servo saturates
    kinds = list(dict.fromkeys(kinds))
    stiff = compute_stiffness({**law.values, **found})
    start = {key: value for key, value in found.items() if key in kinds}
    start |= {"load_friction": np.full(na, 0.15), "stiction": 2e-3 * stiff} if friction != "rigid" else {}
    start |= {
        key: law.values[key] for key in kinds if key in law.values and np.any(law.values[key]) and key not in found
    }
    held = {key: (np.array(law.values[key]) > 0) & (key not in law.estimated) for key in kinds if key in SERVO_ENTRIES}
    parameters = model.robot.parameters
    if "armature" in kinds:
        rows = [parameters[f"{j}.armature"] if f"{j}.armature" in parameters else None for j in joints]
        given = np.array([p is not None and not p.free and p.origin != NOT_GIVEN for p in rows])
        value = np.array([0.0 if p is None else p.value for p in rows])
        held["armature"] = given
        start["armature"] = np.where(held["armature"], value, np.maximum(start.get("armature", 0.0), 5e-4 * stiff))
    for kind in ("coulomb", "viscous", "offset"):
        rows = [
            model.effect_parameters[f"{j}.{kind}"] if f"{j}.{kind}" in model.effect_parameters else None for j in joints
        ]
        if kind in kinds:
            held[kind] = np.array([p is not None and not p.free for p in rows])
            start[kind] = np.where(held[kind], [p.value if p else 0.0 for p in rows], start[kind])
    unknowns = build_unknowns(law, space, start, kinds, held)
    return _apply_own(unknowns, own, joints)


def _apply_own(unknowns: LoopUnknowns, own: Choices, joints: tuple[str, ...]) -> LoopUnknowns:
    """Return the unknowns with the choices for servo entries, by name or pattern, applied."""
    values = {key: np.array(value) for key, value in unknowns.values.items()}
    free, lower, upper, prior = (np.array(x) for x in (unknowns.free, unknowns.lower, unknowns.upper, unknowns.prior))
    kinds = unknowns.kinds
    for text in own.fix:
        pattern, value, sigma = read_fixed(text)
        for kind, j in _match(pattern, joints):
            values[kind][j] = values[kind][j] if value is None else value
            if kind in kinds:
                free[kinds.index(kind), j] = sigma is not None
                prior[kinds.index(kind), j] = sigma if sigma is not None else np.inf
    for text in own.bound:
        pattern, low, high = read_bound(text)
        for kind, j in _match(pattern, joints):
            if kind in kinds:
                k = kinds.index(kind)
                lower[k, j], upper[k, j] = low, high
                values[kind][j] = min(max(values[kind][j], low), high)
    return replace(unknowns, values=values, free=free, lower=lower, upper=upper, prior=prior)


def _match(pattern: str, joints: tuple[str, ...]) -> list[tuple[str, int]]:
    return [
        (kind, j) for kind in SERVO_ENTRIES for j, joint in enumerate(joints) if fnmatchcase(f"{joint}.{kind}", pattern)
    ]


def _split_choices(choices: Choices, robot: Robot) -> tuple[Choices, Choices]:
    """Return the choices for servo entries, and all other choices."""

    def is_own(text: str) -> bool:
        return bool(_match(text.partition("=")[0], robot.actuated))

    own, theirs = (
        Choices(*(tuple(t for t in texts if is_own(t) == mine) for texts in (choices.fix, choices.free, choices.bound)))
        for mine in (True, False)
    )
    return own, theirs


def _build_start(robot: Robot, friction: str) -> Model:
    """Return the model with friction that is the same in both directions, or without friction if it is `rigid`."""
    return Model.of(
        robot, build_friction_model("rigid" if friction == "rigid" else "symmetric", robot.actuated, robot.force_units)
    )


def _guess_law(robot: Robot, train: Sequence[Log], held: Sequence[Log]) -> ServoLaw:
    """Return a law with the only assumption that torque grows with the position error while the motor is on.

    Joints that move with their motors on and off tell friction from the motors' back EMF.
    """
    law = ServoLaw.of(robot.actuated, given=False, position_gain=5.0, force_per_unit=1.0, limit=np.inf)
    unknown = {"position_gain"}
    if not train or not all(TORQUE_SWITCH in log.channels for log in (*train, *held)):
        return replace(law, estimated=frozenset(unknown))
    on = np.concatenate([log.channels[TORQUE_SWITCH][1:] != 0 for log in train])
    travel = np.concatenate([np.abs(np.diff(log.joint("q", robot.actuated), axis=0)).sum(axis=1) for log in train])
    if travel[~on].sum() > MIN_TRAVEL_OFF * travel[on].sum():
        unknown.add("back_emf")
    return replace(law, estimated=frozenset(unknown), enabled=TORQUE_SWITCH)


def _split(log: Log) -> list[Log]:
    """Return a log's parts between gaps, their stamps even where these are rounded.

    A part behind a gap begins in an unknown state and has to outlast the start of a simulation; a whole log may be one step.
    """
    parts = split_at_gaps(log)
    shortest = MIN_LOG_S if len(parts) == 1 else 2 * WARM_UP_S
    return [mend_rounded_stamps(part) for part in parts if part.duration > shortest]


def _refuse_pieces(logs: Sequence[Log], pieces: Sequence[Log]) -> None:
    """Reject training logs of which gaps leave no piece that is long enough."""
    if pieces or not logs:
        return
    log = logs[0]
    lost = 1 - log.n_samples * log.dt / max(log.duration, log.dt)
    if lost > 0:
        said = f"{log.name}: gaps cut it into pieces below {2 * WARM_UP_S:g} s; {100 * lost:.0f} % of its samples are missing"
        raise CannotAnswer("too_little_data", said, "log without losing samples, such as at a lower rate")


def _require_in_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs, or raise if recordings are too large to simulate."""
    for log in logs:
        if not isinstance(log, Log):
            raise InputError(
                "file_too_large", f"{log.name} has {log.n_samples} samples, too many to simulate; give an excerpt"
            )
    return [log for log in logs if isinstance(log, Log)]


def _refuse_stillness(records: Sequence[LoopRecord]) -> None:
    """Reject logs that are too short or in which no joint moves."""
    seconds = sum(float(r.used.sum()) * r.interval for r in records)
    if seconds < MIN_SECONDS:
        raise CannotAnswer(
            "too_little_data",
            f"the logs hold {seconds:.1f} s of free motion",
            "record half a minute or more, free of contact",
        )
    if all(np.ptp(r.q[r.used], axis=0).max() < 1e-6 for r in records if r.used.any()):
        raise CannotAnswer("poor_excitation", "no joint moves in these logs", "command steps and sweeps at every joint")
