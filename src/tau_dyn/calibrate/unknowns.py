"""The unknowns of a fit, and those that poses identify, by rank-revealing QR on scaled columns.

Unknowns are a geometry's parameters, the device's frame, the target's place on the tool, and backlash. A column is the whitened
derivative of all residuals times the unknown's scale: the effect of an error of that size, in units of the noise. Unknowns with
smaller `priority` are preferred, but not if the set becomes badly conditioned; an unknown whose column the kept columns explain
is not identifiable, and `depends_on` names the kept ones. Unidentifiable combinations have singular values of zero to rounding;
a value below 1 means that a combination is uncertain by more than its scale, which is not a structural rank loss.
Reference: Besnard & Khalil 2001; Khalil, Gautier & Enguehard 1991.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from scipy import linalg

from tau_dyn.calibrate.frames import DeviceFrames
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import ENCODERS, KINDS
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.parameters import Parameter
from tau_dyn.results import Brief

STRUCTURAL = 1e-12
"""Share of the largest singular value below which a combination is unidentifiable at any noise."""

SCALES = {"m": 0.01, "rad": 0.01, "1": 0.01, "m/N": 1e-5}
"""Standard error by unit, above which a parameter counts as unknown."""

_LESS = 0.5
"""Weight of a level of priority, relative to the one before."""

_LAST = 10
"""Level of priority that counts as the last: a factor of a thousand in weight."""

_TIE = 1e-10
"""Relative decrease of the weight from each column to the next: the first of two equal columns is chosen despite rounding."""

_INVOLVED = 1e-6
"""Share of the largest factor below which a parameter has no part in a dependence."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Identifiable and unidentifiable parameters.

    Attributes:
        names: All free parameters (p,).
        kept: Indices of those that are estimated (r,).
        dropped: Indices of those that stay at their nominal value (p - r,).
        factors: Changes of the kept parameters that are equivalent to a unit change of a dropped one (r, p - r), each in its
            own unit.
        depends_on: Kept parameters on which each dropped parameter depends.
        singular_values: Singular values of the scaled columns (p,), largest first.
    """

    names: tuple[str, ...]
    kept: np.ndarray
    dropped: np.ndarray
    factors: np.ndarray
    depends_on: tuple[tuple[str, ...], ...]
    singular_values: np.ndarray

    @property
    def rank(self) -> int:
        """Number of parameters that are estimated."""
        return len(self.kept)

    @property
    def condition_number(self) -> float:
        """Largest by smallest singular value of the kept part."""
        s = self.singular_values
        return float(s[0] / s[self.rank - 1]) if self.rank else float("inf")

    def to_dict(self) -> dict[str, object]:
        """Return the contract's `identifiability`."""
        rows = [
            {"parameter": self.names[k], "depends_on": list(d)}
            for k, d in zip(self.dropped, self.depends_on, strict=True)
        ]
        return {"rank": self.rank, "not_identifiable": rows}


def find_identifiable(
    columns: np.ndarray,
    names: tuple[str, ...],
    scales: np.ndarray,
    priority: np.ndarray,
    least: float = 0.0,
) -> Identifiability:
    """Find the identifiable parameters.

    Args:
        columns: Whitened derivatives (rows, p).
        names: Names of the parameters.
        scales: Size of an error that matters (p,).
        priority: Those with smaller numbers are kept first (p,).
        least: Singular value below which a combination is also unidentifiable: its uncertainty is `1 / least` of its scale.
    """
    scaled = columns * scales
    r = np.asarray(np.linalg.qr(scaled, mode="r")) if len(scaled) > scaled.shape[1] else scaled
    s = np.linalg.svd(r, compute_uv=False)
    s = np.concatenate([s, np.zeros(len(names) - len(s))])
    blind = max(STRUCTURAL * s.max(initial=0.0), least)
    structural = int(np.sum(s > blind))
    kept = _chosen(r, priority, structural)
    dropped = np.setdiff1d(np.arange(len(names)), kept)
    factors = np.linalg.lstsq(r[:, kept], r[:, dropped], rcond=None)[0] if len(kept) else np.zeros((0, len(dropped)))
    depends = tuple(_involved(factors[:, d], [names[k] for k in kept]) for d in range(len(dropped)))
    factors = factors / scales[dropped] * scales[kept][:, None]
    return Identifiability(names, kept, dropped, factors, depends, s)


def _involved(factor: np.ndarray, names: list[str]) -> tuple[str, ...]:
    size = np.abs(factor)
    if not size.max(initial=0.0) > 0:
        return ()
    return tuple(name for name, x in zip(names, size, strict=True) if x > _INVOLVED * max(size.max(), 1e-12))


