"""Elastic maps over a robot's workspace: stiffness at the tool, sag under weight and load, resonances.

At every pose the springs of the robot file or of the user are linearised about rest under gravity with the drives held at their
measured positions (`FlexibleModel`). With the springs' stiffness K (the weight's contribution included), mass M, the tool's
Jacobian J and the weight's force h,

    C = J K^-1 J',     k_softest = 1 / (largest eigenvalue of C),     k_x = 1 / C_xx,     f = sqrt(eig(M^-1 K)) / 2 pi.

C is the tool's displacement per force at its origin, the tool free to turn. The sag is the displacement of the tool by the
weight, relative to the undeflected robot; the sag under a load is `C` times the load, downwards at the tool's origin.

Standard errors follow from those of the springs' stiffness, taken as independent, to first order at fixed rest:
`dC/dk_i = -c_i c_i'` with `c_i` column i of `J K^-1`, `df/dk_i = phi_i^2 / (8 pi^2 f)` with `phi' M phi = 1`, and
`ds/dk_i = -K^-1 e_i s_i` (Ewins 2000, ch. 5; Magnus & Neudecker 1999).

If a stiffness is not given, it is unknown, and so are all values that depend on it. If the rods or the structure have a
stiffness and no drive has one, the drives count as held, and values are bounds: an additional spring makes a robot softer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from tau_dyn.exceptions import InputError, TauDynError, UnknownName
from tau_dyn.kinematics.workspace.machine import WorkspaceModel
from tau_dyn.mechanism import FlexibleModel, Linearised, name_rod_spring, state_springs
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

ELASTIC: dict[str, tuple[str, ...]] = {
    "stiffness": ("stiffness", "stiffness_x", "stiffness_y", "stiffness_z"),
    "sag": ("sag", "sag_load"),
    "resonance": ("resonance", "resonance_2"),
}
"""Maps that depend on the springs, by the word that requests them."""
ELASTIC_MAPS = tuple(name for names in ELASTIC.values() for name in names)
STDERR = "_stderr"
"""Ending of the name of a map's standard error."""
_OF_LOAD = "sag_load"
_RIGID_SHARE = 1e-12
"""Share of the largest compliance below which a direction is rigid; rounding leaves 1e-15."""


