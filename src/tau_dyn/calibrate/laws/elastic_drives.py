r"""Elastic drives and joints under their static load, in any robot, with or without loops.

A drive of compliance `c` deflects by `e = c Q(q + e)`, with `Q` the generalised force of all loads by virtual work over the
robot's kinematics with closed loops: with `A_b = m_b dp_b/dq` of body b's centre of mass (`WeightArms`), `J` the tool's Jacobian,
`m` the mass at the tool and `w` the force and moment on it,

    Q = sum_b (1 + e_b) A_b' g + m J_v' g + J' w.

`Q` is exact at the commanded positions and linear in `e` about them, which leaves out `c Q'' e^2 / 2`: 0.1 um of an arm that sags
by 5 mm. So `e = (1 - c Q')^-1 c Q`, with `Q'` by central differences.

If the load at the tool is unknown, `e = c Q + d Q_1` with `Q_1` the force of 1 kg there. The file's masses are known to
`BodyPrior.rough` only, and the base is level within the prior of all angles, because the device's frame absorbs its tilt `t`:
gravity is `g + t x g`. The relative errors `e_b` and `t` are unknowns with these priors. Without known loads poses determine only
the product of compliance and mass; known loads determine both.

Forces are those of the robot file's dimensions. Calibrated placements would make the direction of a link's centre of mass a
parameter: an offset and the next joint's place turn a link in its own frame without moving the tool.
Reference: Khalil & Besnard 2002; Khalil & Dombre 2002, ch. 9.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.laws.displaced_geometry import MovedJoints
from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.mechanism import TreeMechanism, WeightArms
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import ROUGH_FILE, BodyPrior

MAX_DEFLECTION = 0.01
"""Prior standard deviation of a machine's deflection [rad or m]."""
_TRIED = 50
"""Number of positions at which the load of a joint is computed."""
_NO_FORCE = 1e-9
"""Force relative to the largest one, or to 1 N m, that is rounding."""
_STEP = 1e-4
"""[rad or m] of central differences: closures end at 1e-12, forces curve over tenths of a radian."""
_REMEMBERED = 4
"""Sets of positions whose forces are kept: those of training, held-out and screened poses."""
_TILTS = ("base.tilt_x", "base.tilt_y", "base.tilt_z")
"""Rotation vector by which gravity is turned in the base frame [rad], without the component along gravity: it has no effect."""
_LEVEL = 1e-6
"""Share of gravity across an axis that is rounding."""


class Statics(NamedTuple):
    """Factors of the loads at given positions; the last body index is 1 kg at the tool.

    Attributes:
        arms: `A_b` (N, na, b + 1, 3) [kg m] of a rotary joint, [kg] of a slide.
        arm_slopes: Their derivative by the actuated positions (N, na, b + 1, na, 3).
        jacobian: The tool's twist per actuated speed (N, 6, na).
        jacobian_slopes: Its derivative (N, 6, na, na).
    """

    arms: np.ndarray
    arm_slopes: np.ndarray
    jacobian: np.ndarray
    jacobian_slopes: np.ndarray


