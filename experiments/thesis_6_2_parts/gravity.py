r"""Table 6.2 read backwards: which masses and tool positions give the printed forces.

A mass m in the plate loads the carts with `g m u(y, z)`, `u` the carts' force per newton of weight: the column of
`plate_link.gravity_mass` at rest. It does not depend on x. The thesis prints the positions only as a drawing (Figure 6.3),
so they are fitted, inside the frame of the guideways; "fitted" they are called everywhere.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from tau_dyn.mechanism import GantryTauMechanism
from thesis_6_2_parts.motions import cart_positions
from thesis_6_2_parts.printed import GRAVITY_MASS, SYMBOLS, TABLE_6_2, G

EXACT = 0.5  # N rms over the three carts: what the printed digit and a centimetre of reading allow
MASSES = np.concatenate([[9.13, 11.5, GRAVITY_MASS], np.arange(9.0, 41.0), np.arange(16.0, 37.0, 0.1).round(1)])  # kg
STEP = 0.01  # m, grid from which fits start


@dataclass(frozen=True)
class GravityStudy:
    """What Table 6.2 says.

    Attributes:
        fitted: Position of each symbol at 22.38 kg (5, 2) [m].
        forces: Gravity there (5, 3) [N].
        misfit: rms over the carts of each symbol (5,) [N].
        profile: For each mass [kg] the misfit of each symbol and over all rows [N].
        intervals: For each symbol the masses that fit within `EXACT` (5, 2) [kg].
        levers: u of each cart at each fitted position (5, 3).
        largest_lever: The largest u of cart 3 in the frame.
        centre: Forces in the middle of the frame at 22.38 kg (3,) [N]; the thesis calls the star the centre position.
    """

    fitted: np.ndarray
    forces: np.ndarray
    misfit: np.ndarray
    profile: pd.DataFrame
    intervals: np.ndarray
    levers: np.ndarray
    largest_lever: float
    centre: np.ndarray

    def rms_at(self, mass: float) -> float:
        """Return the misfit over all fifteen numbers at a mass [kg], in N."""
        return float(np.interp(mass, self.profile["mass_kg"], self.profile["rms_N"]))

    @property
    def best_mass(self) -> float:
        """The mass of least misfit [kg]."""
        return float(self.profile.loc[self.profile["rms_N"].idxmin(), "mass_kg"])


def levers(mechanism: GantryTauMechanism, yz: np.ndarray) -> np.ndarray:
    """Return the carts' force per newton of weight in the plate (N, 3) at tool positions (y, z) (N, 2), nan out of reach."""
    q = cart_positions(mechanism, np.column_stack([np.zeros(len(yz)), yz]))
    out, ok = np.full((len(yz), 3), np.nan), np.isfinite(q).all(axis=1)
    rest = np.zeros((ok.sum(), 3))
    column = mechanism.robot.parameters.names.index("plate_link.gravity_mass")
    out[ok] = mechanism.regressor(q[ok], rest, rest)[:, :, column] / G
    return out


def study(mechanism: GantryTauMechanism, masses: np.ndarray = MASSES) -> GravityStudy:
    """Fit a position to each row of Table 6.2, at each mass [kg]."""
    low, high = mechanism.origin[:, 1:].min(axis=0), mechanism.origin[:, 1:].max(axis=0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, STEP) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
    grid = grid.reshape(-1, 2)
    u = levers(mechanism, grid)
    grid, u = grid[np.isfinite(u).all(axis=1)], u[np.isfinite(u).all(axis=1)]
    found: dict[float, list[tuple[np.ndarray, float]]] = {}
    near: list[np.ndarray | None] = [None] * len(TABLE_6_2)
    for mass in np.unique(masses):
        rows = zip(TABLE_6_2, near, strict=True)
        found[mass] = [_place(mechanism, grid, u, mass, row, low, high, before) for row, before in rows]
        near = [place for place, _ in found[mass]]
    table = [{"mass_kg": mass} | {f"{s}_N": rms for s, (_, rms) in zip(SYMBOLS, places, strict=True)}
             | {"rms_N": float(np.sqrt(np.mean([rms**2 for _, rms in places])))} for mass, places in found.items()]  # fmt: skip
    profile = pd.DataFrame(table)
    fits = [profile["mass_kg"][profile[f"{s}_N"] < EXACT] for s in SYMBOLS]
    fitted = np.array([place for place, _ in found[GRAVITY_MASS]])
    there = levers(mechanism, fitted)
    return GravityStudy(
        fitted,
        G * GRAVITY_MASS * there,
        np.array([rms for _, rms in found[GRAVITY_MASS]]),
        profile,
        np.array([(m.min(), m.max()) if len(m) else (np.nan, np.nan) for m in fits]),
        there,
        float(u[:, 2].max()),
        G * GRAVITY_MASS * levers(mechanism, (low + high)[None] / 2)[0],
    )


def _place(
    mechanism: GantryTauMechanism,
    grid: np.ndarray,
    u: np.ndarray,
    mass: float,
    row: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    before: np.ndarray | None,
) -> tuple[np.ndarray, float]:
    """Return the position (2,) in the frame [m] at which this mass comes nearest to a row, and the rms misfit [N].

    The fit starts from the best point of the grid, and from where a slightly smaller mass was.
    """

    def misfit(yz: np.ndarray) -> np.ndarray:
        return np.nan_to_num(G * mass * levers(mechanism, yz[None])[0] - row, nan=1e3)

    starts = [grid[np.argmin(np.sum((G * mass * u - row) ** 2, axis=1))], *([] if before is None else [before])]
    inside = [np.clip(start, low + 1e-6, high - 1e-6) for start in starts]
    fits = [least_squares(misfit, start, bounds=(low, high), x_scale=0.1) for start in inside]
    best = min(fits, key=lambda fit: float(fit.cost))
    return best.x, float(np.sqrt(np.mean(best.fun**2)))


def most_symmetric(offset: np.ndarray, gravity: np.ndarray) -> dict[str, tuple[float, float]]:
    """Return the masses [kg] at which Coulomb friction is most symmetric, by three meanings of "most", each as an interval.

    Args:
        offset: Half of forward minus backward Coulomb friction of each cart (3,) [N], found with `GRAVITY_MASS`.
        gravity: Gravity's forces at that mass (3,) [N].
    """
    masses = np.arange(10.0, 30.0, 0.01)
    rest = offset + gravity - masses[:, None] / GRAVITY_MASS * gravity
    measures = {"squares": np.sum(rest**2, 1), "sum": np.sum(np.abs(rest), 1), "largest": np.max(np.abs(rest), 1)}
    # where the sum is least it is flat, because each row of Table 6.2 sums to zero
    best = {name: masses[x < x.min() + 0.01] for name, x in measures.items()}
    return {name: (float(m.min()), float(m.max())) for name, m in best.items()}
