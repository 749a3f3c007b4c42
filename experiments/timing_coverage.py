"""Do 95 % intervals hold on arms whose controller holds its force between samples, and logs it half a sample off?

    python experiments/timing_coverage.py [--robots 2r 6r] [--offset start middle] [--runs 20] [--seed 0] [--out DIR]

In: nothing. An independent simulator (Pinocchio's forward dynamics, Runge-Kutta of fourth order, friction with a sharp sign)
drives a planar 2R arm and a 6R arm through a digital controller at 500 Hz that sees noisy encoders and holds its torque for a
sample. The log holds the positions at the samples and the torque as a controller has it (`start` of its hold: half a sample
early) or as a logger in the middle of the hold would (`middle`). Out: `timing_coverage.csv`, a row a run; the share of base
parameters' 95 % intervals that hold the truth, with its own binomial interval.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pinocchio as pin
from scipy import stats

from tau_dyn.files import write_whole
from tau_dyn.identify import identify
from tau_dyn.log import Log
from tau_dyn.robot import load_robot_from_urdf

RATE_HZ = 500.0
SECONDS = 30.0
SUBSTEPS = 2
"""Runge-Kutta steps a sample."""


def link(name: str, mass: float, centre: tuple, size: float) -> str:
    inertia = mass * size**2
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre[0]} {centre[1]} {centre[2]}"/><mass value="{mass}"/>'
        f'<inertia ixx="{inertia}" iyy="{1.2 * inertia}" izz="{0.9 * inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(k: int, parent: str, child: str, xyz: str, axis: str) -> str:
    return (
        f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" velocity="6" effort="1000"/></joint>'
    )


def urdf(name: str) -> str:
    """Return an arm: `2r` swings in a vertical plane, `6r` has a spherical wrist."""
    if name == "2r":
        bodies = [("a_link", 4.0, (0.2, 0.0, 0.0), 0.15), ("b_link", 2.0, (0.15, 0.02, 0.0), 0.1)]
        places = [("0 0 0", "0 1 0"), ("0.4 0 0", "0 1 0")]
    else:
        bodies = [
            ("l1_link", 9.0, (0.0, 0.02, -0.05), 0.12), ("l2_link", 8.0, (0.2, 0.0, 0.1), 0.15),
            ("l3_link", 4.0, (0.02, 0.0, 0.15), 0.1), ("l4_link", 2.0, (0.0, 0.02, 0.05), 0.06),
            ("l5_link", 1.5, (0.0, 0.03, 0.01), 0.05), ("l6_link", 0.8, (0.02, 0.0, 0.04), 0.03),
        ]  # fmt: skip
        places = [
            ("0 0 0.3", "0 0 1"), ("0.05 0.1 0.1", "0 1 0"), ("0.4 0 0", "0 1 0"),
            ("0.05 0 0.2", "0 0 1"), ("0 0 0.15", "0 1 0"), ("0 0 0.1", "0 0 1"),
        ]  # fmt: skip
    names = ["base_link", *(b[0] for b in bodies)]
    joints = [joint(k + 1, names[k], names[k + 1], *place) for k, place in enumerate(places)]
    drives = "".join(
        f'<transmission name="d{k + 1}"><type>transmission_interface/SimpleTransmission</type><joint name="j{k + 1}"/>'
        f'<actuator name="m{k + 1}"/></transmission>' for k in range(len(places))
    )  # fmt: skip
    links = "".join(link(*body) for body in bodies)
    return f'<robot name="arm_{name}"><link name="base_link"/>{links}{"".join(joints)}{drives}</robot>'


class Truth:
    """The arm as it is: bodies up to 10 % off, rotor inertia, friction."""

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        """Draw bodies, rotors and friction."""
        self.model = pin.buildModelFromXML(urdf(name))
        for k in range(1, self.model.njoints):
            body, factor = self.model.inertias[k], rng.uniform(0.9, 1.1)
            self.model.inertias[k] = pin.Inertia(body.mass * factor, body.lever, body.inertia * factor)
        n = self.model.nv
        size = np.array([1.0, 1.0, 0.6, 0.2, 0.2, 0.1])[:n]
        self.armature = size * rng.uniform(0.3, 1.0, n)
        self.model.armature = self.armature
        self.coulomb, self.viscous = size * rng.uniform(3, 6, n), size * rng.uniform(3, 6, n)
        self.data = self.model.createData()

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return accelerations (n,) under drive torques (n,)."""
        return pin.aba(self.model, self.data, q, v, tau - self.coulomb * np.sign(v) - self.viscous * v)

    def step(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and speeds (n,) after `dt` [s] of constant torques (n,)."""
        f = self.acceleration
        a1 = f(q, v, tau)
        a2 = f(q + dt / 2 * v, v + dt / 2 * a1, tau)
        a3 = f(q + dt / 2 * v + dt**2 / 4 * a1, v + dt / 2 * a2, tau)
        a4 = f(q + dt * v + dt**2 / 2 * a2, v + dt * a3, tau)
        return q + dt * v + dt**2 / 6 * (a1 + a2 + a3), v + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def parameters(self, names: tuple[str, ...], robot) -> dict[str, float]:
        """Return the true value of each named parameter."""
        found = {}
        for body in robot.links:
            values = self.model.inertias[body.joint_id].toDynamicParameters()
            found |= dict(zip(body.names, values, strict=True))
        for k in range(self.model.nv):
            own = {"armature": self.armature[k], "coulomb_pos": self.coulomb[k], "coulomb_neg": self.coulomb[k],
                   "viscous_pos": self.viscous[k], "viscous_neg": self.viscous[k]}  # fmt: skip
            found |= {f"j{k + 1}.{key}": value for key, value in own.items()}
        return {name: found[name] for name in names}


def record(truth: Truth, rng: np.random.Generator, offset: str) -> Log:
    """Return a log of a motion under a computed-torque controller that sees encoders of 20 urad."""
    n, dt = truth.model.nv, 1 / RATE_HZ
    t = np.arange(0, SECONDS, dt)
    w = 2 * np.pi * rng.uniform(0.05, 0.6, (6, n))
    phase, share = rng.uniform(0, 2 * np.pi, (6, n)), rng.dirichlet(np.ones(6), n).T
    angle = w * t[:, None, None] + phase
    reach = 1.2
    ref = [reach * np.sum(share * f, axis=1) for f in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))]
    nominal, data = pin.buildModelFromXML(urdf("2r" if n == 2 else "6r")), None
    data = nominal.createData()
    kp, kd = 400.0, 40.0
    q, v = ref[0][0].copy(), ref[1][0].copy()
    seen = q.copy()
    rows_q, rows_tau = np.zeros((len(t), n)), np.zeros((len(t), n))
    speed = v.copy()
    for k in range(len(t)):
        measured = q + 2e-5 * rng.standard_normal(n)
        speed = speed + 0.3 * ((measured - seen) / dt - speed) if k else speed
        seen = measured
        a = ref[2][k] + kp * (ref[0][k] - measured) + kd * (ref[1][k] - speed)
        tau = (
            pin.rnea(nominal, data, measured, ref[1][k], a)
            + truth.armature * a
            + 0.8 * truth.coulomb * np.sign(ref[1][k])
        )
        tau = tau + 0.01 * truth.coulomb * rng.standard_normal(n)  # the drive's ripple, which the joint feels
        rows_q[k], rows_tau[k] = measured, tau
        for _ in range(SUBSTEPS):
            q, v = truth.step(q, v, tau, dt / SUBSTEPS)
    if offset == "middle":  # the mean of the force held before and after each sample stands at the sample
        rows_tau[1:] = (rows_tau[1:] + rows_tau[:-1]) / 2
    rows_tau = rows_tau + 0.02 * truth.coulomb * rng.standard_normal(rows_tau.shape)
    names = [f"j{k + 1}" for k in range(n)]
    columns = {
        f"{key}_{j}": x[:, k]
        for key, x in (("q", rows_q), ("tau", rows_tau), ("q_ref", ref[0]))
        for k, j in enumerate(names)
    }
    return Log(t, columns, f"{offset}.csv")


def one_run(name: str, offset: str, number: int, seed: int) -> dict:
    rng = np.random.default_rng([seed, number, len(name), len(offset)])
    truth = Truth(name, rng)
    robot = load_robot_from_urdf(urdf(name), f"arm_{name}")
    found = identify(robot, record(truth, rng, offset))
    base, estimate = found.estimate.base, found.estimate
    held_within = found.model.robot.parameters  # drive inertia that bodies hold belongs to the first joint's
    true = truth.parameters(base.names, robot)
    values = np.array([true[n] for n in base.names])
    for j in ("j1", "j2"):
        if not held_within[f"{j}.armature"].free:
            values = values + _as_bodies(robot, base.names, j) * truth.armature[int(j[1]) - 1]
    z = (estimate.beta - base.combine(values)) / estimate.stderr
    held, worst = int(np.sum(np.abs(z) < 1.959964)), float(np.max(np.abs(z)))
    row = {"robot": name, "offset": offset, "number": number, "intervals": len(z), "held": held, "worst_z": worst}
    return row | {"estimator": found.estimator, "error": found.train.relative_error_percent}


def _as_bodies(robot, names: tuple[str, ...], joint_name: str) -> np.ndarray:
    """Return body parameters (p,) that act as a unit drive inertia of a joint does."""
    from tau_dyn.mechanism import build_mechanism

    rng = np.random.default_rng(0)
    q, v, a = rng.uniform(-1, 1, (3, 80, robot.na))
    W = build_mechanism(robot).regressor(q, v, a).reshape(-1, len(robot.parameters))
    column = W[:, robot.parameters.names.index(f"{joint_name}.armature")]
    bodies = [k for k, n in enumerate(robot.parameters.names) if not n.endswith(".armature")]
    share = np.linalg.lstsq(W[:, bodies], column, rcond=1e-10)[0]
    out = dict.fromkeys(names, 0.0) | {robot.parameters.names[b]: x for b, x in zip(bodies, share, strict=True)}
    return np.array([out[n] for n in names])


def main(robots: list[str], offsets: list[str], runs: int, seed: int, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in robots:
        for offset in offsets:
            for number in range(runs):
                rows.append(one_run(name, offset, number, seed))
                write_whole(out / "timing_coverage.csv", pd.DataFrame(rows).to_csv(index=False))
    table = pd.DataFrame(rows)
    for key, group in table.groupby(["robot", "offset"]):
        k, n = int(group["held"].sum()), int(group["intervals"].sum())
        low, high = stats.binomtest(k, n).proportion_ci()
        share, worst = 100 * k / n, group["worst_z"].max()
        print(
            f"{key}: {share:.1f} % of {n} intervals hold the truth ({100 * low:.1f} to {100 * high:.1f}), worst {worst:.1f}"
        )
        print("   ", dict(group["estimator"].value_counts()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["2r", "6r"])
    parser.add_argument("--offset", nargs="+", default=["start", "middle"])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    main(args.robots, args.offset, args.runs, args.seed, args.out)
