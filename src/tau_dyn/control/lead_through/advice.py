"""Stability limit and settings of lead-through for one contact, servo and hand: the result of `tau-dyn lead-through`.

The contact's stiffness is given, or estimated as the slope of force over position in a log of one touch; the command uses the
upper 95 % limit of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.codegen import include_header, locate_header, write_lead_through_source
from tau_dyn.control.lead_through.lead_through import LeadThrough
from tau_dyn.control.lead_through.options_file import LeadThroughOptions
from tau_dyn.control.lead_through.settings import LeadThroughSettings
from tau_dyn.control.lead_through.stability import ForceLoop, StabilityLimit
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.results import Shown

_SHARE = 0.5  # of the stability limit: less than that is calm, see `LeadThroughSettings.warnings`
MAX_INDENTATION_M = 0.1
"""Largest travel in contact; foam yields by centimetres."""
_TOUCH_QUANTILES = np.linspace(0.0, 0.9, 46)  # of the depth, at which the contact may begin
_LEAST_GAIN = 0.01  # share of the squares that a later beginning must explain to be taken
_MIN_CONTACT_SAMPLES = 10  # below, a slope's own scatter is a guess
_STIFFER = np.geomspace(0.1, 10, 61)  # stiffness over the stated one, for the figure


@dataclass(frozen=True, eq=False)
class LeadThroughAdvice(Shown):
    """Stable settings and stability limits of a force loop.

    Attributes:
        settings: Stable settings, with half of the gain at the stability limit.
        limit: Stability limit of the tool's force loop: gain [m/s per N] and frequency of the oscillation.
        hand_limit: Stiffest hand [N/m] that may hold the handle, and the frequency.
        stiffness_stderr: Standard error of the contact's stiffness from a log [N/m]; None if the stiffness was given.
    """

    settings: LeadThroughSettings
    limit: StabilityLimit
    hand_limit: StabilityLimit
    stiffness_stderr: float | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Settings that are close to their limits."""
        return self.settings.warnings

    def to_rows(self) -> list[dict[str, Any]]:
        """Return the settings and limits, one row each with its unit."""
        s, loop = self.settings, self.settings.loop
        rows = (
            ("contact_stiffness", s.contact_stiffness, "N/m"),
            ("force_gain", float(s.gain[0, 0]), "m/s per N"),
            ("force_gain_limit", self.limit.gain, "m/s per N"),
            ("force_gain_limit_hz", self.limit.hz, "Hz"),
            ("hand_stiffness", s.hand_stiffness, "N/m"),
            ("hand_stiffness_limit", self.hand_limit.gain, "N/m"),
            ("hand_stiffness_limit_hz", self.hand_limit.hz, "Hz"),
            ("mass", float(s.inertia[0, 0]), "kg"),
            ("damping", float(s.drag[0, 0]), "N s/m"),
            ("sample_time", loop.sample_time, "s"),
            ("servo_hz", loop.servo_hz, "Hz"),
            ("delay", float(loop.delay), "samples"),
        )
        return [{"name": name, "value": float(value), "unit": unit} for name, value, unit in rows]

    def write_code(self, source: Path) -> dict[Path, str]:
        """Return the texts of the controller's C file and of its header, named after the file.

        Raises:
            InputError: The file's name is no identifier of C.
        """
        header = locate_header(source)
        words = [f"{row['name']}: {row['value']:.6g} {row['unit']}" for row in self.to_rows()]
        numbers = LeadThrough(self.settings).list_numbers()
        code, declared = write_lead_through_source(numbers, source.stem, ["", *words])
        return {source: include_header(code, source.stem, header), header: declared}

    def limits_over_stiffness(self) -> tuple[np.ndarray, np.ndarray]:
        """Return stiffnesses (n,) [N/m] and the gains (n,) at which the loop oscillates."""
        k = self.settings.contact_stiffness * _STIFFER
        return k, np.array([self.settings.loop.limit(x, self.settings.contact_damping).gain for x in k])


