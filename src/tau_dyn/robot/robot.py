"""A robot: Pinocchio's tree, the loops that close it, its actuated joints and its nominal parameters.

Inertial parameters follow Pinocchio: `m, mcx, mcy, mcz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz` about the *joint frame's origin*, a set
of ten for each movable joint's link; links fixed to it are merged in. A link may carry fewer: with `parameters="mass"` its
centre and inertia follow its mass. Drive inertia (`<joint>.armature`) and mass that only gravity acts on
(`<link>.gravity_mass`) follow them. `Robot` wraps `pin.Model` and never decorates it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Shown
from tau_dyn.robot.annotations import ArmNames, JointFriction, Mimic, Spring
from tau_dyn.robot.floating_base import ContactFrame

INERTIAL = ("mass", "mx", "my", "mz", "ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
NOT_GIVEN = "not given"
"""Origin of a drive inertia that the robot file does not give."""
NO_DRIVE = "no drive"
"""Origin of the drive inertia, zero, of a floating base's coordinates."""


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """A link's ten inertial numbers, and which of them are separate parameters.

    Attributes:
        link: Link name.
        joint_id: Pinocchio's joint index.
        nominal: The ten numbers of the robot file (10,) [kg, kg m, kg m^2].
        own: Indices into the ten that are parameters; the others scale with the mass.
    """

    link: str
    joint_id: int
    nominal: np.ndarray
    own: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its own parameters."""
        return tuple(f"{self.link}.{INERTIAL[k]}" for k in self.own)

    @property
    def map(self) -> np.ndarray:
        """Jacobian `d pi / d own parameters` (10, n_own)."""
        matrix = np.zeros((10, len(self.own)))
        matrix[list(self.own), range(len(self.own))] = 1.0
        tied = [k for k in range(10) if k not in self.own]
        matrix[tied, 0] = self.nominal[tied] / self.nominal[0] if self.nominal[0] > 0 else 0.0
        return matrix


@dataclass(frozen=True)
class Loop:
    """Two frames of the tree whose origins coincide when the loop is closed."""

    name: str
    frame_a: int
    frame_b: int


@dataclass(frozen=True, eq=False)
class Robot(Shown):
    """A mechanism and its nominal parameters; build it with `load_robot`.

    Attributes:
        name: The file's robot name.
        source: Path or short name it was loaded from.
        arguments: xacro arguments it was loaded with.
        sha256: Hash of the robot file.
        urdf: The expanded URDF text.
        model: Pinocchio model of the tree, with a frame at each loop's two ends.
        loops: Loop closures; empty for a serial arm or a tree.
        actuated: Names of the actuated joints, in the tree's order; all vectors `q`, `v`, `a`, `tau` follow it.
        home: Actuated positions in the middle of the workspace (na,) [m or rad].
        links: The links that carry mass.
        parameters: Nominal parameters, in the regressor's column order.
        arms: The three arms of a simplified Gantry-Tau, otherwise empty.
        plate: The plate link of a simplified Gantry-Tau, otherwise ''.
        assumed: Statements of the file about assumed values.
        warnings: Warnings about the input, as sentences.
        springs: Compliant joints; `model` has them locked at zero, `FlexibleModel` frees them.
        drive_springs: Springs between the drives and the links of actuated joints; rigid in `model`, free in `FlexibleModel`.
        shared_drives: Pairs of joints with a common transmission in the file.
        tool: Name of the tool frame; empty if the file has no tool frame.
        drive_scales: Travel [m] of actuated slides per metre that their drives read, 1 for those not named; see `drive_scale`.
        passive_home: Positions of passive joints [m or rad] from which the loops are closed at home, zero for those not named;
            they choose the assembly mode.
        mimics: Joints that follow an actuated one, directly or through others.
        friction: Friction of the actuated joints in the file, their followers' included.
        gear_ratios: Motor turns per turn of actuated joints, or radians per metre of slides, if the file gives them.
        packages: Folders of ROS packages with meshes, by name; they take precedence over those that are found.
        base_coordinates: The six coordinates of a floating base. They are the first of `actuated`, as they are measured like
            all others, and their forces are zero.
        contacts: Links of a robot with a floating base that may touch the ground.
        redundant: Drive inertias `<joint>.armature` of the drives beyond the robot's freedoms. They follow the actuated joints
            through the loops: `v_redundant = B v`. The force of an actuated joint k is then the generalised one of all drives,
            `tau_k + sum_i B_ik tau_i`.
    """

    name: str
    source: str
    arguments: Mapping[str, str]
    sha256: str
    urdf: str
    model: pin.Model
    loops: tuple[Loop, ...]
    actuated: tuple[str, ...]
    home: np.ndarray
    links: tuple[LinkInertia, ...]
    parameters: Parameters
    arms: tuple[ArmNames, ...] = ()
    plate: str = ""
    assumed: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    springs: tuple[Spring, ...] = ()
    drive_springs: tuple[Spring, ...] = ()
    shared_drives: tuple[tuple[str, str], ...] = ()
    tool: str = ""
    passive_home: Mapping[str, float] = field(default_factory=dict)
    drive_scales: Mapping[str, float] = field(default_factory=dict)
    mimics: Mapping[str, Mimic] = field(default_factory=dict)
    friction: Mapping[str, JointFriction] = field(default_factory=dict)
    gear_ratios: Mapping[str, float] = field(default_factory=dict)
    packages: Mapping[str, str | Path] = field(default_factory=dict)
    base_coordinates: tuple[str, ...] = ()
    contacts: tuple[ContactFrame, ...] = ()
    redundant: Parameters = Parameters(())

    @property
    def redundant_joints(self) -> tuple[str, ...]:
        """Names of the drives beyond the robot's freedoms, in the tree's order."""
        return tuple(name.rpartition(".")[0] for name in self.redundant.names)

    @property
    def redundant_units(self) -> tuple[str, ...]:
        """'N' or 'N m' for each of these drives."""
        return _get_force_units(self._get_kinds(self.redundant_joints))

    @property
    def merged_links(self) -> dict[str, str]:
        """The links with mass that are fixed to another one, by name, and the link whose parameters contain theirs."""
        owners, frames = {link.joint_id: link.link for link in self.links}, self.model.frames
        bodies = [f for f in frames if f.type == pin.FrameType.BODY and f.parentJoint in owners]
        mounts = [(f, frames[f.parentFrame]) for f in bodies]
        screwed = pin.FrameType.FIXED_JOINT  # Pinocchio keeps the mass behind it there
        return {f.name: owners[f.parentJoint] for f, at in mounts if at.type == screwed and at.inertia.mass > 0}

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the joints with a motor: the actuated ones except the coordinates of a floating base."""
        return self.actuated[len(self.base_coordinates) :]

    @property
    def driven_units(self) -> tuple[str, ...]:
        """'N' or 'N m' for each joint with a motor."""
        return self.force_units[len(self.base_coordinates) :]

    @property
    def coupled_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of actuated joints that one motor may drive: neighbours in the chain, or declared to share a transmission."""
        parent: dict[str, str] = {}
        for joint in self.driven:
            k = self.model.parents[self.model.getJointId(joint)]
            while k > 0 and self.model.names[k] not in self.actuated:
                k = self.model.parents[k]
            if k > 0 and self.model.names[k] in self.driven:
                parent[joint] = self.model.names[k]
        near = {frozenset(pair) for pair in (*parent.items(), *self.shared_drives)}
        order = self.actuated
        return tuple((i, j) for n, i in enumerate(order) for j in order[n + 1 :] if frozenset((i, j)) in near)

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return len(self.actuated)

    @property
    def active_v(self) -> np.ndarray:
        """Indices of the actuated joints in the tree's velocity (na,)."""
        return np.array([self.model.joints[self.model.getJointId(j)].idx_v for j in self.actuated])

    @property
    def active_q(self) -> np.ndarray:
        """Indices of the actuated joints in the tree's configuration (na,)."""
        return np.array([self.model.joints[self.model.getJointId(j)].idx_q for j in self.actuated])

    @property
    def drive_scale(self) -> np.ndarray:
        """Travel of the tree's joints per reading of their drives `s` (na,): `x = s q`, therefore `tau = s F`.

        Actuated coordinates are the readings: `q`, `v`, `a`, limits and home. Work is the same in both, `tau dq = F dx`, so a
        drive that travels `s` times its reading shows `s` times the force on its slide. Friction and drive inertia belong to
        the drive and refer to its readings.
        """
        return np.array([self.drive_scales.get(joint, 1.0) for joint in self.actuated])

    @property
    def passive_v(self) -> np.ndarray:
        """Indices in the tree's velocity of the joints that neither are actuated nor follow one (n,)."""
        followers = [self.model.joints[self.model.getJointId(j)].idx_v for j in self.mimics]
        return np.setdiff1d(np.arange(self.model.nv), [*self.active_v, *followers])

    @property
    def held_positions(self) -> dict[str, float]:
        """Positions [m or rad] at which joints of a tree are held that no motor moves, and those that follow them."""
        if self.loops:
            return {}
        passive = [n for n in self.model.names[1:] if n not in self.actuated and n not in self.mimics]
        followers = {j: mimic.offset for j, mimic in self.mimics.items() if mimic.joint not in self.actuated}
        return dict.fromkeys(passive, 0.0) | followers

    @property
    def coupling(self) -> tuple[np.ndarray, np.ndarray]:
        """Shares (nv, na) and offsets (nv,) by which actuated positions place actuated joints and those that follow them."""
        share, offset = np.zeros((self.model.nv, self.na)), np.zeros(self.model.nv)
        share[self.active_v, range(self.na)] = self.drive_scale
        for joint, mimic in self.mimics.items():
            row = self.model.joints[self.model.getJointId(joint)].idx_v
            offset[row] = mimic.offset
            if mimic.joint in self.actuated:
                k = self.actuated.index(mimic.joint)
                share[row, k] = mimic.multiplier * self.drive_scale[k]
        return share, offset

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """'prismatic' or 'revolute' for each actuated joint."""
        return self._get_kinds(self.actuated)

    @property
    def position_units(self) -> tuple[str, ...]:
        """'m' or 'rad' for each actuated joint."""
        return tuple("m" if kind == "prismatic" else "rad" for kind in self.joint_kinds)

    @property
    def force_units(self) -> tuple[str, ...]:
        """'N' or 'N m' for each actuated joint."""
        return _get_force_units(self.joint_kinds)

    @property
    def lower(self) -> np.ndarray:
        """Lower position limits (na,) [m or rad]; -inf if unlimited."""
        return self._position_limit(self.model.lowerPositionLimit, -np.inf)

    @property
    def upper(self) -> np.ndarray:
        """Upper position limits (na,) [m or rad]; inf if unlimited."""
        return self._position_limit(self.model.upperPositionLimit, np.inf)

    @property
    def velocity_limit(self) -> np.ndarray:
        """Speed limits (na,) [m/s or rad/s]; inf if unlimited."""
        return _or_none(self.model.upperVelocityLimit[self.active_v])

    @property
    def effort_limit(self) -> np.ndarray:
        """Force limits (na,) [N or N m]; inf if unlimited, and for generalised forces of more drives than freedoms."""
        if self.redundant_joints:
            return np.full(self.na, np.inf)
        return _or_none(self.model.upperEffortLimit[self.active_v])

    @property
    def tool_frame(self) -> int | None:
        """Index of the tool frame, or None."""
        return self.model.getFrameId(self.tool) if self.tool else None

    @property
    def carrying_joints(self) -> tuple[str, ...]:
        """The actuated joints between base and tool; without a tool, those before the first branch of the tree."""
        model = self.model
        if self.tool_frame is not None:
            joint = model.frames[self.tool_frame].parentJoint
        else:
            joint, parents = 0, list(model.parents)[1:]
            while parents.count(joint) == 1:
                joint = 1 + parents.index(joint)
        chain = set()
        while joint > 0:
            chain.add(model.names[joint])
            joint = model.parents[joint]
        return tuple(name for name in self.actuated if name in chain)

    def require_fixed_base(self, what: str) -> None:
        """Reject a robot with a floating base for a task that does not support one.

        Raises:
            InputError: The base floats; `what` names the task that does not support it.
        """
        if self.base_coordinates:
            raise InputError("unsupported", f"{self.source}: {what} is for robots with a fixed base")

    def require_unscaled_drives(self, what: str) -> None:
        """Reject a robot with a drive scale for a format or task that does not support one.

        Raises:
            InputError: A drive has a scale; `what` names the format or task that does not support it.
        """
        scaled = next((joint for joint, scale in self.drive_scales.items() if scale != 1.0), None)
        if scaled is not None:
            raise InputError(
                "unsupported",
                f"{self.source}: {what} has no place for a drive's scale, which '{scaled}' has (<tau_dyn:drive>)",
            )

    def with_parameters(self, parameters: Parameters) -> Robot:
        """Return the robot with other values, bounds or freedoms for its parameters; names must be the same."""
        if parameters.names != self.parameters.names:
            unknown = next((n for n in parameters.names if n not in self.parameters), "")
            raise UnknownName("parameter", unknown, self.parameters.names)
        return replace(self, parameters=parameters)

    def untied(self, names: Iterable[str]) -> Robot:
        """Return the robot with these inertial numbers as separate parameters instead of following the mass."""
        wanted = {n for n in names if n not in self.parameters}
        possible = {f"{li.link}.{quantity}" for li in self.links for quantity in INERTIAL}
        for name in wanted - possible:
            owner = self.merged_links.get(name.rpartition(".")[0])
            part = f". {name.rpartition('.')[0]} is part of {owner}" if owner else ""
            raise UnknownName(
                "parameter", name, [*self.parameters.names, *sorted(possible - set(self.parameters.names))], more=part
            )
        links = []
        for link in self.links:
            extra = {k for k in range(10) if f"{link.link}.{INERTIAL[k]}" in wanted}
            links.append(replace(link, own=tuple(sorted({*link.own, *extra}))))
        old = {p.name: p for p in self.parameters}
        inertial = [old.get(p.name, p) for link in links for p in get_inertial_parameters(link)]
        taken = {p.name for p in inertial}
        rest = [p for p in self.parameters if p.name not in taken]
        return replace(self, links=tuple(links), parameters=Parameters([*inertial, *rest]))

    def model_with(self, parameters: Parameters) -> pin.Model:
        """Return a Pinocchio model with the masses, inertias and drive inertias of these parameters."""
        model = self.model.copy()
        for link in self.links:
            model.inertias[link.joint_id] = _inertia(link.map @ parameters.select(link.names).values)
        armature = np.zeros(model.nv)
        for joint, index, scale in zip(self.actuated, self.active_v, self.drive_scale, strict=True):
            armature[index] = (
                parameters[f"{joint}.armature"].value / scale**2
            )  # per travel of the joint, as in the tree
        model.armature = armature
        return model

    def _get_kinds(self, joints: Iterable[str]) -> tuple[str, ...]:
        names = [self.model.joints[self.model.getJointId(j)].shortname() for j in joints]
        return tuple("prismatic" if "JointModelP" in n and "Planar" not in n else "revolute" for n in names)

    def _position_limit(self, limit: np.ndarray, default: float) -> np.ndarray:
        one_number = np.array([self.model.joints[self.model.getJointId(j)].nq == 1 for j in self.actuated])
        return np.where(one_number, _finite_or(limit[self.active_q], default), default)


