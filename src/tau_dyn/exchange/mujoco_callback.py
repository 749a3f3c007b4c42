"""Effects of a state as a Python module that MuJoCo calls in each step; it needs NumPy and MuJoCo alone.

    f = middle + half s,   -1 <= s <= 1,   s = sign(v) where the joint moves

with `lower` and `upper` the effects' forces at sign -1 and +1 as the simulator asks for them, `middle` their mean and `half` half
their difference. `middle` is a passive force. `half` comes upon the joint's `frictionloss`, so that MuJoCo's solver finds who
sticks. Where the sum pushes forwards, the force at the current direction is taken, as in `simulate/forces.py`. Loads take the
acceleration of the last step.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.codegen import (
    Loops,
    TracedFunction,
    draw_random_states,
    find_loops,
    join_names,
    trace_effect_bounds,
    yield_assignments,
)
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.simulate import SampledForces
from tau_dyn.version import __version__

_STATES, _SEED = 15, 3
_AGREEMENT = 1e-9
"""Largest difference between the traced bounds and the simulator's, relative to the largest: both are exact."""


def write_mujoco_callback(model: Model) -> str:
    """Return a module with `install(model)`, for an MJCF of the same robot.

    Args:
        model: The robot with the effects, at the values, that the MJCF lacks. None of them may feel a history or add to the
            mass matrix.

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
    """Refuse expressions that differ from the simulator's bounds at random states."""
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
