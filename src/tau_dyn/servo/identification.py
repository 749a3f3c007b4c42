"""Logs of commands and positions -> masses, friction and the servo's unknowns: the whole main path in one place.

    robot, law, logs -> Records -> contact left out -> screen (equation error) -> directions -> output error -> errors

Masses and friction scale with the law's torque. Where no law is given, the gains are estimated, and the robot file's
masses, or a weighed one, set the scale; the answer says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import Choices, drop_repeated_logs, find_structural_base, get_log_list
from tau_dyn.log import Log, Recording
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import NOMINAL_MASS_STDERR, NOT_GIVEN, Robot
from tau_dyn.servo.by_gain import compare_gains
from tau_dyn.servo.contact import find_contacts
from tau_dyn.servo.data import LoopData
from tau_dyn.servo.doubts import list_loop_warnings
from tau_dyn.servo.fit import (
    FRICTION,
    JOINT_UNITS,
    LoopFit,
    LoopUnknowns,
    build_unknowns,
    choose_directions,
    fit_loop,
    get_unit,
    screen_equation_error,
)
from tau_dyn.servo.prediction import predict_positions
from tau_dyn.servo.records import (
    InertialSpace,
    LoadWaves,
    LoopRecord,
    build_records,
    compute_load_waves,
    mask_unused,
)
from tau_dyn.servo.result import LoopIdentification, LoopParameter, build_position_errors
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw

ALWAYS = ("armature", "command_delay")
"""What is estimated of every joint beside friction, unless the law or `--fix` gives it."""
TRAIN_SHARE = 0.7
"""Where no held-out log is given, a fit of this first part of each log predicts the rest."""
MIN_SECONDS = 5.0
"""Shortest data that a loop is identified from [s]: some ten time constants of a servo."""

Progress = Callable[[str], None]


def is_loop_log(log: Log | Recording, robot: Robot) -> bool:
    """Tell whether a log is one of commands and positions without a torque."""
    names = robot.actuated
    if not isinstance(log, Log) or not (log.has("q", names) and log.has("cmd", names)):
        return False
    return not any(log.has("tau", [joint]) for joint in names)


def identify_loop(
    robot: Robot,
    logs: Log | Recording | Iterable[Log | Recording],
    *,
    law: ServoLaw | None = None,
    holdout: Log | Recording | Iterable[Log | Recording] = (),
    model: str | Path | Model = "asymmetric",
    choices: Choices | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Progress = lambda step: None,
) -> LoopIdentification:
    """Identify a robot's parameters from logs of commands and positions, through its servo loops.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `cmd_J` and `q_J` of every actuated joint.
        law: The servo's law; None to estimate its gains.
        holdout: Logs to judge on; without any, the last 30 % of each log, predicted by a fit of the first 70 %.
        model: `rigid` for no friction; any other name for friction that is the same in both directions.
        choices: What is fixed, free, bounded or measured beforehand; servo entries by `JOINT.entry`, too.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of the random states of the structural study.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the law or a choice is at fault.
        CannotAnswer: The logs hold no motion.
    """
    train, held, doubled = drop_repeated_logs(get_log_list(logs), get_log_list(holdout))
    train, held = require_in_memory(train), require_in_memory(held)
    friction = model if isinstance(model, str) else ""
    law, asked = law or guess_law(robot), choices or Choices()
    started = build_start(robot, friction)
    own, theirs = split_choices(asked, robot)
    started = theirs.apply(started)
    progress("loads")
    records = build_records(started, law, [*train, *held], exclude)
    contacts, records = find_contacts(started, records)
    kept, others = records[: len(train)], records[len(train) :]
    refuse_stillness(kept)
    data = prepare_loop(started, law, kept, own, friction, progress)
    warnings: list[str] = [
        *doubled,
        *started.robot.warnings,
        *(CodedWarning("contact", c.describe()) for c in contacts),
    ]
    if held:
        fit = fit_loop(data.build_problem(), progress)
        progress("held-out errors")
        predicted = predict(data, fit, others)
        errors, how = (
            build_position_errors(robot.actuated, others, predicted),
            "held-out logs: " + ", ".join(x.name for x in held),
        )
        shown = [(r, p, True) for r, p in zip(others, predicted, strict=True)]
    else:
        fit, errors, shown = _judge_last_part(data, progress)
        how = "last 30 % of each log, predicted by a fit of its first 70 %"
    trained = predict(data, fit, kept, data.loads)
    by_gain: tuple[Mapping[str, Any], ...] = ()
    if len({tuple(r.entries["position_gain"]) for r in kept}) > 1:
        by_gain, said = compare_gains(data, fit.x, progress)
        warnings += said
    warnings += list_loop_warnings(law, kept, others, [*train, *held], data, fit)
    return _build_result(
        data, fit, seed=seed, logs=train, held=held, friction=friction or "file", contacts=contacts,
        train=build_position_errors(robot.actuated, kept, trained), holdout=errors, how=how,
        shown=[*shown, *((r, p, False) for r, p in zip(kept, trained, strict=True))], warnings=warnings, by_gain=by_gain,
    )  # fmt: skip


def predict(
    data: LoopData, fit: LoopFit, records: Sequence[LoopRecord], loads: Sequence[LoadWaves] | None = None
) -> list[np.ndarray]:
    """Return positions (N, na) of records at a solution, from their commands alone."""
    u = data.unknowns
    inertial = fit.x[u.n - data.space.n_unknowns :]
    return predict_positions(data.space, inertial, u.with_values(fit.x), data.law, records, loads, fit.step)


def prepare_loop(
    model: Model, law: ServoLaw, records: Sequence[LoopRecord], own: Choices, friction: str, progress: Progress
) -> LoopData:
    """Return what a fit starts from: the screen's values, and the inertial directions that the logs inform on."""
    space = InertialSpace.of(model)
    loads = [compute_load_waves(space, *r.motion, r.dt) for r in records]
    progress("equation error")
    estimate_gain = "position_gain" in law.estimated
    screen = screen_equation_error(law, space, records, loads, estimate_gain)
    space = choose_directions(space, records, loads, screen)
    return LoopData(model, law, space, records, loads, _build_unknowns(model, law, space, screen.values, own, friction))