class StaticForces:
    """Loads of one robot at its file's dimensions; remembers the last requested positions."""

    def __init__(self, nominal: Geometry) -> None:
        """Prepare for a robot with the geometry of its file."""
        self.robot = robot = nominal.robot
        self.gravity = np.asarray(robot.model.gravity.linear, float)
        self._nominal, self._mechanism = nominal, TreeMechanism(robot)
        self._known: OrderedDict[bytes, Statics] = OrderedDict()

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Joints that carry the bodies (b,)."""
        return self._mechanism.weight_arms(self.robot.home[None]).bodies

    def at(self, q: np.ndarray) -> Statics:
        """Return the statics at positions (N, na); zeros if the loops do not close."""
        key = q.tobytes()
        if key not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.popitem(last=False)
            self._known[key] = self._measure(q)
        self._known.move_to_end(key)
        return self._known[key]

    def weigh(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first moments of all masses and of 1 kg at the tool about the base's origin (N, 3) each [kg m]."""
        return self._weigh(q).places.sum(axis=1), self._nominal.forward(
            self._nominal.parameters.values, q
        ).poses.position

    def _measure(self, q: np.ndarray) -> Statics:
        n, na = q.shape
        steps = _STEP * np.concatenate([np.zeros((1, na)), np.eye(na), -np.eye(na)])
        rows = (q + steps[:, None]).reshape(-1, na)
        theta = self._nominal.parameters.values
        poses = self._nominal.forward(theta, rows).poses
        jacobian = np.nan_to_num(self._nominal.tool_by_joint(theta, rows, poses))
        bodies = np.concatenate([self._weigh(rows).rates, np.swapaxes(jacobian[:, :3], 1, 2)[:, :, None]], axis=2)
        arms, jacobian = bodies.reshape(len(steps), n, *bodies.shape[1:]), jacobian.reshape(len(steps), n, 6, na)
        by_arm, by_jacobian = ((x[1 : 1 + na] - x[1 + na :]) / (2 * _STEP) for x in (arms, jacobian))
        return Statics(arms[0], by_arm.transpose(1, 2, 3, 0, 4), jacobian[0], by_jacobian.transpose(1, 2, 3, 0))

    def _weigh(self, q: np.ndarray) -> WeightArms:
        """Return the factors of gravity, zeros if the loops do not close."""
        try:
            return self._mechanism.weight_arms(q)
        except LoopClosureError:
            rows = [self._mechanism.weight_arms(x[None]) if self._mechanism.reachable(x) else None for x in q]
        zero = self._mechanism.weight_arms(self.robot.home[None])
        places, rates = (
            np.concatenate([np.zeros_like(getattr(zero, name)) if x is None else getattr(x, name) for x in rows])
            for name in ("places", "rates")
        )
        return WeightArms(zero.bodies, places, rates)


@dataclass(frozen=True)
class ElasticDrive:
    """An elastic drive or joint.

    Attributes:
        joint: Joint name.
        actuator: Index of the joint.
        unit: Unit of the joint.
        name: Name of its compliance.
        size: Largest force that it holds [N m or N], 0 if unknown.
        load_size: Largest force of an unknown 1 kg at the tool [N m or N]; 0 if the load is known.
        bodies: Joints whose bodies' masses load it.
    """

    joint: str
    actuator: int
    unit: str
    name: str
    size: float
    load_size: float = 0.0
    bodies: tuple[str, ...] = ()

    @property
    def parameters(self) -> Parameters:
        """The compliance, and the deflection by an unknown load at the tool."""
        force = "N" if self.unit == "m" else "N m"
        rows = [(self.name, f"{self.unit}/({force})" if " " in force else f"{self.unit}/{force}", self.size)]
        rows += [("load_deflection", f"{self.unit} kg/({force})", self.load_size)] if self.load_size > 0 else []
        return Parameters(
            Parameter(
                f"{self.joint}.{name}",
                0.0,
                unit,
                prior_stderr=MAX_DEFLECTION / size if size > 0 else None,
                origin="law",
            )
            for name, unit, size in rows
            if size > 0 or self.load_size == 0
        )


class _Pull(NamedTuple):
    """Generalised force of all loads (N, na), of an unknown 1 kg at the tool (N, na), and their slopes (N, na, na)."""

    force: np.ndarray
    unit: np.ndarray
    slope: np.ndarray
    unit_slope: np.ndarray


class _State(NamedTuple):
    """Values by actuator: compliances (na,) and deflections by 1 kg (na,); relative mass errors (b,); gravity (3,)."""

    c: np.ndarray
    d: np.ndarray
    errors: np.ndarray
    gravity: np.ndarray


