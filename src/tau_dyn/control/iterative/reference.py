r"""The repeated motion: where actuators and tool should be, and the part of it where learning acts fully.

Before and after that part the correction is faded in and out (thesis 7.12 to 7.14) with one side of a Tukey window: the
trial's start, which does not repeat well, is not learnt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal.windows import tukey

from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class Reference:
    """A motion that is repeated.

    Attributes:
        dt: Step [s].
        q: Actuated positions (N, na) [m or rad].
        tool: Tool positions (N, 3) [m].
        first: First sample where learning acts fully.
        last: First sample after it.
        lead: Samples of fading in and of fading out.
        taper: Share of the window that is tapered; the thesis takes 0.95.
    """

    dt: float
    q: np.ndarray
    tool: np.ndarray
    first: int
    last: int
    lead: int = 100
    taper: float = 0.95

    def __post_init__(self) -> None:
        """Refuse a part that does not fit into the motion."""
        n = len(self.q)
        if self.q.ndim != 2 or self.tool.shape != (n, 3):
            raise InputError(
                "wrong_shape", f"a reference has q (N, na) and tool (N, 3), not {self.q.shape} and {self.tool.shape}"
            )
        if not 0 <= self.first - self.lead < self.last + self.lead <= n or not self.first < self.last:
            raise InputError(
                "mismatch",
                f"learning from sample {self.first} to {self.last} with {self.lead} samples of lead-in and lead-out "
                f"does not fit into a motion of {n} samples",
            )
        if not (self.dt > 0 and np.isfinite(self.q).all() and np.isfinite(self.tool).all()):
            raise InputError("invalid_value", "a reference has a positive step and finite positions")

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.q)

    @property
    def full(self) -> slice:
        """Where learning acts fully and errors are judged."""
        return slice(self.first, self.last)

    def weights(self) -> np.ndarray:
        """Return the diagonal of `Q_w` (N,), thesis (7.14)."""
        side = tukey(2 * self.lead, self.taper)[: self.lead]
        w = np.zeros(self.n)
        w[self.first - self.lead : self.first] = side
        w[self.full] = 1.0
        w[self.last : self.last + self.lead] = side[::-1]
        return w
