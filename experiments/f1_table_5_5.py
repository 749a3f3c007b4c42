"""Can Table 5.5 of the thesis be right as printed? The F1's six rod lengths, met or not, for four ways to read it.

    python experiments/f1_table_5_5.py [--places 40] [--starts 6] [--seed 0]

At q4 = q5 = q6 = 0 a Tau robot's rods are nearly parallel. So the six lengths, solved for the plate's orientation and the
three carts at a given tool place, should be met with the plate nearly parallel to the joint plates. Places are drawn in front
of the guideways (0.6 x 0.6 m), starts around the parallel orientation with the carts above or below. Readings: the last
component of the quaternion 1u_2 as printed or negative; quaternions as printed in (4.35), where they shrink the joint plates,
or of unit length.
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tau_dyn.files import read_yaml
from tau_dyn.robot.expand import find_urdf_folder

PARALLEL = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
"""The plate's axes when it is parallel to joint plate 3: x down, y to +x, z to -y."""


class Reading(NamedTuple):
    """The ball joints on carts and plate at zero, the carts' points first moved along z, and the lengths [m]."""

    on_cart: np.ndarray
    on_plate: np.ndarray
    lengths: np.ndarray


def matrix(u: np.ndarray) -> np.ndarray:
    """Return R(u) of (4.35), a rotation times the squared norm."""
    a, b, c, d = u
    v = np.array([b, c, d])
    return (a * a - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * a * np.array([[0, -d, c], [d, 0, -b], [-c, b, 0]])


def read(table: dict, sign: float, unit: bool) -> Reading:
    """Return Table 5.5 in one reading; `sign` of the last component of 1u_2 (the file holds the negative one)."""
    u2 = np.array(table["arm2"]["quaternion"]) * [1, 1, 1, -sign]
    turns = [u2, np.array(table["arm3"]["quaternion"]), np.array(table["arm3"]["second_quaternion"])]
    R2, R3, R6 = (matrix(u / np.linalg.norm(u) if unit else u) for u in turns)
    on_cart, on_plate, lengths = [], [], []
    for arm in ("arm1", "arm2", "arm3"):
        for rod in table[arm]["rods"]:
            local = np.array(rod["on_cart"], float)
            if arm == "arm2":
                local = R2 @ local
            if arm == "arm3":
                local = R3 @ (table[arm]["offset"] + R6 @ local)
            on_cart.append(table[arm]["origin"] + local)
            on_plate.append(rod["on_plate"])
            lengths.append(rod["length"])
    return Reading(np.array(on_cart), np.array(on_plate), np.array(lengths))


def solve(reading: Reading, place: np.ndarray, rng: np.random.Generator, starts: int) -> tuple[float, float]:
    """Return the largest misfit of a length [m] and the plate's angle from parallel [degrees] of the best solution."""
    arm_of = np.array([0, 1, 1, 2, 2, 2])

    def misfit(x: np.ndarray) -> np.ndarray:
        plate = place + reading.on_plate @ (PARALLEL @ Rotation.from_rotvec(x[:3]).as_matrix()).T
        carts = reading.on_cart + np.outer(x[3:][arm_of], [0, 0, 1])
        return np.linalg.norm(plate - carts, axis=1) - reading.lengths

    best = (np.inf, np.inf)
    for k in range(starts):
        height = (1.0 if k % 2 == 0 else -1.0) + place[2] - 1.2
        found = least_squares(
            misfit, np.r_[rng.normal(0, 0.2, 3), height + rng.normal(0, 0.1, 3)], xtol=1e-14, ftol=1e-14
        )
        angle = float(np.rad2deg(np.linalg.norm(Rotation.from_rotvec(found.x[:3]).as_rotvec())))
        error = float(np.abs(found.fun).max())
        best = min(best, (max(error, 1e-9), angle))  # all exact solutions count the same, the most parallel one wins
    return best


def main() -> None:
    """Print one line a reading."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    for name, default in (("--places", 40), ("--starts", 6), ("--seed", 0)):
        parser.add_argument(name, type=int, default=default)
    given = parser.parse_args()
    table = read_yaml(find_urdf_folder() / "prototypes" / "f1.yaml")
    print(
        "1u_2 last  quaternions   lengths met   plate from parallel [deg], median (range)   |2a 2b| on cart, plate [mm]"
    )
    for sign, unit in product((1, -1), (False, True)):
        reading, rng = read(table, sign, unit), np.random.default_rng(given.seed)
        places = rng.uniform([-0.4, 1.4, 0.2], [0.2, 2.0, 0.2], (given.places, 3))
        results = np.array([solve(reading, place, rng, given.starts) for place in places])
        met = results[:, 0] < 1e-6
        angles = results[met, 1]
        spread = f"{np.median(angles):.1f} ({angles.min():.1f} to {angles.max():.1f})" if met.any() else "-"
        widths = [1e3 * np.linalg.norm(p[1] - p[2]) for p in (reading.on_cart, reading.on_plate)]
        words = "printed " if sign > 0 else "negative", "unit length" if unit else "as printed "
        print(
            f"{words[0]}   {words[1]}   {met.sum():3d} of {len(met):3d}    {spread:42s}   {widths[0]:.1f}, {widths[1]:.1f}"
        )


if __name__ == "__main__":
    main()