def _build_unknowns(
    model: Model, law: ServoLaw, space: InertialSpace, found: Mapping[str, np.ndarray], own: Choices, friction: str
) -> LoopUnknowns:
    joints, na = law.joints, len(law.joints)
    kinds = [*ALWAYS, *(FRICTION if friction != "rigid" else ()), *sorted(law.estimated)]
    if "back_emf" in law.estimated and "viscous" in kinds:
        kinds.remove("viscous")  # one number until the servo saturates
    kinds = list(dict.fromkeys(kinds))
    stiff = found["position_gain"] * law.values["force_per_unit"]
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
    from tau_dyn.identify import read_bound, read_fixed

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


def split_choices(choices: Choices, robot: Robot) -> tuple[Choices, Choices]:
    """Return what was said of servo entries, and of everything else."""

    def is_own(text: str) -> bool:
        return bool(_match(text.partition("=")[0], robot.actuated))

    own, theirs = (
        Choices(*(tuple(t for t in texts if is_own(t) == mine) for texts in (choices.fix, choices.free, choices.bound)))
        for mine in (True, False)
    )
    return own, theirs


def build_start(robot: Robot, friction: str) -> Model:
    """Return the model with friction that is the same in both directions, or none where it is `rigid`."""
    return Model.of(
        robot, build_friction_model("rigid" if friction == "rigid" else "symmetric", robot.actuated, robot.force_units)
    )


