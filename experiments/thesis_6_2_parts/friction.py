"""The friction experiments: 15 speeds both ways at five positions (Figures 6.2 to 6.4, Table 6.1), and what gravity they tell."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.log import Log
from thesis_6_2_parts.gravity import levers
from thesis_6_2_parts.motions import SPEEDS, strokes
from thesis_6_2_parts.plant import SEED, closed_form, drive_ideal, record, robot_l1, table_6_1_model
from thesis_6_2_parts.printed import CARTS, GRAVITY_MASS, SYMBOLS, TABLE_6_1, G

GIVEN = Choices(fix=("*_link.mass", "plate_link.gravity_mass"))
FREE = Choices(fix=("*_link.mass",), free=("plate_link.gravity_mass",))


@dataclass(frozen=True)
class FrictionStudy:
    """What the friction experiments tell.

    Attributes:
        forces: Mean force of each cart [N] at each position, speed and direction.
        table_6_1: Coefficients found at the star with gravity given, one row a cart.
        star: The identification behind it.
        free_at_star: Standard error of the gravity mass [kg] where it is free with the star's log alone; None: not seen.
        free_everywhere: Gravity mass and its standard error [kg] from all five positions, Coulomb friction free.
    """

    forces: pd.DataFrame
    table_6_1: pd.DataFrame
    star: Identification
    free_at_star: float | None
    free_everywhere: tuple[float, float]


def study(fitted: np.ndarray) -> FrictionStudy:
    """Simulate and identify the experiments at the fitted positions (5, 2) [m]."""
    robot = robot_l1(gravity=True)
    logs = [
        experiment(name, tuple(place), SEED + k) for k, (name, place) in enumerate(zip(SYMBOLS, fitted, strict=True))
    ]
    forces = pd.concat([_means(log) for log in logs], ignore_index=True)
    lever = dict(zip(SYMBOLS, levers(closed_form(robot), fitted), strict=True))
    for k, j in enumerate(CARTS):
        compensation = [G * GRAVITY_MASS * (lever[s][k] - lever["*"][k]) for s in forces["position"]]
        forces[f"{j}_compensated_N"] = forces[f"{j}_N"] - compensation
    star = identify(robot, logs[0], choices=GIVEN, exclude=("ramp",))
    alone = identify(robot, logs[0], choices=FREE, exclude=("ramp",)).parameters["plate_link.gravity_mass"]
    together = identify(robot, logs, choices=FREE, exclude=("ramp",)).parameters["plate_link.gravity_mass"]
    moving = GRAVITY_MASS - robot.parameters["plate_link.gravity_mass"].value
    return FrictionStudy(
        forces, _coefficients(star), star, alone.stderr, (together.value + moving, together.stderr or np.nan)
    )


def experiment(name: str, place: tuple[float, float], seed: int = SEED, speeds: tuple[float, ...] = SPEEDS) -> Log:
    """Return the strokes at a position; the column `ramp` is zero where all carts move steadily."""
    model = table_6_1_model(robot_l1(gravity=True))
    motion, steady = strokes(closed_form(model.robot), place, name, speeds)
    log = record(drive_ideal(model, motion), seed)
    return log.with_channels(ramp=1.0 - np.interp(log.t, motion.t, steady))


def _means(log: Log) -> pd.DataFrame:
    v = np.gradient(log.joint("q_ref", CARTS)[:, 0], log.t)
    rows = []
    for speed in (*(-s for s in SPEEDS[::-1]), *SPEEDS):
        here = (log.channels["ramp"] == 0) & (np.abs(v - speed) < 1e-6)
        mean = log.joint("tau", CARTS)[here].mean(axis=0)
        rows.append(
            {"position": log.name, "speed_m_per_s": speed} | {f"{j}_N": x for j, x in zip(CARTS, mean, strict=True)}
        )
    return pd.DataFrame(rows)


def _coefficients(found: Identification) -> pd.DataFrame:
    rows = []
    for k, j in enumerate(CARTS):
        for name, printed in TABLE_6_1.items():
            p = found.parameters[f"{j}.{name}"]
            rows.append(
                {"parameter": p.name, "unit": p.unit, "ours": p.value, "stderr": p.stderr, "thesis": printed[k]}
            )
    return pd.DataFrame(rows)
