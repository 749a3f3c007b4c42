"""What any motion could show of a model: the base parameters of random states, and which bodies must stay physical."""

from __future__ import annotations

import numpy as np

from tau_dyn.estimate import BaseParameters, InertialBody, PhysicalConstraints, find_base
from tau_dyn.identify.drive_inertia import WITHIN_BODIES
from tau_dyn.identify.signals import compute_travel
from tau_dyn.log import differentiate
from tau_dyn.model import Model

_STATES = 60  # random states; several times the rows that a rank needs
_SAMPLES = 2000  # of the random motion


def find_structural_base(model: Model, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the free columns over random motion around home.

    Positions are drawn as far from home as the limits and the loops allow; speeds and accelerations are of order one.
    Effects that a single state does not determine are seen along a smooth random motion instead.
    """
    rng = np.random.default_rng(seed)
    q = draw_random_positions(model, _STATES, rng)
    if len(model.steady().effects) == len(model.effects):
        v, a = rng.normal(size=(2, *q.shape))
        W = model.regressor(q, v, a)
    else:
        W = _along_a_motion(model, q, rng)
    known = [k for k, p in enumerate(model.parameters) if p.free and p.prior_stderr]
    rows = np.zeros((len(known), W.shape[2]))
    rows[range(len(known)), known] = np.abs(W).max()
    stacked = np.concatenate([W.reshape(-1, W.shape[2]), rows])
    free = model.parameters.free
    names = tuple(n for n, f in zip(model.parameters.names, free, strict=True) if f)
    units = [p.unit for p in model.parameters if p.free]
    return find_base(stacked[:, free], names, units=units)


def _along_a_motion(model: Model, reached: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return columns (n, na, p) along sums of sines within the box around home that random positions (N, na) span.

    Speeds and accelerations are differentiated as effects differentiate displacements, so that what is equivalent is
    equal. Temperatures, and the number of the log, change along the way.
    """
    robot, dt = model.robot, 0.005
    t = dt * np.arange(_SAMPLES)
    waves = np.sin(
        2 * np.pi * rng.uniform(0.1, 1.5, (5, robot.na)) * t[:, None, None] + rng.uniform(0, 6, (5, robot.na))
    )
    share = rng.dirichlet(np.ones(5), robot.na).T
    path, reach = np.sum(share * waves, axis=1), np.max(np.abs(reached - robot.home), axis=0)
    while not all(model.mechanism.reachable(q) for q in robot.home + reach * path[:: _SAMPLES // _STATES]):
        reach = 0.9 * reach
    q = robot.home + reach * path
    v = differentiate(q, dt, accuracy=4)
    a = differentiate(v, dt, accuracy=4)
    numbers = np.array(sorted({0.0, *(e.settings["number"] for e in model.effects if "campaign" in e.needs)}))
    signals = {
        "temperature": 30 + 10 * np.sin(0.4 * t[:, None] + np.arange(robot.na)),
        "reversal": np.column_stack([compute_travel(x, y, 0.0) for x, y in zip(q.T, v.T, strict=True)]),
        "campaign": numbers[np.arange(_SAMPLES) % len(numbers)],
    }
    return model.regressor(q, v, a, t=t, signals=signals)[20:-20:5]


def draw_random_positions(model: Model, count: int, rng: np.random.Generator) -> np.ndarray:
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


def build_physical_constraints(model: Model) -> PhysicalConstraints:
    """Return the bodies whose inertial numbers must be those of something that exists, and the rotors that they may hold."""
    rotors = tuple(p.name for p in model.robot.parameters if not p.free and p.origin.startswith(WITHIN_BODIES))
    return PhysicalConstraints(
        tuple(InertialBody(link.link, link.names, link.map) for link in model.robot.links), rotors
    )
