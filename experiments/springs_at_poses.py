"""Do hammer tests at four poses give a robot's springs, and resonances at poses where nobody measured?

    python experiments/springs_at_poses.py [--robots l1 ur5 delta] [--seeds 20] [--seed 0] [--out DIR]

In: nothing. `l1`: the flexible L1 of urdf/prototypes/flexible_l1.yaml, all its springs times e^(0.5 N(0, 1)); `ur5`: six drives
of 5 to 50 kN m/rad; `delta`: three drives of 0.5 to 5 kN m/rad and six rods of 1 to 10 N/um; damping ratios of each spring alone
0.5 to 3 %. The robot hangs in its springs under gravity at four poses about home. A hammer strikes the tool (UR5: and the
forearm; L1: and carts and mounts) along x, y and z once or twice each, accelerometers are on the same places: half-sine blows of
100 to 200 N, noise of 1:600 of the force and of 1 % of the accelerations' root mean square within 0.2 s of a blow, 1 kHz.

Truth: M, D and K at rest by `FlexibleModel`; forces behind a steep anti-aliasing filter, responses to them by an inverse Laplace
transform, exact for signals of that band. The fit begins at the file's springs (L1), or without any (UR5, Delta). Out:
`springs_at_poses.csv`, a row a machine: intervals of identified springs that hold the truth, how many were identified, and the
largest error of the first three resonances at 20 other poses.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.signal import fftconvolve, firwin

from tau_dyn.exceptions import TauDynError
from tau_dyn.files import write_whole
from tau_dyn.log import Log
from tau_dyn.mechanism import FlexibleModel, state_springs
from tau_dyn.modes import SpringFit, find_springs
from tau_dyn.modes.springs.channels import find_frame
from tau_dyn.robot import Robot, load_robot

N_POSES, N_OTHER, N_RESONANCES = 4, 20, 3
RATE_HZ, FINER, BLOW_S = 1000.0, 8, 2.0
FORCE_NOISE, RESPONSE_NOISE = 1 / 600, 0.01


class Machine(NamedTuple):
    """A machine of the study.

    Attributes:
        truth: The robot with drawn springs.
        start: The robot that the fit begins with.
        springs: Springs that are fitted.
        places: Axes along which each place is struck.
        blows: Blows along each axis.
        reach: Spread of the poses about home [m or rad].
    """

    truth: FlexibleModel
    start: Robot
    springs: tuple[str, ...]
    places: dict[str, str]
    blows: int
    reach: float

    @property
    def points(self) -> list[str]:
        """Axis and place of each hammer and sensor."""
        return [f"{axis}_{place}" for place, axes in self.places.items() for axis in axes]


def draw_machine(name: str, rng: np.random.Generator) -> Machine:
    """Return a machine whose springs are drawn."""
    if name == "l1":
        start = load_robot("gantry_tau", arms="complete", flexible="true")
        places = {"tool": "xyz"} | {
            f"{part}{k}": axes for part, axes in (("cart", "yz"), ("mount", "xyz")) for k in (1, 2, 3)
        }
        model = FlexibleModel(start)
        sizes = [s.stiffness * np.exp(0.5 * rng.standard_normal()) for s in model.springs]
        return Machine(_with(model, sizes, rng), start, ("file",), places, 1, 0.3)
    start = load_robot(name)
    log_range = {"ur5": (5e3, 5e4), "delta": (5e2, 5e3)}[name]
    drives = {j: float(np.exp(rng.uniform(*np.log(log_range)))) for j in start.actuated}
    stated = state_springs(start, drives=drives, rods=None if name == "ur5" else 5e6)
    model = FlexibleModel(stated)
    sizes = [
        s.stiffness if s.joint in drives else float(np.exp(rng.uniform(*np.log((1e6, 1e7))))) for s in model.springs
    ]
    if name == "ur5":
        return Machine(_with(model, sizes, rng), start, ("drives",), {"tool": "xyz", "forearm_link": "xyz"}, 2, 0.6)
    return Machine(_with(model, sizes, rng), start, ("drives", "rods"), {"tool": "xyz"}, 2, 0.3)


def _with(model: FlexibleModel, sizes: list[float], rng: np.random.Generator) -> FlexibleModel:
    """Return the model with these stiffnesses; each spring alone is damped by 0.5 to 3 % at its own frequency."""
    springs = [replace(s, stiffness=float(k)) for s, k in zip(model.springs, sizes, strict=True)]
    near = model.with_springs(springs).at(tool=model.robot.tool, sag=False)
    mass = np.diag(near.M)[near.na :]
    ratios = rng.uniform(0.005, 0.03, len(springs))
    return model.with_springs([
        replace(s, damping=float(2 * z * np.sqrt(s.stiffness * m))) for s, z, m in zip(springs, ratios, mass, strict=True)
    ])  # fmt: skip


def strike(machine: Machine, q: np.ndarray, rng: np.random.Generator, name: str) -> Log:
    """Return the record of a hammer test at a pose: blows at every place along every axis, one after the other."""
    near, a = machine.truth.at(q, tool=machine.truth.robot.tool), machine.truth.robot.na
    rows = np.vstack([
        machine.truth.compute_jacobian(near, find_frame(machine.truth.robot, place))[["xyz".index(x) for x in axes], a:]
        for place, axes in machine.places.items()
    ])  # fmt: skip
    n, count, dt = int(BLOW_S * RATE_HZ * FINER), machine.blows * len(rows), 1 / (RATE_HZ * FINER)
    force = np.zeros((count * n, len(rows)))
    for blow in range(count):
        t = np.arange(n) * dt - 0.1
        width, size = rng.uniform(0.003, 0.006), rng.uniform(100, 200)
        force[blow * n : (blow + 1) * n, blow // machine.blows] = (
            size * np.sin(np.pi * t / width) * ((t > 0) & (t < width))
        )
    taps = firwin(801, 0.42 * RATE_HZ, fs=1 / dt, window=("kaiser", 10.0))[:, None]
    u = fftconvolve(force, taps, "same", axes=0)[::FINER]
    y = respond(near.M[a:, a:], near.D[a:, a:], near.K[a:, a:], rows, u)
    t, lively = np.arange(len(u)) / RATE_HZ, np.any(np.abs(u) > 1.0, axis=1)
    lively = np.convolve(lively, np.ones(200), "full")[: len(u)] > 0
    u = u + FORCE_NOISE * 150 * rng.standard_normal(u.shape)
    y = y + RESPONSE_NOISE * np.sqrt(np.mean(y[lively] ** 2, axis=0)) * rng.standard_normal(y.shape)
    channels = {
        f"{kind}{name}": x
        for kind, some in (("f", u), ("a", y))
        for name, x in zip(machine.points, some.T, strict=True)
    }
    channels |= {f"q_{joint}": np.full(len(t), at) for joint, at in zip(machine.truth.robot.actuated, q, strict=True)}
    return Log(t, channels, name)


def respond(M: np.ndarray, D: np.ndarray, K: np.ndarray, rows: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return accelerations (N, p) at places with Jacobians `rows` (p, n) under band-limited forces there (N, p), from rest.

    The inverse Laplace transform along a line right of all poles, where a record twice as long does not wrap around.
    """
    n, size, out = len(u), 2 * len(u), []
    sigma = 9 * RATE_HZ / n
    shift = np.exp(-sigma * np.arange(n) / RATE_HZ)[:, None]
    s = sigma + 2j * np.pi * np.fft.rfftfreq(size, 1 / RATE_HZ)
    pushed = np.fft.rfft(u * shift, size, axis=0) @ rows
    for some, push in zip(np.array_split(s, 32), np.array_split(pushed, 32), strict=True):
        Z = some[:, None, None] ** 2 * M + some[:, None, None] * D + K
        out.append(some[:, None] ** 2 * (np.linalg.solve(Z, push[:, :, None])[:, :, 0] @ rows.T))
    return np.fft.irfft(np.concatenate(out), size, axis=0)[:n] / shift


