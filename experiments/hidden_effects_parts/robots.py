"""The robots in which something hides, as they truly are: masses off the file's, friction near Dressler 2012, Table 6.1.

Five robots: the L1 Gantry-Tau (`l1`), one linear axis (`axis`), a serial arm of three hinges (`arm`), whose last two may share a
motor, its last two hinges alone (`elbow`, for actuators), and a six-axis arm with geared drives (`geared`), of whose rotors'
inertia its file says nothing. For clean sets also geared arms of three makes (`ur5`, `panda`, `xarm7` of `example-robot-data`)
and trees of three to five hinges, drawn from a number (`tree7`); their files say nothing of rotors either. Forces are
`rigid body + base friction` with a sign that jumps exactly where the speed changes its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import files
from pathlib import Path

import numpy as np

from tau_dyn.effects import SymmetricFriction, build_friction_model
from tau_dyn.identify.fitted_model import free_drive_inertias
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

# Dressler 2012, Table 6.1: coulomb_neg, coulomb_pos [N], viscous_neg, viscous_pos [N/(m/s)] of each cart
TABLE_6_1 = ((145.69, 189.12, 158.01, 205.03), (119.23, 262.59, 133.76, 190.00), (177.22, 239.06, 197.52, 185.94))
AXIS = ((20.3, 20.4, 239.0, 204.0),)  # N, N/(m/s); of the size of EMPS'
ARM = ((7.0, 9.0, 6.0, 5.0), (8.0, 6.5, 5.0, 6.5), (3.0, 4.0, 2.0, 2.5))  # N m, N m/(rad/s)
GEARED = (
    (14.0, 16.0, 12.0, 14.0), (18.0, 15.0, 15.0, 12.0), (9.0, 10.0, 8.0, 7.0), (3.0, 3.5, 2.5, 2.0), (2.5, 2.0, 1.5, 2.0),
    (1.5, 1.8, 0.8, 1.0),
)  # N m, N m/(rad/s)  # fmt: skip
FRICTION = {"l1": TABLE_6_1, "axis": AXIS, "arm": ARM, "elbow": ARM[1:], "geared": GEARED}
ROTORS = ((2.5e-4, 101), (2.5e-4, 101), (1.2e-4, 101), (3e-5, 80), (3e-5, 80), (1e-5, 50))
"""Rotor inertia [kg m2] and gear ratio of each drive of the geared arm, up to 30 % off."""
ARM_RATIOS = {"turn": 101, "lift": 41, "bend": 21}
MAKES = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", (10.0, 12.0, 8.0, 2.0, 2.0, 1.5)),
    "panda": ("panda_description/urdf/panda.urdf", (6.0, 6.0, 5.0, 5.0, 2.0, 2.0, 1.0)),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", (8.0, 9.0, 6.0, 6.0, 3.0, 2.0, 1.5)),
}
"""End of the file of each make, and the Coulomb friction of its joints [N m]."""
ROTORS_KG_M2 = (0.05, 1.0)
"""Rotor inertia behind the gear of makes and trees, which their files lack."""
N_TREES = 10_000
TREE_HINGES = (3, 6)  # hinges of a tree, the last excluded
OFF = 0.1
"""Largest relative error of a mass in the robot file."""

_ARM_URDF = """<robot name="arm"><link name="base_link"/>
<link name="column_link"><inertial><origin xyz="0 0 0.05"/><mass value="9"/>
 <inertia ixx="0.06" ixy="0" ixz="0" iyy="0.06" iyz="0" izz="0.08"/></inertial></link>
<link name="upper_link"><inertial><origin xyz="0.18 0.03 0"/><mass value="7"/>
 <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.11" iyz="0" izz="0.11"/></inertial></link>
<link name="fore_link"><inertial><origin xyz="0.15 0 0.02"/><mass value="4"/>
 <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base_link"/><child link="column_link"/><axis xyz="0 0 1"/>
 <origin xyz="0 0 0.3"/><limit lower="-3" upper="3" velocity="4" effort="400"/></joint>
