"""Which mass a motion tells, and why link masses and asymmetric friction went wrong in section 6.2.

The plate's column of the regressor is nearly all gravity, so where gravity feels another mass than inertia does, one
`plate_link.mass` answers with gravity's; a second column, `--free plate_link.gravity_mass`, tells the two apart.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from tau_dyn.effects import SymmetricFriction
from tau_dyn.estimate import Estimate
from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import PlantRun
from thesis_6_2_parts.motions import ALONG_X, SIDEWAYS_FAST, SIDEWAYS_SLOW, WELL, fast_and_slow
from thesis_6_2_parts.plant import SEED, closed_form, drive_ideal, model_2, record, robot_l1
from thesis_6_2_parts.printed import CARTS

RODS = ("rod1_link.mass", "rod2_link.mass", "rod3_link.mass")
PLATE = "plate_link.mass"
CASES = {  # motion, friction moment of each ball joint [N m]
    "all axes moved well": (WELL, 0.0),
    "all axes moved well, 1 N m in the ball joints": (WELL, 1.0),
    "mostly along x": (SIDEWAYS_FAST, 0.0),
    "mostly along x, 1 N m in the ball joints": (SIDEWAYS_FAST, 1.0),
    "mostly along x, y and z slow": (SIDEWAYS_SLOW, 0.0),
}


@dataclass(frozen=True)
class TwoMasses:
    """Masses [kg] found on a motion whose gravity feels 22.38 kg and whose inertia feels the nominal masses.

    Attributes:
        one_column: With one plate mass and no rods, as in the thesis: value and standard error.
        inertia: With two columns and the rods known, the plate's mass.
        gravity: With two columns, what gravity feels in all: plate, half the rods, and the extra mass.
        energy: Energy of the plate's column from gravity over that from inertia, by motion.
    """

    one_column: tuple[float, float]
    inertia: tuple[float, float]
    gravity: tuple[float, float]
    energy: dict[str, float]


@dataclass(frozen=True)
class Asymmetry:
    """Asymmetric friction freed although the truth is symmetric, with 3 N m in the ball joints.

    Attributes:
        correlation: Of the plate's mass with each cart's constant offset (3,).
        stderr: Of the plate's mass [kg].
        plain: Plain least-squares values by name [kg, N].
        held: What the library reports instead, within physics.
        warnings: What it says about it.
        symmetric_plate: The plate's mass with symmetric friction on the same log [kg].
    """

    correlation: np.ndarray
    stderr: float
    plain: dict[str, float]
    held: dict[str, float]
    warnings: tuple[str, ...]
    symmetric_plate: float


def two_masses() -> TwoMasses:
    """Simulate and identify a robot with two masses."""
    robot = robot_l1(gravity=True)
    log = record(_drive(robot, WELL, 0.0))
    alone = identify(
        robot, log, model=_symmetric(robot), choices=Choices(fix=("rod*_link.mass=0", "plate_link.gravity_mass=0"))
    )
    choices = Choices(fix=("rod*_link.mass",), free=("plate_link.gravity_mass",))
    both = identify(robot, log, model=_symmetric(robot), choices=choices).estimate
    plate, extra = (both.parameters[n] for n in (PLATE, "plate_link.gravity_mass"))
    rods = sum(robot.parameters[n].value for n in RODS)
    variance = _variance(both, {PLATE: 1.0, "plate_link.gravity_mass": 1.0})
    return TwoMasses(
        _value(alone.estimate, PLATE),
        (plate.value, plate.stderr or np.nan),
        (plate.value + extra.value + rods / 2, float(np.sqrt(variance))),
        {name: _gravity_share(robot, terms) for name, terms in (("well", WELL), ("mostly along x", ALONG_X))},
    )


def link_masses(seeds: int = 20) -> pd.DataFrame:
    """Free the rods' masses with symmetric friction: how many of so many seeds give a negative one by plain least squares."""
    robot, rows = robot_l1(), []
    for case, (terms, moment) in CASES.items():
        run = _drive(robot, terms, moment)
        found = [free_rods(robot, record(run, SEED + k)) for k in range(seeds)]
        plain = np.array([[values[n] for n in RODS] for values, _ in found])
        held = np.array([one.parameters.select(RODS).values for _, one in found])
        row = {"case": case, "any_negative_percent": 100 * np.mean(np.any(plain < 0, axis=1))}
        for k, n in enumerate(RODS):
            row |= {
                f"{n}_truth": robot.parameters[n].value,
                f"{n}_mean": plain[:, k].mean(),
                f"{n}_sd": plain[:, k].std(),
            }
        rows.append(row | {"plate_mean": np.mean([values[PLATE] for values, _ in found]), "held_smallest": held.min()})
    return pd.DataFrame(rows)