def find_end_link(robot: Robot) -> LinkInertia | None:
    """Return the link that carries the tool, or the only leaf of the tree; None if there is not exactly one.

    A floating base carries loads itself: its link is returned.
    """
    by_joint = {link.joint_id: link for link in robot.links}
    if robot.base_coordinates:
        return by_joint.get(robot.model.getJointId(robot.base_coordinates[-1]))
    if robot.tool_frame is not None:
        joint = int(robot.model.frames[robot.tool_frame].parentJoint)
        if joint in by_joint:
            return by_joint[joint]
    parents = set(robot.model.parents)
    leaves = [link for joint, link in by_joint.items() if joint not in parents]
    return leaves[0] if len(leaves) == 1 else None


def get_inertial_parameters(link: LinkInertia) -> list[Parameter]:
    """Return a link's own parameters at their nominal values."""
    rows = []
    for k in link.own:
        lower = 0.0 if INERTIAL[k] in ("mass", "ixx", "iyy", "izz") else -np.inf
        rows.append(Parameter(f"{link.link}.{INERTIAL[k]}", float(link.nominal[k]), _UNITS[k], lower))
    return rows


def compute_inertia_matrix(pi: np.ndarray) -> np.ndarray:
    """Return the inertia matrix (3, 3) about the joint frame's origin of ten inertial numbers in Pinocchio's order [kg m^2]."""
    xx, xy, yy, xz, yz, zz = pi[4:]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _get_force_units(kinds: Iterable[str]) -> tuple[str, ...]:
    return tuple("N" if kind == "prismatic" else "N m" for kind in kinds)


def _inertia(pi: np.ndarray) -> pin.Inertia:
    """Return a body of ten inertial numbers; Pinocchio divides by the mass, which an estimate may find to be zero."""
    if pi[0] == 0 and not pi[1:4].any():
        found = pin.Inertia.Zero()
        found.inertia = compute_inertia_matrix(
            pi
        )  # its constructor rejects negative masses, which an estimate may also find
        return found
    return pin.Inertia.FromDynamicParameters(pi)


def _finite_or(values: np.ndarray, default: float) -> np.ndarray:
    """Replace the huge numbers by which Pinocchio denotes 'no limit'."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values) & (np.abs(values) < 1e10), values, default)


def _or_none(values: np.ndarray) -> np.ndarray:
    """Return a speed or force limit; zero means that the file gives no limit."""
    values = _finite_or(values, np.inf)
    return np.where(values > 0, values, np.inf)
