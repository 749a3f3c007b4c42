"""What any motion could show of a model: the base parameters of random states, and which bodies must stay physical."""

from __future__ import annotations

import numpy as np

from tau_dyn.estimate import BaseParameters, Body, Physics, find_base
from tau_dyn.model import Model

_STATES = 60


def structural_base(model: Model, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the free columns over random motion around home.

    Positions are drawn as far from home as the limits and the loops allow; speeds and accelerations are of order one.
    """
    rng = np.random.default_rng(seed)
    q = random_positions(model, _STATES, rng)
    v, a = rng.normal(size=(2, *q.shape))
    W = model.regressor(q, v, a)
    known = [k for k, p in enumerate(model.parameters) if p.free and p.prior_stderr]
    rows = np.zeros((len(known), W.shape[2]))
    rows[range(len(known)), known] = np.abs(W).max()
    stacked = np.concatenate([W.reshape(-1, W.shape[2]), rows])
    free = model.parameters.free
    names = tuple(n for n, f in zip(model.parameters.names, free, strict=True) if f)
    units = [p.unit for p in model.parameters if p.free]
    return find_base(stacked[:, free], names, units=units)


def random_positions(model: Model, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw actuated positions (count, na) within limits at which the loops close, nearer home where need be."""
    robot = model.robot
    low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - 1.0)
    high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + 1.0)
    found: list[np.ndarray] = []
    reach = 0.8
    while len(found) < count:
        q = robot.home + reach * (rng.uniform(low, high) - robot.home)
        if model.mechanism.reachable(q):
            found.append(q)
        else:
            reach *= 0.9
    return np.array(found)


def physics_of(model: Model) -> Physics:
    """Return the bodies whose inertial numbers must be those of something that exists."""
    return Physics(tuple(Body(link.link, link.names, link.map) for link in model.robot.links))
