r"""A motion at its nodes, all the unknowns of the program, and the motion between them.

Between N + 1 even nodes the acceleration is linear in time, so speeds and positions follow exactly (d = 1/N):

    x'_k+1 = x'_k + d/2 (x''_k + x''_k+1),   x_k+1 = x_k + d x'_k + d^2 (x''_k / 3 + x''_k+1 / 6)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.control.motion.coordinates import Actuated, Coordinates
from tau_dyn.control.motion.expressions import ForceLaw

_FLAT = 1e-3  # share of the largest inner unknown below which none is scaled


@dataclass(frozen=True, eq=False)
class Nodes:
    """A motion at the nodes.

    Attributes:
        x: Coordinates (N + 1, n).
        dx: Their derivative by the normalised time.
        ddx: And the second.
        p: Passive joints at nodes and middles (2 N + 1, n_p).
        y: Solutions of the inner systems there (2 N + 1, n_y), in the law's units.
        T: Duration [s].
    """

    x: np.ndarray
    dx: np.ndarray
    ddx: np.ndarray
    p: np.ndarray
    y: np.ndarray
    T: float

    def flat(self) -> np.ndarray:
        """Return all unknowns in the program's order."""
        return np.concatenate([*(z.ravel() for z in (self.x, self.dx, self.ddx, self.p, self.y)), [self.T]])

    def like(self, flat: np.ndarray) -> Nodes:
        """Return nodes of the same shapes from all unknowns."""
        parts, at = [], 0
        for z in (self.x, self.dx, self.ddx, self.p, self.y):
            parts.append(flat[at : at + z.size].reshape(z.shape))
            at += z.size
        return Nodes(*parts, T=float(flat[at]))


def start_nodes(law: ForceLaw, coordinates: Coordinates, profile: tuple[np.ndarray, ...], T: float) -> Nodes:
    """Return the nodes of a motion along the starting path.

    Args:
        law: The forces.
        coordinates: What moves.
        profile: Share of the way, speed and acceleration by the normalised time, at nodes and middles (2 N + 1,).
        T: Duration [s].
    """
    x, dx, ddx = (z[::2] for z in coordinates.along(*profile))
    ddx[[0, -1]] = 0.0
    rough = Nodes(x, dx, ddx, np.zeros((len(profile[0]), 0)), np.zeros((len(profile[0]), 0)), T)
    q, v, a = build_node_motion(coordinates, rough, np.linspace(0, 1, len(profile[0])), T)
    p = law.passive(q)
    return replace(rough, p=p, y=law.inner(q, v, a, p))


def scale_unknowns(law: ForceLaw, start: Nodes) -> tuple[ForceLaw, Nodes]:
    """Return forces and start with inner unknowns measured by their largest value at the start.

    They are speeds, accelerations and forces of the passive joints, some a thousand times larger than others; the solver treats a
    unit of each alike, and takes small steps where they differ (measured in docs/explanation/control.md).
    """
    size = np.abs(start.y).max(axis=0, initial=0.0)
    size = np.maximum(size, max(_FLAT * size.max(initial=0.0), 1e-6))
    return law.in_units(size), replace(start, y=start.y / size)


def build_node_motion(coordinates: Coordinates, nodes: Nodes, share: np.ndarray, T: float) -> Actuated:
    """Return the joints' motion (M, na) at shares (M,) of the duration, exactly as the nodes say, over a duration T [s]."""
    N = len(nodes.x) - 1
    k = np.minimum((share * N).astype(int), N - 1)
    h = (share - k / N)[:, None]
    jerk = (nodes.ddx[k + 1] - nodes.ddx[k]) * N
    x = nodes.x[k] + h * (nodes.dx[k] + h * (nodes.ddx[k] / 2 + h * jerk / 6))
    dx = nodes.dx[k] + h * (nodes.ddx[k] + h * jerk / 2)
    return coordinates.motion(x, dx, nodes.ddx[k] + h * jerk, T)
