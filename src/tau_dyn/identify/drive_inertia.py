"""Which drives' reflected rotor inertia can be told from the bodies' inertia, and so is estimated.

A drive adds `armature * a_J` to its own joint's force. Where this column lies in the span of the bodies' columns (a prismatic
direct drive, the first joint of an arm), no data can separate it: it is part of a body's parameter. Elsewhere it is a parameter
of its own, free unless the robot file or `--fix` gives it. Reference: Gautier & Khalil 1990, on grouping `Ia` with inertias.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.estimate import BaseParameters, find_base
from tau_dyn.model import Model
from tau_dyn.robot import NOT_GIVEN

WITHIN_BODIES = "within "
"""How the `origin` of a drive inertia begins that is part of bodies' parameters; their names follow."""
N_STATES = 60
"""Random states; each gives a row a joint, several times as many as bodies have parameters."""


def free_drive_inertias(model: Model, seed: int = 0) -> Model:
    """Return the model with every drive inertia free that nobody gave and that is separable from the bodies' inertia.

    One that is not separable stays at zero; its `origin` names the parameters that hold it.

    Args:
        model: Any model; drive inertias that its file or its user gave are kept.
        seed: Of the random states at which columns are compared.
    """
    from tau_dyn.identify.structural_identifiability import draw_random_positions  # which knows the words above

    robot, parameters = model.robot, model.parameters
    unknown = [j for j in robot.actuated if parameters[f"{j}.armature"].origin == NOT_GIVEN]
    if not unknown:
        return model
    rng = np.random.default_rng(seed)
    q = draw_random_positions(model, N_STATES, rng)
    v, a = rng.normal(size=(2, *q.shape))
    W = model.mechanism.regressor(q, v, a).reshape(-1, len(robot.parameters))
    names = robot.parameters.names
    bodies = [k for k, name in enumerate(names) if not name.endswith(".armature")]
    changes: dict[str, dict] = {}
    for joint in unknown:
        columns = [*bodies, names.index(f"{joint}.armature")]
        base = find_base(W[:, columns], tuple(names[k] for k in columns))
        free = len(bodies) in base.kept
        changes[f"{joint}.armature"] = {"free": True} if free else {"origin": _describe_holders(base)}
    return replace(model, robot=robot.with_parameters(robot.parameters.update(changes)))


def _describe_holders(base: BaseParameters) -> str:
    """Return which body parameters hold the drive inertia that is the last column, in words."""
    share = base.K[:, -1]
    names = [base.names[base.kept[k]] for k in np.argsort(-np.abs(share)) if share[k]]
    if len(names) == 1:
        return f"{WITHIN_BODIES}{names[0]}"
    links = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return f"{WITHIN_BODIES}the inertia of {', '.join(links)}"
