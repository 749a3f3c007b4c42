"""A model's effects in MuJoCo: elements of the file that are exactly their laws, else a callback in addition to the file.

    quadratic_drag      second coefficient of a joint's `damping`                       MuJoCo 3.7
    cyclic_ripple, cogging  passive `dcmotor` with `cogging`, one per harmonic              4.0
    lugre, hysteresis   passive `dcmotor` with `lugre`, Dahl's law: no damping, static = Coulomb    4.0
    reducer_coupling    `tendon/fixed` of joints in one chain with armature, damping, frictionloss  3.3
    gravity_direction   `option/gravity`; forces at rest are linear in it
    delay               `sensor/actuatorfrc` that shows a drive's force with a delay of at least one step    3.5

Effects that the installed MuJoCo does not support go to the callback if the state determines them. Effects are lost if they
depend on a history, on a load of a loop that is solved numerically or on a temperature, or if they distort only the recording
and not the motion. A delayed sensor shows the force at the joint: the reported force without the drive's constant and gain.

The callback is a Python module that MuJoCo calls in each step; it needs only NumPy and MuJoCo. The force of its effects is

    f = middle + half s,   -1 <= s <= 1,   s = sign(v) if the joint moves

with `lower` and `upper` the effects' forces at sign -1 and +1 as in the simulator, `middle` their mean and `half` half their
difference. `middle` is a passive force. `half` is added to the joint's `frictionloss`, so that MuJoCo's solver determines which
joints stick. If the sum drives the motion, the force at the current direction is used, as in `simulate/forces.py`. Loads use
the acceleration of the last step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from tau_dyn.codegen import (
    Loops,
    draw_random_states,
    find_loops,
    join_names,
    list_unsupported_effects,
    trace_effect_bounds,
    yield_assignments,
)
from tau_dyn.effects import (
    Armature,
    AsymmetricFriction,
    Bristle,
    Cogging,
    CyclicRipple,
    Delay,
    DriveGain,
    Effect,
    GravityDirection,
    Hysteresis,
    Lugre,
    QuadraticDrag,
    ReducerCoupling,
    acts_on_recording,
)
from tau_dyn.equations import TracedFunction
from tau_dyn.exceptions import InputError
from tau_dyn.exchange.content import build_carried_model, list_means
from tau_dyn.mechanism import compute_perpendicular_axes
from tau_dyn.model import Model
from tau_dyn.simulate import SampledForces
from tau_dyn.version import __version__

_STATES, _SEED = 15, 3
_AGREEMENT = 1e-9
"""Largest difference between the traced bounds and the simulator's, relative to the largest: both are exact."""


def write_mujoco_callback(model: Model) -> str:
    """Return the text of a module with `install(model)`, for an MJCF of the same robot.

    Args:
        model: The robot with the effects and values that the MJCF lacks. They may not depend on a history or add to the mass
            matrix.

    Raises:
        InputError: An effect cannot be written as expressions of a state, or its expressions differ from the simulator.
    """
    loops = find_loops(model)
    try:
        part = trace_effect_bounds(model, loops)
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects)
        raise InputError("unsupported", f"{names} cannot be written as a callback: it uses {fault}") from fault
    passive = () if loops is None else tuple(model.robot.model.names[1 + k] for k in loops.passive)
    _compare_with_simulator(model, part, loops)
    outputs = (*part.outputs["lower"], *part.outputs["upper"])
    guards = [f"{'' if answer else 'not '}t{k}" for k, answer in part.graph.guards.items()]
    inputs = {n.args[0].rstrip("0123456789") for n in part.graph.needed(outputs) if n.op == "input"}
    settings = {e: "".join(f", {k} = {x:g}" for k, x in e.settings.items()) for e in model.effects}
    return _MODULE.format(
        robot=model.robot.name,
        version=__version__,
        about="\n".join(f"    {e.name} ({', '.join(e.joints)}{settings[e]}): {e.equation}" for e in model.effects),
        values="\n".join(f"    {p.name} = {p.value:.9g} {p.unit}" for p in model.effect_parameters if p.value),
        joints=model.robot.actuated,
        passive=passive if "p" in inputs else (),
        body="\n".join(f"    {line}" for line in yield_assignments(part.graph, outputs)),
        good=" and ".join(guards) or "True",
        lower=join_names(part.outputs["lower"]),
        upper=join_names(part.outputs["upper"]),
    )


