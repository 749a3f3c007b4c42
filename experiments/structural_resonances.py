"""Does `diagnose` find the resonances of a robot whose structure yields, in forces and at the tool, and none where it is rigid?

    python experiments/structural_resonances.py [--what tool force axis clean] [--runs 5] [--seed 1] [--duration 40]

In: nothing. The truth is the L1 with the springs of urdf/prototypes/flexible_l1.yaml and its wrist (7.4 and twice 11.5 Hz,
damping 1 to 2 %), linearised at home: its springs are driven by the carts' accelerations and push back on the drives. None of
this goes through the effects of the library. To the rigid simplified robot with friction, moved by a multisine on short
strokes, this adds forces or tool displacements; encoders have 0.5 um of noise, forces 1 %, the tool 10 um. `axis` is a sledge
with two pendulums (7.4 and 11.5 Hz) on it; `clean` is the rigid sledge, and what is proposed for the rigid gantry's tool. Out,
on the screen: what each run named, how far frequency and damping are from the truth in standard errors, and the gain on
held-out data. About 10 s a run.
"""

import argparse
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.signal import cont2discrete, lfilter
from thesis_6_3_parts.robots import with_wrist

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.resonances import propose_resonances
from tau_dyn.diagnose.tool_channel import build_tool_channel
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import Log
from tau_dyn.mechanism import Linearised
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory, build_named_motion

RATE_HZ = 250.0
FRICTION = {"coulomb": 12.0, "viscous": 40.0}
PENDULUMS = ((7.4, 0.012, 1.5), (11.5, 0.018, 1.0))
"""Frequency [Hz], damping ratio and mass that swings [kg] of what rides on the sledge."""
SLOWEST_TOLD = 20.0
"""Modes of the flexible robot above are in the truth, but their few newtons and micrometres need not be found [Hz]."""


