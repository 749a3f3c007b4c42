r"""A payload from logs without and with it: its mass, centre and inertia, in one estimate with all other parameters in common.

    tau = Y theta + [loaded] (Y_last pi + sum_j (c_j sign(v_j) + d_j v_j))

`pi` are the ten inertial parameters of a rigid body fixed to a link, so model errors common to both recordings do not affect
them. Coulomb friction depends on the load of a gear or a guide, and on its temperature: each joint's Coulomb and viscous
friction may differ between empty and loaded, by the same amount in both directions, and a test names the joints with a
difference. The part of load friction that follows the force within the motion stays in the residual, whose scatter is part of
the intervals. The payload is kept physically consistent: its pseudo-inertia is positive semidefinite
(`estimate/physical_consistency.py`). Drive gains scale the result: a force scale that is 2 % off makes a mass 2 % off.
Reference: Khalil, Gautier & Lemoine 2007.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.diagnose import (
    PAYLOAD,
    BodyEstimate,
    build_body_parameters,
    build_load_parameters,
    constrain_loads,
    estimate_body,
    find_end_link,
    find_payload_frame,
    format_load_sentence,
    list_load_names,
)
from tau_dyn.effects import PARAMETER_CAUSES
from tau_dyn.estimate import MAX_RELATIVE_STDERR, Estimate, Regression, solve_least_squares
from tau_dyn.evidence import DIFFERENCE_LEVEL, Finding
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError, UnknownName
from tau_dyn.excitation import Noise, predict_ideal_log
from tau_dyn.identify import (
    Data,
    build_model,
    build_physical_constraints,
    complete_positions,
    compute_contrast_p_value,
    drop_repeated_logs,
    list_information_warnings,
    name_apart,
    refuse_constant_forces,
    require_forces,
)
from tau_dyn.legged import complete_base, list_base_warnings
from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning, format_warnings, get_code
from tau_dyn.model import Model
from tau_dyn.monitor.drive_gains import compare_drives
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Z95, Shown, format_list
from tau_dyn.robot import INERTIAL, LinkInertia, Robot
from tau_dyn.simulate import build_fourier_motion

MIN_DRIVE_DIFFERENCE = 0.05
"""Smallest relevant difference of the mass by two joints; torque constants and the load friction of gears scatter less."""
MAX_HIDDEN_SHARE = 0.05
"""Part of the robot's own mass that may hide in the interval of an answer "no payload": an arm's rated payload is a quarter."""
_EXPERIMENT_S = 20.0  # of the simulated motion from which the length of the proposed one is predicted
_MAX_EXPERIMENT_S = 600.0  # a motion longer than ten minutes is not practical; more accuracy needs another motion
_MIN_JOINT_SHARE = 0.1  # of the information about a payload's mass: joints with less are not named
_WALK = (
    "sway on all feet for a minute, the base tilting and turning as far as the legs reach, then step, without and with "
    "the payload"
)
_MIN_LENGTH_M = 0.05  # lever by which a centre counts as known if the payload is at the frame's origin

INERTIA = INERTIAL[4:]


class PropertyEstimate(NamedTuple):
    """Mass, centre or inertia of a payload: values (k,), standard errors (k,; NaN if unknown), whether they are determined."""

    values: np.ndarray
    stderr: np.ndarray
    unit: str
    determined: bool

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers; those that the data do not determine are None."""
        told = np.isfinite(self.stderr)
        values = [float(x) if ok else None for x, ok in zip(self.values, told, strict=True)]
        ends = [
            [float(x - Z95 * s), float(x + Z95 * s)] if ok else None
            for x, s, ok in zip(self.values, self.stderr, told, strict=True)
        ]
        stderr = [float(s) if ok else None for s, ok in zip(self.stderr, told, strict=True)]
        rows: dict[str, Any] = {"value": values, "stderr": stderr, "ci95": ends}
        if len(values) == 1:
            ends[0] = ends[0] and [max(0.0, ends[0][0]), ends[0][1]]  # no body has a negative mass
            rows = {name: row[0] for name, row in rows.items()}
        return rows | {"unit": self.unit, "determined": self.determined}


