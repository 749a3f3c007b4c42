"""The reading of a pose file with which the robot file fits: found without parameters, then applied and reported.

The robot file's dimensions, with device and targets placed in closed form, are compared at every reading of one cause; if no
single reading is enough, the best are combined. `evidence/readings.py` decides whether one is taken; the robot file then misses
the poses by no more than a machine is built off its drawing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.calibrate.conventions.readings import Reading, apply_reading, apply_reading_alike, list_readings
from tau_dyn.calibrate.conventions.rigid_fit import UNREACHED, Misfit, measure_misfit
from tau_dyn.calibrate.geometry import Geometry, Predicted
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.evidence import (
    Gain,
    ReadingFit,
    ReadingTest,
    is_preferred,
    list_aliases,
    search_readings,
)
from tau_dyn.exceptions import TauDynError
from tau_dyn.mechanism import Poses
from tau_dyn.message_codes import CodedWarning

_ALIKE_RAD = 2.0
"""Angle that counts as much as the spread of the tool: six joints 40 mrad off turn it by 5 % of this."""
_TEST = ReadingTest(np.array([1.0, _ALIKE_RAD]), model_error=0.01, max_good_share=0.05)
"""Errors over the spread of the tool: an arm out of the box has 0.002, joints 20 mrad off move a tool by 0.05."""
_MAX_DIMENSIONS_SHARE = 0.15
"""Largest error as written, over the spread, at which fitted dimensions are tried: three times `max_good_share`."""
_MAX_CAUSES = 3
"""Largest number of causes in one file; more indicate a wrong file."""
_BRANCHES = 3
"""Best readings that are combined with every further cause."""
_MAX_POSES = 60
"""Number of poses at which the readings are compared; more do not separate them better."""
_FIRST_POSES = 8
"""Poses that are computed first: if a robot with loops reaches fewer than half of them, the others are not computed."""
_DRAWS = 200
"""Bootstrap draws of a gain's interval; orders of magnitude need no finer ends."""
_LIMIT_MARGIN = 0.05
"""Distance beyond a joint's limit [rad or m] that counts as within it."""


@dataclass(frozen=True, eq=False)
class FoundReading:
    """Intended convention of a file.

    Attributes:
        reading: Changes, in order; empty if the file is read as it is written.
        alike: Readings that such poses cannot distinguish from it.
        written: Misfit as the file is written.
        meant: Misfit in the intended convention.
        n_tried: Number of readings that were compared.
    """

    reading: Reading
    alike: tuple[Reading, ...]
    written: Misfit
    meant: Misfit
    n_tried: int

    def apply(self, poses: PoseSet) -> PoseSet:
        """Return poses in the intended convention."""
        return apply_reading(self.reading, poses)

    def apply_alike(self, poses: PoseSet) -> PoseSet:
        """Return held-out poses in the convention of the file.

        Raises:
            InputError: They have no orientations and the convention needs them.
        """
        return apply_reading_alike(self.reading, poses)

    def compute_gain(self, seed: int = 0) -> Gain:
        """Return the gain of the reading, with the robot file's dimensions; the interval is by bootstrap over poses."""
        p_value = float(np.exp(-self.meant.n_numbers * np.log(self.written.value / max(self.meant.value, 1e-300))))
        rng = np.random.default_rng(seed)
        if not np.isfinite(self.written.value):
            ends = (100.0, 100.0)
        else:
            ratios = [_redraw(self.meant, rng) / _redraw(self.written, rng) for _ in range(_DRAWS)]
            low, high = np.percentile(ratios, [2.5, 97.5])
            ends = (100 * (1 - float(high)), 100 * (1 - float(low)))
        percent = 100 * (1 - self.meant.value / self.written.value)
        turned = (self.written.rotation, self.meant.rotation) if self.written.rotation is not None else (None, None)
        return Gain(
            self.written.position, self.meant.position, percent, ends, min(1.0, p_value * self.n_tried), *turned
        )

    def describe(self, source: str) -> str:
        """Return the reading as a sentence."""
        said = "; ".join(change.words for change in self.reading)
        others = [" and ".join(c.words for c in one) for one in self.alike[:3]]
        alike = f"; the same poses also mean that {' or that '.join(others)}" if others else ""
        return CodedWarning(
            "poses_reread",
            f"{source}: {said}; the robot file misses the poses by {_describe(self.meant)} with that and by "
            f"{_describe(self.written)} as written, so they are read so{alike}",
        )


def _redraw(misfit: Misfit, rng: np.random.Generator) -> float:
    """Return the misfit's value at poses drawn with replacement."""
    index = rng.integers(0, len(misfit.distances), len(misfit.distances))
    angles = None if misfit.angles is None else misfit.angles[index]
    return Misfit.of(misfit.distances[index], angles, misfit.spread, misfit.unit).value