def advise_lead_through(
    loop: ForceLoop,
    stiffness: float,
    *,
    mass: float = 3.0,
    damping: float = 40.0,
    force_gain: float | None = None,
    hand_stiffness: float = 1000.0,
    stderr: float | None = None,
    options: LeadThroughOptions = LeadThroughOptions(),
) -> LeadThroughAdvice:
    """Return stable settings and how far they are from oscillating.

    Args:
        loop: Sampling, servo and delay.
        stiffness: The stiffest contact to expect [N/m].
        mass: Mass of the handle [kg].
        damping: Damping of the handle [N s/m].
        force_gain: Gain of the tool force [m/s per N]; None for half of the limit.
        hand_stiffness: The stiffest hand [N/m].
        stderr: Standard error of the stiffness if it was estimated from a log [N/m].
        options: Further settings.

    Raises:
        InputError: A value is out of range, or the loop would be unstable.
    """
    limit = loop.limit(stiffness)
    gain: float | np.ndarray = _SHARE * limit.gain if force_gain is None else force_gain
    turning = options.values.get("turning_stiffness")
    if turning is not None:  # torques turn the tool through a loop of their own
        gain = np.repeat([gain, _SHARE * loop.limit(turning).gain], 3)
    settings = LeadThroughSettings(
        stiffness, mass, damping, gain, loop=loop, hand_stiffness=hand_stiffness, **options.values
    )
    return LeadThroughAdvice(settings, limit, loop.hand_limit(mass, damping), stderr)


def _find_free_travel(position: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the samples (N,) bool before a contact: `force = offset + stiffness max(0, depth)` from the best place on.

    Without free travel a straight line fits as well as any, and no sample is free.
    """
    best, free = np.inf, np.zeros(len(position), bool)
    for side in (1.0, -1.0):
        depth = side * position
        for touch in np.quantile(depth, _TOUCH_QUANTILES):
            columns = np.column_stack([np.maximum(depth - touch, 0.0), np.ones(len(depth))])
            found, *_ = np.linalg.lstsq(columns, force, rcond=None)
            misfit = float(np.sum((force - columns @ found) ** 2))
            if misfit < best * (1 - _LEAST_GAIN):
                best, free = misfit, depth < touch
    return free


def fit_contact_stiffness(position: np.ndarray, force: np.ndarray, threshold: float = 0.5) -> tuple[float, float]:
    """Return a contact's stiffness and its standard error [N/m], the slope of force over position while in contact.

    The force of a sensor without load, which may have an offset, is that of the free travel before the contact, if there is some.

    Args:
        position: Position of the tool along the contact's normal (N,) [m].
        force: Force on the tool (N,) [N].
        threshold: Smallest force that counts as contact [N].

    Raises:
        InputError: Shapes differ, or a number is not finite.
        CannotAnswer: Too few samples in contact, or the force does not grow with the position.
    """
    if position.shape != force.shape or position.ndim != 1 or not np.isfinite([*position, *force]).all():
        raise InputError("wrong_shape", "position and force are finite columns of one length")
    free = _find_free_travel(position, force)
    touching = ~free & (np.abs(force - (np.median(force[free]) if free.any() else 0.0)) >= threshold)
    if touching.sum() < _MIN_CONTACT_SAMPLES or np.ptp(position[touching]) <= 0:
        raise CannotAnswer(
            "poor_excitation",
            f"only {int(touching.sum())} samples of the log are in contact above {threshold:g} N",
            "press the tool on the work slowly, up to the largest force, and release it",
        )
    travel = float(np.ptp(position[touching]))
    if travel > MAX_INDENTATION_M:
        raise InputError(
            "wrong_unit",
            f"the position moves by {travel:.3g} m in contact, more than a tool is pressed into any work; is it in mm? Write "
            "`x_tool: {column: .., scale: 0.001}` into a column map, and --position x_tool",
        )
    columns = np.column_stack([position[touching], np.ones(touching.sum())])
    found, *_ = np.linalg.lstsq(columns, force[touching], rcond=None)
    rest = force[touching] - columns @ found
    variance = rest @ rest / (len(rest) - 2) * np.linalg.inv(columns.T @ columns)[0, 0]
    stiffness, stderr = abs(float(found[0])), float(np.sqrt(variance))
    if not stiffness > 2 * stderr:
        raise CannotAnswer(
            "poor_excitation",
            f"the force does not follow the position: stiffness {stiffness:.3g} N/m, standard error {stderr:.3g} N/m",
            "check that the two columns belong together, and press harder",
        )
    return stiffness, stderr
