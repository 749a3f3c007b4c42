"""What is watched: each case returns named numbers (and words), computed from nothing but the library, a seed, and measured logs.

A number's tolerance carries its reason (`REASONS`); what is not listed in a case's `loose` is held to `exact`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.calibrate import PoseSet, calibrate
from tau_dyn.diagnose import diagnose
from tau_dyn.effects import ReducerCoupling, SymmetricFriction, TorqueOffset, build_friction_model
from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.kinematics.workspace import find_workspace
from tau_dyn.log import Log, read_log
from tau_dyn.mechanism import Poses, build_mechanism, forward_kinematics, inverse_kinematics
from tau_dyn.model import Model
from tau_dyn.modes import find_modes
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_named_motion

COLUMNS = Path(__file__).resolve().parents[2] / "identification" / "columns"

REASONS: Mapping[str, tuple[float, str]] = {
    "exact": (0.0, "a count or a name: it is this one or another"),
    "closed": (1e-10, "closed forms and Newton's last step: rounding alone, in another order on another machine"),
    "fit": (1e-6, "least squares and filters: rounding times the condition number, some hundreds, squared at worst"),
    "stderr": (1e-4, "covariances of coloured noise: an order chosen by AIC and sums of many small products"),
    "search": (1e-3, "iterative searches end where their last step is small, not where it is zero"),
    "drawn": (
        0.05,
        "p-values, scores and intervals rest on noise draws, whose matrices are factored anew on each machine",
    ),
}


@dataclass(frozen=True)
class Case:
    """One watched study.

    Attributes:
        compute: From the folder of measured data to named values.
        data: Measured files that it needs.
        kinds: Name's beginning -> kind of tolerance; the longest that fits counts.
        slow: Whether the suite leaves it to `experiments/golden.py`.
    """

    compute: Callable[[Path], dict[str, Any]]
    kinds: Mapping[str, str]
    data: tuple[str, ...] = ()
    slow: bool = False

    def kind(self, name: str) -> str:
        """Return the kind of tolerance of a value."""
        fitting = [key for key in self.kinds if name.startswith(key)]
        return self.kinds[max(fitting, key=len)] if fitting else "exact"


def _identified(found: Identification) -> dict[str, Any]:
    values: dict[str, Any] = {"rank": int(found.estimate.base.rank), "n_samples": int(found.to_dict()["n_samples"])}
    for p in found.parameters:
        if p.stderr is not None:
            values |= {f"value {p.name}": float(p.value), f"stderr {p.name}": float(p.stderr)}
    values["error percent"] = float(found.train.relative_error_percent)
    return values


IDENTIFIED = {"value": "fit", "stderr": "stderr", "error": "fit"}


def emps(data: Path) -> dict[str, Any]:
    """EMPS with asymmetric friction."""
    log = read_log(data / "emps" / "DATA_EMPS.csv", COLUMNS / "emps.yaml")
    return _identified(identify(load_robot("linear_axis"), log))


def tx40(data: Path) -> dict[str, Any]:
    """TX40 with its coupled wrist: base parameters, since single ones cannot be told."""
    robot = load_robot(data / "tx40" / "tx40.urdf")
    log = read_log(data / "tx40", COLUMNS / "tx40.yaml")
    units = robot.force_units
    effects = (
        SymmetricFriction(robot.actuated, units),
        TorqueOffset(robot.actuated, units),
        ReducerCoupling(("joint_5", "joint_6"), units[4:]),
    )
    found = identify(robot, log, model=Model.of(robot, effects), choices=Choices(free=("*.armature",)))
    values = {"rank": int(found.estimate.base.rank), "error percent": float(found.train.relative_error_percent)}
    return values | {f"base {k}": float(x) for k, x in enumerate(found.estimate.beta)}


def daisy(data: Path) -> dict[str, Any]:
    """DaISy's flexible arm, order 4."""
    u, y = np.loadtxt(data / "daisy_robot_arm" / "robot_arm.dat").T
    log = Log(np.arange(float(len(u))), {"torque": u, "acceleration": y}, "robot_arm.dat")
    found = find_modes(log, ["torque"], ["acceleration"], holdout=log, order=4, sensor="acceleration")
    values: dict[str, Any] = {"modes": len(found.modes), "delay": int(found.delay), "fit": float(found.judged.mean)}
    for k, mode in enumerate(found.modes):
        values |= {f"frequency {k}": float(mode.frequency_hz), f"damping {k}": float(mode.damping_ratio)}
    return values


def made_l1(data: Path) -> dict[str, Any]:
    """A made log of the simplified L1, noise drawn by its seed."""
    return _identified(identify(l1(), l1_log(7), model="asymmetric"))


def l1():
    """Return the L1."""
    return load_robot("gantry_tau", prototype="l1")