def _describe(misfit: Misfit) -> str:
    if not np.isfinite(misfit.position):
        return "more than its reach"
    turned = "" if misfit.rotation is None else f" and {1e3 * misfit.rotation:.3g} mrad"
    return f"{1e3 * misfit.position:.3g} mm{turned}"


class _Search:
    """Misfits of readings and tool poses of joint positions, each computed once."""

    def __init__(self, geometry: Geometry, poses: PoseSet, limits: tuple[np.ndarray, np.ndarray]) -> None:
        self.geometry, self.poses, self.limits = geometry, poses, limits
        self.known: dict[frozenset[int], Misfit] = {}
        self.placed: dict[bytes, Predicted] = {}
        order = np.lexsort((*poses.q.T, poses.campaign))  # rows in another order are the same file
        self.compared = np.sort(order[:: -(-poses.n // _MAX_POSES)])

    def measure(self, reading: Reading) -> Misfit:
        """Return the misfit of a reading."""
        key = _get_key(reading)
        if key not in self.known:
            try:
                unit = float(np.prod([change.unit for change in reading]))
                self.known[key] = self._measure(self._read(reading))._replace(unit=unit)
            except (TauDynError, np.linalg.LinAlgError):
                self.known[key] = UNREACHED
        return self.known[key]

    def place_all(self, readings: Sequence[Reading]) -> None:
        """Place the robot at the positions of many readings at once, so that each path through the workspace serves all."""
        every = [self._read(reading).q for reading in readings if _get_key(reading) not in self.known]
        every = [q for q in every if not is_far_beyond(q, self.limits)]
        try:
            self._place_together([q[:_FIRST_POSES] for q in every])
            self._place_together([q for q in every if _is_reached(self._place(q[:_FIRST_POSES]))])
        except (TauDynError, np.linalg.LinAlgError):
            return  # `measure` computes each by itself, and finds the faulty one

    def _read(self, reading: Reading) -> PoseSet:
        """Return the poses that are compared, after a reading."""
        poses = apply_reading(reading, self.poses)
        return poses.take(self.compared[self.compared < poses.n])

    def _place_together(self, parts: Sequence[np.ndarray]) -> None:
        """Store the tool poses at several sets of joint positions (N, na)."""
        new = {q.tobytes(): q for q in parts if q.tobytes() not in self.placed}
        if not new:
            return
        found = self.geometry.forward(self.geometry.parameters.values, np.concatenate(list(new.values())))
        ends = np.cumsum([len(q) for q in new.values()])
        for key, end in zip(new, ends, strict=True):
            part = slice(end - len(new[key]), end)
            at = Poses(found.poses.position[part], found.poses.rotation[part])
            self.placed[key] = Predicted(at, found.ok[part], found.reason[part])

    def fit(self, reading: Reading) -> ReadingFit | None:
        """Return the misfit of a reading as `evidence` compares it; None if the robot is not placed or does not move."""
        found = self.measure(reading)
        if not (np.isfinite(found.position) and found.spread > 0):  # a robot that does not move explains no pose
            return None
        size = self.poses.spread if found.rotation is None else np.sqrt(self.poses.spread * _ALIKE_RAD)
        log_p = found.n_numbers * float(np.log(size / max(found.value, 1e-300)))
        return ReadingFit(log_p, log_p, _compute_power(found), 0.0, found.distances[:, None])

    def compute_log_p(self, reading: Reading) -> float:
        """Return the log-likelihood of a reading [nats]; a robot that explains no part of the poses has 0."""
        fit = self.fit(reading)
        return 0.0 if fit is None else fit.log_p

    def is_plausible(self, reading: Reading, share: float = _TEST.max_good_share) -> bool:
        """Return whether the robot file's dimensions explain the misfit of a reading."""
        return is_explained(self.measure(reading), share)

    def _measure(self, poses: PoseSet) -> Misfit:
        """Return the misfit of poses in the intended convention."""
        if is_far_beyond(poses.q, self.limits):
            return UNREACHED
        if not _is_reached(self._place(poses.q[:_FIRST_POSES])):
            return UNREACHED
        found = self._place(poses.q)
        return measure_misfit(poses, found.poses, found.ok, turns=self.geometry.orients)

    def _place(self, q: np.ndarray) -> Predicted:
        """Return the tool poses that the robot file predicts at joint positions (N, na)."""
        self._place_together([q])
        return self.placed[q.tobytes()]


def _get_key(reading: Reading) -> frozenset[int]:
    """Return the key that identifies a reading, whatever the order of its changes."""
    return frozenset(id(change) for change in reading)


def _is_reached(first: Predicted) -> bool:
    """Return whether a robot reaches enough of the first poses to compute the others."""
    return bool(2 * first.ok.sum() >= len(first.ok))


def is_explained(misfit: Misfit, share: float = _TEST.max_good_share) -> bool:
    """Return whether a machine that is built off its drawing by a share of its workspace has such a misfit."""
    if not (np.isfinite(misfit.position) and misfit.spread > 0):
        return False
    return bool(np.all(_compute_power(misfit) <= (share * _TEST.size) ** 2))


def _compute_power(misfit: Misfit) -> np.ndarray:
    """Return the squared errors of position, as a share of the spread, and orientation [rad]."""
    return np.square([misfit.position / misfit.spread, misfit.rotation or 0.0])


def measure_as_written(geometry: Geometry, poses: PoseSet, limits: tuple[np.ndarray, np.ndarray]) -> Misfit:
    """Return the misfit of poses as their file writes them."""
    return _Search(geometry, poses, limits).measure(())


def is_far_beyond(q: np.ndarray, limits: tuple[np.ndarray, np.ndarray]) -> bool:
    """Return whether most positions (N, na) of a joint are beyond its limits by more than their width.

    The limits of a robot file may be wrong by less. Loops are not closed at such positions, and the attempt takes minutes.
    """
    low, high = limits
    width = high - low
    return bool(np.any(np.mean((q < low - width) | (q > high + width), axis=0) > 0.5))


def find_reading(
    geometry: Geometry, poses: PoseSet, limits: tuple[np.ndarray, np.ndarray], fit: Callable[[PoseSet], float]
) -> FoundReading | None:
    """Return the intended convention of a file, None if it is read as it is written.

    Args:
        geometry: The robot with its file's dimensions.
        poses: Poses as written.
        limits: Lower and upper limits of the joints (na,).
        fit: Function that returns the error level of poses after a fit of the robot's dimensions; called if these may explain the
            misfit.
    """
    search = _Search(geometry, poses, limits)
    if search.is_plausible((), _TEST.model_error):
        return None
    every = list_readings(poses, geometry.actuated, geometry.position_units, turns=geometry.orients)
    single = [reading for reading in every if len(reading) == 1]

    def grow(last: Sequence[Reading]) -> list[Reading]:
        changes = single if any(last) else every
        grown = {_get_key(r): r for base in last for more in changes if (r := _join(base, more))}
        search.place_all(list(grown.values()))
        return sorted(grown.values(), key=lambda r: -search.compute_log_p(r))

    depth = 1 if search.is_plausible(()) else _MAX_CAUSES
    tried = search_readings((), grow, depth, _BRANCHES, search.is_plausible)
    likely = [tried[k] for k in list_aliases([search.compute_log_p(reading) for reading in tried])]
    alike = [r for r in likely if _accept(search, r, limits, fit)]
    if not alike:
        return None
    best = min(alike, key=lambda r: (len(r), _count_beyond(search.poses, r, limits)))
    others = [r for r in alike if r is not best and len(r) <= max(len(best), 2)]
    return FoundReading(best, tuple(others), search.measure(()), search.measure(best), len(tried) + 1)


def _join(base: Reading, more: Reading) -> Reading | None:
    """Return a reading with more changes, the format of orientations first; None if it already changes the same place."""
    places = {change.place for change in base}
    if any(change.place in places for change in more):
        return None
    return tuple(sorted((*base, *more), key=lambda change: not change.is_format))


def _accept(
    search: _Search, reading: Reading, limits: tuple[np.ndarray, np.ndarray], fit: Callable[[PoseSet], float]
) -> bool:
    """Return whether a reading replaces the one as written."""
    before, after = search.fit(()), search.fit(reading)
    if after is None or not search.is_plausible(reading) or not _TEST.accepts(before, after):
        return False
    if _count_beyond(search.poses, reading, limits) > _count_beyond(search.poses, (), limits):
        return False
    if not search.is_plausible((), _MAX_DIMENSIONS_SHARE):
        return True
    left, left_so = fit(search.poses), fit(apply_reading(reading, search.poses))
    return is_preferred(search.measure(reading).n_numbers * np.log(left / left_so), (left_so / left) ** 2)


def _count_beyond(poses: PoseSet, reading: Reading, limits: tuple[np.ndarray, np.ndarray]) -> int:
    """Return the number of positions beyond the joints' limits."""
    q = apply_reading(reading, poses).q
    return int(np.sum((q < limits[0] - _LIMIT_MARGIN) | (q > limits[1] + _LIMIT_MARGIN)))
