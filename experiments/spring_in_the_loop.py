"""A joint behind a spring, logged as command and position only: is the spring named, and how well are it and the delay known?

    python experiments/spring_in_the_loop.py [--sets N] [--hidden spring delay backlash nothing] [--out TABLE.csv]

The joint of pace-sim2real issue 19: harmonic drive 20:1, 1 kHz, a linear chirp of 0.3 rad from 0.1 to 8 Hz over 30 s. Drawn
for each set: link 0.03 to 0.12 kg m^2, motor 0.01 to 0.05, gains at which the loop is stable and exaggerates no command of
the chirp more than fourfold, encoder on the motor or the link, friction, a delay of 1 to 10 ms of the command (even sets) or
of the torque (odd ones). A spring gives the link a resonance of 3 to 8 Hz with the motor held, and a damping ratio of 1 to
6 %. The law file gives gains and encoder.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

sys.path[:0] = [str(Path(__file__).resolve().parent.parent)]
from tests.servo.arms import build_link  # noqa: E402

from tau_dyn.effects import build_friction_model  # noqa: E402
from tau_dyn.model import Model  # noqa: E402
from tau_dyn.servo import diagnose_loop, simulate_loop_log  # noqa: E402
from tau_dyn.simulate import ServoLaw, Trajectory  # noqa: E402

RATE_HZ, SECONDS, AMPLITUDE, BAND_HZ = 1000.0, 30.0, 0.3, (0.1, 8.0)
RESOLUTION, NOISE = 2 * np.pi / 2**14, 1e-4  # rad; a 14 bit encoder
HIDDEN = ("spring", "delay", "backlash", "nothing")
NAMES = {"spring": "joint_compliance", "backlash": "backlash"}
MAX_PEAK = 4.0  # of position over command; the joint would hit its stops
WITHIN_HZ, WITHIN_S = 0.02, 5e-4  # relative, absolute


def draw_joint(rng: np.random.Generator, hidden: str, late: str) -> tuple[dict[str, float], ServoLaw, ServoLaw]:
    """Return the joint's numbers, its true law, and the law that is known."""
    while True:
        joint = {
            "link": float(np.exp(rng.uniform(*np.log([0.03, 0.12])))), "armature": float(rng.uniform(0.01, 0.05)),
            "coulomb": float(rng.uniform(0.02, 0.3)), "viscous": float(rng.uniform(0.01, 0.1)),
            "resonance_hz": float(rng.uniform(3, 8)), "damping_ratio": float(rng.uniform(0.01, 0.06)),
            "delay_s": float(rng.uniform(1e-3, 1e-2)), "backlash": float(rng.uniform(0.01, 0.05)),
        }  # fmt: skip
        stiff = float(np.exp(rng.uniform(*np.log([10, 150]))))
        known = {"position_gain": 1.0, "force_per_unit": stiff, "derivative_gain": float(rng.uniform(0.01, 0.05))}
        side, extra, turn = ("motor", "link")[rng.integers(2)], {}, 2 * np.pi * joint["resonance_hz"]
        if hidden == "spring":
            extra["joint_compliance"] = 1 / (joint["link"] * turn**2)
            extra["joint_damping"] = 2 * joint["damping_ratio"] * joint["link"] * turn
        if hidden == "backlash":
            extra["backlash"] = joint["backlash"]
        if hidden in ("spring", "delay"):
            extra[late] = joint["delay_s"]
        if is_stable(joint, known, side, extra):
            plain, true = (ServoLaw.of(("j1",), encoder=side, **(known | more)) for more in ({}, extra))
            return joint, true, plain


def is_stable(joint: dict[str, float], known: dict[str, float], side: str, extra: dict[str, float]) -> bool:
    """Tell whether the linear loop is damped by 2 % at least; a delay of the torque by its Pade approximation."""
    B, link, kp = joint["armature"], joint["link"], known["force_per_unit"]
    c = extra.get("joint_compliance", 0.0)
    late = extra.get("torque_delay", 0.0)
    s = np.polynomial.Polynomial([0, 1])
    push = kp * (1 + known["derivative_gain"] * s)
    if c:
        K, D = 1 / c, extra["joint_damping"]
        own, through = link * s**2 + D * s + K, D * s + K
        free = (B * s**2 + joint["viscous"] * s) * own + link * s**2 * through
        back = push * (own if side == "motor" else through)
    else:
        free, back = (B + link) * s**2 + joint["viscous"] * s, push
    roots = (free * (1 + late / 2 * s) + back * (1 - late / 2 * s)).roots()
    w = 2j * np.pi * np.linspace(*BAND_HZ, 400)
    shown = (push * (own if side == "motor" else through) if c else push)(w) / push(w) * kp * np.exp(-late * w)
    peak = np.abs(shown / (free(w) + back(w) * np.exp(-late * w))).max()
    return bool(np.all(roots.real < -0.02 * np.abs(roots)) and peak < MAX_PEAK)


