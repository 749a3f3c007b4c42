"""Inverse kinematics of a robot of rods: each chain for itself, or all together where the plate cannot take every pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.chain_inverse import NewtonChain, RootChain, build_chains
from tau_dyn.mechanism.kinematics import CommandedCoordinates
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.manifold_inverse import CommandedInverse, ManifoldInverse
from tau_dyn.mechanism.poses import (
    BRANCH_CHANGE,
    NOT_A_NUMBER,
    OK,
    OUT_OF_REACH,
    InverseResult,
    Poses,
    StraightWay,
    measure_turns,
)

_AGREE = 1e-9  # [m] largest gap of a rod when its chain was solved by another one
_WAY = 0.1  # steps from home for chains of several actuators, of the rods' length or rad


class RodInverse:
    """Inverse kinematics of one robot of rods."""

    def __init__(self, rods: Legs, commanded: Callable[[], CommandedCoordinates]) -> None:
        """Split the robot into chains; `commanded` is used if the plate cannot take every pose."""
        self.rods, self.chains = rods, build_chains(rods)
        whole = rods.translates or rods.na == 6
        self.separate = whole and all(isinstance(c, RootChain) or len(c.rods) == len(c.actuators) for c in self.chains)
        self.manifold: ManifoldInverse | None = None
        if not self.separate:
            asked = commanded()
            position = asked.by_position
            self.manifold = (
                ManifoldInverse(rods, self.chains) if position else CommandedInverse(rods, self.chains, asked)
            )

    def signs(self, configuration: Sequence[int] | np.ndarray | None) -> tuple[int, ...]:
        """Return a configuration's signs, home's by default.

        Raises:
            InputError: There is no such configuration.
        """
        if configuration is None:
            return tuple(chain.home_sign for chain in self.chains)
        signs = tuple(int(s) for s in configuration)
        if len(signs) != len(self.chains) or any(s not in c.signs for s, c in zip(signs, self.chains, strict=True)):
            wanted = ", ".join(" or ".join(map(str, chain.signs)) for chain in self.chains)
            raise InputError(
                "invalid_value", f"{self.rods.robot.source}: configuration {signs} does not exist; one holds ({wanted})"
            )
        return signs

    def signs_near(self, tool: Poses, q: np.ndarray) -> tuple[int, ...]:
        """Return the signs of the configuration that has positions (na,) at or near a pose (1 sample)."""
        B = self._plate_points(self._held(tool))
        found = []
        for chain in self.chains:
            roots = {chain.home_sign: 0.0}
            if isinstance(chain, RootChain):
                own = {s: chain.solve(B[chain.rods[0]], s, clipped=True)[0, 0] for s in chain.signs}
                roots = {s: abs(float(x) - q[chain.actuators[0]]) for s, x in own.items()}
            found.append(min(roots, key=lambda s: roots[s]))
        return tuple(found)

    def inverse(self, tool: Poses, signs: tuple[int, ...], start: np.ndarray | None, home: bool) -> InverseResult:
        """Return positions of one configuration, whatever their limits.

        Args:
            tool: Poses wanted.
            signs: The configuration.
            start: Positions (N, na) from which chains without a closed form are searched.
            home: Whether poses beyond a parallel singularity, seen from home, are refused.
        """
        wanted = self._held(tool)
        if self.manifold is not None:
            q, reached = self.manifold.solve(wanted, signs, home, start)
            return self._judged(tool, reached, q, home)
        return self._judged(tool, wanted, self._by_chains(wanted, signs, start), home)

    def all(self, tool: Poses) -> np.ndarray:
        """Return the positions of all configurations (N, n_configurations, na), nan where complex."""
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
        way = StraightWay(self.rods.tool_poses(self.rods.home), tool)
        far = np.nan_to_num(way.measure(float(np.mean(self.rods.lengths)))).max(initial=0.0)
        shares = np.linspace(0, 1, int(np.ceil(min(far / _WAY, 100.0))) + 1)[1:-1]
        places = [self._plate_points(way.at(share)) for share in shares]
        return np.array(places).reshape(-1, self.rods.n, 3, len(tool.position))

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

    def _judged(self, asked: Poses, reached: Poses, q: np.ndarray, home: bool) -> InverseResult:
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
        reached = self.rods.ridden(q, reached)
        away = np.linalg.norm(asked.position - reached.position, axis=1)
        turn = np.linalg.norm(measure_turns(asked.rotation, reached.rotation), axis=1)
        good = code == OK
        found = np.where(good[:, None], q, np.nan)
        blame[good | ~numbers] = ""
        turned = np.where(good[:, None, None], reached.rotation, np.nan)
        away, turn = np.where(good, away, np.nan), np.where(good, turn, np.nan)
        return InverseResult(found, code, away, turn, blame.astype(str), found, turned)

    def _beyond(self, q: np.ndarray, tool: Poses) -> np.ndarray:
        """Return where the plate is on the other side of a parallel singularity than at home (N,)."""
        rods = self.rods
        if rods.ride is not None:  # two spheres of the first rod's circle and one of another rod hold the point
            here, at_home = (rods.rod_directions(*x)[:, :3] for x in ((q, tool), (rods.robot.home[None], rods.home)))
            return np.linalg.det(np.where(np.isfinite(here), here, at_home)) * np.linalg.det(at_home) < 0
        if rods.n != (3 if rods.translates else 6):
            return np.zeros(len(q), bool)
        width = 3 if rods.translates else 6
        here = rods.gap_by_pose(q, rods.plate_poses(tool))[:, :, :width]
        at_home = rods.gap_by_pose(rods.robot.home[None], rods.home)[:, :, :width]
        here[~np.isfinite(here).all(axis=(1, 2))] = at_home
        return np.linalg.det(here) * np.linalg.det(at_home) < 0