def guess_law(robot: Robot) -> ServoLaw:
    """Return a law of which nothing is known but that torque grows with the position error."""
    law = ServoLaw.of(robot.actuated, given=False, position_gain=5.0, force_per_unit=1.0, limit=np.inf)
    return replace(law, estimated=frozenset({"position_gain"}))


def require_in_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs, and refuse recordings that are too large to simulate."""
    for log in logs:
        if not isinstance(log, Log):
            raise InputError(
                "file_too_large", f"{log.name} has {log.n_samples} samples, too many to simulate; give an excerpt"
            )
    return [log for log in logs if isinstance(log, Log)]


def refuse_stillness(records: Sequence[LoopRecord]) -> None:
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


def _judge_last_part(data: LoopData, progress: Progress):  # noqa: ANN202
    """Return the fit of all data, errors on the last part of each log by a fit of its first part, and what to look at."""
    first, last = [], []
    for r in data.records:
        early = np.arange(len(r.t)) < TRAIN_SHARE * len(r.t)
        first.append(mask_unused(r, ~early))
        last.append(mask_unused(r, early))
    part = fit_loop(data.build_problem(records=first), progress)
    predicted = predict(data, part, last)
    errors = build_position_errors(data.law.joints, last, predicted)
    again = replace(data.unknowns, values=data.unknowns.with_values(part.x))
    fit = fit_loop(data.build_problem(again), progress)
    return fit, errors, [(r, p, True) for r, p in zip(last, predicted, strict=True)]


def _build_result(
    data: LoopData, fit: LoopFit, *, logs, held, contacts, shown, warnings, how, holdout, **more: Any
) -> LoopIdentification:  # noqa: ANN001
    u, robot = data.unknowns, data.model.robot
    values = u.with_values(fit.x)
    m = u.n - data.space.n_unknowns
    theta = data.space.at(fit.x[m:])
    rows = _list_joint_rows(data, fit, values)
    bodies, base = _list_body_rows(data, fit, theta, more["seed"])
    law = data.law.with_values(**{key: values[key] for key in SERVO_ENTRIES})
    law = replace(law, estimated=frozenset())
    identified = fill_model(data, values, theta, rows, bodies)
    identified = replace(identified, provenance=_list_provenance(logs, held, more["seed"]), controller=law.to_dict())
    scale = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
    loose = np.diag(fit.covariance) > 0
    normal = fit.covariance[np.ix_(loose, loose)] / scale[loose][:, None] / scale[loose][None, :]
    return LoopIdentification(
        model=identified, law=law, parameters=(*rows, *bodies), base_parameters=base, train=more["train"], holdout=holdout,
        holdout_how=how, contacts=tuple(contacts), warnings=tuple(dict.fromkeys(warnings)), seed=more["seed"], logs=tuple(logs),
        shown=tuple(shown), friction=more["friction"], n_samples=int(sum(r.used.sum() for r in data.records)) * robot.na,
        condition_number=float(np.linalg.cond(normal)) if loose.any() else 1.0, rank=u.n, start=(data, fit),
        by_gain=tuple(more["by_gain"]),
    )  # fmt: skip


def _list_joint_rows(data: LoopData, fit: LoopFit, values: Mapping[str, np.ndarray]) -> list[LoopParameter]:
    """Return what was estimated at joints, joint by joint."""
    u, sigma = data.unknowns, np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    where = np.full(u.free.shape, -1)
    where[u.free] = np.arange(int(u.free.sum()))
    rows = []
    for j, (joint, force) in enumerate(zip(data.law.joints, data.model.robot.force_units, strict=True)):
        for k, kind in enumerate(u.kinds):
            if not u.free[k, j]:
                continue
            unit = get_unit(kind) if force == "N m" else get_unit(kind).replace("N m", "N").replace("rad", "m")
            nominal = (
                float(data.law.values[kind][j])
                if kind in SERVO_ENTRIES and data.law.given and kind in data.law.estimated
                else None
            )
            stderr = float(sigma[where[k, j]])
            rows.append(
                LoopParameter(
                    f"{joint}.{kind}", float(values[kind][j]), unit, stderr if stderr > 0 else None, nominal, None,
                    float(u.lower[k, j]), float(u.upper[k, j]),
                )
            )  # fmt: skip
    return rows


def _list_body_rows(
    data: LoopData, fit: LoopFit, theta: np.ndarray, seed: int
) -> tuple[list[LoopParameter], tuple[LoopParameter, ...]]:
    """Return the bodies' parameters that are free, and the combinations that motion can show."""
    space, m = data.space, data.unknowns.n - data.space.n_unknowns
    parameters = data.model.robot.parameters
    D, cov = space.directions, fit.covariance[m:, m:]
    total = D @ cov @ D.T + np.diag(space.prior**2) - D @ D.T  # what the logs do not inform on keeps its prior
    free = [k for k, p in enumerate(parameters) if space.prior[k] > 0 and not p.name.endswith(".armature")]
    if not free:
        return [], ()
    names = {parameters.names[k] for k in free}
    bare = Model.of(
        data.model.robot.with_parameters(Parameters([replace(p, free=p.name in names) for p in parameters]))
    )
    base = find_structural_base(bare, seed)
    full = [parameters.names.index(n) for n in base.names]
    P = np.zeros((base.rank, len(full)))
    P[np.arange(base.rank), base.kept] = 1.0
    P[:, base.dropped] = base.K
    alone = {base.names[c] for c in np.flatnonzero(base.alone)}
    rows = []
    for k in free:
        p = parameters[parameters.names[k]]
        seen = p.name in alone
        nominal_stderr = NOMINAL_MASS_STDERR * abs(p.value) if p.name.endswith(".mass") else None
        sigma = float(np.sqrt(max(total[k, k], 0.0)))
        rows.append(
            LoopParameter(
                p.name, float(theta[k]) if seen else p.value, p.unit, sigma if seen else None, p.value,
                p.prior_stderr if p.prior_stderr is not None else nominal_stderr, identifiable=seen,
            )
        )  # fmt: skip
    combined, spread = P @ theta[full], P @ total[np.ix_(full, full)] @ P.T
    nominal = P @ space.nominal[full]
    combos = [
        LoopParameter(
            base.names[c], float(combined[i]), parameters[base.names[c]].unit, float(np.sqrt(max(spread[i, i], 0.0))),
            float(nominal[i]), None, expression=base.expression(i),
        )
        for i, c in enumerate(base.kept)
    ]  # fmt: skip
    return rows, tuple(combos)


