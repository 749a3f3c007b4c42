"""Does `diagnose` with default options name what hides in a stock arm, and nothing else?

    python experiments/stock_arms.py [--robots ur5 panda] [--effects clean stribeck ...] [--seeds 1] [--seed 0] [--out DIR]

In: nothing. UR5 and Panda of `example-robot-data`; bodies differ from the file by up to 15 %, rotors of 0.05 to 1 kg m2 are not
in it. Forces come from Pinocchio's recursive Newton-Euler along a sum of sines of 60 s (`spoiled_logs_parts/machines.py`);
effects are written here, in other forms than the library's. Out: `stock_arms.csv`, a row a log: confirmed causes, whether the
true one is among them with its joint, false ones; a summary.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter
from spoiled_logs_parts.machines import GRAVITY, RATE_HZ, Made, as_log, forces_of_bodies, make_log

from tau_dyn.diagnose import diagnose
from tau_dyn.exceptions import TauDynError
from tau_dyn.files import write_whole

DURATION_S = 60.0
Effect = Callable[[Made, int, np.random.Generator], np.ndarray]


def _scale(made: Made, joint: int) -> float:
    """Return the joint's root-mean-square force [N m]."""
    return float(np.sqrt(np.mean(made.force[:, joint] ** 2)))


def _one(made: Made, joint: int, force: np.ndarray) -> np.ndarray:
    out = made.force.copy()
    out[:, joint] += force
    return out