<joint name="lift" type="revolute"><parent link="column_link"/><child link="upper_link"/><axis xyz="0 1 0"/>
 <origin xyz="0.05 0 0.1"/><limit lower="-2" upper="2" velocity="4" effort="400"/></joint>
<joint name="bend" type="revolute"><parent link="upper_link"/><child link="fore_link"/><axis xyz="0 1 0"/>
 <origin xyz="0.4 0 0"/><limit lower="-2" upper="2" velocity="4" effort="400"/></joint>
TRANSMISSIONS</robot>"""


_GEARED = (  # joint, mass, centre, radius of gyration, place, axis
    ("turn", 8.0, (0.0, -0.02, 0.03), 0.09, "0 0 0.15", "0 0 1"), ("lift", 11.0, (0.21, 0.0, 0.12), 0.14, "0 0.12 0.1", "0 1 0"),
    ("bend", 4.5, (0.17, 0.0, 0.02), 0.12, "0.43 -0.1 0", "0 1 0"), ("roll", 1.9, (0.0, 0.03, 0.01), 0.05, "0.39 0 0", "0 1 0"),
    ("tip", 1.6, (0.0, -0.01, 0.04), 0.05, "0 0.1 0", "0 0 1"), ("spin", 0.6, (0.01, 0.04, 0.0), 0.03, "0 0 0.1", "0 1 0"),
)  # fmt: skip


def _geared_urdf() -> str:
    """Return a six-axis arm whose file gives no drive inertia."""
    parts, parent = [], "base_link"
    for joint, mass, c, gyration, place, axis in _GEARED:
        i = mass * gyration**2
        parts.append(
            f'<link name="{joint}_link"><inertial><origin xyz="{c[0]} {c[1]} {c[2]}"/><mass value="{mass}"/>'
            f'<inertia ixx="{i}" iyy="{1.1 * i}" izz="{0.8 * i}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/><axis xyz="{axis}"/>'
            f'<origin xyz="{place}"/><limit lower="-2.5" upper="2.5" velocity="3" effort="400"/></joint>'
        )
        parent = f"{joint}_link"
    return f'<robot name="geared"><link name="base_link"/>{"".join(parts)}TRANSMISSIONS</robot>'


def _tree_urdf(number: int) -> str:
    """Return a tree of hinges about axes by chance, each on the last link or, in three of ten, on an earlier one."""
    rng = np.random.default_rng([number, 17])
    links, parts = ["base_link"], []
    for k in range(int(rng.integers(*TREE_HINGES))):
        parent = links[-1] if rng.random() < 0.7 else links[int(rng.integers(len(links)))]
        axis, place = rng.normal(size=3), rng.uniform(0.1, 0.4) * _direction(rng)
        mass, centre, gyration = rng.uniform(1, 8), rng.uniform(0.02, 0.15) * _direction(rng), rng.uniform(0.04, 0.15)
        i = mass * gyration**2
        axis = axis / np.linalg.norm(axis)
        links.append(f"body{k}_link")
        parts.append(
            f'<link name="body{k}_link"><inertial><origin xyz="{_xyz(centre)}"/><mass value="{mass:.6g}"/>'
            f'<inertia ixx="{i:.6g}" iyy="{1.1 * i:.6g}" izz="{0.8 * i:.6g}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="hinge{k}" type="revolute"><parent link="{parent}"/><child link="body{k}_link"/>'
            f'<axis xyz="{_xyz(axis)}"/><origin xyz="{_xyz(place)}"/>'
            '<limit lower="-2.2" upper="2.2" velocity="3" effort="300"/></joint>'
        )
    return f'<robot name="tree"><link name="base_link"/>{"".join(parts)}</robot>'


def _direction(rng: np.random.Generator) -> np.ndarray:
    x = rng.normal(size=3)
    return x / np.linalg.norm(x)


def _xyz(values: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in values)


def _friction_of(name: str, n: int) -> np.ndarray:
    """Return coefficients (n, 4) as in `FRICTION`; of a make or a tree Coulomb and viscous friction in proportion."""
    if name in FRICTION:
        return np.array(FRICTION[name])
    coulomb = np.array(MAKES[name][1]) if name in MAKES else np.random.default_rng([int(name[4:]), 18]).uniform(1, 8, n)
    return coulomb[:, None] * np.array([0.9, 1.1, 0.8, 0.7])


@cache
def nominal_robot(name: str) -> Robot:
    """Return a robot as its file has it, by the names of this module; `l1_point` is `l1` with point masses for rods."""
    if name == "axis":
        return load_robot("linear_axis")
    if name in MAKES:
        found = next(f for f in files("example-robot-data") or () if str(f).endswith(MAKES[name][0]))
        joints = [f"panda_joint{k}" for k in range(1, 8)] if name == "panda" else None
        return load_robot(Path(str(found.locate())), actuated=joints)
    if name.startswith("tree"):
        return load_robot_from_urdf(_tree_urdf(int(name.removeprefix("tree"))), name)
    if name.startswith("l1"):
        return load_robot("gantry_tau", prototype="l1", rod_mass_model="point" if name == "l1_point" else "uniform")
    kind = "<type>transmission_interface/SimpleTransmission</type>"
    ratios = ARM_RATIOS
    if name == "geared":
        ratios = {row[0]: ratio for row, (_, ratio) in zip(_GEARED, ROTORS, strict=True)}
    elif name == "elbow":
        ratios = {joint: ratio for joint, ratio in ARM_RATIOS.items() if joint != "turn"}
    drives = (
        f'<transmission name="{j}_drive">{kind}<joint name="{j}"/><actuator name="{j}_motor"><mechanicalReduction>{ratio}'
        "</mechanicalReduction></actuator></transmission>"
        for j, ratio in ratios.items()
    )
    urdf = _geared_urdf() if name == "geared" else _ARM_URDF
    if name == "elbow":
        urdf = urdf.replace('name="turn" type="revolute"', 'name="turn" type="fixed"')
    return load_robot_from_urdf(urdf.replace("TRANSMISSIONS", "\n".join(drives)), name)


@dataclass(frozen=True, eq=False)
class Friction:
    """Coulomb and viscous friction with coefficients of its own in each direction, each (na,)."""

    coulomb_neg: np.ndarray
    coulomb_pos: np.ndarray
    viscous_neg: np.ndarray
    viscous_pos: np.ndarray

    @property
    def coulomb(self) -> np.ndarray:
        """Mean Coulomb friction (na,) [N or N m]."""
        return (self.coulomb_neg + self.coulomb_pos) / 2

    @property
    def viscous(self) -> np.ndarray:
        """Mean viscous friction (na,)."""
        return (self.viscous_neg + self.viscous_pos) / 2

    def force(self, v: np.ndarray) -> np.ndarray:
        """Return the friction (N, na) at velocities (N, na), with a sharp sign."""
        forward = self.coulomb_pos + self.viscous_pos * v
        backward = -self.coulomb_neg + self.viscous_neg * v
        return np.where(v > 0, forward, np.where(v < 0, backward, 0.0))


@dataclass(frozen=True, eq=False)
class Rig:
    """A robot as it is, and what a person knows of it.

    Attributes:
        name: As this module calls it.
        nominal: The robot file.
        base: Friction the person's model has: `asymmetric`, `symmetric` (with an offset) or `plain` (without).
        robot: The true robot.
        friction: Its true friction, without what hides.
    """

    name: str
    nominal: Robot
    base: str
    robot: Robot
    friction: Friction
    mechanism: Mechanism

    @property
    def joints(self) -> tuple[str, ...]:
        """Actuated joints."""
        return self.nominal.actuated

    @property
    def turns(self) -> bool:
        """Whether the joints are hinges."""
        return set(self.nominal.position_units) == {"rad"}

    @property
    def model(self) -> Model:
        """The person's model: the robot file and base friction at zero."""
        return free_drive_inertias(Model.of(self.nominal, self._effects()))

    @property
    def driven(self) -> Model:
        """The true robot as the library's simulator takes it, without what hides."""
        model = Model.of(self.robot, build_friction_model("asymmetric", self.joints, self.robot.force_units))
        return model.with_values(
            {f"{j}.{key}": float(getattr(self.friction, key)[k]) for k, j in enumerate(self.joints)
             for key in ("coulomb_neg", "coulomb_pos", "viscous_neg", "viscous_pos")}
        )  # fmt: skip

    def force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return rigid-body force and base friction (N, na) [N or N m] along a motion (N, na)."""
        return self.mechanism.inverse_dynamics(q, v, a) + self.friction.force(v)

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (n, na, na) at positions (n, na)."""
        rest = np.zeros_like(q)
        weight = self.mechanism.inverse_dynamics(q, rest, rest)
        columns = [self.mechanism.inverse_dynamics(q, rest, rest + unit) - weight for unit in np.eye(len(self.joints))]
        return np.stack(columns, axis=2)

    def _effects(self) -> tuple:
        if self.base == "plain":
            return (SymmetricFriction(self.joints, self.nominal.force_units),)
        return build_friction_model(self.base, self.joints, self.nominal.force_units)


