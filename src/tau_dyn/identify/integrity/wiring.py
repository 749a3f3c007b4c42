"""Test whether a log's columns match the robot file: signs, joints, scales, clock, gravity, forces that lack a part.

The log as read is compared with the readings of `wiring_alternatives.py`. `reading_fit.py` computes the log marginal likelihood
of each, and `evidence/readings.py` decides whether one is named. `wiring_numbers.py` estimates their scales. After the last
fault the whole map is tried: the search runs again on the log as read, and a column map is advised only if there is no further
fault and the joints concerned are predicted well. The map has one line for each column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from tau_dyn.evidence import (
    ALIAS_NATS,
    MAX_NUMBER_STDERR,
    MAX_ZERO_MEAN,
    MIN_GAIN_NATS,
    MIN_POWER_DROP,
    ReadingFit,
    is_factor_known,
    is_hopeless,
    is_part_missing,
    is_preferred_at_each_joint,
    is_preferred_in_each_half,
    list_aliases,
    permits_size,
    permits_speed_scale,
    search_readings,
)
from tau_dyn.identify.integrity.excerpt import Excerpt, Records
from tau_dyn.identify.integrity.reading_fit import Design, LogModel
from tau_dyn.identify.integrity.wiring_alternatives import (
    Number,
    Rewiring,
    build_unit_reading,
    is_within_reach,
    list_alternatives,
    list_lacking,
    list_map_lines,
    move_to_motor_side,
)
from tau_dyn.identify.integrity.wiring_numbers import (
    MAX_ROUNDED,
    compute_posterior,
    estimate_errors,
    refine_numbers,
    round_to_units,
    separate_numbers,
    try_units,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

FINE_MODEL_ERROR = 0.005
"""Least residual of a joint, as a share of its force, if all joints fit almost exactly (only simulated and very good robots)."""

MIN_GRAVITY_SHARE = 0.1
"""Part of gravity in a joint's force, from which its absence shows: twice the least model error."""

MAX_FAULTS = 4
"""Largest number of faults that are searched, one after another."""

N_FINALISTS = 8
"""Number of the best readings that are fitted to all samples."""


MIN_SCREENED_NATS = 3.0
"""Gain on few samples from which a reading is fitted to all samples."""


LEFT_STEP = 0.1
"""Step of the share of gravity that is left: the bodies' prior determines it no better."""


RATIOS = tuple(np.geomspace(3.0, 600.0, 19))
"""Gear ratios at which the search for motor-side columns starts: steps of a third, the width of the likelihood's maximum where a
joint moves by a radian."""

TYPICAL_TRAVEL = 0.6
"""Travel of a motion as a share of a joint's range, for the first gear ratio of a search."""

MAX_SIGNED_JOINTS = 3
"""Largest number of joints for which the search starts from every pattern of signs: mirrored arms are local maxima."""

TURN_RAD = 2 * np.pi
"""Range of a joint without limits, for the same [rad]."""


UNDETERMINED = "the log does not determine the factors"
"""Why no map is advised although the fault is certain; after any other objection, its reading is not stated as a fact."""


@dataclass(frozen=True, eq=False)
class Fault:
    """A reading that is accepted, with the fits before and after.

    Attributes:
        reading: The reading.
        before: The fit without it; None if the robot cannot reach the positions as logged.
        after: The fit with it.
        is_alias: Whether the log cannot distinguish it from the fault named before.
    """

    reading: Rewiring
    before: ReadingFit | None
    after: ReadingFit
    is_alias: bool = False


class Mend(NamedTuple):
    """The reading that mends all faults, the relative standard errors of its numbers, and why no map is advised, or ''."""

    reading: Rewiring
    errors: dict[Number, float]
    objection: str


def check_wiring(robot: Robot, excerpt: Excerpt, name: str, records: Records | None = None) -> list[CodedWarning]:
    """Return the wiring faults of a log against the robot file, each with evidence, and the column map that mends all.

    Args:
        robot: The robot file.
        excerpt: Its log.
        name: The log's name, for the sentences.
        records: Properties of the whole log; by default those of the excerpt.
    """
    records = Records.of(robot, excerpt) if records is None else records
    model = LogModel.of(robot, excerpt, records.mean_force)
    plain = Rewiring.none(robot.na)
    tests = (model.test, replace(model.test, model_error=FINE_MODEL_ERROR, is_fine=True))
    for start in dict.fromkeys((plain, build_unit_reading(robot, plain, excerpt.q))):
        for test in tests:
            search = Search(replace(model, test=test), records)
            if faults := search.find_faults(start):
                return _describe(robot, name, faults, search.try_map(faults))
    return []