def _chosen(r: np.ndarray, priority: np.ndarray, rank: int) -> np.ndarray:
    """Return the columns to keep: by pivoting on unit columns, each level of priority at half the weight of the one before.

    A strict order would keep a badly conditioned set; then the others could not be reset to their nominal values.
    """
    norm = np.linalg.norm(r, axis=0)
    level = np.minimum(priority - priority.min(initial=0), _LAST)
    rounding = norm <= STRUCTURAL * norm.max(
        initial=0.0
    )  # a column that is rounding only must not be scaled up to count
    order_of_equals = 1 - _TIE * np.arange(len(norm))
    weight = np.where(rounding, 0.0, order_of_equals * _LESS**level / np.where(rounding, 1.0, norm))
    order = np.asarray(linalg.qr(r * weight, mode="r", pivoting=True)[-1])
    return np.sort(order[:rank])


DELAY = "joints.delay"
"""Name of the time by which joints were read before the tool was measured [s]."""
_PRIOR_UNITS = ("m", "rad")
_FRAMES_FIRST = -1  # priority of device and target: below that of any parameter of the robot
_DEVICES_FIRST = -6
"""Priority of devices if some do not measure poses: fixed at its starting value, a device would fix the robot's size."""


@dataclass(frozen=True, eq=False)
class Unknowns(Brief):
    """Names and kinds of all unknowns, free or not.

    Attributes:
        rows: One parameter for each unknown (P,), at its starting value.
        free: Which unknowns are free (P,).
        scales: Size of an error that matters (P,).
        priority: Among dependent unknowns those with smaller numbers are kept (P,).
        n_geometry: Number of the geometry's own parameters, which come first.
        n_device: Number of the device frames' parameters, which follow.
        n_tool: Number of the target's, which follow.
        n_length: Number of devices' offsets and radii, which follow.
    """

    rows: tuple[Parameter, ...]
    free: np.ndarray
    scales: np.ndarray
    priority: np.ndarray
    n_geometry: int
    n_device: int
    n_tool: int
    n_length: int = 0

    @property
    def n_frames(self) -> int:
        """Number of all unknowns of devices and targets."""
        return self.n_device + self.n_tool + self.n_length

    @property
    def plays(self) -> bool:
        """Whether the backlash of a joint, or the delay of the joints, is free."""
        return bool(self.free[self.n_geometry + self.n_frames :].any())

    @property
    def names(self) -> tuple[str, ...]:
        """Names (P,)."""
        return tuple(p.name for p in self.rows)

    def split(self, step: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Return the parts of a step (P,): geometry; device frames, tool frames and lengths; backlash and delay."""
        ends = np.cumsum([self.n_geometry, self.n_device, self.n_tool, self.n_length])
        geometry, device, tool, length, play = np.split(step, ends)
        return geometry, (device, tool, length), play


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
        fix: Names or patterns of parameters that are fixed.
        free: Names or patterns of parameters that are free although they are fixed by default.
        device: Whether the device's frame is unknown.
        tool: Whether the target's place on the tool is unknown.
        turned: Whether orientations were measured; without them the target's own orientation is not identifiable.
        backlash: Whether backlash of the actuated joints is unknown; needs poses with the side from which each was approached.
        prior: Standard deviations of the robot's lengths [m] and perhaps angles [rad] from nominal; `SCALES` by default.

    Raises:
        InputError: A standard deviation is not above zero.
        UnknownName: No parameter matches a pattern.
    """
    p = len(geometry.parameters)
    own, nd, nt = frames.parameters(), 6 * len(frames.device), 6 * len(frames.tool)
    joints = zip(geometry.actuated, geometry.position_units, strict=True)
    play = [Parameter(f"{joint}.backlash", 0.0, unit, free=False) for joint, unit in joints]
    rows = (*geometry.parameters, *own, *play, Parameter(DELAY, 0.0, "s", free=False))
    kinds = frames.kinds or ("pose",) * len(frames.device)
    tool = tool and not set(kinds) <= set(ENCODERS)
    may = [*geometry.parameters.free, *(device and axis in KINDS[kind].axes for kind in kinds for axis in range(6))]
    target = [tool and geometry.orients] * 3 + [tool and geometry.orients and turned] * 3
    n_length = len(frames.with_length)
    may = np.array([*may, *target * len(frames.tool), *[True] * n_length, *[backlash] * len(play), False], bool)
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
    device_first = _DEVICES_FIRST if set(kinds) - {"pose"} else _FRAMES_FIRST
    of_frames = [device_first] * nd + [_FRAMES_FIRST] * nt + [device_first] * n_length
    priority = np.concatenate([geometry.priority, of_frames, np.zeros(len(play) + 1, int)])
    return Unknowns(rows, may, scales, priority, p, nd, nt, n_length)
