"""Logs of commands and positions -> masses, friction and the servo's unknowns: the main path.

    robot, law, logs -> Records -> contact left out -> screen (equation error) -> directions -> output error -> errors

Masses and friction scale with the law's torque. If no law is given, the gains are estimated, and the robot file's masses, or a
weighed one, set the scale; the result states this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack

import numpy as np

from tau_dyn.evidence import describe_poor_simulations, find_poor_simulations
from tau_dyn.identify import find_structural_base, list_provenance
from tau_dyn.log import Log, Recording
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot, compute_nominal_stderr
from tau_dyn.servo.by_gain import compare_gains, start_springs
from tau_dyn.servo.data import LoopData, Mixing, fit_coupled
from tau_dyn.servo.doubts import list_loop_warnings, list_unsettled
from tau_dyn.servo.fit import LoopFit, fit_loop
from tau_dyn.servo.prediction import SimulatedMotion, simulate_coupled
from tau_dyn.servo.preparation import LoopOptions, read_loop_logs
from tau_dyn.servo.records import LoopRecord, mask_unused
from tau_dyn.servo.residual_structure import compute_noise_floor
from tau_dyn.servo.result import LoopIdentification, LoopParameter, build_position_errors
from tau_dyn.servo.saturation import start_saturated
from tau_dyn.servo.unknowns import JOINT_UNITS, get_unit
from tau_dyn.simulate import SERVO_ENTRIES

SETTLED_FOR_ERRORS = 1.0
"""Change of unknowns over standard errors below which a fit's held-out error counts as converged: their own scatter changes it
as much."""
TRAIN_SHARE = 0.7
"""Share of each log whose fit predicts the rest, if no held-out log is given."""


def identify_loop(
    robot: Robot, logs: Log | Recording | Iterable[Log | Recording], **options: Unpack[LoopOptions]
) -> LoopIdentification:
    """Identify a robot's parameters from logs of commands and positions, through its servo loops.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `cmd_J` and `q_J` of every actuated joint.
        **options: See `LoopOptions`.

    Raises:
        InputError: A log, the law or a choice is at fault.
        CannotAnswer: The logs hold no motion.
    """
    given = read_loop_logs(robot, logs, options)
    progress, kept, others = given.progress, given.kept, given.others
    given, data = start_saturated(given, kept)
    data, law = start_springs(data, progress), data.law
    if others:
        data, fit = fit_coupled(data, progress)
        progress("held-out errors")
        judged, predicted = others, predict(data, fit, others)
        how = "held-out logs: " + ", ".join(x.name for x in given.held)
    else:
        data, fit, judged, predicted = _judge_last_part(data, progress)
        how = "last 30 % of each log, predicted by a fit of its first 70 %"
    trained = predict(data, fit, kept)
    pairs = [(r, m, True) for r, m in zip(judged, predicted, strict=True)]
    pairs += [(r, m, False) for r, m in zip(kept, trained, strict=True)]
    warnings = [*given.warnings, *list_unsettled([(r.name, m.unsettled) for r, m, _ in pairs])]
    by_gain: tuple[Mapping[str, Any], ...] = ()
    if len({tuple(r.entries["position_gain"]) for r in kept}) > 1:
        by_gain, said = compare_gains(data, fit.x, progress)
        warnings += said
    warnings += list_loop_warnings(law, kept, others, [*given.train, *given.held], data, fit)
    errors = build_position_errors(robot.actuated, kept, [m.q for m in trained])
    poor = find_poor_simulations(
        robot.actuated,
        errors.rms_per_joint,
        compute_noise_floor(kept),
        errors.pool(errors.command_rms),
        errors.count.sum(),
    )
    warnings += describe_poor_simulations(poor, dict(zip(robot.actuated, robot.position_units, strict=True)))
    return _build_result(
        data, fit, seed=given.seed, logs=given.train, held=given.held, friction=given.friction or "file",
        contacts=given.contacts, train=errors, poor_fits=poor,
        holdout=build_position_errors(robot.actuated, judged, [m.q for m in predicted]), how=how,
        shown=[(r, m.q, apart) for r, m, apart in pairs], warnings=warnings, by_gain=by_gain,
    )  # fmt: skip


def predict(data: LoopData, fit: LoopFit, records: Sequence[LoopRecord]) -> list[SimulatedMotion]:
    """Return the motions of records at a solution, from their commands alone."""
    u = data.unknowns
    inertial = fit.x[u.n - data.space.n_unknowns :]
    return simulate_coupled(data.space, inertial, u.with_values(fit.x), data.law, records, data.compute_exact_step(fit))


def _judge_last_part(data: LoopData, progress: Callable[[str], None]):  # noqa: ANN202
    """Return the fit of all data, and the last part of each log with its motion by a fit of the first part."""
    first, last = [], []
    for r in data.records:
        early = np.arange(len(r.t)) < TRAIN_SHARE * len(r.t)
        first.append(mask_unused(r, ~early))
        last.append(mask_unused(r, early))
    mixing = Mixing()
    near, part = fit_coupled(replace(data, records=first), progress, settled=SETTLED_FOR_ERRORS, mixing=mixing)
    predicted = predict(data, part, last)
    data = replace(near, records=data.records)  # with exact motions, which masks do not change
    data, fit = fit_coupled(data, progress, fit_loop(data.build_problem(), progress, first=part.x), mixing=mixing)
    return data, fit, last, predicted


def _build_result(
    data: LoopData, fit: LoopFit, *, logs, held, contacts, shown, warnings, how, holdout, **more: Any
) -> LoopIdentification:  # noqa: ANN001
    u, robot = data.unknowns, data.model.robot
    values = u.with_values(fit.x)
    m = u.n - data.space.n_unknowns
    theta = data.space.at(fit.x[m:])
    rows = list_joint_rows(data, fit, values)
    bodies, base = list_body_rows(data, fit, theta, more["seed"])
    law = data.law.with_values(**{key: values[key] for key in SERVO_ENTRIES})
    law = replace(law, estimated=frozenset())
    identified = fill_model(data, values, theta, rows, bodies)
    identified = replace(identified, provenance=list_provenance(logs, held, more["seed"]), controller=law.to_dict())
    scale = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
    loose = np.diag(fit.covariance) > 0
    normal = fit.covariance[np.ix_(loose, loose)] / scale[loose][:, None] / scale[loose][None, :]
    return LoopIdentification(
        model=identified, law=law, parameters=(*rows, *bodies), base_parameters=base, train=more["train"], holdout=holdout,
        holdout_how=how, contacts=tuple(contacts), warnings=tuple(dict.fromkeys(warnings)), seed=more["seed"], logs=tuple(logs),
        shown=tuple(shown), friction=more["friction"], n_samples=int(sum(r.used.sum() for r in data.records)) * robot.na,
        condition_number=float(np.linalg.cond(normal)) if loose.any() else 1.0, rank=u.n, start=(data, fit),
        by_gain=tuple(more["by_gain"]), poor_fits=more["poor_fits"],
    )  # fmt: skip


def list_joint_rows(data: LoopData, fit: LoopFit, values: Mapping[str, np.ndarray]) -> list[LoopParameter]:
    """Return the estimated parameters of joints, joint by joint."""
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


def list_body_rows(
    data: LoopData, fit: LoopFit, theta: np.ndarray, seed: int
) -> tuple[list[LoopParameter], tuple[LoopParameter, ...]]:
    """Return the bodies' free parameters, and their identifiable combinations."""
    space, m = data.space, data.unknowns.n - data.space.n_unknowns
    parameters = data.model.robot.parameters
    D, cov = space.directions, fit.covariance[m:, m:]
    total = D @ cov @ D.T + np.diag(space.prior**2) - D @ D.T  # directions without information keep their prior
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
        sigma = float(np.sqrt(max(total[k, k], 0.0)))
        rows.append(
            LoopParameter(
                p.name, float(theta[k]) if seen else p.value, p.unit, sigma if seen else None, p.value,
                compute_nominal_stderr(p), identifiable=seen,
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
