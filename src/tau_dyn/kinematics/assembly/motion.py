"""Sides of the singularities of a parallel robot, and the assembly modes between which it can move.

The rods' closure `gap(q, X) = 0` gives `gap_X V + gap_q v = 0`. If `det gap_X = 0`, the actuators do not constrain the plate
(parallel singularity); if a chain's block of `gap_q` is singular, the chain is stretched or folded (serial singularity). A
continuous motion changes a determinant's sign only through zero, so the signs define the state: the sign of `gap_X` is the
assembly, the signs of the blocks of `gap_q` are the working mode, the thesis' configuration `c` (4.2). A mode in another state
cannot be reached without crossing a singularity.

A mode in the same state is reachable if a motion to it is found. The pose moves along a straight line with one rotation; the
actuated positions follow by Newton steps. Between two samples both Jacobians may change by less than half their smallest
singular value, so no matrix on the line between the two is singular (Weyl); steps are halved until this holds. The search grows
two trees of poses, from home and from the mode (RRT-Connect, Kuffner & LaValle 2000). If it ends without a motion, the answer is
unknown. References: Gosselin & Angeles 1990, IEEE Trans. Robotics and Automation 6, 281; Merlet 2006, ch. 6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, Rods, StraightWay

_NOISE = 1e-10
"""Smallest singular value, as a share of the largest, below which a determinant has no sign."""


class States(NamedTuple):
    """States at N poses.

    Attributes:
        assembly: Sign of `det gap_X` (N,); 0 on a parallel singularity.
        working: Signs of the chains' blocks of `det gap_q` (N, n_chains), as `rods.groups`; 0 on a serial singularity, and if
            a chain has more rods than actuators.
        distance: Smallest singular value of the dimensionless `gap_X` (N,): 0 on a parallel singularity.
    """

    assembly: np.ndarray
    working: np.ndarray
    distance: np.ndarray

    @property
    def names(self) -> list[str]:
        """Return each state as text, as `+ | + - +` (N)."""
        sign = {1: "+", -1: "-", 0: "0"}
        return [
            f"{sign[int(a)]} | {' '.join(sign[int(w)] for w in row)}"
            for a, row in zip(self.assembly, self.working, strict=True)
        ]


def solve_configuration_states(rods: Rods, q: np.ndarray, plate: Poses) -> States:
    """Return the states at positions (N, na) and poses of the plate (N) that fit them.

    Raises:
        InputError: The number of rods differs from the plate's degrees of freedom.
    """
    parallel = compute_plate_jacobian(rods, q, plate)
    assembly, distance = _signs(parallel)
    serial = rods.gap_by_q(q, plate)
    working = [_signs(serial[:, list(rows)][:, :, list(columns)])[0] for rows, columns in rods.groups]
    return States(assembly, np.array(working, dtype=int).T, distance)


def compute_plate_jacobian(rods: Rods, q: np.ndarray, plate: Poses) -> np.ndarray:
    """Return `gap_X` (N, n, n) by the plate's twist, turns multiplied by the rods' mean distance from the plate's centre."""
    J = rods.gap_by_pose(q, plate)
    freedoms = 3 if rods.translates else 6
    if rods.n != freedoms:
        raise InputError(
            "unsupported",
            f"{rods.robot.source} has {rods.n} rods; states need as many as the plate has freedoms, {freedoms}",
        )
    if rods.translates:
        return J[:, :, :3]
    centre = rods.on_plate.mean(axis=0)
    size = np.linalg.norm(rods.on_plate - centre, axis=1).mean()
    arm = plate.rotation @ centre
    about = J[:, :, 3:] - np.cross(
        arm[:, None], J[:, :, :3]
    )  # turns about the rods' mean point, so that the frame's place is free
    return np.concatenate([J[:, :, :3], about / size], axis=2)


