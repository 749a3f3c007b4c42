"""The robot that learns: the flexible L1 with wrist behind drives (6.11), its square, and models identified on it."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from ilc_parts.learning_plant import LearningPlant, Trial, square_path
from scipy.signal import max_len_seq
from thesis_6_3_parts.printed import DRIVE_SAMPLES, DRIVES
from thesis_6_3_parts.robots import kinematics, with_wrist

from tau_dyn.control.iterative import Reference
from tau_dyn.mechanism import L1_DRIVES
from tau_dyn.modes import Actuator, Record, StateSpace, compress_subspace_data, refine
from tau_dyn.modes.state_space import simulate

DT = 0.004  # s
VELOCITY_SHARE = 0.5  # assumed: (6.11) alone is "too slow" for this motion (thesis 6.3)
JERK_TIME, PAUSE = 0.06, 0.15  # s; so that two rounds take 1.2 to 4.5 s, as Figure 7.8 has them
START, FIRST, LAST = 1.2, 400, 1025  # s; samples: 1.6 to 4.1 s
ORDER_REFERENCE, ORDER_COMPUTED, ORDER_KINEMATICS = 9, 4, 10
AXES = (0, 1)


def plant(seed: int, velocity_share: float = VELOCITY_SHARE) -> LearningPlant:
    return LearningPlant(with_wrist(), kinematics(), L1_DRIVES, DT, velocity_share, seed=seed)


def motion(of: LearningPlant, speed: float = 0.1) -> Reference:
    """The 10 mm square; at a lower speed the part that is learnt is longer by as much."""
    edge = 0.01 / speed + speed + JERK_TIME + PAUSE
    later = round(8 * (edge - 0.41) / DT)
    path = square_path(1400 + later, DT, speed=speed, jerk_time=JERK_TIME, pause=PAUSE, start=START)
    tool = of.rest + path
    return Reference(DT, of.actuators(tool), tool, FIRST, LAST + later)


def printed_actuators() -> list[Actuator]:
    """(6.11)."""
    return [Actuator.from_discrete(b, a, DRIVE_SAMPLES, DT) for b, a in DRIVES.values()]


@dataclass(frozen=True, eq=False)
class Models:
    """From the tool's reference to tool and computed tool, from the computed tool to the tool; and held-out fits [%]."""

    reference_to_tool: StateSpace
    reference_to_computed: StateSpace
    computed_to_tool: StateSpace
    fit: dict[str, np.ndarray]


@cache
def models(seed: int) -> Models:
    """Identify all three from 80 s of binary sequences added to the tool's reference in the plane."""
    robot = plant(seed)
    train, test = _shaken(robot, 20_000, 1), _shaken(robot, 6_000, 2)
    found, fit = {}, {}
    for name, u, y, order, delay in (
        ("reference_to_tool", 0, 2, ORDER_REFERENCE, DRIVE_SAMPLES - 1),
        ("reference_to_computed", 0, 1, ORDER_COMPUTED, DRIVE_SAMPLES - 1),
        ("computed_to_tool", 1, 2, ORDER_KINEMATICS, 0),
    ):
        data, held = (Record(x[u], x[y], DT, ("x", "y"), ("x", "y"), name) for x in (train, test))
        found[name] = refine(compress_subspace_data([data], delay=delay).model(order), [data]).model
        left = held.y - simulate(found[name], held)
        fit[name] = 100 * (1 - np.linalg.norm(left, axis=0) / np.linalg.norm(held.y - held.y.mean(axis=0), axis=0))
    return Models(**found, fit=fit)


def _shaken(robot: LearningPlant, n: int, which: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reference, computed tool and measured tool (N, 2), less the rest."""
    bits = 2.0 * max_len_seq(13)[0] - 1
    shift = np.random.default_rng([robot.seed, which]).integers(len(bits), size=2) + [0, 4000]
    moved = np.column_stack([np.repeat(np.roll(bits, s)[: -(-n // 4)], 4)[:n] for s in shift]) * 1e-3
    moved[:2] = 0
    tool = np.tile(robot.rest, (n, 1))
    tool[:, AXES] += moved
    trial: Trial = robot.run(robot.actuators(tool), 10_000 + which)
    return moved, (trial.kinematic - robot.rest)[:, AXES], (trial.tool - robot.rest)[:, AXES]