@dataclass(frozen=True, eq=False)
class ElasticDrives:
    """All elastic drives of a robot, as `JointDisplacement`.

    Attributes:
        statics: The loads.
        drives: The drives.
        masses_known: Whether the file's masses and a level base count as exact.
    """

    statics: StaticForces
    drives: tuple[ElasticDrive, ...]
    masses_known: bool = False

    beyond_file = ""

    @property
    def parameters(self) -> Parameters:
        """The drives' parameters, then the relative errors of the masses that load them, and the base's tilt."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        masses = [
            Parameter(f"{body}.mass_error", 0.0, "1", prior_stderr=share, origin="law")
            for body, share in self._mass_shares.items()
        ]
        tilts = [Parameter(_TILTS[axis], 0.0, "rad", origin="law") for axis in self._tilts]
        return Parameters([*(p for drive in self.drives for p in drive.parameters), *masses, *tilts])

    @property
    def known_beforehand(self) -> np.ndarray:
        """Which parameters (p,) have prior knowledge: masses and tilt."""
        known = len(self._bodies) + len(self._tilts)
        return np.arange(len(self.parameters)) >= len(self.parameters) - known

    @cached_property
    def _bodies(self) -> tuple[str, ...]:
        """Joints whose bodies load an elastic joint, each once; empty if masses are known."""
        return () if self.masses_known else tuple(dict.fromkeys(b for drive in self.drives for b in drive.bodies))

    @property
    def _mass_shares(self) -> dict[str, float]:
        """Standard deviation of the mass of each of these bodies, relative to the robot file's."""
        robot = self.statics.robot
        known = BodyPrior.of(robot).rough
        stated = {
            str(robot.model.names[link.joint_id]): known[f"{link.link}.mass"] / float(link.nominal[0])
            for link in robot.links
            if f"{link.link}.mass" in known and link.nominal[0] > 0
        }
        return {body: stated.get(body, ROUGH_FILE) for body in self._bodies}

    @cached_property
    def _tilts(self) -> tuple[int, ...]:
        """Axes about which a tilt of the base turns gravity."""
        if self.masses_known:
            return ()
        gravity = self.statics.gravity
        across = np.linalg.norm(np.cross(np.eye(3), gravity), axis=1)
        return tuple(np.flatnonzero(across > _LEVEL * np.linalg.norm(gravity)).tolist())

    def move(self, values: np.ndarray, q: np.ndarray, loads: np.ndarray | None) -> MovedJoints:
        """Return the real joint positions at encoder readings `q` (N, na).

        Args:
            values: Values of the parameters (p,).
            q: Encoder readings (N, na) [m or rad].
            loads: Mass at the tool [kg], force [N] and moment [N m] on it in base axes (N, 7), or None.
        """
        loads = np.zeros((len(q), 7)) if loads is None else loads
        state, at = self._read(values), self.statics.at(q)
        pull = self._pull(state, at, loads)
        back = self._yield_back(state, pull)
        moved = np.einsum("nij,nj->ni", back, state.c * pull.force + state.d * pull.unit)
        arms = at.arms + np.einsum("nabkx,nk->nabx", at.arm_slopes, moved)
        force = pull.force + np.einsum("nak,nk->na", pull.slope, moved)
        unit = pull.unit + np.einsum("nak,nk->na", pull.unit_slope, moved)
        columns = []
        for drive in self.drives:
            a = drive.actuator
            for p in drive.parameters:
                size = unit if p.name.endswith(".load_deflection") else force
                columns.append(back[:, :, a] * size[:, [a]])
        for body in self._bodies:
            own = arms[:, :, self.statics.bodies.index(body)] @ state.gravity
            columns.append(np.einsum("nij,nj->ni", back, state.c * own))
        for axis in self._tilts:
            turned = arms @ np.cross(np.eye(3)[axis], self.statics.gravity)
            own = state.c * np.sum(turned * self._weights(state, loads)[:, None], axis=2) + state.d * turned[:, :, -1]
            columns.append(np.einsum("nij,nj->ni", back, own))
        real = q + moved

        def by_position() -> np.ndarray:
            return self._yield_back(state, self._pull(state, self.statics.at(real), loads))

        return MovedJoints(real, np.stack(columns, axis=2), by_position)

    def list_springs(self, values: np.ndarray) -> dict[str, tuple[str, float]]:
        """Return the parameter and the compliance [rad/(N m) or m/N] of each elastic joint.

        Raises:
            InputError: The load at the tool is unknown, or a compliance is below zero, which no spring has.
        """
        found = {}
        for p, value in zip(self.parameters, values.tolist(), strict=True):
            joint, _, what = p.name.partition(".")
            if value and (what == "load_deflection" or (what.endswith("_compliance") and value < 0)):
                raise InputError("unsupported", f"a robot file cannot hold {p.name} = {value:.3g} {p.unit}")
            if value and what.endswith("_compliance"):
                found[joint] = p.name, value
        return found

    def _read(self, values: np.ndarray) -> _State:
        na = self.statics.robot.na
        c, d, errors, tilt = np.zeros(na), np.zeros(na), np.zeros(len(self.statics.bodies)), np.zeros(3)
        rest = list(np.asarray(values, float))
        for drive in self.drives:
            for p in drive.parameters:
                (d if p.name.endswith(".load_deflection") else c)[drive.actuator] = rest.pop(0)
        for body in self._bodies:
            errors[self.statics.bodies.index(body)] = rest.pop(0)
        for axis in self._tilts:
            tilt[axis] = rest.pop(0)
        return _State(c, d, errors, self.statics.gravity + np.cross(tilt, self.statics.gravity))

    def _weights(self, state: _State, loads: np.ndarray) -> np.ndarray:
        """Return the weights of the sum over bodies and 1 kg at the tool (N, b + 1)."""
        return np.column_stack([np.tile(1 + state.errors, (len(loads), 1)), loads[:, 0]])

    def _pull(self, state: _State, at: Statics, loads: np.ndarray) -> _Pull:
        weights = self._weights(state, loads)
        each, slopes = at.arms @ state.gravity, at.arm_slopes @ state.gravity
        force = np.sum(each * weights[:, None], axis=2) + np.einsum("nka,nk->na", at.jacobian, loads[:, 1:])
        slope = np.einsum("nabk,nb->nak", slopes, weights) + np.einsum("nikj,ni->nkj", at.jacobian_slopes, loads[:, 1:])
        return _Pull(force, each[:, :, -1], slope, slopes[:, :, -1])

    def _yield_back(self, state: _State, pull: _Pull) -> np.ndarray:
        """Return `(1 - c Q')^-1` (N, na, na)."""
        softened = state.c[:, None] * pull.slope + state.d[:, None] * pull.unit_slope
        return np.linalg.inv(np.eye(len(state.c)) - softened)


