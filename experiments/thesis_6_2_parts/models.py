"""Models 1 to 4 of Table 6.3, each one set of `--fix`, and their validation on a slow 1 cm circle (Figures 6.5 to 6.7).

All four are one model file with symmetric and asymmetric friction side by side, of which each keeps a part:

    tau-dyn identify gantry_tau log.csv --set rod_mass_model=point --model both.yaml --fix 'rod*_link.mass=0' --fix ...
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from tau_dyn.effects import AsymmetricFriction, SymmetricFriction
from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import PlantRun
from thesis_6_2_parts.motions import CIRCLE, RISE, WELL, fast_and_slow, small_circle
from thesis_6_2_parts.plant import (
    FLOOR,
    SENSORS,
    STRIBECK_SHARE,
    closed_form,
    drive_ideal,
    fixes,
    model_2,
    record,
    robot_l1,
)
from thesis_6_2_parts.printed import CARTS, TABLE_6_1, TABLE_6_3

NO_RODS = ("rod*_link.mass=0",)
OLD_COULOMB = fixes({f"{j}.{q}": TABLE_6_1[q][k] for k, j in enumerate(CARTS) for q in ("coulomb_pos", "coulomb_neg")})
OLD_VISCOUS = fixes({f"{j}.{q}": TABLE_6_1[q][k] for k, j in enumerate(CARTS) for q in ("viscous_pos", "viscous_neg")})
MODELS = {  # what each model of Table 6.3 fixes
    1: (*NO_RODS, "*.viscous*=0", "*.coulomb_*=0"),
    2: (*NO_RODS, "*.viscous_*=0", "*.coulomb_*=0"),
    3: (*NO_RODS, "*.coulomb=0", "*.viscous=0", *OLD_COULOMB, *OLD_VISCOUS),
    4: (*NO_RODS, "*.viscous=0", "*.coulomb_*=0", *OLD_VISCOUS),
}


@dataclass(frozen=True)
class ModelStudy:
    """Table 6.3 on simulated logs.

    Attributes:
        table: One row a model and cart: values, residual, thesis' values.
        known_rods: Plate mass [kg] that model 2 finds when the rods' nominal masses are kept.
        found: The four identifications on the log with 5 N of noise.
    """

    table: pd.DataFrame
    known_rods: float
    found: dict[int, Identification]

    def order(self, cart: str, column: str = "e_N2") -> tuple[int, ...]:
        """Return the models from best to worst fit of a cart."""
        rows = self.table[self.table["cart"] == cart].sort_values(column)
        return tuple(rows["model"])


@dataclass(frozen=True)
class CircleStudy:
    """The 1 cm circle, predicted by model 2 that was identified on the fast and slow motion of the same robot.

    Attributes:
        identified: Model 2.
        log: The circle's log, without its fading ends.
        measured: Forces (N, 3) [N].
        modelled: Model 2 with speeds from differences of the measured positions (N, 3) [N], as the thesis had them.
        speed: Speeds without that noise (N, 3) [m/s].
        misfit: rms of measured minus modelled force where the speed's sign is sure (3,) [N].
        flips: Sign changes of each cart's differenced speed.
        reversals: True ones.
    """

    identified: Identification
    log: Log
    measured: np.ndarray
    modelled: np.ndarray
    speed: np.ndarray
    misfit: np.ndarray
    flips: np.ndarray
    reversals: np.ndarray


def both_frictions(robot: Robot) -> Model:
    """Return the model that holds all frictions of Table 6.3."""
    joints, units = robot.actuated, robot.force_units
    return Model.of(robot, [SymmetricFriction(joints, units), AsymmetricFriction(joints, units)])


def fit(log: Log, number: int, *, holdout: tuple[Log, ...] = (), rods_known: bool = False) -> Identification:
    """Identify a model of Table 6.3; the rods' masses are left out as in the thesis, or kept at their nominal values."""
    robot = robot_l1()
    fix = MODELS[number][1:] + ("rod*_link.mass",) if rods_known else MODELS[number]
    return identify(robot, log, holdout=holdout, model=both_frictions(robot), choices=Choices(fix=fix))