@dataclass(frozen=True, eq=False)
class Search:
    """The search for readings of one log."""

    model: LogModel
    records: Records

    def find_faults(self, start: Rewiring | None = None) -> list[Fault]:
        """Return the faults found by forward selection of the largest gain, and those indistinguishable from them."""
        current = Rewiring.none(self.model.robot.na) if start is None else start
        fit = self.model.fit(current)
        search = self
        if fit is not None:
            search = replace(self, model=self.model.counted(fit))
            fit = search.model.fit(current)
            if fit is not None and is_hopeless(search.model.test, fit, search.model.estimate_noise(fit)):
                return []

        def grow(last: Sequence[Fault | None]) -> list[Fault | None]:
            fault = last[0]
            return [*(search.find_best(fault.reading, fault.after) if fault else search.find_best(current, fit))]

        return [fault for fault in search_readings(None, grow, MAX_FAULTS) if fault]

    def find_best(self, current: Rewiring, fit: ReadingFit | None) -> list[Fault]:
        """Return the reading of the largest gain, and those of another code that cannot be distinguished from it."""
        quick = self.model.thinned()
        design, plain = quick.design(current), quick.fit(current)
        tried = []
        if fit is None or self._most_to_gain(fit) > MIN_GAIN_NATS:
            tried = self._screen(quick, current, design)
        if plain is not None and design is not None and not current.lacks and self._is_within_limits(current):
            tried += self._screen_lacking(quick, current, design)
        least = MIN_SCREENED_NATS + (0.0 if plain is None else plain.log_p)
        tried = sorted((item for item in tried if item[1] > least), key=lambda item: -item[1])
        found = [fault for reading, _ in tried[:N_FINALISTS] if (fault := self._judge(current, fit, reading))]
        if not found:
            return []
        return self._list_equivalent(found)

    def _list_equivalent(self, found: list[Fault]) -> list[Fault]:
        """Return the best of accepted readings and those of another code that the data do not exclude.

        They are compared with the least residual that one of them leaves as the model error. Below the usual model error all of
        them fit, and the prior alone would decide.
        """
        tests = [self.model.test.sharpened(fault.after, fault.reading.tau_from) for fault in found]
        sharp = replace(self.model, test=min(tests, key=lambda test: test.model_error))
        values = [fit.log_p if (fit := sharp.fit(fault.reading)) else -np.inf for fault in found]
        codes: dict[str, Fault] = {}
        for k in list_aliases(values):
            codes.setdefault(found[k].reading.code, found[k])
        return [replace(fault, is_alias=n > 0) for n, fault in enumerate(codes.values())]

    def try_map(self, faults: list[Fault]) -> Mend:
        """Return the reading that mends all, after it passed the test again."""
        last = next(fault for fault in reversed(faults) if not fault.is_alias)
        test = self.model.test.sharpened(last.after, last.reading.tau_from)
        bare = self.model.bare(test)
        final = try_units(bare, separate_numbers(bare, last.reading))
        errors = estimate_errors(bare, final)
        final = round_to_units(final, errors)
        fit = self.model.fit(final)
        joints = sorted({j for fault in faults for j in fault.reading.joints})
        objection = ""
        # a reading of the whole robot, such as another direction of gravity, is no column map that each joint has to confirm
        is_good = self.model.test.is_good if list_map_lines(self.model.robot, final) else self.model.test.is_mended
        if fit is None or not is_good(fit, joints, final.tau_from):
            objection = "the log read so does not fit the robot file well"
        elif max(errors.values(), default=0.0) > MAX_NUMBER_STDERR:
            objection = UNDETERMINED
        elif self.find_faults(final):
            objection = "the log read so has a further fault"
        return Mend(final, errors, objection)

    def _judge(self, current: Rewiring, fit: ReadingFit | None, reading: Rewiring) -> Fault | None:
        """Return the fault of a reading, or None if it is not accepted."""
        if reading.code == "scale_wrong":
            bare = self.model.thinned().bare(self.model.test)
            reading = refine_numbers(bare, reading, reading.numbers[len(current.numbers) :] or reading.numbers)
        if not self._is_permitted(reading):
            return None
        after, test = self.model.fit(reading), self.model.test
        if after is None or not test.is_mended(after, reading.joints, reading.tau_from):
            return None
        if reading.lacks != current.lacks and fit is not None:
            good = test.accepts_lack(fit, after) and test.is_good(after, reading.joints, reading.tau_from)
            single, of_bodies = len(reading.joints) == 1, reading.code == "model_subtracted"
            if not (good and is_part_missing(self._estimate_left(reading), is_single=single, of_bodies=of_bodies)):
                return None
            if self._explain_by_zeros(current) > after.log_p - ALIAS_NATS:
                return None
        elif not test.accepts(fit, after):
            return None
        if fit is not None and not is_preferred_in_each_half(self._gains_by_half(current, reading)):
            return None
        if reading.code == "scale_wrong" and not self._is_determined(reading):
            return None
        if reading.code == "gravity_direction" and fit is not None:
            if not is_preferred_at_each_joint(test, fit, after, self.model.counts):
                return None
        return Fault(reading, fit, after)

    def _is_determined(self, reading: Rewiring) -> bool:
        """Return whether the log determines the numbers of a reading, or shows at least that they are not 1."""
        errors = estimate_errors(self.model.thinned().bare(self.model.test), reading)
        return all(is_factor_known(reading.get(number), error) for number, error in errors.items())

    def _explain_by_zeros(self, reading: Rewiring) -> float:
        """Return the log marginal likelihood of a reading with other zeros of the joints."""
        design = self.model.design(reading)
        design = design and self.model.free_zeros(design, reading)
        return -np.inf if design is None else self.model.solve(design, reading).log_p

    def _estimate_left(self, reading: Rewiring) -> float:
        """Return the share that is left of the part that forces lack, at the maximum of a parabola through three fits."""
        design = self.model.design(reading)
        if design is None or "mean" in reading.lacks:
            return 0.0
        near, middle, far = (
            self.model.solve(replace(design, subtracted=1 - left), reading).log_posterior
            for left in (-LEFT_STEP, 0.0, LEFT_STEP)
        )
        curvature = 2 * middle - near - far
        return LEFT_STEP * (far - near) / 2 / curvature if curvature > 0 else np.inf

    def _gains_by_half(self, current: Rewiring, reading: Rewiring) -> list[float]:
        gains = []
        for half in self.model.halves():
            before, after = half.fit(current), half.fit(reading)
            if before is not None and after is not None:
                gains.append(after.log_p - before.log_p)
        return gains

    def _is_permitted(self, reading: Rewiring) -> bool:
        """Return whether recorded velocities and the robot file's limits permit a reading."""
        robot, model = self.model.robot, self.model
        source, q_scale = list(reading.q_from), np.abs(reading.q_scale)
        ratio = np.full(robot.na, reading.t_scale) / q_scale
        inside = [is_within_reach(robot, j, model.q[:, source[j]]) for j in range(robot.na)]
        foreign = ~np.array(inside) & (
            reading.t_scale == 1
        )  # velocities of an encoder in another unit are in that unit
        recorded = np.where(foreign, np.nan, self.records.speed_ratio[source])
        if not permits_speed_scale(recorded, ratio):
            return False
        speed = np.percentile(np.abs(model.v), 99, axis=0)
        force = np.percentile(np.abs(model.tau), 99, axis=0)
        read = force[list(reading.tau_from)] / np.abs(reading.tau_scale)
        return permits_size(speed[source], speed[source] * ratio, robot.velocity_limit) and permits_size(
            force[list(reading.tau_from)], read, robot.effort_limit
        )

    def _is_within_limits(self, reading: Rewiring) -> bool:
        """Return whether joints with limits stay near them; beyond, forces of the bodies are not known, nor whether they lack."""
        robot, (q, _, _) = self.model.robot, self.model.motion(reading)
        limited = np.flatnonzero(np.isfinite(robot.upper - robot.lower)).tolist()
        return all(is_within_reach(robot, j, q[:, j]) for j in limited)

    def _most_to_gain(self, fit: ReadingFit) -> float:
        """Return the gain of a perfect reading [nats]."""
        floor = self.model.test.floor
        return float(self.model.counts @ np.log(np.maximum(fit.power, floor) / floor) / 2 + fit.prior)

    def _screen(self, quick: LogModel, current: Rewiring, design: Design | None) -> list[tuple[Rewiring, float]]:
        """Return readings of other columns with their marginal likelihood on few samples."""
        robot, by_gravity = self.model.robot, None
        if design is not None and not current.gravity and robot.model.gravity.linear.any():
            by_gravity = quick.designs_by_gravity(current, design)
        tried = []
        for change in list_alternatives(robot, current, self.model.q):
            other: ReadingFit | None
            if design is not None and change.moves_as(current):
                other = quick.solve(design, change)
            elif by_gravity is not None and change.code == "gravity_direction":
                other = quick.solve(by_gravity(change.gravity), change)
            elif design is not None and change.q_scale == current.q_scale and change.q_from == current.q_from:
                other = quick.solve(design.by_clock(change.t_scale / current.t_scale), change)
            else:
                other = quick.fit(change)
            if other is not None:
                tried.append((change, other.log_p))
        return tried + self._screen_motor_side(quick, current)

    def _screen_lacking(self, quick: LogModel, current: Rewiring, design: Design) -> list[tuple[Rewiring, float]]:
        """Return readings in which forces lack a part, with their marginal likelihood on few samples."""
        robot, size = self.model.robot, self.model.size[list(current.tau_from)] / np.abs(current.tau_scale)
        static = np.abs(design.static @ robot.parameters.values).max(axis=0)
        centred = np.abs(self.model.mean) < MAX_ZERO_MEAN * np.maximum(self.records.force_deviation, 1e-300)
        weighs = (static > MIN_GRAVITY_SHARE * size) & bool(np.any(robot.model.gravity.linear))
        readings = list_lacking(robot, current, weighs, centred[list(current.tau_from)])
        return [(reading, quick.solve(design, reading).log_p) for reading in readings]

    def _screen_motor_side(self, quick: LogModel, current: Rewiring) -> list[tuple[Rewiring, float]]:
        """Return the best readings of all joints beyond their limits at the motor's side, with and without their forces."""
        robot = self.model.robot
        q, _, _ = self.model.motion(current)
        beyond = [j for j in range(robot.na) if not is_within_reach(robot, j, q[:, j])]
        if not beyond or len(beyond) == 1 and robot.na == 1 and not np.isfinite(robot.upper[0]):
            return []
        found = []
        for with_force in (True, False):
            ratios = self._search_ratios(quick.thinned(), current, beyond, with_force)
            reading = move_to_motor_side(robot, current, list(ratios.items()), with_force)
            if (fit := quick.fit(reading)) is not None:
                found.append((reading, fit.log_p))
        return found

    def _search_ratios(
        self, quick: LogModel, current: Rewiring, joints: list[int], with_force: bool
    ) -> dict[int, float]:
        """Return the gear ratio of each joint, by coordinate ascent over a grid of both signs."""
        robot = self.model.robot
        q, _, _ = self.model.motion(current)
        width = np.where(np.isfinite(robot.upper - robot.lower), robot.upper - robot.lower, TURN_RAD)
        width = np.minimum(width, TURN_RAD)
        first = {j: float(np.ptp(q[:, j]) / (TYPICAL_TRAVEL * width[j])) for j in joints}
        grid = {j: self._list_ratios(j, q[:, j]) for j in joints}

        known: dict[tuple[float, ...], float] = {}

        def compute(trial: dict[int, float]) -> float:
            if (key := tuple(trial.values())) not in known:
                known[key] = compute_posterior(
                    quick, move_to_motor_side(robot, current, list(trial.items()), with_force)
                )
            return known[key]

        def climb(ratios: dict[int, float]) -> tuple[float, dict[int, float]]:
            best = compute(ratios)
            for _ in range(3):
                last = ratios
                for j in joints:
                    value, ratio = max((compute(ratios | {j: x}), x) for x in grid[j])
                    if value > best + 1e-9:
                        best, ratios = value, ratios | {j: ratio}
                if ratios == last:
                    break
            return best, ratios

        signs = product((1.0, -1.0), repeat=len(joints)) if len(joints) <= MAX_SIGNED_JOINTS else [(1.0,) * len(joints)]
        starts = [{j: sign * first[j] for j, sign in zip(joints, pattern, strict=True)} for pattern in signs]
        return max((climb(start) for start in starts), key=lambda item: item[0])[1]

    def _list_ratios(self, j: int, q: np.ndarray) -> list[float]:
        """Return the gear ratios of both signs with which positions (n,) are within a joint's limits."""
        known = self.model.robot.gear_ratios.get(self.model.robot.actuated[j])
        sizes = (*RATIOS, *([abs(known)] if known else []))
        return [x for size in sizes for x in (size, -size) if is_within_reach(self.model.robot, j, q / x)] or [
            RATIOS[-1]
        ]


