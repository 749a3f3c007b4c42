"""Which drives' reflected rotor inertia can be told from the bodies' inertia, and so is estimated.

A drive adds `armature * a_J` to its own joint's force. Where this column lies in the span of the bodies' columns (a prismatic
direct drive, the first joint of an arm), no data can separate it: it is part of a body's parameter. Elsewhere it is a parameter
of its own, free unless the robot file or `--fix` gives it. Reference: Gautier & Khalil 1990, on grouping `Ia` with inertias.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.estimate import unit_columns
from tau_dyn.model import Model
from tau_dyn.robot import NOT_GIVEN

MIN_RELATIVE_RESIDUAL = 1e-6
"""Part of a unit column that the bodies must leave for a parameter of its own; the tolerance of the base parameters."""
N_STATES = 60
_MIN_SHARE = 1e-3
"""Part of a drive's unit column below which a body's column has no share in it worth a word."""


def free_drive_inertias(model: Model, seed: int = 0) -> Model:
    """Return the model with every drive inertia free that nobody gave and that is separable from the bodies' inertia.

    One that is not separable stays at zero; its `origin` names the parameters that hold it.

    Args:
        model: Any model; drive inertias that its file or its user gave are kept.
        seed: Of the random states at which columns are compared.
    """
    from tau_dyn.identify.structure import random_positions

    robot, parameters = model.robot, model.parameters
    unknown = [j for j in robot.actuated if parameters[f"{j}.armature"].origin == NOT_GIVEN]
    if not unknown:
        return model
    rng = np.random.default_rng(seed)
    q = random_positions(model, N_STATES, rng)
    v, a = rng.normal(size=(2, *q.shape))
    W = model.mechanism.regressor(q, v, a).reshape(-1, len(robot.parameters))
    bodies = [k for k, name in enumerate(robot.parameters.names) if not name.endswith(".armature")]
    B, _ = unit_columns(W[:, bodies])
    changes: dict[str, dict] = {}
    for joint in unknown:
        name = f"{joint}.armature"
        column = W[:, robot.parameters.names.index(name)]
        column = column / np.linalg.norm(column)
        share = np.linalg.lstsq(B, column, rcond=1e-10)[0]
        separable = float(np.linalg.norm(column - B @ share)) > MIN_RELATIVE_RESIDUAL
        holders = [robot.parameters.names[bodies[k]] for k in np.flatnonzero(np.abs(share) > _MIN_SHARE)]
        changes[name] = {"free": True} if separable else {"origin": _describe_holders(holders)}
    return replace(model, robot=robot.with_parameters(robot.parameters.update(changes)))


def _describe_holders(names: list[str]) -> str:
    """Return which body parameters hold a drive inertia, in words."""
    if len(names) == 1:
        return f"within {names[0]}"
    links = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return f"within the inertia of {', '.join(links)}"
