"""Contact of the tool with an object below it: the tip stays up although it is commanded to go down.

A servo without integral action yields to gravity, so the tip of a free arm hangs at or below its commanded height. A tip that
rests at the lowest height of its log, well above its command, but only there, rests on an object. These samples hold no
information about the robot, and in a fit they cause false friction at every joint that pushes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.log import find_true_runs
from tau_dyn.model import Model
from tau_dyn.servo.records import LoopRecord, mask_unused

MIN_GAP_M = 0.005
"""Least height above its command of a tip that is held up [m]: dry friction of small arms causes less."""
RESTING = 0.06
"""Speed of every joint below which the tip rests [rad/s]."""
LOWEST_BAND_M = 0.012
"""Distance [m] to the lowest point of its log within which a tip may rest on an object."""
MIN_DURATION_S = 0.15
"""Shortest rest on an object [s]."""
BEFORE_S, AFTER_S = 0.5, 1.0
"""Time left out around a contact [s]: the approach before it, and the transient of the loop after it."""


@dataclass(frozen=True)
class Contact:
    """One log's contact with an object below the tool.

    Attributes:
        log: The log's name.
        joint: The joint whose servo pushes most.
        start: First time [s].
        stop: Last time [s].
        share: Share of the log that is left out.
        height: Median height of the tip while it rests [m].
    """

    log: str
    joint: str
    start: float
    stop: float
    share: float
    height: float

    def describe(self) -> str:
        """Return a sentence that describes it."""
        return (
            f"{self.log}: the tool rests on something at z = {1e3 * self.height:.0f} mm (tip), from {self.start:.1f} to "
            f"{self.stop:.1f} s; {self.joint} pushes on; {100 * self.share:.0f} % of the log is left out as contact"
        )


def find_contacts(model: Model, records: Sequence[LoopRecord]) -> tuple[list[Contact], list[LoopRecord]]:
    """Return the contacts in logs, and the records without those samples.

    An object found in one log is searched in the others, in which the tip may rest on it too briefly to show it.
    """
    if not model.robot.tool or any(r.told != "position" for r in records):
        return [], list(records)
    usual = float(np.median([_measure_usual_gap(model, record) for record in records]))
    found = [_find_contact(model, record, usual, np.inf) for record in records]
    heights = [contact.height for contact, _ in found if contact]
    if heights:
        known = float(np.median(heights))
        found = [
            pair if pair[0] else _find_contact(model, r, usual, known) for pair, r in zip(found, records, strict=True)
        ]
    kept = [mask_unused(record, mask) for record, (_, mask) in zip(records, found, strict=True)]
    return [contact for contact, _ in found if contact], kept


def _measure_gap(model: Model, record: LoopRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tip's height (N,) [m], its height above the command (N,) [m], and the mask of samples at rest (N,)."""
    tip, told = (model.mechanism.tool_position(x)[:, 2] for x in (record.q, record.command))
    return tip, tip - told, np.all(np.abs(record.motion[1]) < RESTING, axis=1)


def _measure_usual_gap(model: Model, record: LoopRecord) -> float:
    """Return the upper limit of the gap of a free tip at rest in this log [m]; zero if it never rests."""
    tip, gap, still = _measure_gap(model, record)
    free = gap[still & (tip > tip.min() + LOWEST_BAND_M)]
    return float(np.percentile(free, 98)) if len(free) > 10 else 0.0


def _find_contact(model: Model, record: LoopRecord, usual: float, known: float) -> tuple[Contact | None, np.ndarray]:
    """Return a log's contact or None, and the mask of its samples to be left out (N,).

    `usual` is the gap of a free tip, `known` the height of a known object, infinite without one [m].
    """
    nothing = np.zeros(len(record.t), dtype=bool)
    tip, gap, still = _measure_gap(model, record)
    low = tip < (known + LOWEST_BAND_M / 2 if np.isfinite(known) else tip.min() + LOWEST_BAND_M)
    held = still & low & (gap > max(MIN_GAP_M, usual + 0.4 * MIN_GAP_M)) & (record.enabled > 0)
    runs = [run for run in find_true_runs(held) if (run.stop - run.start) * record.dt >= MIN_DURATION_S]
    if not runs:
        return None, nothing
    rests = np.zeros_like(nothing)
    for run in runs:
        rests[run] = True
    height = float(np.median(tip[rests]))
    touching = rests | ((tip < height + 0.002) & (gap > 0.6 * MIN_GAP_M))
    before, after = round(BEFORE_S / record.dt), round(AFTER_S / record.dt)
    mask = nothing.copy()
    for k in np.flatnonzero(touching):
        mask[max(0, k - before) : k + after + 1] = True
    joint = model.robot.actuated[int(np.argmax(_share_gap(model, record, rests)))]
    times = record.t[touching] - record.t[0]
    return Contact(record.name, joint, float(times[0]), float(times[-1]), float(mask.mean()), height), mask


def _share_gap(model: Model, record: LoopRecord, rests: np.ndarray) -> np.ndarray:
    """Return the contribution of each joint to the tip's gap to its command (na,) [m], as a median."""
    q, command = record.q[rests], record.command[rests]
    shares = []
    for j in range(q.shape[1]):
        moved = np.array(q)
        moved[:, j] = command[:, j]
        shares.append(np.median((model.mechanism.tool_position(q) - model.mechanism.tool_position(moved))[:, 2]))
    return np.array(shares)
