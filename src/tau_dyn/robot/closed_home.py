"""A home at which the loops of a robot close, for files whose zero positions do not close them.

The zero position of a stretched mechanism is a dead centre, and zeros chosen by a CAD program may close no loop at all. Least
squares on the gaps `p_A - p_B`, started at the file's home and at random positions, moves the passive joints, or all joints if
that is not enough. The closure within the limits that is nearest to the file's home is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot.robot import Robot

_CLOSED = 1e-9  # [m] largest gap of a closed loop
_ALIKE = 1e-4  # [rad or m] difference of joint positions below which two closures are equal
_STARTS = 30  # at random; a chain of six passive joints with four assembly modes closes from each tenth
_NEWTON_STEPS = 30  # the number of iterations of the loop solver
_MAX_STEP = 0.5  # [m or rad] of a passive joint in one step of Newton's method
_BLIND = 1e-9  # share of the largest singular value below which directions are not moved
_MAX_CLOSURES = 6  # closures that end the search
_MAX_EVALUATIONS = 200  # iterations of one descent; one that reaches a closure takes about ten
_FREE_SLIDE = 1.0  # [m] reach of a slide without limits
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
_NAMED = 6  # joints in a message


def close_home(robot: Robot) -> Robot:
    """Return the robot with a home at which its loops close, and a warning that states it; unchanged if its home closes them.

    If no start leads to a closure, the robot is returned unchanged, and closing its loops raises later.
    """
    passive = [int(k) for k in robot.passive_v]
    if any(joint.nv != 1 for joint in robot.model.joints[1:]) or not passive:
        return robot
    gap = LoopGap(robot)
    x = gap.solve_from_home()
    if x is not None:
        far = np.abs(x - gap.home).max() > _MAX_STEP
        return replace(robot, passive_home=gap.name_passive(x)) if far else robot
    for moved in (passive, [*passive, *map(int, robot.active_v)]):
        found = gap.search(moved)
        if found:
            return _with_home(gap, found, moved)
    return robot


class LoopGap:
    """The loops' gaps of one tree over the positions of its joints `x` (nv,), turns in rad."""

    def __init__(self, robot: Robot) -> None:
        """Find the joints' places, limits and followers, and the file's home."""
        self.robot, self.data = robot, robot.model.createData()
        share, offset = robot.coupling
        self.share, self.offset = share, offset
        self.home = share @ robot.home + offset
        self.spread = np.eye(robot.model.nv)  # positions of all joints by each joint, including its followers
        self.spread[:, robot.active_v] = share / robot.drive_scale
        joints = list(robot.model.joints)[1:]
        self.names = {joint.idx_v: name for name, joint in zip(robot.model.names[1:], joints, strict=True)}
        self.turns = np.zeros(robot.model.nv, bool)
        self.lower, self.upper = np.full(robot.model.nv, -np.inf), np.full(robot.model.nv, np.inf)
        for joint in joints:
            self.turns[joint.idx_v] = "JointModelP" not in joint.shortname()
            if joint.nq == 1:
                self.lower[joint.idx_v] = robot.model.lowerPositionLimit[joint.idx_q]
                self.upper[joint.idx_v] = robot.model.upperPositionLimit[joint.idx_q]
        for name, value in robot.passive_home.items():
            self.home[robot.model.joints[robot.model.getJointId(name)].idx_v] = value

    def name_passive(self, x: np.ndarray) -> dict[str, float]:
        """Return the positions of the passive joints by name."""
        return {self.names[k]: float(x[k]) for k in map(int, self.robot.passive_v)}

    def measure(self, x: np.ndarray) -> np.ndarray:
        """Return the gaps (3 loops,) [m] at positions of all joints (nv,)."""
        model, data, loops = self.robot.model, self.data, self.robot.loops
        pin.framesForwardKinematics(model, data, pin.integrate(model, pin.neutral(model), x))
        return np.concatenate([data.oMf[k.frame_a].translation - data.oMf[k.frame_b].translation for k in loops])

    def follow(self, x: np.ndarray) -> np.ndarray:
        """Return positions (nv,) in which joints that follow actuated ones have the positions given by these."""
        active = self.robot.active_v
        placed = self.share @ (x[active] / self.robot.drive_scale) + self.offset
        rows = self.share.any(axis=1)
        return np.where(rows, placed, x)

    def differentiate(self, x: np.ndarray, moved: list[int]) -> np.ndarray:
        """Return the gaps' derivative (3 loops, moved) by the positions of some joints, with their followers."""
        model, data = self.robot.model, self.data
        pin.computeJointJacobians(model, data, pin.integrate(model, pin.neutral(model), x))
        pin.updateFramePlacements(model, data)
        rows = [
            pin.getFrameJacobian(model, data, loop.frame_a, _WORLD)[:3]
            - pin.getFrameJacobian(model, data, loop.frame_b, _WORLD)[:3]
            for loop in self.robot.loops
        ]
        return np.concatenate(rows) @ self.spread[:, moved]

    def descend(self, start: np.ndarray, moved: list[int]) -> np.ndarray | None:
        """Return the closure (nv,) that least squares over some joints reaches; None if gaps remain."""

        def place(part: np.ndarray) -> np.ndarray:
            x = start.copy()
            x[moved] = part
            return self.follow(x)

        def slope(part: np.ndarray) -> np.ndarray:
            return self.differentiate(place(part), moved)

        stop = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": _MAX_EVALUATIONS}
        end = least_squares(lambda x: self.measure(place(x)), start[moved], jac=slope, **stop)  # pyright: ignore[reportArgumentType]
        x = place(end.x)
        return x if np.abs(self.measure(x)).max() < _CLOSED else None

    def solve_from_home(self) -> np.ndarray | None:
        """Return the closure (nv,) that Newton's method finds for the passive joints from the file's home, or None."""
        x, moved = self.home.copy(), [int(k) for k in self.robot.passive_v]
        for _ in range(_NEWTON_STEPS):
            gap = self.measure(x)
            if np.abs(gap).max() < _CLOSED:
                return x
            step = -np.linalg.pinv(self.differentiate(x, moved), rcond=_BLIND) @ gap
            x[moved] += step * min(1.0, _MAX_STEP / max(np.abs(step).max(), 1e-300))
        return None

    def search(self, moved: list[int]) -> list[np.ndarray]:
        """Return closures (nv,) within the limits, the nearest to the file's home first."""
        found: list[np.ndarray] = []
        for start in self._list_starts(moved):
            x = self.descend(start, moved)
            x = None if x is None else self._wrap(x)
            if x is not None and all(np.abs(x - other).max() > _ALIKE for other in found):
                found.append(x)
            if len(found) == _MAX_CLOSURES:
                break
        return sorted(found, key=lambda x: (round(float(np.sum((x - self.home)[moved] ** 2)), 6), *(-x).tolist()))

    def _list_starts(self, moved: list[int]) -> Iterator[np.ndarray]:
        """Yield starts (nv,): near the home first, then over the whole range of the limits."""
        rng, reach = np.random.default_rng(0), np.where(self.turns, np.pi, _FREE_SLIDE)
        lower, upper = np.maximum(self.lower, self.home - reach), np.minimum(self.upper, self.home + reach)
        yield self.home
        for share in np.linspace(0.1, 1.0, _STARTS):
            x, at = self.home.copy(), self.home[moved]
            low, high = (at + share * (end[moved] - at) for end in (lower, upper))
            x[moved] = rng.uniform(np.minimum(low, high), np.maximum(low, high))
            yield x

    def _wrap(self, x: np.ndarray) -> np.ndarray | None:
        """Return angles within half a turn of the home if the limits permit it; None beyond the limits."""
        near = np.where(self.turns, self.home + (x - self.home + np.pi) % (2 * np.pi) - np.pi, x)
        for shift in (0.0, 2 * np.pi, -2 * np.pi):
            out = self.turns & ((near < self.lower - _ALIKE) | (near > self.upper + _ALIKE))
            near = np.where(out & (near + shift >= self.lower) & (near + shift <= self.upper), near + shift, near)
        inside = (near >= self.lower - _ALIKE) & (near <= self.upper + _ALIKE)
        return near if inside.all() else None


def _with_home(gap: LoopGap, found: list[np.ndarray], moved: list[int]) -> Robot:
    """Return the robot with the first closure as its home."""
    robot, first = gap.robot, found[0]
    passive = gap.name_passive(first)
    actuated = first[robot.active_v] / robot.drive_scale
    shown = {gap.names[k]: f"{first[k]:.4g} {'rad' if gap.turns[k] else 'm'}" for k in moved}
    listed = ", ".join(f"{name} = {value}" for name, value in list(shown.items())[:_NAMED])
    more = f" and {len(shown) - _NAMED} more" if len(shown) > _NAMED else ""
    others = f"; {len(found) - 1} other closures were found" if len(found) > 2 else ""
    others = "; one other closure was found" if len(found) == 2 else others
    sentence = (
        f"{robot.source}: its loops do not close from the file's home; one is taken at {listed}{more}{others}; "
        "<tau_dyn:home joint=.. value=../> in the file chooses another"
    )
    said = CodedWarning("home_searched", sentence)
    return replace(robot, home=actuated, passive_home=passive, warnings=(*robot.warnings, said))