def _compare_with_simulator(model: Model, part: TracedFunction, loops: Loops | None) -> None:
    """Reject expressions that differ from the simulator's bounds at random states."""
    q, v, a = draw_random_states(model, _STATES, np.random.default_rng(_SEED))
    known = {"q": q, "v": v, "a": a}
    if loops is not None:
        known["p"] = np.array([loops.closed(x) for x in q])[:, loops.passive]
    found = part.evaluate(known)
    lower, upper = found["lower"], found["upper"]
    now, pushing = np.where(v > 0, upper, lower), lower > upper
    both = np.stack([np.where(pushing, now, lower), np.where(pushing, now, upper)], axis=1)
    forces = SampledForces(model)
    expected = np.array([forces.bounds(*state) for state in zip(q, v, a, strict=True)])
    difference = np.max(np.abs(both - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
    if not difference < _AGREEMENT:
        raise InputError(
            "unsupported",
            f"{model.robot.source}: the traced effects differ from the simulator's by {difference:.2g}; no callback is written",
        )


_MODULE = '''\
"""Effects of {robot} that its MuJoCo file has no element for, written by tau_dyn {version}.

    model = mujoco.MjModel.from_xml_path(...)
    install(model)

Effects:
{about}
Parameters (their values are folded into the code):
{values}
"""

import mujoco
import numpy as np

JOINTS = {joints}
PASSIVE = {passive}
LEAST = 1e-12  # N or N m; MuJoCo has no row for a joint without any frictionloss
OWN = {{}}  # frictionloss of the file, by the model's signature


def compute_bounds(q, v, a, p):
    """Return the force (na,) [N, N m] that each joint's drive must add when it moves backwards, and forwards.

    q, v and a are the positions, speeds and accelerations of JOINTS, p the positions of PASSIVE.
    """
    with np.errstate(all="ignore"):
{body}
        lower, upper = np.array([{lower}], float), np.array([{upper}], float)
    if not ({good}):
        raise ValueError("a position is out of reach")
    return lower, upper


def install(model):
    """Let MuJoCo call the effects in each step of this model; `mujoco.set_mjcb_passive(None)` ends it."""
    dofs, places = (np.array([adr[model.joint(j).id] for j in JOINTS]) for adr in (model.jnt_dofadr, model.jnt_qposadr))
    others = np.array([model.jnt_qposadr[model.joint(j).id] for j in PASSIVE], int)
    signature = model.signature
    own = OWN.setdefault(signature, model.dof_frictionloss[dofs].copy())
    model.dof_frictionloss[dofs] = np.maximum(own, LEAST)

    def act(model, data):
        if model.signature != signature:
            return
        v = data.qvel[dofs]
        lower, upper = compute_bounds(data.qpos[places], v, data.qacc[dofs], data.qpos[others])
        middle, half = (lower + upper) / 2, own + (upper - lower) / 2
        data.qfrc_passive[dofs] -= np.where(half < 0, middle + half * np.sign(v), middle)
        model.dof_frictionloss[dofs] = np.maximum(half, LEAST)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        data.efc_frictionloss[rows] = model.dof_frictionloss[data.efc_id[rows]]

    mujoco.set_mjcb_passive(act)
'''


TIMESTEP_S = 5e-4
"""Time step in the file [s]: MuJoCo's integrator is of first order; its error is below 0.1 % in 0.5 s of free motion, friction
that stops joints included. With 1 ms it is 0.11 %."""

_SINCE = {
    QuadraticDrag: (3, 7),
    CyclicRipple: (4, 0),
    Cogging: (4, 0),
    Hysteresis: (4, 0),
    Lugre: (4, 0),
    ReducerCoupling: (3, 3),
    GravityDirection: (3, 3),
    Delay: (3, 5),
}
"""First MuJoCo that reads the element of an effect, by its changelog: `damping` with three numbers, `dcmotor` without a motor
constant, delays; 3.3 is the project's oldest MuJoCo."""


@dataclass(frozen=True, eq=False)
class EffectPlaces:
    """The distribution of a model's effects over file and callback.

    Attributes:
        native: Effects with an element in the file, in addition to each joint's law.
        carried: The model with the file's values.
        callback: The callback's text; empty if it is not needed.
        said: Effects in the callback, one sentence each.
        lost: Effects in neither, one sentence each.
        known: The model with the values of file and callback.
    """

    native: tuple[Effect, ...]
    carried: Model
    callback: str
    said: tuple[str, ...]
    lost: tuple[str, ...]
    known: Model


def place_effects(model: Model) -> EffectPlaces:
    """Return the distribution of a model's effects over MJCF file and callback."""
    native = tuple(effect for effect in model.effects if _is_native(effect, model))
    carried = build_carried_model(model, drives=True, more=native)
    rest = model.effect_parameters.values - carried.effect_parameters.values
    change = dict(zip(model.effect_parameters.names, rest, strict=True))
    held, lost = _sort_effects(model, change)
    text, why = _try_callback(model, held, change) if held else ("", "")
    if not text:
        lost, held = {**lost, **dict.fromkeys(held, why)}, []
    parts = [("the difference between directions of " if isinstance(e, AsymmetricFriction) else "", e) for e in held]
    said = [f"{part}effect {e.name} of {', '.join(e.joints)} is in the callback" for part, e in parts]
    sentences = [f"effect {e.name} of {', '.join(e.joints)} is left out: {why}" for e, why in lost.items()]
    sentences += () if text else list_means(model, drives=True)
    gone = {n: carried.effect_parameters[n].value for e in lost for n in e.parameters.names}
    return EffectPlaces(native, carried, text, tuple(said), tuple(sentences), model.with_values(gone))


def _sort_effects(model: Model, change: dict[str, float]) -> tuple[list[Effect], dict[Effect, str]]:
    """Return the effects missing in the file that a callback can hold, and the reasons why it cannot hold the others."""
    missing = dict(list_unsupported_effects(model))
    held, lost = [], {}
    for effect in model.effects:
        if isinstance(effect, Armature | DriveGain) or not any(change[n] for n in effect.parameters.names):
            continue
        if acts_on_recording(effect):
            lost[effect] = "it distorts the recording, not the motion"
        elif effect in missing:
            lost[effect] = f"it feels {missing[effect]}, which a state alone does not give"
        elif why := _try_callback(model, [effect], change)[1]:
            lost[effect] = why
        else:
            held.append(effect)
    return held, lost


def _try_callback(model: Model, effects: list[Effect], change: dict[str, float]) -> tuple[str, str]:
    """Return the callback of effects at the values that the file lacks, or '' and the reason."""
    kept = model.only(effects)
    try:
        return write_mujoco_callback(kept.with_values({n: change[n] for n in kept.effect_parameters.names})), ""
    except InputError as fault:
        return "", str(fault)


def get_mujoco_version() -> tuple[int, ...]:
    """Return the version of the installed MuJoCo, or the oldest supported one if it is not installed."""
    try:
        return tuple(int(x) for x in version("mujoco").split(".")[:2])
    except PackageNotFoundError:
        return (3, 3)


def _is_native(effect: Effect, model: Model) -> bool:
    """Return whether the installed MuJoCo has an element with exactly the effect's law."""
    since = next((first for kind, first in _SINCE.items() if type(effect) is kind), None)
    if since is None or get_mujoco_version() < since:
        return False
    if isinstance(effect, Bristle):
        forces = {j: sum(force for _, force in _list_bristles(model.effects, model, j)) for j in effect.joints}
        return not effect.measured and all(force <= _find_dry(model, j) for j, force in forces.items())
    if isinstance(effect, Delay):
        return _find_delay(effect, model) >= TIMESTEP_S
    if isinstance(effect, ReducerCoupling):
        return _is_chained(model, *effect.joints)
    return not isinstance(effect, GravityDirection) or set(effect.joints) == set(model.robot.actuated)


def _find_delay(effect: Delay, model: Model) -> float:
    """Return the delay of forces [s]."""
    return model.effect_parameters[effect.parameters.names[0]].value


def _is_chained(model: Model, one: str, other: str) -> bool:
    """Return whether one joint moves the other; MuJoCo's mass matrix cannot couple two branches."""
    tree = model.robot.model
    a, b = tree.getJointId(one), tree.getJointId(other)
    return a in tree.supports[b] or b in tree.supports[a]


def _find_dry(model: Model, joint: str) -> float:
    """Return a joint's smaller Coulomb friction [N or N m]."""
    found = model.effect_parameters
    one = found[f"{joint}.coulomb"].value if f"{joint}.coulomb" in found else 0.0
    sides = [found[n].value for n in (f"{joint}.coulomb_pos", f"{joint}.coulomb_neg") if n in found]
    return one + min(sides, default=0.0)


def _list_bristles(effects: Iterable[Effect], model: Model, joint: str) -> list[tuple[float, float]]:
    """Return distance [m or rad] and force [N or N m] of each bristle on a joint."""
    values = model.effect_parameters
    kept = [e for e in effects if isinstance(e, Bristle) and joint in e.joints and not e.measured]
    return [(e.settings["distance"], values[f"{joint}.{e.terms[0][0]}{e.label}"].value) for e in kept]


def compute_gravity(model: Model, places: EffectPlaces) -> np.ndarray:
    """Return gravity (3,) [m/s^2], corrected by the model's gravity direction."""
    gravity = np.asarray(model.robot.model.gravity.linear, float)
    turned = gravity.copy()
    for effect in places.native:
        if isinstance(effect, GravityDirection):
            tilts = model.effect_parameters.select(effect.parameters.names).values
            turned += sum(
                t * np.cross(axis, gravity) for t, axis in zip(tilts, compute_perpendicular_axes(gravity), strict=True)
            )
    return turned


def compute_drag(model: Model, places: EffectPlaces, joint: str) -> float:
    """Return a joint's coefficient of quadratic drag [N s^2/m^2 or N m s^2/rad^2]."""
    drags = [e for e in places.native if isinstance(e, QuadraticDrag) and joint in e.joints]
    return sum(model.effect_parameters[f"{joint}.quadratic_drag{e.label}"].value for e in drags)


def compute_bristle_force(model: Model, places: EffectPlaces, joint: str) -> float:
    """Return the part of a joint's Coulomb friction that its bristles carry [N or N m]."""
    return sum(force for _, force in _list_bristles(places.native, model, joint))


def add_passive_motors(actuator: Element, model: Model, places: EffectPlaces) -> None:
    """Add ripples and bristles as motors without an input, after the drives."""
    passive = {"input": "none", "motorconst": "0", "resistance": "1"}
    count: Counter[str] = Counter()
    for effect in places.native:
        for joint in effect.joints if isinstance(effect, CyclicRipple | Bristle) else ():
            count[joint] += 1
            name = {"name": f"{joint}_{effect.name}_{count[joint]}", "joint": joint}
            if isinstance(effect, Bristle):
                ((distance, force),) = _list_bristles([effect], model, joint)
                law = _write([force / distance, 0, force, force, 1])
                if force:
                    SubElement(actuator, "dcmotor", {**name, **passive, "lugre": law})
                continue
            amounts = [model.effect_parameters[f"{joint}.{term}{effect.label}"].value for term, _ in effect.terms]
            for k in range(1, len(amounts) // 2 + 1):
                sine, cosine = amounts[2 * k - 2 : 2 * k]
                gear, size = 2 * np.pi * k / effect.settings["period"], float(np.hypot(sine, cosine))
                law = _write([size / gear, 1, np.arctan2(cosine, sine) + np.pi])
                if size:
                    wave = {"name": f"{name['name']}_{k}", "joint": joint, "gear": _write([gear])}
                    SubElement(actuator, "dcmotor", {**wave, **passive, "cogging": law})


def add_late_sensors(root: Element, model: Model, places: EffectPlaces) -> None:
    """Add sensors that show the forces of drives with the delay of the log."""
    late = {j: _find_delay(e, model) for e in places.native if isinstance(e, Delay) for j in e.joints}
    sensor = SubElement(root, "sensor") if late else root
    for joint, delay in late.items():
        buffer = {"delay": repr(delay), "nsample": str(int(np.ceil(delay / TIMESTEP_S)) + 2), "interp": "linear"}
        SubElement(sensor, "actuatorfrc", {"name": f"{joint}_force", "actuator": f"{joint}_motor", **buffer})


def add_shared_motors(root: Element, model: Model, places: EffectPlaces, stiff: dict[str, str]) -> None:
    """Add the coupling of two joints by their drives as a fixed tendon."""
    shared = [e for e in places.native if isinstance(e, ReducerCoupling)]
    tendon = SubElement(root, "tendon") if shared else root
    for effect in shared:
        inertia, viscous, coulomb = model.effect_parameters.select(effect.parameters.names).values
        law = {"armature": _write([inertia]), "damping": _write([viscous])}
        if coulomb:
            law |= {"frictionloss": _write([coulomb]), **{f"{key}friction": x for key, x in stiff.items()}}
        fixed = SubElement(tendon, "fixed", {"name": "_".join(effect.joints) + effect.label, **law})
        for joint in effect.joints:
            SubElement(fixed, "joint", joint=joint, coef="1")


def _write(values: list[float]) -> str:
    return " ".join(repr(float(x)) for x in values)
