r"""Inverse kinematics: which actuated positions put the tool at a pose (thesis (4.2)).

Rods make the chains independent of each other, so each is solved for itself (`chain_inverse.py`). A chain of one actuator
has two solutions, named by a sign, and all chains together up to `2^k`: the *configuration*. It is not related to the
assembly mode of forward kinematics (thesis 4.2). Without a configuration home's is taken, and a pose that lies beyond a
parallel singularity from home is refused as `branch change`.

A free plate on fewer than six actuators cannot take every pose: it takes the position asked for, and the orientation as
far as it has freedoms left (`manifold_inverse.py`); `Inverse.orientation_error` says what is missing. A translating plate
keeps its orientation, whatever is asked for. A tree (`tree_pose.py`) does the same by priority.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.chain_inverse import NewtonChain, RootChain, chains_of
from tau_dyn.kinematics.engines import engine_of, robot_of, rods_of
from tau_dyn.kinematics.kept import kept
from tau_dyn.kinematics.manifold_inverse import ManifoldInverse
from tau_dyn.kinematics.outcome import BRANCH_CHANGE, JOINT_LIMIT, NOT_A_NUMBER, OK, OUT_OF_REACH, Inverse
from tau_dyn.kinematics.plate_arrays import log_of, turned_by
from tau_dyn.kinematics.poses import Poses, checked_poses
from tau_dyn.kinematics.rods import Rods, checked_positions
from tau_dyn.kinematics.tree_inverse import tree_inverse, tree_solutions
from tau_dyn.kinematics.tree_newton import TreeNewton
from tau_dyn.kinematics.tree_pose import TreePose
from tau_dyn.robot import Robot

__all__ = ["Inverse", "configurations", "home_configuration", "inverse_kinematics", "inverse_solutions"]

_AGREE = 1e-9  # [m] what a rod may lack when its chain was solved by another one
_SLACK = 1e-9  # [m or rad] rounding at a joint limit
_WAY = 0.1  # steps from home for chains of several actuators, of the rods' length or rad


def inverse_kinematics(
    robot: Robot | Rods,
    poses: Poses,
    *,
    configuration: Sequence[int] | np.ndarray | None = None,
    start: np.ndarray | None = None,
    limits: bool = True,
) -> Inverse:
    """Return the actuated positions that put the tool at poses.

    Args:
        robot: A robot, or its rods (perhaps with another geometry).
        poses: Of the tool (N).
        configuration: One of `configurations`, a sign for each chain; by default home's.
        start: Positions (N or 1, na) from which to search, where a chain has no closed form, by default home. Where actuators
            can move without the tool (a telescopic arm, a serial arm with a joint to spare), the positions nearest to it
            are taken. It does not choose the configuration; `follow` does.
        limits: Whether positions outside the file's joint limits are refused.

    Raises:
        InputError: Arrays of the wrong shape, an unknown configuration, or joint limits that are the wrong way round.
    """
    rods, poses = rods_of(robot), checked_poses(poses)
    owner = robot_of(robot)
    start = None if start is None else _starts(owner, start, len(poses.position))
    if limits:
        _check_limits(owner)
    if rods is None:
        if configuration is not None:
            raise InputError(f"{owner.source}: has no rods, hence no named configurations; give a start instead")
        return _limited(owner, tree_inverse(_tree(robot), poses, start, limits), limits)
    solver = _solver(rods)
    return _limited(owner, solver.inverse(poses, solver.signs(configuration), start, configuration is None), limits)


def inverse_solutions(robot: Robot | Rods, poses: Poses) -> np.ndarray:
    """Return the positions of all configurations (N, n_configurations, na), nan where complex; joint limits are not looked at.

    Rods in closed form: rows as `configurations`. Chains of several actuators and trees: what many starts find, nearest to
    home first, not certified to be all.
    """
    rods, poses = rods_of(robot), checked_poses(poses)
    if rods is None:
        return tree_solutions(_tree(robot), poses)
    return _solver(rods).all(poses)


def configurations(robot: Robot | Rods) -> np.ndarray:
    """Return the configurations by name (n, chains): -1 or 1 of a chain with two solutions, 1 of a leg, 0 by Newton.

    Raises:
        InputError: The robot has no rods.
    """
    return np.array(list(product(*(chain.signs for chain in _solver(_rods(robot)).chains))))


def nearest_configuration(rods: Rods, poses: Poses, q: np.ndarray) -> np.ndarray:
    """Return the configuration (chains,) that has positions (na,) at or near a pose (1 sample)."""
    return np.array(_solver(rods).signs_near(checked_poses(poses), q))


def home_configuration(robot: Robot | Rods) -> np.ndarray:
    """Return home's configuration (chains,)."""
    return np.array(_solver(_rods(robot)).signs(None))


