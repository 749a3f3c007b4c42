"""F1 (thesis 5.4): what its 10 + 24 + 38 parameters leave blind (Table 5.4), and a calibration of 200 poses chosen from a grid.

The null space is that of every arm's closure equations (5.10) to (5.12) in the device's frame, quaternions on their
manifold: 0, 2 and 4 combinations. For each, the parameters that take part are listed. The calibration starts from a
robot file that is tens of mm and several degrees off; 200 poses are those without which the condition number is
largest, (5.9).

    python experiments/calibrate_f1.py --seed 1
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet, fit_geometry_to_poses
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.result import turn_rows
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.calibrate.unknowns import find_identifiable
from tau_dyn.mechanism import Poses, build_rods, inverse_kinematics
from tau_dyn.robot import load_robot

ARMS = (("rod1",), ("rod2a", "rod2b"), ("rod3a", "rod3b", "rod3c"))
NOISE = (20e-6, 50e-6)  # [m], [rad] each axis
FAR = {"origin": 20e-3, "turn": 0.03, "length": 3e-3, "base": 3e-3, "plate": 3e-3, "direction": 3e-3}


def grid(rods, rng: np.random.Generator, wanted: int = 1347) -> np.ndarray:  # noqa: ANN001
    """Return commanded positions of poses on a grid of 25 cm and 10 degrees that the robot reaches (about 1347, 6)."""
    home = rods.tool_poses(rods.home)
    x = np.arange(-0.5, 0.51, 0.25)
    turns = np.deg2rad(np.arange(-20, 21, 10))
    every = np.array(np.meshgrid(x, x, x, turns, turns, turns, indexing="ij")).reshape(6, -1).T
    every = every[rng.permutation(len(every))[: 4 * wanted]]
    rotation = Rotation.from_rotvec(every[:, 3:]).as_matrix() @ home.rotation[0]
    found = inverse_kinematics(rods, Poses(home.position[0] + every[:, :3], rotation))
    return found.q[found.ok][:wanted]


def null_space(geometry: RodGeometry, q: np.ndarray) -> None:
    """Print each arm's parameters, rank and blind combinations."""
    theta = geometry.parameters.values
    poses = geometry.forward(theta, q).poses
    j = geometry.closure(theta, q, poses).by_parameter
    family = RodFamily(geometry.rods, PoseSet(q, np.zeros((len(q), 3))))
    extra = set(family._superfluous("complete"))
    names = geometry.parameters.names
    rods = list(geometry.rods.names)
    for arm in ARMS:
        rows = j[:, [rods.index(r) for r in arm]]
        seen = np.abs(rows).max(axis=(0, 1)) > 0
        own = [k for k, name in enumerate(names) if seen[k] and name not in extra]
        listed = tuple(names[k] for k in own)
        flat = rows[:, :, own].reshape(-1, len(own)) / 1e-5
        found = find_identifiable(flat, listed, np.full(len(own), 0.01), geometry.priority[own])
        quaternions = sum(".turn_x" in name for name in listed)
        print(
            f"{' '.join(arm)}: {len(own) + quaternions} parameters with quaternions, rank {found.rank}, "
            f"blind beyond norms {len(found.dropped)}"
        )
        for k, depends in zip(found.dropped, found.depends_on, strict=True):
            print(f"    {listed[k]:<16} with {', '.join(depends)}")


def chosen(geometry: RodGeometry, q: np.ndarray, many: int = 200) -> np.ndarray:
    """Return the poses with the largest condition number of the Jacobian without them (5.9)."""
    theta = geometry.parameters.values
    poses = geometry.forward(theta, q).poses
    j = geometry.tool_by_parameter(theta, q, poses)
    flat = j.reshape(-1, j.shape[2])
    norm = np.linalg.norm(flat, axis=0)
    kept = find_identifiable(flat / 1e-5, geometry.parameters.names, np.full(len(norm), 0.01), geometry.priority).kept
    a = j[:, :, kept] / norm[kept]
    whole = np.einsum("nij,nik->jk", a, a)
    cond = [np.linalg.cond(whole - part.T @ part) for part in a]
    return np.sort(np.argsort(cond)[-many:])


def study(seed: int) -> None:
    """Print null space and calibration."""
    rng = np.random.default_rng(seed)
    rods = build_rods(load_robot("gantry_tau_f1"))
    geometry = RodGeometry(rods)
    q = grid(rods, rng)
    print(f"{len(q)} poses on the grid (thesis 1347)")
    null_space(geometry, q[:300])
    size = np.array([FAR[n.rpartition(".")[2].rpartition("_")[0] or "length"] for n in geometry.parameters.names])
    theta = geometry.parameters.values + size * rng.standard_normal(len(size))
    best = chosen(geometry, q)
    poses = simulate_poses(geometry, theta, q[best], rng, noise=NOISE)
    unseen = simulate_poses(geometry, theta, np.delete(q, best, axis=0)[:300], rng, noise=NOISE)
    family = RodFamily(rods, poses)
    for structure in ("frames", "complete"):
        found = fit_geometry_to_poses(family.build(Spec(structure)), poses)
        p, r = found.errors(unseen).position_size, found.errors(unseen).orientation_size
        assert r is not None
        print(
            f"{structure:<10} {poses.n} poses, {found.n_estimated} estimated, unseen: "
            f"position mean {1e3 * p.mean:.3f} mm largest {1e3 * p.max:.2f} mm; "
            f"orientation mean {1e3 * r.mean:.3f} mrad largest {np.rad2deg(r.max):.3f} deg"
        )
    norms = [float(np.linalg.norm(row["quaternion"])) for row in turn_rows(found)]  # type: ignore[arg-type]
    print("norms of the quaternions", *(f"{n:.12f}" for n in norms), "(thesis 0.974 to 1.003)")


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for seed in range(args.seed, args.seed + args.runs):
        study(seed)


if __name__ == "__main__":
    main()