def _signs(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the determinants' signs (N,), 0 if rounding hides them, and the smallest singular values (N,)."""
    if J.shape[1] != J.shape[2]:
        return np.zeros(len(J), dtype=int), np.zeros(len(J))
    values = np.linalg.svd(J, compute_uv=False)
    sign = np.sign(np.linalg.det(J)).astype(int)
    return np.where(values[:, -1] > _NOISE * values[:, 0], sign, 0), values[:, -1]


_CLOSED = 1e-10  # [m] largest gap of a sample
_CHORDS = 12
"""Newton steps with the Jacobian of the previous sample; since it is near, each step gains a digit or more."""
_SHARE = 0.5
"""Change of a Jacobian between samples, as a share of its smallest singular value."""
_MIN_STEP_RATIO = 1e-4
"""Shortest step, as a share of the longest, before a motion counts as blocked."""


class Sample(NamedTuple):
    """One point of a motion.

    Attributes:
        q: Actuated positions (na,).
        plate: Pose of the plate (1 sample).
        parallel: Closure Jacobian by the plate's twist (n, n), dimensionless.
        serial: Closure Jacobian by the actuated positions (n, na).
        margin: Smallest singular values of both Jacobians.
    """

    q: np.ndarray
    plate: Poses
    parallel: np.ndarray
    serial: np.ndarray

    margin: tuple[float, float]


class Limits(NamedTuple):
    """Limits of a motion.

    Attributes:
        lower: Lower limits of the actuated positions (na,).
        upper: Upper limits.
        clearance: Smallest distance between two rods that share no point [m]; 0 to let them cross.
        scale: Length that counts as much as a turn by one radian [m].
        longest: Longest step, in those units.
    """

    lower: np.ndarray
    upper: np.ndarray
    clearance: float
    scale: float
    longest: float = 0.1


def sample_at(rods: Rods, q: np.ndarray, plate: Poses) -> Sample:
    """Return the sample at positions (na,) and a pose that fit."""
    parallel, serial = compute_plate_jacobian(rods, q[None], plate)[0], rods.gap_by_q(q[None], plate)[0]
    return Sample(q, plate, parallel, serial, (_smallest(parallel), _smallest(serial)))


def advance(rods: Rods, start: Sample, goal: Poses, limits: Limits, reach: float = np.inf) -> tuple[list[Sample], bool]:
    """Move towards a pose and return the samples after the start, and whether the pose was reached.

    Args:
        rods: The robot.
        start: First sample.
        goal: One pose of the plate.
        limits: Limits of the motion.
        reach: Distance after which the motion ends, in the units of `limits.scale`.
    """
    way = float(measure_pose_distances(start.plate, goal, limits.scale)[0])
    if way == 0:
        return [], True
    end, line = min(1.0, reach / way), StraightWay(start.plate, goal)
    done, step, motion = 0.0, limits.longest / way, []
    here = start
    while done < end:
        step = min(step, end - done)
        there = _next(rods, here, line.at(done + step), limits)
        if there is None:
            step /= 2
            if step * way < _MIN_STEP_RATIO * limits.longest:
                return motion, False
            continue
        motion.append(there)
        here, done, step = there, done + step, min(2 * step, limits.longest / way)
    return motion, end == 1.0


def measure_pose_distances(a: Poses, b: Poses, scale: float) -> np.ndarray:
    """Return the distances (N,) of poses (N) from one pose: metres over `scale` plus radians."""
    chord = np.linalg.norm(a.rotation - b.rotation, axis=(1, 2)) / np.sqrt(8)  # sin of half the angle between them
    return np.linalg.norm(a.position - b.position, axis=1) / scale + 2 * np.arcsin(np.minimum(chord, 1.0))


def measure_rod_distance(rods: Rods, q: np.ndarray, plate: Poses) -> float:
    """Return the smallest distance [m] between two rods that share no end, at one pose."""
    A, B = rods.base_points(q[None])[0], rods.plate_points(plate)[0]
    i, j = np.triu_indices(rods.n, 1)
    own = (np.linalg.norm(A[i] - A[j], axis=1) > 1e-9) & (np.linalg.norm(B[i] - B[j], axis=1) > 1e-9)
    return float(_segments(A[i[own]], B[i[own]], A[j[own]], B[j[own]]).min(initial=np.inf))


def _next(rods: Rods, here: Sample, pose: Poses, limits: Limits) -> Sample | None:
    """Return the sample at a pose nearby, or None if it violates a limit or is too far for a proof."""
    q = here.q
    for _ in range(_CHORDS):
        gap = rods.gap(q[None], pose)[0]
        if not np.isfinite(gap).all():
            return None
        if np.abs(gap).max() < _CLOSED:
            break
        q = q - np.linalg.solve(here.serial, gap)  # regular, or the search would not be here
    else:
        return None
    if (q < limits.lower - 1e-9).any() or (q > limits.upper + 1e-9).any():
        return None
    there = sample_at(rods, q, pose)
    if limits.clearance and measure_rod_distance(rods, q, pose) < limits.clearance:
        return None
    return there if is_regular_between(here, there) else None


def is_regular_between(a: Sample, b: Sample) -> bool:
    """Return whether all Jacobians on the line between those of two samples are regular."""
    pairs = zip((a.parallel, a.serial), (b.parallel, b.serial), a.margin, b.margin, strict=True)
    return all(np.linalg.norm(first - second) < _SHARE * min(margins) for first, second, *margins in pairs)


def _smallest(J: np.ndarray) -> float:
    return float(np.linalg.svd(J, compute_uv=False)[-1])


def _segments(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return distances (m,) of segments a-b and c-d (m, 3) (Ericson 2005, section 5.1.9)."""
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    ur, vr = (u * r).sum(1), (v * r).sum(1)
    det = uu * vv - uv**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(det > 1e-14 * uu * vv, np.clip((uv * vr - vv * ur) / det, 0, 1), 0.0)
    t = (uv * s + vr) / vv
    s = np.where((t < 0) | (t > 1), np.clip((uv * np.clip(t, 0, 1) - ur) / uu, 0, 1), s)
    return np.linalg.norm(r + s[:, None] * u - np.clip(t, 0, 1)[:, None] * v, axis=1)


HOME, REACHABLE, SEPARATED, UNKNOWN = "home", "reachable", "behind a singularity", "unknown"

_EQUALITY_TOLERANCE = 1e-6
"""Positions and poses closer than this count as equal."""
_EXTENSION = 0.5
"""Largest growth of a tree towards a random pose, in lengths of `Limits.scale` and radians."""


class Reach(NamedTuple):
    """Whether one mode can be reached.

    Attributes:
        verdict: `home`, `reachable`, `behind a singularity` or `unknown`.
        why: A sentence.
        q: Actuated positions along the motion (M, na); empty without a motion.
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
    """Return for each real mode at one set of actuated positions whether the robot can reach it from one of them.

    Args:
        rods: A robot with as many actuators and rods as its plate has freedoms.
        q: Actuated positions (na,).
        modes: The real modes' poses of the plate (m).
        home: Index of the mode in which the robot is.
        limits: Keep the actuators' limits on the way.
        clearance: Smallest distance between rods on the way [m]; 0 lets them cross.
        n_samples: Random poses to try for each mode.
        seed: Seed of these poses.

    Raises:
        InputError: The robot has more rods than actuators, or home is not the index of a mode.
    """
    q = np.asarray(q, float).ravel()
    if rods.na != rods.n:
        raise InputError(
            "unsupported",
            f"{rods.robot.source} has {rods.n} rods and {rods.na} actuators; motions between modes need as many",
        )
    if not 0 <= home < modes.n_samples:
        raise InputError("invalid_value", f"home is one of the {modes.n_samples} modes; there is no number {home}")
    everywhere = np.full(rods.na, np.inf)
    lower, upper = (rods.robot.lower, rods.robot.upper) if limits else (-everywhere, everywhere)
    kept = Limits(lower, upper, clearance, float(rods.lengths.mean()))  # poses are measured in rods' lengths
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
    """Return why two states are separated by a singularity, or an empty string."""
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
    why = f"the determinant has the same sign, but {n_samples} random poses gave no motion, which is no proof"
    return _answer(UNKNOWN, why, [])


class _Tree:
    """Samples that a motion from the root reaches."""

    def __init__(self, root: Sample) -> None:
        self.root = root
        self.samples, self.parents = [root], [-1]
        self.q, self.plate = root.q[None], root.plate

    def grow(self, rods: Rods, target: Poses, limits: Limits, reach: float) -> Sample:
        """Move from the nearest sample towards a pose and store the samples; return the last one."""
        parent = int(np.argmin(measure_pose_distances(self.plate, target, limits.scale)))
        motion, _ = advance(rods, self.samples[parent], target, limits, reach)
        for sample in motion:
            self.parents.append(parent)
            parent = len(self.samples)
            self.samples.append(sample)
        if motion:
            self.q = np.concatenate([self.q, [s.q for s in motion]])
            self.plate = Poses.join([self.plate, *(s.plate for s in motion)])
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


def _answer(verdict: str, why: str, samples: list[Sample]) -> Reach:
    """Put a motion's samples into arrays."""
    if not samples:
        return Reach(verdict, why, np.zeros((0, 0)), Poses.join([]))
    return Reach(verdict, why, np.array([s.q for s in samples]), Poses.join([s.plate for s in samples]))