class _RodInverse:
    """Inverse kinematics of one robot of rods."""

    def __init__(self, rods: Rods) -> None:
        self.rods, self.chains = rods, chains_of(rods)
        whole = rods.translates or rods.na == 6
        self.separate = whole and all(isinstance(c, RootChain) or len(c.rods) == len(c.actuators) for c in self.chains)
        self.manifold = None if self.separate else ManifoldInverse(rods, self.chains)

    def signs(self, configuration: Sequence[int] | np.ndarray | None) -> tuple[int, ...]:
        if configuration is None:
            return tuple(chain.home_sign for chain in self.chains)
        signs = tuple(int(s) for s in configuration)
        if len(signs) != len(self.chains) or any(s not in c.signs for s, c in zip(signs, self.chains, strict=True)):
            wanted = ", ".join(" or ".join(map(str, chain.signs)) for chain in self.chains)
            raise InputError(f"{self.rods.robot.source}: configuration {signs} does not exist; one holds ({wanted})")
        return signs

    def signs_near(self, tool: Poses, q: np.ndarray) -> tuple[int, ...]:
        B = self._plate_points(self._held(tool))
        found = []
        for chain in self.chains:
            roots = {chain.home_sign: 0.0}
            if isinstance(chain, RootChain):
                own = {s: chain.solve(B[chain.rods[0]], s, clipped=True)[0, 0] for s in chain.signs}
                roots = {s: abs(float(x) - q[chain.actuators[0]]) for s, x in own.items()}
            found.append(min(roots, key=lambda s: roots[s]))
        return tuple(found)

    def inverse(self, tool: Poses, signs: tuple[int, ...], start: np.ndarray | None, home: bool) -> Inverse:
        wanted = self._held(tool)
        if self.manifold is not None:
            q, rotation = self.manifold.solve(wanted, signs, home, start)
            return self._judged(tool, Poses(wanted.position, rotation), q, home)
        return self._judged(tool, wanted, self._by_chains(wanted, signs, start), home)

    def all(self, tool: Poses) -> np.ndarray:
        wanted = self._held(tool)
        if self.manifold is not None:
            signs = list(product(*(chain.signs for chain in self.chains)))
            return np.stack([self.manifold.solve(wanted, s, walk=False)[0] for s in signs], axis=1)
        B = self._plate_points(wanted)
        each = [self._chain_solutions(chain, B) for chain in self.chains]
        rows = []
        for choice in product(*each):
            q = np.full((len(tool.position), self.rods.na), np.nan)
            for chain, own in zip(self.chains, choice, strict=True):
                q[:, list(chain.actuators)] = own.T
            q[~np.isfinite(q).all(axis=1)] = np.nan
            rows.append(self._agreeing(q, wanted))
        return np.stack(rows, axis=1)

    def _chain_solutions(self, chain: RootChain | NewtonChain, B: np.ndarray) -> list[np.ndarray]:
        if isinstance(chain, RootChain):
            return [chain.solve(B[chain.rods[0]], sign) for sign in chain.signs]
        return chain.all(B[list(chain.rods)]) or [np.full((len(chain.actuators), B.shape[2]), np.nan)]

    def _by_chains(self, tool: Poses, signs: tuple[int, ...], start: np.ndarray | None) -> np.ndarray:
        B = self._plate_points(tool)
        q = np.full((len(tool.position), self.rods.na), np.nan)
        ways: np.ndarray | None = None
        for chain, sign in zip(self.chains, signs, strict=True):
            columns = list(chain.actuators)
            if isinstance(chain, RootChain):
                q[:, columns] = chain.solve(B[chain.rods[0]], sign).T
                continue
            own = B[list(chain.rods)]
            if start is not None:
                q[:, columns] = chain.newton(own, start[:, columns].T).T
            else:
                ways = self._ways(tool) if ways is None else ways
                q[:, columns] = chain.solve(own, ways[:, list(chain.rods)]).T
        return q

    def _ways(self, tool: Poses) -> np.ndarray:
        """Return the plate's points (steps, n, 3, N) on the straight way from home to poses, those included left out."""
        home = self.rods.tool_poses(self.rods.home)
        sound = np.isfinite(tool.position).all(axis=1)
        turn = np.nan_to_num(log_of(np.moveaxis(tool.rotation @ home.rotation[0].T, 0, 2)))
        away = tool.position - home.position
        far = np.linalg.norm(away[sound], axis=1).max(initial=0.0) / float(np.mean(self.rods.lengths))
        steps = int(np.ceil(min(max(far, np.abs(turn).max(initial=0.0)) / _WAY, 100.0)))
        start = np.repeat(np.moveaxis(home.rotation, 0, 2), len(away), axis=2)
        shares = np.linspace(0, 1, steps + 1)[1:-1]
        poses = [Poses(home.position + s * away, np.moveaxis(turned_by(s * turn, start), 2, 0)) for s in shares]
        return (
            np.stack([self._plate_points(pose) for pose in poses])
            if poses
            else np.zeros((0, self.rods.n, 3, len(away)))
        )

    def _plate_points(self, tool: Poses) -> np.ndarray:
        return self.rods.plate_points(self.rods.plate_poses(tool)).transpose(1, 2, 0)

    def _held(self, tool: Poses) -> Poses:
        """Return the poses with the rotation that a translating plate keeps."""
        if not self.rods.translates:
            return tool
        kept = self.rods.rotation @ self.rods.tool.rotation
        return Poses(tool.position, np.broadcast_to(kept, (len(tool.position), 3, 3)))

    def _agreeing(self, q: np.ndarray, tool: Poses) -> np.ndarray:
        """Return positions (N, na) with those taken out that leave another rod of a chain open."""
        gap = np.abs(self.rods.gap(q, self.rods.plate_poses(tool))).max(axis=1)
        return np.where((gap < _AGREE)[:, None], q, np.nan)

    def _judged(self, asked: Poses, reached: Poses, q: np.ndarray, home: bool) -> Inverse:
        code = np.full(len(q), OK, np.int8)
        blame = np.full(len(q), "", object)
        numbers = np.isfinite(asked.position).all(axis=1) & np.isfinite(asked.rotation).all(axis=(1, 2))
        for chain in self.chains:
            lost = ~np.isfinite(q[:, list(chain.actuators)]).all(axis=1)
            code[lost] = OUT_OF_REACH
            names = " ".join(self.rods.robot.actuated[a] for a in chain.actuators)
            blame[lost & (blame == "")] = names
        open_ = (code == OK) & np.isnan(self._agreeing(q, reached)[:, 0])
        code[open_] = OUT_OF_REACH
        if home:
            code[(code == OK) & self._beyond(q, reached)] = BRANCH_CHANGE
        code[~numbers] = NOT_A_NUMBER
        turn = np.linalg.norm(log_of(np.moveaxis(asked.rotation @ np.swapaxes(reached.rotation, 1, 2), 0, 2)), axis=0)
        good = code == OK
        found = np.where(good[:, None], q, np.nan)
        blame[good | ~numbers] = ""
        zero = np.where(good, 0.0, np.nan)
        turned = np.where(good[:, None, None], reached.rotation, np.nan)
        return Inverse(found, code, zero, np.where(good, turn, np.nan), blame.astype(str), found, turned)

    def _beyond(self, q: np.ndarray, tool: Poses) -> np.ndarray:
        """Return where the plate is on the other side of a parallel singularity than at home (N,)."""
        rods = self.rods
        if rods.n != (3 if rods.translates else 6):
            return np.zeros(len(q), bool)
        width = 3 if rods.translates else 6
        here = rods.gap_by_pose(q, rods.plate_poses(tool))[:, :, :width]
        at_home = rods.gap_by_pose(rods.robot.home[None], rods.home)[:, :, :width]
        here[~np.isfinite(here).all(axis=(1, 2))] = at_home
        return np.linalg.det(here) * np.linalg.det(at_home) < 0


