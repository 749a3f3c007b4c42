r"""Which assembly modes a robot reaches from home without crossing a singularity.

What is proven: a mode whose determinant `det gap_X` has the other sign than home's cannot be reached without crossing
a parallel singularity, nor one in another working mode without a serial one. A mode is reachable if a motion to it is
found along which no Jacobian is singular (`motion` says in which sense); the motion is returned. Otherwise the answer
is unknown: no search that ends proves that there is no motion. The search grows two trees of poses, from home and from
the mode (RRT-Connect, Kuffner & LaValle 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.motion import Limits, Sample, advance, measure_pose_distances, sample_at
from tau_dyn.kinematics.assembly.states import solve_configuration_states
from tau_dyn.mechanism import Poses, Rods

HOME, REACHABLE, SEPARATED, UNKNOWN = "home", "reachable", "behind a singularity", "unknown"

_EQUALITY_TOLERANCE = 1e-6
"""Positions and poses closer than this are one."""
_EXTENSION = 0.5
"""How far a tree grows towards a random pose, in lengths of `Limits.scale` and radians."""


class Reach(NamedTuple):
    """Whether one mode can be reached.

    Attributes:
        verdict: `home`, `reachable`, `behind a singularity` or `unknown`.
        why: A sentence.
        q: Actuated positions along the motion (M, na); empty where there is none.
        plate: Poses of the plate along it (M).
    """

    verdict: str
    why: str
    q: np.ndarray
    plate: Poses


def find_reachable_modes(
    rods: Rods,
    q: np.ndarray,
    modes: Poses,
    home: int,
    *,
    limits: bool = True,
    clearance: float = 0.0,
    n_samples: int = 200,
    seed: int = 1,
) -> list[Reach]:
    """Say of each real mode at one set of actuated positions whether the robot can move there from one of them.

    Args:
        rods: A robot with as many actuators and rods as its plate has freedoms.
        q: Actuated positions (na,).
        modes: The real modes' poses of the plate (m).
        home: Index of the mode in which the robot is.
        limits: Keep the actuators' limits on the way.
        clearance: Smallest distance between rods on the way [m]; 0 lets them cross.
        n_samples: Random poses to try for each mode.
        seed: Of these.

    Raises:
        InputError: The robot has more rods than actuators, or home is none of the modes.
    """
    q = np.asarray(q, float).ravel()
    if rods.na != rods.n:
        raise InputError(
            "unsupported",
            f"{rods.robot.source} has {rods.n} rods and {rods.na} actuators; motions between modes need as many",
        )
    if not 0 <= home < modes.n_samples:
        raise InputError("invalid_value", f"home is one of the {modes.n_samples} modes; there is no number {home}")
    kept = _limits(rods, limits, clearance)
    states = solve_configuration_states(rods, np.repeat(q[None], modes.n_samples, axis=0), modes)
    samples = [sample_at(rods, q, modes.take(slice(k, k + 1))) for k in range(modes.n_samples)]
    out = []
    for k, mode in enumerate(samples):
        said = _by_signs(states.assembly[[home, k]], states.working[[home, k]])
        if k == home:
            out.append(_answer(HOME, "the mode the robot is in", [mode]))
        elif said:
            out.append(_answer(SEPARATED, said, []))
        else:
            out.append(_search(rods, samples[home], mode, kept, n_samples, np.random.default_rng([seed, k])))
    return out


def _by_signs(assembly: np.ndarray, working: np.ndarray) -> str:
    """Return why two states are apart, or nothing."""
    if assembly[0] * assembly[1] < 0:
        return "the closure determinant has the other sign, so every motion crosses a parallel singularity"
    if (working[0] * working[1] < 0).any():
        return "a chain is in its other working mode, so every motion crosses a serial singularity"
    return ""


def _search(rods: Rods, home: Sample, mode: Sample, limits: Limits, n_samples: int, rng: np.random.Generator) -> Reach:
    """Grow two trees until they meet."""
    trees = [_Tree(home), _Tree(mode)]
    for k in range(n_samples):
        target = mode.plate  # first the straight way
        if k > 0:
            target = trees[1].grow(rods, _random_pose(rods, home, mode, rng), limits, _EXTENSION).plate
        new = trees[0].grow(rods, target, limits, np.inf)
        met = trees[1].holds(new, limits.scale)
        if met is not None:
            halves = trees[0].way(new), trees[1].way(met)
            first, second = halves if trees[0].root is home else halves[::-1]
            return _answer(REACHABLE, "a motion without a singularity was found", first + second[-2::-1])
        trees.reverse()
    why = f"the determinant has the same sign, but {n_samples} random poses gave no motion; that does not prove there is none"
    return _answer(UNKNOWN, why, [])


class _Tree:
    """Samples that a motion from the root reaches."""

    def __init__(self, root: Sample) -> None:
        self.root = root
        self.samples, self.parents = [root], [-1]
        self.q, self.plate = root.q[None], root.plate

    def grow(self, rods: Rods, target: Poses, limits: Limits, reach: float) -> Sample:
        """Move from the nearest sample towards a pose and keep the way; return where it ended."""
        parent = int(np.argmin(measure_pose_distances(self.plate, target, limits.scale)))
        motion, _ = advance(rods, self.samples[parent], target, limits, reach)
        for sample in motion:
            self.parents.append(parent)
            parent = len(self.samples)
            self.samples.append(sample)
        if motion:
            self.q = np.concatenate([self.q, [s.q for s in motion]])
            self.plate = _joined([self.plate, *(s.plate for s in motion)])
        return self.samples[parent]

    def holds(self, sample: Sample, scale: float) -> Sample | None:
        """Return the own sample that is the same pose at the same actuated positions."""
        same = (np.abs(self.q - sample.q).max(axis=1) < _EQUALITY_TOLERANCE) & (
            measure_pose_distances(self.plate, sample.plate, scale) < _EQUALITY_TOLERANCE
        )
        return self.samples[int(np.argmax(same))] if same.any() else None

    def way(self, sample: Sample) -> list[Sample]:
        """Return the samples from the root to one of the tree's."""
        k = next(i for i, own in enumerate(self.samples) if own is sample)
        back = []
        while k >= 0:
            back.append(self.samples[k])
            k = self.parents[k]
        return back[::-1]