class FrictionDifference(NamedTuple):
    """Increase of one joint's friction in the loaded logs; the p-value counts all joints (Bonferroni)."""

    joint: str
    coulomb: Parameter
    viscous: Parameter
    p_value: float | None

    @property
    def differs(self) -> bool:
        """Whether the friction differs."""
        return self.p_value is not None and self.p_value < DIFFERENCE_LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        parts = (("coulomb_change", self.coulomb), ("viscous_change", self.viscous))
        rows = {name: {"value": p.value, "stderr": p.stderr, "unit": p.unit} for name, p in parts}
        return {"joint": self.joint, **rows, "p_value": self.p_value, "differ": self.differs}


@dataclass(frozen=True, eq=False)
class PayloadEstimate(Shown):
    """The body that the loaded logs carry beyond the empty ones.

    Attributes:
        robot: The robot.
        link: Link that carries it.
        frame: Frame of centre and inertia.
        mass: Mass.
        centre: Centre in that frame.
        inertia: `ixx ixy iyy ixz iyz izz` about the centre, along the frame's axes.
        plain_mass: The mass without the constraint of physical consistency [kg].
        p_value: p-value of the hypothesis that all recordings have the same load.
        friction: Differences of friction.
        logs: Names of the empty and of the loaded logs.
        estimate: The solved regression.
        warnings: Doubts, as sentences.
    """

    robot: Robot
    link: str
    frame: str
    mass: PropertyEstimate
    centre: PropertyEstimate
    inertia: PropertyEstimate
    plain_mass: float
    p_value: float
    friction: tuple[FrictionDifference, ...]
    logs: tuple[tuple[str, ...], tuple[str, ...]]
    estimate: Estimate
    warnings: tuple[str, ...]

    @property
    def differs(self) -> bool:
        """Whether the loaded logs carry anything."""
        return self.p_value < DIFFERENCE_LEVEL

    @property
    def largest_mass(self) -> float:
        """Upper end of the mass' 95 % interval [kg]."""
        return max(float(self.mass.values[0]), 0.0) + Z95 * float(self.mass.stderr[0])

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The payload as a finding; empty if the difference is not significant.

        Its status is `parameter`, since no part of the logs is held out. It is `suspected` if the joints disagree about the mass,
        or if the loaded logs are lighter.
        """
        if not self.differs:
            return ()
        parts = (self.mass, self.centre, self.inertia)
        values, stderr = (np.concatenate([getattr(part, key) for part in parts]) for key in ("values", "stderr"))
        body = BodyEstimate(values, stderr, np.isfinite(stderr))
        empty, loaded = self.logs
        why = "the joints disagree about its mass" if any(get_code(w) == "scale_wrong" for w in self.warnings) else ""
        why = "the loaded logs are lighter than the empty ones" if self.is_lighter else why
        return (
            Finding(
                PAYLOAD,
                (self.link,),
                "suspected" if why else "parameter",
                float((values[0] / stderr[0]) ** 2),
                self.p_value,
                tuple(build_body_parameters(body, self.frame)),
                None,
                (),
                PARAMETER_CAUSES[PAYLOAD],
                format_load_sentence(body, self.frame, loaded, empty),
                why_not_confirmed=why,
                logs=loaded,
            ),
        )

    @property
    def is_lighter(self) -> bool:
        """Whether the loaded logs carry significantly less than the empty ones."""
        return self.differs and self.plain_mass < -Z95 * float(self.mass.stderr[0])

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result, without the entries that the command adds."""
        parts = (("mass", self.mass), ("centre", self.centre), ("inertia", self.inertia))
        return {
            "payload": {
                "link": self.link, "frame": self.frame, **{name: part.to_dict() for name, part in parts},
                "inertia_components": list(INERTIA),
            },
            "p_value": self.p_value,
            "differ": self.differs,
            "friction": [row.to_dict() for row in self.friction],
            "findings": [f.to_dict() for f in self.findings],
            **format_warnings(self.warnings),
        }  # fmt: skip