class JointLoading:
    """Loads of each joint over the range of some poses."""

    def __init__(self, statics: StaticForces, low: np.ndarray, high: np.ndarray, loads: np.ndarray) -> None:
        """Try positions between two (na,), with loads (N, 7) of the poses."""
        rng = np.random.default_rng(0)
        self.statics = statics
        q = low + (high - low) * rng.random((_TRIED, len(low)))
        at, loads = statics.at(q), loads[rng.integers(len(loads), size=_TRIED)]
        each = at.arms @ statics.gravity
        known = each[:, :, -1] * loads[:, :1] + np.einsum("nka,nk->na", at.jacobian, loads[:, 1:])
        total = each[:, :, :-1].sum(axis=2) + known
        self._largest, self._of_load = np.abs(total).max(axis=0), np.abs(each[:, :, -1]).max(axis=0)
        self._no_force = _NO_FORCE * max(float(self._largest.max()), float(self._of_load.max()), 1.0)
        self._varies = np.ptp(total, axis=0)
        self._bodies = np.abs(each[:, :, :-1]).max(axis=0) >= self._no_force

    def list_carrying(self) -> tuple[str, ...]:
        """Return the joints that carry gravity somewhere, or would carry that of a load at the tool."""
        carries = np.maximum(self._largest, self._of_load) >= self._no_force
        return tuple(np.array(self.statics.robot.actuated)[carries].tolist())

    def list_varying(self) -> tuple[str, ...]:
        """Return the joints whose load varies over the poses; a constant one is the joint's offset."""
        varies = self._varies >= self._no_force
        return tuple(np.array(self.statics.robot.actuated)[varies].tolist())

    def build(self, joints: Mapping[str, str], load_known: bool, masses_known: bool = False) -> ElasticDrives:
        """Return the elastic drives.

        Args:
            joints: Name of the compliance by joint.
            load_known: Whether the load at the tool is known.
            masses_known: Whether the file's masses and a level base count as exact.
        """
        return ElasticDrives(
            self.statics, tuple(self._build(j, name, load_known) for j, name in joints.items()), masses_known
        )

    def _build(self, joint: str, name: str, load_known: bool) -> ElasticDrive:
        robot = self.statics.robot
        a = robot.actuated.index(joint)
        size, load = (float(x[a]) if x[a] >= self._no_force else 0.0 for x in (self._largest, self._of_load))
        bodies = tuple(np.array(self.statics.bodies)[self._bodies[a]].tolist())
        return ElasticDrive(joint, a, robot.position_units[a], name, size, 0.0 if load_known else load, bodies)