def draw_pose(machine: Machine, rng: np.random.Generator) -> np.ndarray:
    """Return a pose about home at which gravity and the springs are in equilibrium."""
    robot = machine.truth.robot
    while True:
        q = robot.home + machine.reach * rng.uniform(-1, 1, robot.na)
        try:
            machine.truth.at(q, tool=robot.tool)
            return q
        except TauDynError:
            continue


def compare_resonances(machine: Machine, found: SpringFit, rng: np.random.Generator) -> float:
    """Return the largest relative error of the first resonances at other poses."""
    fitted, worst = FlexibleModel(found.build_robot()), 0.0
    for _ in range(N_OTHER):
        q = draw_pose(machine, rng)
        true, seen = (
            model.at(q, tool=model.robot.tool).natural_frequencies()[:N_RESONANCES] for model in (machine.truth, fitted)
        )
        worst = max(worst, float(np.abs(seen / true - 1).max()))
    return worst


def study(name: str, number: int, seed: int) -> dict[str, object]:
    """Return the row of one machine."""
    rng = np.random.default_rng([seed, number, ("l1", "ur5", "delta").index(name)])
    machine = draw_machine(name, rng)
    logs = [strike(machine, draw_pose(machine, rng), rng, f"{name} pose {k + 1}") for k in range(N_POSES)]
    inputs, outputs = ([f"{kind}{point}" for point in machine.points] for kind in "fa")
    start = time.process_time()
    found = find_springs(machine.start, logs, inputs, outputs, springs=machine.springs)
    seconds = time.process_time() - start
    true = {s.joint: s for s in machine.truth.springs}
    kept = [s for s in found.springs if s.identified]
    inside = [s.ci95[0] <= true[s.spring.joint].stiffness <= s.ci95[1] for s in kept]
    damped = [abs(s.spring.damping - true[s.spring.joint].damping) < 1.96 * s.damping_stderr for s in kept]
    return {
        "robot": name, "number": number, "springs": len(found.springs), "identified": len(kept), "inside": sum(inside),
        "damping_inside": sum(damped),
        "relative_stderr": float(np.median([s.stiffness_stderr / s.spring.stiffness for s in kept])),
        "fit_percent": float(np.mean([np.mean(r.fit_percent) for r in found.records])),
        "worst_resonance_percent": 100 * compare_resonances(machine, found, rng), "seconds": round(seconds, 1),
    }  # fmt: skip


def main(robots: list[str], seeds: int, seed: int, out: Path) -> None:
    """Run the study."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for name in robots:
        for number in range(seeds):
            rows.append(study(name, number, seed))
            print(*rows[-1].values(), flush=True)
            write_whole(out / "springs_at_poses.csv", pd.DataFrame(rows).to_csv(index=False))
        table = pd.DataFrame([row for row in rows if row["robot"] == name])
        n, hold, damped = (int(table[x].sum()) for x in ("identified", "inside", "damping_inside"))
        print(
            f"{name}: {n} of {int(table.springs.sum())} springs identified; intervals hold {hold} ({100 * hold / n:.1f} %), of "
            f"damping {damped} ({100 * damped / n:.1f} %); resonances within {table.worst_resonance_percent.max():.2g} %"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=("l1", "ur5", "delta"), default=["l1", "ur5", "delta"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    main(args.robots, args.seeds, args.seed, args.out)