def l1_log(seed: int, hidden: float = 0.0) -> Log:
    """Return 25 s of the L1 at 250 Hz: 5 N and 5 um of noise, and a peak of `hidden` newtons at low speeds of cart 2."""
    robot = l1()
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units)).with_values(
        {f"{j}.{what}": x for j in robot.actuated for what, x in
         (("coulomb_pos", 40.0), ("coulomb_neg", 44.0), ("viscous_pos", 110.0), ("viscous_neg", 120.0))}
    )  # fmt: skip
    path = build_named_motion("strokes" if hidden else "fourier", model, 25.0, seed).every(4)
    force = model.torque(path.q, path.v, path.a)
    force[:, 1] += hidden * np.sign(path.v[:, 1]) * np.exp(-((path.v[:, 1] / 0.04) ** 2))
    rng = np.random.default_rng(seed)
    q = path.q + 5e-6 * rng.standard_normal(path.q.shape)
    tau = force + 5.0 * rng.standard_normal(force.shape)
    channels = {f"{k}_{j}": x[:, i] for i, j in enumerate(robot.actuated) for k, x in (("q", q), ("tau", tau))}
    return Log(path.t, channels, "made.csv")


def forces(data: Path) -> dict[str, Any]:
    """Inverse dynamics where loops are closed in closed form and through the tree."""
    values = {}
    for name, arguments in (("gantry_tau", {}), ("gantry_tau", {"arms": "complete"}), ("linear_axis", {})):
        robot = load_robot(name, **arguments)
        x = np.linspace(-1, 1, robot.na)
        tau = build_mechanism(robot).inverse_dynamics(robot.home + 0.1 * x, 0.5 * x, 2 - x)
        label = " ".join((name, *arguments.values()))
        values |= {f"{label} {j}": float(t) for j, t in zip(robot.actuated, np.ravel(tau), strict=True)}
    return values


def kinematics(data: Path) -> dict[str, Any]:
    """Forward and inverse kinematics of rods, turning drives and a hexapod."""
    values = {}
    for name in ("gantry_tau", "gantry_tau_f1", "delta", "stewart"):
        robot = load_robot(name)
        home = forward_kinematics(robot, robot.home[None]).poses
        moved = Poses(home.position + [0.02, -0.01, 0.015], home.rotation)
        found = inverse_kinematics(robot, moved)
        values |= {f"{name} {j}": float(x) for j, x in zip(robot.actuated, found.q[0], strict=True)}
    return values


def workspace(data: Path) -> dict[str, Any]:
    """The delta's workspace on a coarse lattice."""
    found = find_workspace(load_robot("delta"), resolution=0.06, seed=1)
    return {"volume": float(found.size.value)}


def calibration(data: Path) -> dict[str, Any]:
    """Poses of an L1 that is as its file says, with 20 um of noise: frames alone are fitted."""
    robot = l1()
    rng = np.random.default_rng(5)
    q = robot.home + 0.4 * (2 * rng.random((60, 3)) - 1)
    place = forward_kinematics(robot, q).poses.position + 2e-5 * rng.standard_normal((60, 3))
    found = calibrate(robot, PoseSet(q, place), model="auto", seed=2).to_dict()
    values: dict[str, Any] = {"chosen": found["chosen"], "rank": found["identifiability"]["rank"]}
    for model in found["models"]:
        values |= {f"{key} of {model['name']}": x for key, x in model["holdout"]["position"].items()}
    return values


def hidden(data: Path) -> dict[str, Any]:
    """A hidden friction peak of 25 N is named, with its size."""
    found = diagnose(l1(), [l1_log(3, hidden=25.0)], seed=4)
    first = found.findings[0]
    values: dict[str, Any] = {"verdict": found.verdict, "cause": first.cause, "joints": " ".join(first.joints)}
    values |= {f"amplitude {p.name.split('.')[-1]}": float(p.value) for p in first.parameters if p.stderr is not None}
    if first.gain is not None:
        values["gain percent"] = float(first.gain.reduction_percent)
    return values


def emps_diagnosed(data: Path) -> dict[str, Any]:
    """EMPS from the symmetric model."""
    log = read_log(data / "emps" / "DATA_EMPS.csv", COLUMNS / "emps.yaml")
    found = diagnose(load_robot("linear_axis"), [log], model="symmetric", seed=0)
    values: dict[str, Any] = {"verdict": found.verdict, "first": found.findings[0].cause}
    values["confirmed"] = " ".join(f.cause for f in found.findings if f.status == "confirmed")
    return values | {
        "error before": float(found.baseline.relative_error_percent),
        "error after": float(found.extended.relative_error_percent),
    }


CASES: dict[str, Case] = {
    "emps": Case(emps, IDENTIFIED, ("emps/DATA_EMPS.csv",)),
    "tx40": Case(tx40, {"base": "fit", "error": "fit"}, ("tx40/tx40.urdf",), slow=True),
    "daisy": Case(
        daisy, {"fit": "search", "frequency": "search", "damping": "search"}, ("daisy_robot_arm/robot_arm.dat",)
    ),
    "made_l1": Case(made_l1, IDENTIFIED),
    "forces": Case(forces, {"": "closed"}),
    "kinematics": Case(kinematics, {"": "closed"}),
    "workspace": Case(workspace, {"volume": "search"}),
    "calibration": Case(calibration, {"mean": "search", "rms": "search", "max": "search"}),
    "hidden": Case(hidden, {"amplitude": "search", "gain": "search"}, slow=True),
    "emps_diagnosed": Case(emps_diagnosed, {"error": "search"}, ("emps/DATA_EMPS.csv",), slow=True),
}