def table_6_3() -> ModelStudy:
    """Simulate the fast and slow motion with model 2's friction and fit all four models, without and with a floor of 50 N."""
    robot = robot_l1()
    run = drive_ideal(model_2(robot), fast_and_slow(closed_form(robot), WELL, "fast and slow"))
    log = record(run)
    found = {number: fit(log, number) for number in MODELS}
    floor = {number: fit(record(run, sensors=FLOOR), number) for number in MODELS}
    known = fit(log, 2, rods_known=True)
    return ModelStudy(_rows(found, floor), known.parameters["plate_link.mass"].value, found)


def circle(stribeck: float = STRIBECK_SHARE) -> CircleStudy:
    """Identify a robot with this Stribeck share on the fast and slow motion, and predict its circle."""
    robot = robot_l1()
    mechanism, truth = closed_form(robot), model_2(robot, stribeck=stribeck)
    turns = drive_ideal(truth, small_circle(mechanism))
    log = _without_ends(record(turns))
    training = record(drive_ideal(truth, fast_and_slow(mechanism, WELL, "fast and slow")))
    found = fit(training, 2, holdout=(log,))
    step = round(1 / (float(turns.t[1] - turns.t[0]) * float(SENSORS.log_rate_hz or 0)))
    clean = _cut(turns.every(step))
    q = log.joint("q", CARTS)
    noisy = np.gradient(q, log.t, axis=0)
    assert found.holdout is not None
    return CircleStudy(
        identified=found,
        log=log,
        measured=log.joint("tau", CARTS),
        modelled=found.model.torque(q, noisy, clean.a),
        speed=clean.v,
        misfit=found.holdout.rms,
        flips=_sign_changes(noisy),
        reversals=_sign_changes(clean.v),
    )


def _rows(found: dict[int, Identification], floor: dict[int, Identification]) -> pd.DataFrame:
    """Return the table; `e_N2` sums squared residuals over the samples that every model's fit uses."""
    rows = []
    for number, one in found.items():
        plate, carts, coulomb, viscous, e = TABLE_6_3[number]
        for k, j in enumerate(CARTS):
            p = {q: one.parameters[f"{j}.{q}"] for q in ("coulomb", "viscous")}
            free = {q: x.value if x.free else np.nan for q, x in p.items()}
            rows.append({
                "model": number, "cart": j,
                "plate_kg": one.parameters["plate_link.mass"].value, "plate_thesis": plate,
                "cart_kg": one.parameters[f"{j}_link.mass"].value, "cart_thesis": carts[k],
                "coulomb_N": free["coulomb"], "coulomb_thesis": coulomb[k],
                "viscous_Ns_per_m": free["viscous"], "viscous_thesis": viscous[k],
                "e_N2": _squares(one)[k], "e_ratio": _squares(one)[k] / _squares(found[2])[k],
                "e_ratio_floor": _squares(floor[number])[k] / _squares(floor[2])[k], "e_floor_N2": _squares(floor[number])[k],
                "e_ratio_thesis": e[k] / TABLE_6_3[2][4][k], "e_thesis_1e7": e[k],
            })  # fmt: skip
    return pd.DataFrame(rows)


def _squares(found: Identification) -> np.ndarray:
    usable = sum(run.usable.sum(axis=0) for run in found.estimate.regression.runs)
    return found.train.rms**2 * usable


def _without_ends(log: Log) -> Log:
    radius, period, turns = CIRCLE
    return log.select_time(RISE, RISE + period * turns)


def _cut(run: PlantRun) -> PlantRun:
    radius, period, turns = CIRCLE
    start, stop = np.searchsorted(run.t, RISE, "left"), np.searchsorted(run.t, RISE + period * turns, "right")
    part = {key: getattr(run, key)[start:stop] for key in ("t", "q", "v", "a", "tau", "stuck")}
    return replace(run, **part, reference=None)


def _sign_changes(v: np.ndarray) -> np.ndarray:
    """Return how often each column changes its sign; zeros do not count."""
    return np.array([np.sum(np.diff(np.sign(x[x != 0])) != 0) for x in v.T])