def _describe(robot: Robot, name: str, faults: list[Fault], mend: Mend) -> list[CodedWarning]:
    """Return one warning for each fault, with its evidence; the last adds the column map, or why no map is advised."""
    sentences = [_describe_fault(robot, name, fault, mend) for fault in faults]
    if mend.objection not in ("", UNDETERMINED):
        start = f"{name}: the columns disagree with the robot file, and no reading of them agrees. The nearest is that "
        sentences = [
            text if fault.is_alias else start + text.removeprefix(f"{name}: ")
            for fault, text in zip(faults, sentences, strict=True)
        ]
    lines = list_map_lines(robot, mend.reading)
    if lines and not mend.objection:
        sentences[-1] += f" The column map (--columns) that mends this log, tried on it: {', '.join(lines)}."
    elif mend.objection:
        sentences[-1] += f" No column map is advised: {mend.objection}. Check units, joints and signs at their source."
    return [
        CodedWarning(fault.reading.code, text, [robot.actuated[j] for j in fault.reading.joints])
        for fault, text in zip(faults, sentences, strict=True)
    ]


def _describe_fault(robot: Robot, name: str, fault: Fault, mend: Mend) -> str:
    reading = fault.reading
    mine = [number for number in mend.reading.numbers if set(number[1]) <= set(reading.joints)]
    words = reading.words.replace("{number}", _format_numbers(robot, mine, mend))
    start = f"{name}: {'or ' if fault.is_alias else ''}{words}."
    if (
        "{number}" in reading.words
        and (worst := max((mend.errors.get(x, 0.0) for x in mine), default=0.0)) > MAX_ROUNDED
    ):
        start += f" Standard errors reach {100 * worst:.0f} %, as the file's bodies are uncertain; prefer a data sheet."
    return f"{start} Evidence: {_describe_evidence(robot, fault)}"


def _format_numbers(robot: Robot, numbers: list[Number], mend: Mend) -> str:
    """Return the estimates with their standard errors, by joint if there are several."""
    texts = []
    for number in numbers:
        value, error = mend.reading.get(number), mend.errors.get(number, 0.0)
        text = f"{value:.4g} ± {abs(value) * error:.2g}"
        alone = len(numbers) == 1 or len(number[1]) != 1
        texts.append(text if alone else f"{text} ({robot.actuated[number[1][0]]})")
    return ", ".join(texts)


def _describe_evidence(robot: Robot, fault: Fault) -> str:
    if fault.before is None:
        return "as logged, the robot cannot reach its positions."
    before, after = fault.before.power, fault.after.power
    ratio = np.sqrt(after / np.maximum(before, 1e-300))
    k = int(np.argmin(np.where(before > 0, ratio, np.inf)))
    if ratio[k] ** 2 < MIN_POWER_DROP:
        return (
            f"so read, the model leaves {np.sqrt(after[k]):.3g} instead of {np.sqrt(before[k]):.3g} {robot.force_units[k]} of "
            f"tau_{robot.actuated[k]}, {100 * (1 - ratio[k]):.3g} % less."
        )
    return "as logged, only bodies far from the robot file's explain the forces."
