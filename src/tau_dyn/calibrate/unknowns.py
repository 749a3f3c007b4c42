"""All that a fit may change: a geometry's parameters, the device's frame, the target's place on the tool, backlash."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from tau_dyn.calibrate.frames import DeviceFrames
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.identifiability import SCALES
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.parameters import Parameter

_PRIOR_UNITS = ("m", "rad")
_FRAMES_FIRST = -1  # priority of device and target: below that of any parameter of the robot


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Names and kinds of all unknowns, free or not.

    Attributes:
        rows: One parameter for each unknown (P,), at its starting value.
        free: Which may change (P,).
        scales: Size of an error that matters (P,).
        priority: Which are kept where they depend on each other (P,).
        n_geometry: Number of the geometry's own parameters, which come first.
        n_device: Number of the device frames' parameters, which follow.
        n_tool: Number of the target's, which follow.
    """

    rows: tuple[Parameter, ...]
    free: np.ndarray
    scales: np.ndarray
    priority: np.ndarray
    n_geometry: int
    n_device: int
    n_tool: int

    @property
    def plays(self) -> bool:
        """Whether backlash is free somewhere."""
        return bool(self.free[self.n_geometry + self.n_device + self.n_tool :].any())

    @property
    def names(self) -> tuple[str, ...]:
        """Names (P,)."""
        return tuple(p.name for p in self.rows)

    def split(self, step: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts of a step (P,): geometry, device frames, tool frames, backlash."""
        ends = np.cumsum([self.n_geometry, self.n_device, self.n_tool])
        a, b, c, d = np.split(step, ends)
        return a, b, c, d


def collect(
    geometry: Geometry,
    frames: DeviceFrames,
    *,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    device: bool,
    tool: bool,
    turned: bool,
    backlash: bool = False,
    prior: Sequence[float] = (),
) -> Unknowns:
    """Return the unknowns of a fit.

    Args:
        geometry: The mechanism.
        frames: Starting frames.
        fix: Names or patterns that stay.
        free: Names or patterns that may change although they would stay.
        device: Whether the device's frame is unknown.
        tool: Whether the target's place on the tool is unknown.
        turned: Whether orientations were measured; without them the target's own orientation is invisible.
        backlash: Whether backlash of the actuated joints is unknown; needs poses that tell from which side each came.
        prior: Standard deviations of what the robot was built to: lengths [m] and perhaps angles [rad]; `SCALES` unless given.

    Raises:
        InputError: A standard deviation that is not above zero.
        UnknownName: A pattern that no parameter matches.
    """
    p = len(geometry.parameters)
    own, nd, nt = frames.parameters(), 6 * len(frames.device), 6 * len(frames.tool)
    joints = zip(geometry.actuated, geometry.position_units, strict=True)
    play = [Parameter(f"{joint}.backlash", 0.0, unit, free=False) for joint, unit in joints]
    rows = (*geometry.parameters, *own, *play)
    may = [*geometry.parameters.free, *[device] * nd]
    target = [tool and geometry.orients] * 3 + [tool and geometry.orients and turned] * 3
    may = np.array([*may, *target * len(frames.tool), *[backlash] * len(play)], bool)
    names = [row.name for row in rows]
    for patterns, value in ((free, True), (fix, False)):
        for pattern in patterns:
            hit = [k for k, name in enumerate(names) if fnmatchcase(name, pattern)]
            if not hit:
                raise UnknownName("geometry parameter", pattern, names)
            may[hit] = value
    if len(prior) > len(_PRIOR_UNITS) or not all(0 < x < np.inf for x in prior):
        raise InputError(
            "invalid_value", f"a prior is a length [m] and perhaps an angle [rad], above zero, not {prior}"
        )
    known = SCALES | dict(zip(_PRIOR_UNITS, prior, strict=False))
    scales = np.array([row.prior_stderr or known.get(row.unit, 0.01) for row in rows])
    priority = np.concatenate([geometry.priority, np.full(len(own), _FRAMES_FIRST), np.zeros(len(play), int)])
    return Unknowns(rows, may, scales, priority, p, nd, nt)