def draw_rig(name: str, base: str, rng: np.random.Generator, *, off: float = OFF, nominal: str | None = None) -> Rig:
    """Return a robot whose bodies are up to `off` heavier or lighter than its file says, with friction by chance.

    Args:
        name: As this module calls it.
        base: Friction of the person's model; where it is symmetric, so is the true base friction.
        rng: Randomness.
        off: Largest relative error of a body's mass; centre and inertia follow.
        nominal: Another robot file that the person uses, such as `l1_point`.
    """
    known, true = nominal_robot(nominal or name), nominal_robot(name)
    values: dict[str, float] = {}
    for link in true.links:
        factor = rng.uniform(1 - off, 1 + off)
        values |= {key: true.parameters[key].value * factor for key in link.names}
    if name == "geared":
        for joint, (inertia, ratio) in zip(true.actuated, ROTORS, strict=True):
            values[f"{joint}.armature"] = inertia * ratio**2 * rng.uniform(0.7, 1.3)
    if name in MAKES or name.startswith("tree"):
        values |= {f"{joint}.armature": rng.uniform(*ROTORS_KG_M2) for joint in true.actuated}
    robot = Model.of(true).with_values(values).robot
    neg, pos, slow, fast = _friction_of(name, true.na).T * rng.uniform(0.8, 1.2, (4, true.na))
    if base == "plain":
        neg = pos = (neg + pos) / 2
    if base != "asymmetric":  # an offset lies in `symmetric`, another slope for each direction does not
        slow = fast = (slow + fast) / 2
    return Rig(name, known, base, robot, Friction(neg, pos, slow, fast), build_mechanism(robot))


DRAWS: dict[str, Callable[[np.random.Generator], str]] = {
    "any": lambda rng: str(rng.choice(("l1", "l1", "axis", "arm", "geared", "geared"))),
    "l1": lambda rng: "l1",
    "axis": lambda rng: "axis",
    "arm": lambda rng: "arm",
    "geared": lambda rng: "geared",
    "several": lambda rng: str(rng.choice(("l1", "l1", "arm", "geared"))),
    "small": lambda rng: str(rng.choice(("axis", "elbow"))),
    "hinges": lambda rng: str(rng.choice(("elbow", "elbow", "elbow", "arm"))),
    "wide": lambda rng: str(
        rng.choice(("l1", "geared", *MAKES, f"tree{rng.integers(N_TREES)}", f"tree{rng.integers(N_TREES)}"))
    ),
    "cart": lambda rng: str(rng.choice(("l1", "axis"))),
}
"""Choices of a robot by chance: most effects are tried on any, some on those that can have them; `wide` is for clean sets."""