def _random_pose(rods: Rods, home: Sample, mode: Sample, rng: np.random.Generator) -> Poses:
    """Draw a pose about the two modes: within half a rod's length of the line between them, any orientation."""
    share, spread = rng.uniform(), 0.5 * rods.lengths.mean()
    position = (
        home.plate.position + share * (mode.plate.position - home.plate.position) + rng.uniform(-spread, spread, 3)
    )
    rotation = rods.rotation if rods.translates else Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return Poses(position, rotation[None])


def _limits(rods: Rods, keep: bool, clearance: float) -> Limits:
    """Return the limits of a search; poses are measured in rods' lengths."""
    everywhere = np.full(rods.na, np.inf)
    lower, upper = (rods.robot.lower, rods.robot.upper) if keep else (-everywhere, everywhere)
    return Limits(lower, upper, clearance, float(rods.lengths.mean()))


def _answer(verdict: str, why: str, samples: list[Sample]) -> Reach:
    """Put a motion's samples into arrays."""
    if not samples:
        return Reach(verdict, why, np.zeros((0, 0)), Poses(np.zeros((0, 3)), np.zeros((0, 3, 3))))
    return Reach(verdict, why, np.array([s.q for s in samples]), _joined([s.plate for s in samples]))


def _joined(poses: list[Poses]) -> Poses:
    return Poses(np.concatenate([p.position for p in poses]), np.concatenate([p.rotation for p in poses]))