def fill_model(
    data: LoopData,
    values: Mapping[str, np.ndarray],
    theta: np.ndarray,
    rows: Sequence[LoopParameter],
    bodies: Sequence[LoopParameter],
) -> Model:
    """Return the model at the identified values."""
    model, joints = data.model, data.law.joints
    new = {
        name: float(x)
        for name, x in zip(model.robot.parameters.names, theta, strict=True)
        if not name.endswith(".armature")
    }
    for kind in JOINT_UNITS:
        new |= {
            f"{j}.{kind}": float(x)
            for j, x in zip(joints, values[kind], strict=True)
            if f"{j}.{kind}" in model.parameters
        }
    found = {row.name: row.stderr for row in (*rows, *bodies)}
    items = [
        replace(
            p, value=new.get(p.name, p.value), stderr=found.get(p.name), lower=min(p.lower, new.get(p.name, p.value))
        )
        for p in model.parameters
    ]
    return model.with_parameters(Parameters(items))


def _list_provenance(train: Sequence[Log], held: Sequence[Log], seed: int) -> dict[str, Any]:
    from tau_dyn.version import __version__

    rows = [[{"path": log.name, "sha256": log.sha256} for log in logs] for logs in (train, held)]
    return {"tool_version": __version__, "trained_on": rows[0], "held_out": rows[1], "seed": seed}