def free_asymmetry(terms: tuple = ALONG_X) -> Asymmetry:
    """Free all Coulomb friction; the default motion hardly moves y and z."""
    robot = robot_l1()
    log = record(_drive(robot, terms, 3.0))
    found = identify(robot, log, choices=Choices(fix=("rod*_link.mass=0",)))
    estimate = found.estimate
    offsets = [{f"{j}.coulomb_pos": 0.5, f"{j}.coulomb_neg": -0.5} for j in CARTS]
    of_plate = _variance(estimate, {PLATE: 1.0})
    correlation = [_variance(estimate, {PLATE: 1.0}, o) / np.sqrt(of_plate * _variance(estimate, o)) for o in offsets]
    names = (PLATE, *(f"{j}.coulomb_{s}" for j in CARTS for s in ("pos", "neg")))
    held = {n: found.parameters[n].value for n in names}
    symmetric = identify(robot, log, model=_symmetric(robot), choices=Choices(fix=("rod*_link.mass=0",)))
    plain = {n: _plain(estimate)[n] for n in names}
    return Asymmetry(
        np.array(correlation), np.sqrt(of_plate), plain, held, found.warnings, symmetric.parameters[PLATE].value
    )


def _symmetric(robot: Robot) -> Model:
    """Return symmetric friction alone; `--model symmetric` of the library also has an offset, which the thesis' has not."""
    return Model.of(robot, [SymmetricFriction(robot.actuated, robot.force_units)])


def _drive(robot: Robot, terms: tuple, moment: float) -> PlantRun:
    return drive_ideal(model_2(robot, passive_moment=moment), fast_and_slow(closed_form(robot), terms, "fast and slow"))


def free_rods(robot: Robot, log: Log) -> tuple[dict[str, float], Identification]:
    """Identify all masses with symmetric friction; return plain least squares by name, and what the library makes of it."""
    found = identify(robot, log, model=_symmetric(robot))
    return _plain(found.estimate), found


def _plain(estimate: Estimate) -> dict[str, float]:
    """Return the values of plain least squares, before any bound, by name; the motions here determine every parameter."""
    return {estimate.base.names[c]: float(x) for c, x in zip(estimate.base.kept, estimate.beta_plain, strict=True)}


def _value(estimate: Estimate, name: str) -> tuple[float, float]:
    p = estimate.parameters[name]
    return p.value, p.stderr or np.nan


def _variance(estimate: Estimate, one: dict[str, float], two: dict[str, float] | None = None) -> float:
    """Return the variance of a combination of parameters, or the covariance of two."""
    names = [estimate.base.names[c] for c in estimate.base.kept]
    a, b = (np.array([weights.get(n, 0.0) for n in names]) for weights in (one, one if two is None else two))
    return float(a @ estimate.cov @ b)


def _gravity_share(robot: Robot, terms: tuple) -> float:
    mechanism = closed_form(robot)
    motion = fast_and_slow(mechanism, terms, "fast and slow")
    Y = mechanism.regressor(motion.q, motion.v, motion.a)
    names = robot.parameters.names
    gravity = Y[:, :, names.index("plate_link.gravity_mass")]
    return float(np.sum(gravity**2) / np.sum((Y[:, :, names.index(PLATE)] - gravity) ** 2))