@dataclass(frozen=True, eq=False)
class Elasticity:
    """The springs of a robot and the source of their values.

    Attributes:
        model: The robot with its springs, or None if the stiffness is unknown.
        origin: Clause that names the source of the values, or the reason why the stiffness is unknown.
        not_stated: Springs without a given stiffness: rods and joints by name.
        load: Weight of a load at the tool [N], or None.
        tool: Name of the tool frame.
    """

    model: FlexibleModel | None
    origin: str
    not_stated: tuple[str, ...]
    load: float | None
    tool: str

    @property
    def known(self) -> bool:
        """Whether the given stiffness determines the maps."""
        return self.model is not None

    @property
    def stiffness_stderr(self) -> np.ndarray | None:
        """Standard errors of the springs (ns,), zero for springs without one; None if no spring has one."""
        springs = self.model.springs if self.model is not None else ()
        if all(s.stiffness_stderr is None for s in springs):
            return None
        return np.array([s.stiffness_stderr or 0.0 for s in springs])

    def list_maps(self) -> list[str]:
        """Return the names of the maps: all; without a load all except that of the load."""
        return [name for name in ELASTIC_MAPS if name != _OF_LOAD or self.load is not None]

    def warnings(self) -> list[str]:
        """Return sentences about springs without a given stiffness."""
        named = ", ".join(self.not_stated)
        if not self.known:
            return [
                CodedWarning("stiffness_unknown", f"stiffness, sag and resonances are {self.origin}", self.not_stated)
            ]
        if not self.not_stated:
            return []
        return [
            CodedWarning(
                "drives_held",
                f"no stiffness is stated for the drives {named}: they count as held, so stiffness and resonances are upper "
                "bounds and sag is a lower bound; state it by <tau_dyn:drive_spring> or --actuator-stiffness",
                self.not_stated,
            )
        ]

    def compute_maps(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Return all maps, and their standard errors if springs have some, at positions (N, na); each (N,) in SI.

        Values are nan at a pose at which the springs do not carry the weight, and at every pose if the stiffness is unknown.
        """
        names = self.list_maps()
        if self.stiffness_stderr is not None:
            names += [name + STDERR for name in self.list_maps()]
        out = {name: np.full(len(q), np.nan) for name in names}
        for k, at in enumerate(q):
            near = self.linearise(at)
            if near is not None:
                for name, value in compute_elastic_values(near, self._weight(), self.stiffness_stderr).items():
                    out[name][k] = value
        return out

    def linearise(self, q: np.ndarray) -> Linearised | None:
        """Return the robot about rest at one pose (na,); None if no rest exists or the stiffness is unknown."""
        if self.model is None or not np.isfinite(q).all():
            return None
        try:
            return self.model.at(q, tool=self.tool)
        except TauDynError:
            return None

    def _weight(self) -> np.ndarray | None:
        """Return the load's force at the tool (3,) [N], along gravity."""
        if self.model is None or self.load is None:
            return None
        gravity = self.model.robot.model.gravity.linear
        return self.load * gravity / np.linalg.norm(gravity)


def compute_elastic_values(
    near: Linearised, load: np.ndarray | None = None, stiffness_stderr: np.ndarray | None = None
) -> dict[str, float]:
    """Return the maps of one pose and their standard errors.

    Args:
        near: The robot about rest.
        load: Force at the tool (3,) [N], or None.
        stiffness_stderr: Standard errors of the springs (ns,), or None.
    """
    a = near.na
    c = np.linalg.solve(near.K[a:, a:], near.tool[:, a:].T).T  # (3, ns)
    C = c @ near.tool[:, a:].T
    C = (C + C.T) / 2
    soft, axes = np.linalg.eigh(C)
    directions = {"stiffness": axes[:, -1]} | {f"stiffness_{x}": e for x, e in zip("xyz", np.eye(3), strict=True)}
    squares, shapes = eigh(near.K[a:, a:], near.M[a:, a:])
    frequencies = np.sqrt(squares) / (2 * np.pi)
    displacement = near.tool_position - near.unloaded_position
    values, slopes = {}, {}
    for name, d in directions.items():
        along = float(d @ C @ d)
        rigid = along <= _RIGID_SHARE * soft[-1]
        values[name] = np.inf if rigid else 1.0 / along
        slopes[name] = np.zeros(c.shape[1]) if rigid else (d @ c) ** 2 / along**2
    values["sag"] = float(np.linalg.norm(displacement))
    slopes["sag"] = -_unit(displacement) @ c * near.deflection
    if load is not None:
        under_load = C @ load
        values["sag_load"] = float(np.linalg.norm(under_load))
        slopes["sag_load"] = -(_unit(under_load) @ c) * (load @ c)
    for name, k in (("resonance", 0), ("resonance_2", 1)):
        there = k < len(frequencies)
        values[name] = float(frequencies[k]) if there else np.nan
        slopes[name] = shapes[:, k] ** 2 / (8 * np.pi**2 * frequencies[k]) if there else np.full(c.shape[1], np.nan)
    if stiffness_stderr is not None:
        values |= {name + STDERR: float(np.linalg.norm(slope * stiffness_stderr)) for name, slope in slopes.items()}
    return values


def _unit(vector: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vector)
    return vector / size if size > 0 else np.zeros(3)


def build_elasticity(
    machine: WorkspaceModel,
    rod: float | None = None,
    actuators: Mapping[str, float] | None = None,
    load: float | None = None,
) -> Elasticity:
    """Return a robot's springs: those of its file, or the given ones that replace them.

    Args:
        machine: The robot.
        rod: Stiffness of each rod with its joints [N/m], inf for rigid; None takes the file's `<rod>_stretch` springs.
        actuators: Stiffness by joint name, or '' for all [N/m or N m/rad], inf for rigid.
        load: Weight of a load at the tool [N].

    Raises:
        UnknownName: A joint that is not actuated.
        InputError: A stiffness is not above zero, a rod's is given for a robot without rods, or a load is below zero.
    """
    robot, drives = machine.robot, _list_drives(machine.robot, actuators or {})
    if rod is not None and not rod > 0:
        raise InputError("invalid_value", f"a rod's stiffness must be above zero, not {rod}")
    if rod is not None and machine.rods is None:
        raise InputError("unsupported", f"{robot.source} has no rods; give --actuator-stiffness")
    if load is not None and not 0 <= load < np.inf:
        raise InputError("invalid_value", f"a load must be zero or a number of newtons above it, not {load:g}")
    missing, held = _find_not_stated(machine, rod, drives)
    if missing:
        words = ", ".join(missing)
        return Elasticity(
            None, f"unknown: no stiffness is stated for {words}; {_advise(machine)}", missing, load, robot.tool
        )
    try:
        stated = state_springs(robot, rods=rod, drives=drives) if rod is not None or drives else robot
        model = FlexibleModel(stated)
    except InputError as fault:
        return Elasticity(None, f"unknown: {fault.args[0]}", (), load, robot.tool)
    return Elasticity(model, _describe(model, rod, drives), held, load, robot.tool)


def _list_drives(robot: Robot, given: Mapping[str, float]) -> dict[str, float]:
    """Return the given stiffness by actuated joint; a value for a joint has priority over a value for all.

    Raises:
        UnknownName: A joint that is not actuated.
        InputError: A stiffness that is not above zero.
    """
    found = {}
    for name, value in sorted(given.items(), key=lambda item: item[0] != ""):
        if not value > 0:
            raise InputError(
                "invalid_value", f"the stiffness of actuator '{name or 'all'}' must be above zero, not {value}"
            )
        if name and name not in robot.actuated:
            raise UnknownName("actuated joint", name, robot.actuated)
        found |= dict.fromkeys([name] if name else robot.actuated, float(value))
    return found


def _find_not_stated(
    machine: WorkspaceModel, rod: float | None, drives: Mapping[str, float]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the springs whose missing stiffness makes the maps unknown, and the drives that count as held."""
    robot, rods = machine.robot, machine.rods
    in_file = {s.joint for s in robot.springs}
    stretched = [] if rods is None else [name for name in rods.names if name_rod_spring(name) not in in_file]
    missing = [] if rod is not None else stretched
    stated = {*drives, *(s.joint for s in robot.drive_springs)}
    others = tuple(joint for joint in robot.actuated if joint not in stated)
    yields = bool(in_file) or (rod is not None and bool(np.isfinite(rod)))
    if stated or not yields:  # some drives, or no spring at all
        missing = [*missing, *others]
    return tuple(missing), () if missing else others


def _advise(machine: WorkspaceModel) -> str:
    options = "--actuator-stiffness" if machine.rods is None else "--rod-stiffness and --actuator-stiffness"
    return (
        "state it by <tau_dyn:spring> and <tau_dyn:drive_spring> in the robot file, or by "
        f"{options} ('rigid' for a part that does not yield)"
    )


def _describe(model: FlexibleModel, rod: float | None, drives: Mapping[str, float]) -> str:
    """Return the source of the values."""
    as_given = [*(["rods"] if rod is not None else []), *(["drives"] if drives else [])]
    in_file = [
        s.joint
        for s in model.springs
        if s.joint not in drives and not (rod is not None and s.joint.endswith("_stretch"))
    ]
    parts = [f"{' and '.join(as_given)} as given"] if as_given else []
    if in_file:
        parts.append(f"the robot file's {len(in_file)}{' other' if as_given else ''} springs")
    return ", ".join(parts) + "; all else rigid"