def modal(near: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return angular frequencies (n,), dampings (n,), what the carts feel (na, n) and how the tool moves (3, n)."""
    a = near.na
    w2, P = eigh(near.K[a:, a:], near.M[a:, a:])
    w = np.sqrt(w2)
    damping = np.array([p @ near.D[a:, a:] @ p for p in P.T]) / (2 * w)
    return w, damping, near.M[:a, a:] @ P, near.tool[:, a:] @ P


def truth(near: Linearised) -> list[tuple[float, float]]:
    """Return frequency [Hz] and damping of the modes that are to be found."""
    w, z, _, _ = modal(near)
    return [(float(x / 2 / np.pi), float(y)) for x, y in zip(w, z, strict=True) if x < 2 * np.pi * SLOWEST_TOLD]


def swings(t: np.ndarray, push: np.ndarray, w: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a mode's deflection and its acceleration (N,), from rest, under a push per unit of modal mass (N,)."""
    dt, swing = float(t[1] - t[0]), (1.0, 2 * z * w, w**2)
    found = []
    for top in ([1.0], [1.0, 0.0, 0.0]):
        made: Any = cont2discrete((top, swing), dt, method="foh")
        found.append(np.asarray(lfilter(np.ravel(made[0]), np.ravel(made[1]), push)))
    return found[0], found[1]


def added(near: Linearised, motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return what yielding adds to the carts' forces (N, na) [N] and to the tool's place (N, 3) [m]."""
    force, tool = np.zeros_like(motion.q), np.zeros((len(motion.t), 3))
    for w, z, felt, seen in zip(*(x.T for x in modal(near)), strict=True):
        x, xdd = swings(motion.t, -motion.a @ felt, float(w), float(z))
        force += np.outer(xdd, felt)
        tool += np.outer(x, seen)
    return force, tool


@cache
def rigid() -> Model:
    """The robot that a controller knows."""
    return Model.of(load_robot("gantry_tau"))


def rigid_forces(model: Model, motion: Trajectory) -> np.ndarray:
    """Return the forces of rigid bodies and friction (N, na)."""
    friction = FRICTION["coulomb"] * np.sign(motion.v) + FRICTION["viscous"] * motion.v
    return model.mechanism.inverse_dynamics(motion.q, motion.v, motion.a) + friction


def gantry_log(
    seed: int, *, yields: bool = True, tool: bool = False, duration: float = 60.0, noise: float = 1.0
) -> Log:
    """Return a log of the Gantry-Tau with forces, or with the tool measured instead.

    Args:
        seed: Of motion and noise.
        yields: Whether the structure does.
        tool: Measure the tool, not the forces.
        duration: Length [s].
        noise: Multiple of the usual noise.
    """
    model, rng = rigid(), np.random.default_rng([seed, 77])
    motion = near_home(model, duration, seed)
    force, moved = added(with_wrist(), motion) if yields else (np.zeros_like(motion.q), np.zeros((len(motion.t), 3)))
    names = model.robot.actuated
    channels = {
        f"q_{j}": q for j, q in zip(names, (motion.q + 5e-7 * noise * rng.normal(size=motion.q.shape)).T, strict=True)
    }
    if tool:
        place = model.mechanism.tool_position(motion.q) + moved + 1e-5 * noise * rng.normal(size=moved.shape)
        channels |= dict(zip(("x_tool", "y_tool", "z_tool"), place.T, strict=True))
    else:
        channels |= forces(names, rigid_forces(model, motion) + force, rng, noise)
    return Log(motion.t, channels, f"gantry {seed}")


def axis_log(
    seed: int, *, pendulums: tuple = PENDULUMS, duration: float = 60.0, noise: float = 1.0
) -> tuple[Model, Log]:
    """Return a sledge with pendulums on it, and its log; without any it is rigid."""
    model, rng = Model.of(load_robot("linear_axis")), np.random.default_rng([seed, 78])
    motion = build_named_motion("multisine", model, duration, seed).resampled(RATE_HZ)
    force = rigid_forces(model, motion)
    for f, z, mass in pendulums:
        force += np.sqrt(mass) * swings(motion.t, -np.sqrt(mass) * motion.a[:, 0], 2 * np.pi * f, z)[1][:, None]
    read = motion.q + 5e-7 * noise * rng.normal(size=motion.q.shape)
    names = model.robot.actuated
    channels = {f"q_{names[0]}": read[:, 0]} | forces(names, force, rng, noise)
    return model, Log(motion.t, channels, f"axis {seed}")


def near_home(model: Model, duration: float, seed: int) -> Trajectory:
    """Return slow strokes of some centimetres with a multisine of 2 to 13 Hz on them, all joints at once."""
    rng, t = np.random.default_rng([seed, 5]), np.arange(0, duration, 1 / RATE_HZ)
    q, v, a = np.zeros((3, len(t), model.robot.na))
    for k in range(model.robot.na):
        slow = [(0.13 * (1 + 0.11 * k), 0.015), (0.29 * (1 + 0.07 * k), 0.006)]
        fast = [(f, 0.0005 / (2 * np.pi * f) * (0.4 + 1.2 * rng.uniform())) for f in np.arange(2 + k / 3, 13, 0.57)]
        for f, size in (*slow, *fast):
            w, phase = 2 * np.pi * f, rng.uniform(0, 2 * np.pi)
            q[:, k] += size * np.sin(w * t + phase)
            v[:, k] += size * w * np.cos(w * t + phase)
            a[:, k] -= size * w**2 * np.sin(w * t + phase)
    return Trajectory(model.robot.actuated, t, model.robot.home + q, v, a, "near home")


def forces(names: tuple[str, ...], force: np.ndarray, rng: np.random.Generator, noise: float) -> dict[str, np.ndarray]:
    """Return force columns with 1 % of coloured noise."""
    coloured = lfilter([np.sqrt(1 - 0.25)], [1, -0.5], rng.normal(size=force.shape), axis=0)
    read = force + 0.01 * noise * force.std(axis=0) * coloured
    return {f"tau_{j}": x for j, x in zip(names, read.T, strict=True)}


def report(what: str, seed: int, found: Diagnosis, modes: list[tuple[float, float]]) -> None:
    """Print one run: every finding, and each resonance against the nearest true one."""
    causes = [(f.cause, f.status, *f.joints) for f in found.findings]
    print(
        f"{what} seed {seed}: {found.verdict}, {causes}, unexplained {[(u.joint, u.depends_on) for u in found.unexplained]}"
    )
    for finding in found.findings:
        gain = (
            "" if finding.gain is None else f"gain {finding.gain.reduction_percent:.0f} % {np.round(finding.gain.ci95)}"
        )
        pairs = {
            p.name.rsplit(".", 1)[-1]: p for p in finding.parameters if "frequency" in p.name or "damping" in p.name
        }
        if finding.cause == "structural_compliance":
            print(f"    {finding.sentence}\n    {gain}")
            for end in ("", "_2", "_3"):
                if f"frequency{end}" in pairs:
                    f, z = pairs[f"frequency{end}"], pairs[f"damping{end}"]
                    near = min(modes, key=lambda m: abs(m[0] - f.value), default=(np.nan, np.nan))
                    print(f"    {f.value:8.3f} Hz ± {f.stderr:.3f}, off {100 * (f.value / near[0] - 1):+.2f} % "
                          f"damping {z.value:.4f} ± {z.stderr:.4f}, true {near[1]:.4f}", flush=True)  # fmt: skip
        else:
            print(f"    {finding.cause} {finding.joints} {finding.status} {gain}")


def main(what: list[str], runs: int, seed: int, duration: float) -> None:
    for number in range(seed, seed + runs):
        if "tool" in what:
            log, other = (gantry_log(n, tool=True, duration=duration) for n in (number, 1000 + number))
            report("tool", number, diagnose(rigid().robot, log, holdout=other), truth(with_wrist()))
        if "force" in what:
            log, other = (gantry_log(n, duration=duration) for n in (number, 1000 + number))
            report("force", number, diagnose(rigid().robot, log, holdout=other, model="symmetric"), truth(with_wrist()))
        if "axis" in what:
            (model, log), (_, other) = (axis_log(n, duration=duration) for n in (number, 1000 + number))
            found = diagnose(model.robot, log, holdout=other, model="symmetric")
            report("axis", number, found, [(f, z) for f, z, _ in PENDULUMS])
        if "clean" in what:
            model, log = axis_log(number, pendulums=(), duration=25.0)
            report("clean axis", number, diagnose(model.robot, log, model="symmetric"), [])
            log = gantry_log(number, yields=False, tool=True, duration=25.0)
            print(f"    clean tool: proposed {propose_resonances(build_tool_channel(rigid(), [log]))}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--what", nargs="+", choices=("tool", "force", "axis", "clean"), default=["tool", "force", "axis"]
    )
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--duration", type=float, default=40.0, metavar="S", help="of each log, beside 25 s of clean ones"
    )
    main(**vars(parser.parse_args()))