def _solver(rods: Rods) -> _RodInverse:
    return kept(rods, "inverse", lambda: _RodInverse(rods))


def _tree(robot: Robot | Rods) -> TreeNewton:
    engine = engine_of(robot)
    assert isinstance(engine, TreePose)
    return kept(robot, "inverse", lambda: TreeNewton(engine))


def _rods(robot: Robot | Rods) -> Rods:
    rods = rods_of(robot)
    if rods is None:
        raise InputError(f"{robot_of(robot).source}: has no rods, hence no named configurations")
    return rods


def _starts(robot: Robot, start: np.ndarray, n: int) -> np.ndarray:
    start = checked_positions(robot, start)
    if len(start) not in (1, n):
        raise InputError(f"start must hold one row of positions or {n}, one a pose, not {len(start)}")
    return np.repeat(start, n, axis=0) if len(start) != n else start


def _check_limits(robot: Robot) -> None:
    for name, low, high in zip(robot.actuated, robot.lower, robot.upper, strict=True):
        if low > high:
            raise InputError(
                f"{robot.source}: joint '{name}': its lower limit {low:g} is above its upper limit {high:g}"
            )


def _limited(robot: Robot, found: Inverse, limits: bool) -> Inverse:
    """Return the positions with those outside joint limits refused; a turn may be a whole one away."""
    if not limits:
        return found
    q = found.q.copy()
    for k, kind in enumerate(robot.joint_kinds):
        if kind == "revolute":
            for turn in (2 * np.pi, -2 * np.pi):
                outside = (q[:, k] < robot.lower[k] - _SLACK) | (q[:, k] > robot.upper[k] + _SLACK)
                moved = q[:, k] + turn
                fits = outside & (moved >= robot.lower[k] - _SLACK) & (moved <= robot.upper[k] + _SLACK)
                q[fits, k] = moved[fits]
    with np.errstate(invalid="ignore"):
        beyond = np.any([q < robot.lower - _SLACK, q > robot.upper + _SLACK], axis=0)
    bad = beyond.any(axis=1)
    culprit = found.culprit.astype(object)
    for k in np.flatnonzero(bad):
        culprit[k] = " ".join(name for name, wrong in zip(robot.actuated, np.ravel(beyond[k]), strict=True) if wrong)
    code = np.where(bad, JOINT_LIMIT, found.code).astype(np.int8)
    allowed = np.where(bad[:, None], np.nan, q)
    lost = np.where(bad, np.nan, 1.0)
    return Inverse(
        allowed,
        code,
        found.position_error * lost,
        found.orientation_error * lost,
        culprit.astype(str),
        q,
        found.rotation,
    )