def judge_set(seed: int, hidden: str) -> dict[str, object]:
    """Return what was hidden in a set, what was found, and how far off it is."""
    rng = np.random.default_rng([seed, HIDDEN.index(hidden)])
    late = ("command_delay", "torque_delay")[seed % 2]
    joint, true, known = draw_joint(rng, hidden, late)
    robot = build_link(joint["link"])
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    model = model.with_values({f"j1.{kind}": joint[kind] for kind in ("armature", "coulomb", "viscous")})
    t = np.arange(0, SECONDS, 1 / RATE_HZ)
    q = AMPLITUDE * np.sin(2 * np.pi * (BAND_HZ[0] * t + (BAND_HZ[1] - BAND_HZ[0]) * t**2 / (2 * SECONDS)))
    v = np.gradient(q, t)
    motion = Trajectory(robot.actuated, t, q[:, None], v[:, None], np.gradient(v, t)[:, None])
    log = simulate_loop_log(
        model, true, motion, rate_hz=RATE_HZ, encoder_noise=NOISE, encoder_resolution=RESOLUTION, seed=seed
    )
    begin = time.perf_counter()
    found = diagnose_loop(robot, log, law=known)
    told = {f.cause: f for f in found.findings if f.status == "confirmed"}
    wanted = {NAMES[hidden]} if hidden in NAMES else set()
    wanted |= (
        {{"command_delay": "command_delay", "torque_delay": "delay"}[late]} if hidden in ("spring", "delay") else set()
    )
    law = dict(found.extended_model.controller)
    twins = {name for f in told.values() for name in f.indistinguishable_from}
    row: dict[str, object] = {
        "set": seed, "hidden": hidden, "encoder": true.encoder, "told": " ".join(told), "unexplained": len(found.unexplained),
        "named": all(w in told or w in twins for w in wanted), "false": bool(set(told) - wanted),
        "baseline_mrad": 1e3 * found.baseline[0], "extended_mrad": 1e3 * found.extended[0],
        "floor_mrad": 1e3 * found.noise_floor[0],
    }  # fmt: skip
    if hidden == "spring":
        compliance = float(law.get("joint_compliance", 0.0))
        link = joint["link"]  # the file's
        estimate = np.sqrt(1 / (compliance * link)) / (2 * np.pi) if compliance else np.nan
        row |= {"resonance_hz": joint["resonance_hz"], "resonance_error": estimate / joint["resonance_hz"] - 1}
    if hidden in ("spring", "delay"):
        errors = {key: float(law.get(key, 0.0)) - (joint["delay_s"] if key == late else 0.0) for key in
                  ("command_delay", "torque_delay")}  # fmt: skip
        row |= {"late": late, "delay_error_s": max(errors.values(), key=abs)}
    return row | {"seconds": time.perf_counter() - begin}


def tabulate_springs(sets: Iterable[int], hidden: tuple[str, ...] = HIDDEN) -> pd.DataFrame:
    """Return one row a set and kind; prints as it goes."""
    rows = []
    for seed in sets:
        for kind in hidden:
            if kind != "spring" and seed % 4:  # a quarter as many
                continue
            rows.append(judge_set(seed, kind))
            print({k: round(x, 5) if isinstance(x, float) else x for k, x in rows[-1].items()}, flush=True)
    return pd.DataFrame(rows)


def summarise_springs(table: pd.DataFrame) -> str:
    """Return the figures."""
    lines = []
    for kind, rows in table.groupby("hidden"):
        line = f"{kind}: named {rows['named'].sum()} of {len(rows)}, false claims in {rows['false'].sum()}"
        if kind == "spring":
            near, early = rows["resonance_error"].abs() < WITHIN_HZ, rows["delay_error_s"].abs() < WITHIN_S
            line += f", resonance within 2 % in {near.sum()}, delay within 0.5 ms in {early.sum()}"
            line += f", all three in {(rows['named'] & near & early).sum()}"
        lines.append(line)
    return "\n".join(lines)


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--hidden", nargs="+", default=list(HIDDEN), choices=HIDDEN)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    table = tabulate_springs(range(options.sets), tuple(options.hidden))
    print(summarise_springs(table))
    if options.out:
        table.to_csv(options.out, index=False)


if __name__ == "__main__":
    main()