def identify_payload(
    robot: Robot | Model,
    empty: Sequence[Log],
    loaded: Sequence[Log],
    *,
    link: str | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> PayloadEstimate:
    """Identify the body that the loaded logs carry beyond the empty ones.

    Args:
        robot: The robot, whose friction is then asymmetric; or a model with its effects.
        empty: Logs with `q_J` and `tau_J` without the payload.
        loaded: The same robot with it; the same motion or another.
        link: Link that carries it; by default the one with the tool, the tree's only leaf, or a floating base.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of the motion that is proposed if the logs are too short.
        progress: Called with a word for each step.

    Raises:
        InputError: A log or the link is invalid.
        CannotAnswer: The logs are too short or have too little motion; the error proposes a sufficient motion.
    """
    model = robot if isinstance(robot, Model) else build_model(robot, "asymmetric")
    body = find_carrying_link(model.robot, link)
    try:
        return _identify(model, body, empty, loaded, exclude, seed, progress)
    except CannotAnswer as fault:
        if isinstance(fault, TooLittleTold):
            raise
        progress("the motion to make")
        told = replace_experiment(fault, _propose_motion(model, body, None, None, seed))
        raise told from fault


_CURRENTS = (
    "If the efforts are motor currents [A], as UR robots publish them, give the constant of each joint behind its gear [N m/A] "
    "in a column map: `tau_J: {column: joint_states.effort.J, scale: CONSTANT}`."
)


class TooLittleTold(CannotAnswer):
    """The logs do not determine a payload's mass."""


def replace_experiment(fault: CannotAnswer, experiment: str) -> CannotAnswer:
    """Return a refusal with another experiment."""
    found = TooLittleTold(fault.code, fault.missing, experiment)
    found.warnings = fault.warnings
    return found


def _identify(
    model: Model,
    body: LinkInertia,
    empty: Sequence[Log],
    loaded: Sequence[Log],
    exclude: tuple[str, ...],
    seed: int,
    progress: Callable[[str], None],
) -> PayloadEstimate:
    without, with_it = _tell_apart(model.robot, empty, loaded)
    of_base = list_base_warnings(model.robot, [*without, *with_it])
    without, with_it = (complete_base(model.robot, some) for some in (without, with_it))
    progress("columns")
    data = Data.of(untie_link(model, body), [*without, *with_it], exclude=exclude)
    said = [*of_base, *data.warnings()]
    _refuse_wrong_wiring(said, model.robot.actuated)
    built = data.build(data.model)
    for logs in (without, with_it):
        refuse_constant_forces(logs, built.regression, model.robot.driven)
    names = {log.name for log in with_it}
    regression = add_payload_columns(model, body, built.regression, names)
    progress("estimate")
    estimate = solve_payload(model, regression)
    found = describe_payload(model, body, estimate, ([log.name for log in without], [log.name for log in with_it]))
    said = [*said, *model.robot.warnings, *built.left_out]
    said += list_information_warnings(built.regression, estimate.base.rank)
    said += _compare_drives(found)
    found = replace(found, warnings=tuple(dict.fromkeys([*said, *_list_warnings(found)])))
    _refuse_undetermined(model, body, found, seed, progress)
    return found


def _refuse_wrong_wiring(warnings: Sequence[str], joints: Sequence[str]) -> None:
    """Refuse forces of another sign, joint or unit: the difference would be reported as a payload, or scale its mass.

    A wrong scale of single joints is compared in `_compare_drives`. If all joints have one, no joint measures the mass.

    Raises:
        InputError: A log has other cabling than the robot file.
    """
    for warning in warnings:
        if not isinstance(warning, CodedWarning):
            continue
        if warning.code in ("sign_reversed", "joints_exchanged"):
            raise InputError(warning.code, warning)
        if warning.code == "scale_wrong" and set(warning.joints) >= set(joints):
            raise InputError(
                warning.code, f"{warning} The payload's mass would be wrong by the same factor. {_CURRENTS}"
            )


def find_carrying_link(robot: Robot, name: str | None) -> LinkInertia:
    """Return the link of a name, or the one that carries the tool.

    Raises:
        InputError: There is no such link, or no single end.
    """
    if name is None:
        body = find_end_link(robot)
        if body is None:
            raise InputError(
                "bad_option",
                f"{robot.name} has several ends; name the link that carries the payload with --link, or --tool",
            )
        return body
    body = next((link for link in robot.links if link.link == name), None)
    if body is None:
        raise UnknownName("link that moves", name, [link.link for link in robot.links])
    return body


def _tell_apart(robot: Robot, empty: Sequence[Log], loaded: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Return the logs with names of their own.

    Raises:
        InputError: One kind is missing, or a log is of both kinds.
    """
    if not empty or not loaded:
        raise InputError("missing_input", "a payload takes logs without it and, after --loaded, logs with it")
    once, held, said = drop_repeated_logs(*(complete_positions(robot, some) for some in (empty, loaded)))
    if said:
        raise InputError("bad_option", f"{said[0].split(';')[0]}; an empty and a loaded log are two recordings")
    require_forces(robot, [*once, *held])
    named = name_apart([*once, *held])
    return named[: len(once)], named[len(once) :]


def untie_link(model: Model, body: LinkInertia) -> Model:
    """Return the model with all ten inertial numbers of a link as columns."""
    robot = model.robot.untied(f"{body.link}.{quantity}" for quantity in INERTIAL)
    return replace(model, robot=robot)


def add_payload_columns(model: Model, body: LinkInertia, regression: Regression, loaded: set[str]) -> Regression:
    """Return the regression with columns for payload and friction differences, from one whose link has all ten columns.

    Args:
        model: The model.
        body: The link that carries the payload.
        regression: Regression of the model with this link untied.
        loaded: Names of the runs with the payload.
    """
    names = regression.parameters.names
    shared = np.zeros((len(names), len(model.parameters)))
    for k, name in enumerate(model.parameters.names):
        shared[names.index(name), k] = 1.0
    ten = [names.index(f"{body.link}.{quantity}") for quantity in INERTIAL]
    own = [model.parameters.names.index(name) for name in body.names]
    shared[np.ix_(ten, own)] = body.map
    extra = list(build_load_parameters())
    columns = list(np.eye(len(names))[ten])
    for joint in model.robot.driven:
        for law in ("coulomb", "viscous"):
            mine = [k for k, name in enumerate(names) if name in _friction_names(joint, law)]
            if mine:
                extra.append(Parameter(f"{joint}.{law}_change", 0.0, model.parameters[names[mine[0]]].unit))
                columns.append(np.isin(range(len(names)), mine).astype(float))
    more = np.column_stack(columns)
    maps = [np.hstack([shared, more * (run.name in loaded)]) for run in regression.runs]
    return regression.combine_columns(model.parameters + Parameters(extra), maps)


def _friction_names(joint: str, law: str) -> tuple[str, ...]:
    return f"{joint}.{law}", f"{joint}.{law}_pos", f"{joint}.{law}_neg"


def solve_payload(model: Model, regression: Regression) -> Estimate:
    """Return the joint estimate, with physically consistent links and payload."""
    return solve_least_squares(regression, physics=constrain_loads(build_physical_constraints(model), [""]))


def describe_payload(
    model: Model, body: LinkInertia, estimate: Estimate, logs: tuple[Sequence[str], Sequence[str]]
) -> PayloadEstimate:
    """Return mass, centre and inertia with their errors, and the tests."""
    robot, base = model.robot, estimate.base
    frame, R, p = find_payload_frame(robot, body)
    kept = [base.names[k] for k in base.kept]
    mine = np.eye(base.rank)[[k for k, name in enumerate(kept) if name.startswith("payload.")]]
    p_value = compute_contrast_p_value(estimate, mine)
    values, stderr, _ = estimate_body(estimate, list_load_names(), R, p)
    mass = float(values[0])
    lever = max(float(np.linalg.norm(values[1:4])), _MIN_LENGTH_M)
    size = np.array([abs(mass), *[lever] * 3, *[float(np.abs(values[4:]).max())] * 6])
    told = np.nan_to_num(stderr, nan=np.inf) < MAX_RELATIVE_STDERR * size
    parts = [
        PropertyEstimate(values[k], stderr[k], unit, bool(told[k].all()))
        for k, unit in ((slice(0, 1), "kg"), (slice(1, 4), "m"), (slice(4, 10), "kg m^2"))
    ]
    plain = float(estimate.beta_plain[kept.index("payload.mass")]) if np.isfinite(stderr[0]) else np.nan
    return PayloadEstimate(
        robot, body.link, frame, parts[0], parts[1], parts[2], plain, 1.0 if p_value is None else p_value,
        _compare_friction(robot, estimate), (tuple(logs[0]), tuple(logs[1])), estimate, (),
    )  # fmt: skip


def _compare_friction(robot: Robot, estimate: Estimate) -> tuple[FrictionDifference, ...]:
    found, kept = [], [estimate.base.names[k] for k in estimate.base.kept]
    for joint in robot.driven:
        names = [f"{joint}.{law}_change" for law in ("coulomb", "viscous")]
        if not all(name in estimate.parameters for name in names):
            continue
        rows = np.eye(len(kept))[[k for k, name in enumerate(kept) if name in names]]
        p = compute_contrast_p_value(estimate, rows)
        corrected = None if p is None else min(1.0, len(robot.driven) * p)
        coulomb, viscous = (estimate.parameters[name] for name in names)
        found.append(FrictionDifference(joint, coulomb, viscous, corrected))
    return tuple(found)


def _compare_drives(found: PayloadEstimate) -> list[str]:
    """Return a warning if the joints disagree about the payload, with the mass by each of them.

    The equations of a floating base hold the forces of several joints, so they compare no single one.
    """
    if not found.differs or not found.mass.values[0] > 0 or found.robot.base_coordinates:
        return []
    gains = compare_drives(found.estimate, list_load_names())
    if gains is None or gains.p_value >= DIFFERENCE_LEVEL or gains.largest_difference < MIN_DRIVE_DIFFERENCE:
        return []
    first, rows = gains.joints[0], zip(gains.joints[1:], gains.factors[1:], gains.stderr[1:], strict=True)
    listed = format_list([f"{joint} {factor:.3g} ± {stderr:.1g}" for joint, factor, stderr in rows])
    sentence = (
        f"the joints disagree about the payload's mass: relative to {first}, the mass is {listed} times as large; divide the "
        "scale of each joint's force column by its factor, and weigh the payload, since a factor of all joints stays unknown"
    )
    return [CodedWarning("scale_wrong", sentence)]


def _list_warnings(found: PayloadEstimate) -> list[str]:
    said = []
    changed = [row.joint for row in found.friction if row.differs]
    if changed:
        said.append(
            f"the friction of {format_list(changed)} differs between empty and loaded logs; each recording has its own in the "
            "estimate, as friction follows load and temperature"
        )
    if found.is_lighter:
        said.append(
            f"the loaded logs are lighter than the empty ones by {-found.plain_mass:.3g} kg; are they exchanged?"
        )
    missing = [name for name, part in (("centre", found.centre), ("inertia", found.inertia)) if not part.determined]
    if found.differs and missing:
        said.append(
            f"these logs do not determine the payload's {' and '.join(missing)}; only a tool that turns, far and fast, would"
        )
    return said


def _refuse_undetermined(
    model: Model, body: LinkInertia, found: PayloadEstimate, seed: int, progress: Callable[[str], None]
) -> None:
    """Refuse logs that do not determine the mass, and propose a motion that does.

    Raises:
        TooLittleTold: The standard error of the mass is too large for an answer.
    """
    stderr, own = float(found.mass.stderr[0]), _compute_own_mass(model)
    allowed = MAX_HIDDEN_SHARE * own / Z95
    if found.differs and found.mass.values[0] > 0:
        allowed = max(MAX_RELATIVE_STDERR * float(found.mass.values[0]), 1e-3 * allowed)
    if stderr < allowed:
        return
    progress("the motion to make")
    told = (
        f"its standard error is {stderr:.2g} kg"
        if np.isfinite(stderr)
        else "no joint feels it by itself in these motions"
    )
    raise TooLittleTold(
        "too_little_data",
        f"the logs do not determine the payload's mass: {told}",
        _propose_motion(model, body, found.estimate.sigma, allowed, seed),
    )


def _compute_own_mass(model: Model) -> float:
    return float(
        sum(model.robot.model_with(model.robot.parameters).inertias[link.joint_id].mass for link in model.robot.links)
    )


def _propose_motion(model: Model, body: LinkInertia, sigma: np.ndarray | None, allowed: float | None, seed: int) -> str:
    """Return which joints to move and how long, from the standard errors predicted for a Fourier motion of 20 s.

    Args:
        model: The model.
        body: The link that carries the payload.
        sigma: Residual deviation of each joint (na,), which enlarges the noise of good drives.
        allowed: Standard error of the mass to reach [kg].
        seed: Seed of the motion and its noise.
    """
    if model.robot.base_coordinates:
        return _WALK
    seconds, named = _EXPERIMENT_S, list(model.robot.actuated)
    try:
        still = model.steady()
        motion = build_fourier_motion(still, _EXPERIMENT_S, seed)
        noise = Noise.typical(still, still.torque(motion.q, motion.v, motion.a), 500.0)
        logs = [replace(predict_ideal_log(still, motion, noise, seed + k), name=str(k)) for k in range(2)]
        data = Data.of(untie_link(still, body), logs)
        estimate = solve_payload(still, add_payload_columns(still, body, data.build(data.model).regression, {"1"}))
        stderr = float(describe_payload(still, body, estimate, (("0",), ("1",))).mass.stderr[0])
        if sigma is not None:
            stderr *= float(np.max(np.maximum(sigma / estimate.sigma, 1.0)))
        if allowed is not None and np.isfinite(stderr):
            seconds = _EXPERIMENT_S * max(1.0, (stderr / allowed) ** 2)
        named = _list_feeling(estimate)
    except TauDynError:
        pass  # the robot cannot make the motion; the advice is then general
    length = 10 * np.ceil(min(seconds, _MAX_EXPERIMENT_S) / 10)
    return (
        f"move {format_list(named)} over their range in both directions for {length:g} s, without and then with the payload, "
        f"such as the motion of tau-dyn excite ROBOT --duration {length:g}"
    )


def _list_feeling(estimate: Estimate) -> list[str]:
    """Return the joints with the most information about a payload's mass."""
    column = estimate.regression.parameters.names.index("payload.mass")
    felt = sum(np.sum((run.W[:, :, column] * run.usable) ** 2, axis=0) for run in estimate.regression.runs)
    share = felt / estimate.sigma**2
    share = share / max(float(share.sum()), 1e-300)
    return [joint for joint, x in zip(estimate.regression.outputs, share, strict=True) if x >= _MIN_JOINT_SHARE]
