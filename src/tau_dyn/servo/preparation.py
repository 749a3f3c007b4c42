"""A robot, logs of commands and positions, and what is said of them -> what a fit through the loop starts from.

    Records -> contact left out -> screen (equation error) -> directions of the bodies' numbers -> unknowns at their start

`identify_loop` and `diagnose_loop` share it, and their options.
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
from tau_dyn.log import Log, Recording, list_unit_warnings, split_at_gaps
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.robot import NOT_GIVEN, Robot
from tau_dyn.servo.contact import Contact, find_contacts
from tau_dyn.servo.data import LoopData
from tau_dyn.servo.equation_error import choose_directions, screen_equation_error
from tau_dyn.servo.records import InertialSpace, LoopRecord, build_records, compute_load_waves
from tau_dyn.servo.unknowns import FRICTION, LoopUnknowns, build_unknowns, compute_stiffness
from tau_dyn.servo.waves import MAX_STEP_S, SPRING_STEP_S
from tau_dyn.simulate import COMMANDS, SERVO_ENTRIES, ServoLaw

ALWAYS = ("armature", "command_delay")
"""What is estimated of every joint beside friction, unless the law or `--fix` gives it."""
MIN_SECONDS = 5.0
"""Shortest data that a loop is identified from [s]: some ten time constants of a servo."""

Progress = Callable[[str], None]


class LoopOptions(TypedDict, total=False):
    """What may be said to `identify_loop` and `diagnose_loop`; everything may be left out.

    Attributes:
        law: The servo's law; None to estimate its gains.
        holdout: Logs to judge on; without any, the last 30 % of each log, predicted by a fit of the first 70 %, or, of a
            diagnosis, blocks of the logs.
        model: `rigid` for no friction; any other name for friction that is the same in both directions.
        choices: What is fixed, free, bounded or measured beforehand; servo entries by `JOINT.entry`, too.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of whatever is random: the structural study, the bootstrap.
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
    """Logs on even clocks, free of contact, and what was said of them.

    Attributes:
        model: Robot and friction, at start values.
        law: The servo's law.
        train: Training logs.
        held: Held-out logs.
        kept: Records of the training logs.
        others: Records of the held-out logs.
        contacts: Where the tool rested on something.
        own: What was said of servo entries.
        friction: Name of the friction model; empty for that of a model given.
        warnings: What is doubtful of the logs.
        seed: Seed of whatever is random.
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
    """Tell whether a log is one of commands and positions without a torque."""
    names = robot.actuated
    if not isinstance(log, Log) or not (log.has("q", names) and log.has("cmd", names)):
        return False
    return not any(log.has("tau", [joint]) for joint in names)


def read_loop_logs(robot: Robot, logs: Log | Recording | Iterable[Log | Recording], options: LoopOptions) -> LoopLogs:
    """Return logs as a fit needs them.

    Raises:
        InputError: A log, the law or a choice is at fault.
        CannotAnswer: The logs hold no motion.
    """
    train, held, doubled = drop_repeated_logs(get_log_list(logs), get_log_list(options.get("holdout", ())))
    train, held = _require_in_memory(train), _require_in_memory(held)
    refuse_slow_clocks([*train, *held])
    pieces, apart = ([piece for log in logs for piece in split_at_gaps(log)] for logs in (train, held))
    said = list(dict.fromkeys(w for x in (*pieces, *apart) for w in (*x.warnings, *list_unit_warnings(x, robot))))
    model, progress = options.get("model", "asymmetric"), options.get("progress", lambda step: None)
    friction = model if isinstance(model, str) else ""
    law = options.get("law") or _guess_law(robot)
    own, theirs = _split_choices(options.get("choices") or Choices(), robot)
    started = theirs.apply(_build_start(robot, friction))
    progress("loads")
    contacts, records = find_contacts(
        started, build_records(started, law, [*pieces, *apart], options.get("exclude", ()))
    )
    kept = records[: len(pieces)]
    _refuse_stillness(kept)
    warnings = [*doubled, *said, *started.robot.warnings, *(CodedWarning("contact", c.describe()) for c in contacts)]
    return LoopLogs(
        started, law, train, held, kept, records[len(pieces) :], contacts, own, friction, warnings, options.get("seed", 0),
        progress,
    )  # fmt: skip


def prepare_loop(given: LoopLogs, records: Sequence[LoopRecord]) -> LoopData:
    """Return what a fit of some records starts from: the screen's values, and the inertial directions that they inform on."""
    model, law, space = given.model, given.law, InertialSpace.of(given.model)
    given.progress("equation error")
    estimate_gain = "position_gain" in law.estimated and not np.any(law.values["speed_gain"])
    screen = screen_equation_error(law, space, records, estimate_gain)
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
        kinds.remove("viscous")  # one number until the servo saturates
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
    """Return the unknowns with what was said about servo entries by name or pattern."""
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
    """Return what was said of servo entries, and of everything else."""

    def is_own(text: str) -> bool:
        return bool(_match(text.partition("=")[0], robot.actuated))

    own, theirs = (
        Choices(*(tuple(t for t in texts if is_own(t) == mine) for texts in (choices.fix, choices.free, choices.bound)))
        for mine in (True, False)
    )
    return own, theirs


def _build_start(robot: Robot, friction: str) -> Model:
    """Return the model with friction that is the same in both directions, or none where it is `rigid`."""
    return Model.of(
        robot, build_friction_model("rigid" if friction == "rigid" else "symmetric", robot.actuated, robot.force_units)
    )


def _guess_law(robot: Robot) -> ServoLaw:
    """Return a law of which nothing is known but that torque grows with the position error."""
    law = ServoLaw.of(robot.actuated, given=False, position_gain=5.0, force_per_unit=1.0, limit=np.inf)
    return replace(law, estimated=frozenset({"position_gain"}))


def _require_in_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs, and refuse recordings that are too large to simulate."""
    for log in logs:
        if not isinstance(log, Log):
            raise InputError(
                "file_too_large", f"{log.name} has {log.n_samples} samples, too many to simulate; give an excerpt"
            )
    return [log for log in logs if isinstance(log, Log)]


def _refuse_stillness(records: Sequence[LoopRecord]) -> None:
    """Refuse logs that are too short or in which nothing moves."""
    seconds = sum(float(r.used.sum()) * r.dt for r in records)
    if seconds < MIN_SECONDS:
        raise CannotAnswer(
            "too_little_data",
            f"the logs hold {seconds:.1f} s of free motion",
            "record half a minute or more, free of contact",
        )
    if all(np.ptp(r.q[r.used], axis=0).max() < 1e-6 for r in records if r.used.any()):
        raise CannotAnswer("poor_excitation", "no joint moves in these logs", "command steps and sweeps at every joint")