def stribeck(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """Friction that falls by 1 / (1 + |v| / v_s)^2 from standstill."""
    v = made.motion[1][:, joint]
    return _one(made, joint, 0.1 * _scale(made, joint) * np.sign(v) / (1 + np.abs(v) / 0.06) ** 2)


def load_friction(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """Coulomb friction in proportion to the torque that the gear transmits: that of the bodies."""
    v = made.motion[1][:, joint]
    return _one(made, joint, 0.12 * np.abs(made.bodies[:, joint]) * np.tanh(v / 0.003))


def position_friction(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """Friction that a bent shaft raises on one side of the range."""
    q, v = made.motion[0][:, joint], made.motion[1][:, joint]
    x = (q - q.mean()) / (q.max() - q.min())
    return _one(made, joint, 0.12 * _scale(made, joint) * np.sign(v) * np.tanh(4 * x))


def cyclic_ripple(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """A gear's torque ripple with a second harmonic."""
    q, phase = made.motion[0][:, joint], rng.uniform(0, 2 * np.pi)
    k = 2 * np.pi / 0.13
    return _one(made, joint, 0.05 * _scale(made, joint) * (np.sin(k * q + phase) + 0.4 * np.sin(2 * k * q)))


def delay(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """All forces 9 ms late."""
    t = np.arange(len(made.force)) / RATE_HZ
    return np.stack([np.interp(t - 0.009, t, x) for x in made.force.T], axis=1)


def drive_lag(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """One joint's force through a low-pass of 15 ms."""
    out, a = made.force.copy(), np.exp(-1 / (RATE_HZ * 0.015))
    out[:, joint] = lfilter([1 - a], [1, -a], out[:, joint] - out[0, joint]) + out[0, joint]
    return out


def viscous_curvature(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """Viscous friction that saturates as an oil film warms in shear."""
    v = made.motion[1][:, joint]
    fast = np.quantile(np.abs(v), 0.98)
    return _one(made, joint, 0.5 * _scale(made, joint) * np.arcsinh(v / (0.25 * fast)) / np.arcsinh(4))


def payload(made: Made, joint: int, rng: np.random.Generator) -> np.ndarray:
    """2 kg at the last link, 6 cm out."""
    robot, values = made.robot, dict(made.truth)
    m, c = 2.0, np.array([0.02, 0.03, 0.05])
    about = m * (2e-3 * np.eye(3) + (c @ c) * np.eye(3) - np.outer(c, c))
    more = [m, *(m * c), about[0, 0], about[0, 1], about[1, 1], about[0, 2], about[1, 2], about[2, 2]]
    for name, x in zip(robot.links[-1].names, more, strict=True):
        values[name] += x
    before, after = (forces_of_bodies(robot, x, *made.motion, GRAVITY) for x in (made.truth, values))
    return made.force + after - before


EFFECTS: dict[str, Effect] = {
    "stribeck": stribeck, "load_friction": load_friction, "position_friction": position_friction, "cyclic_ripple": cyclic_ripple,
    "delay": delay, "drive_lag": drive_lag, "viscous_curvature": viscous_curvature, "payload": payload,
}  # fmt: skip
BY_REFIT = ("payload",)
"""Causes that only a trusted nominal shows; the bodies here are too far off for a certain answer."""
EVERYWHERE = ("delay", "payload")


def make_row(robot: str, effect: str, number: int) -> dict:
    """Return what `diagnose` says of one log."""
    made = make_log(robot, number, duration_s=DURATION_S)
    rng = np.random.default_rng([number, sum(map(ord, robot + effect))])
    joint = int(rng.integers(made.robot.na))
    log = made.log
    if effect != "clean":
        t = np.arange(len(made.position)) / RATE_HZ
        log = as_log(made.robot, t, made.position, EFFECTS[effect](made, joint, rng), made.log.name)
    name = made.robot.actuated[joint]
    row = {"robot": robot, "effect": effect, "number": number, "joint": "" if effect in EVERYWHERE else name}
    began = time.monotonic()
    try:
        found = diagnose(made.robot, log)
    except TauDynError as fault:
        return row | {"verdict": type(fault).__name__, "found": str(fault)[:200], "false": 0, "named": False}
    claims = [f for f in found.findings if f.status == "confirmed"]
    right = [
        f
        for f in claims
        if effect in {f.cause, *f.indistinguishable_from} and (effect in EVERYWHERE or name in f.joints)
    ]
    structures = [u for u in found.unexplained if u.status == "confirmed"]
    return row | {
        "verdict": found.verdict,
        "recommendation": found.recommendation,
        "found": "; ".join(f"{f.cause}@{'+'.join(f.joints)}:{f.status}" for f in found.findings),
        "unexplained": "; ".join(f"{u.joint}({'+'.join(u.depends_on)}):{u.status}" for u in found.unexplained),
        "warnings": " ".join(found.warnings)[:300],
        "false": len(claims) - len(right) + len(structures),
        "named": bool(right) or (effect in BY_REFIT and any(f.cause == effect for f in found.findings)),
        "before_percent": found.baseline.relative_error_percent,
        "after_percent": found.extended.relative_error_percent,
        "floor_percent": found.noise_floor.relative_error_percent,
        "seconds": time.monotonic() - began,
    }  # fmt: skip


def main(robots: list[str], effects: list[str], seeds: int, seed: int, out_dir: Path) -> None:
    out_dir.mkdir(parents=True, exist_ok=True)
    rows = []
    for number in range(seeds):
        for robot in robots:
            for effect in effects:
                rows.append(make_row(robot, effect, 1000 * seed + number))
                print({k: v for k, v in rows[-1].items() if v != ""}, flush=True)
                write_whole(out_dir / "stock_arms.csv", pd.DataFrame(rows).to_csv(index=False, float_format="%.4g"))
    table = pd.DataFrame(rows)
    hidden = table[table.effect != "clean"]
    print(
        f"{len(table)} logs: false claims in {int((table.false > 0).sum())}; named {int(hidden.named.sum())} of {len(hidden)}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=("ur5", "panda"), default=["ur5", "panda"])
    parser.add_argument("--effects", nargs="+", choices=("clean", *EFFECTS), default=["clean", *EFFECTS])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out"))
    given = parser.parse_args()
    main(given.robots, given.effects, given.seeds, given.seed, given.out)
