"""What a call of the exported controller code costs: kinematics, tool observers, a learning update.

In: nothing but the robots that come along and the arm of chapter 8's kind. Every piece is exported, compiled with `cc -O2`
and called in a loop of C: kinematics along a smooth motion at the controller's period, as a controller meets it (each call
starts where the last one ended), observers a sample at a time, a learning update over a whole trial. Best of `--repeats`.

Prints a table: piece, what it does, us a call (mean of a round), share of the period; for kinematics also the largest
difference from Python along the motion.

    python experiments/benchmarks/controller_code.py [--repeats 20] [--period 0.004] [--seed 0]
"""

from __future__ import annotations

import argparse
import ctypes
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from tau_dyn.codegen import (
    KinematicsProgram,
    build_kinematics,
    write_kinematics_source,
    write_learning_source,
    write_observer_source,
)
from tau_dyn.control import (
    ComplementaryToolObserver,
    KalmanToolObserver,
    LearningLaw,
    MotorSide,
    TimeShift,
    design_low_pass,
    stack_controlled_actuators,
)
from tau_dyn.mechanism import forward_kinematics, jacobian
from tau_dyn.modes import Actuator, StateSpace
from tau_dyn.robot import load_robot

N = 1000
ARM = Path(__file__).parents[1] / "lead_through_parts" / "irb140.urdf"
ROBOTS = {
    "gantry_tau, simplified": ("gantry_tau", {}),
    "gantry_tau, 1-2-3 rods": ("gantry_tau", {"arms": "complete"}),
    "gantry_tau_f1": ("gantry_tau_f1", {}),
    "stewart": ("stewart", {}),
    "gantry_tau with wrist, loops": ("gantry_tau", {"arms": "complete", "wrist": "serial2", "wrist_moves": "true"}),
    "arm of six joints (IRB 140)": (ARM, {"actuated": [f"joint{k}" for k in range(1, 7)]}),
}

TIMED = """
#define _POSIX_C_SOURCE 199309L
#include <stddef.h>
#include <time.h>
#include "@NAME@.h"
static double now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec * 1e9 + t.tv_nsec; }
double bench(int n, int rounds, double *a, double *b, double *c, double *state, int *bad)
{
    double best = 1e30;
    *bad = 0;
    (void)state;
    for (int r = 0; r < rounds; ++r) {
        @BEGIN@
        const double t = now();
        for (int k = 0; k < n; ++k) if (@CALL@) ++*bad;
        const double took = now() - t;
        if (took < best) best = took;
    }
    return best / n;
}
"""


def main(argv: list[str] | None = None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--period", type=float, default=0.004)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    if shutil.which("cc") is None:
        sys.exit("there is no C compiler (cc) here")
    print(f"{'piece':30s} {'call':>10s} {'us':>9s} {'of the period':>14s} {'difference':>11s}")
    for name, (robot, options) in ROBOTS.items():
        for call, cost, off in kinematics(load_robot(robot, **options), args):
            print(f"{name:30s} {call:>10s} {cost:9.2f} {100e-6 * cost / args.period:12.2f} % {off:11.1e}")
    for name, call, cost in filters(args):
        print(f"{name:30s} {call:>10s} {cost:9.2f} {100e-6 * cost / args.period:12.2f} %")


def kinematics(robot, args) -> list[tuple[str, float, float]]:
    """Return what each function costs [us], and how far it is from Python along the motion."""
    program = build_kinematics(robot)
    source = write_kinematics_source(program, "kin")
    q = smooth(robot, args)
    poses = forward_kinematics(robot, q).poses
    p, R = np.ascontiguousarray(poses.position), np.ascontiguousarray(poses.rotation)
    start = np.zeros(len(program.home))
    na, begins = robot.na, begin(program)
    first = "state, " if program.kind != "closed" and program.freedoms else ""
    J, turns = np.zeros((N, program.rows * na)), np.zeros((N, 9))
    place = np.zeros((N, 3))
    call = f"kin_fk({first}a + {na} * k, b + 3 * k, c + 9 * k)"
    cost = timed(source, "kin", call, begins, (q, place, turns), start, args)
    rows = [("fk", cost, float(np.abs(place - p).max()))]
    call = f"kin_jacobian({first}a + {na} * k, b + {program.rows * na} * k)"
    cost = timed(source, "kin", call, begins, (q, J, J), start, args)
    rows.append(("jacobian", cost, float(np.abs(J - jacobian(robot, q).reshape(N, -1)).max())))
    if not program.no_inverse:
        first = "state, " if program.inverse is None else ""
        out = np.zeros_like(q)
        call = f"kin_ik({first}a + 3 * k, b + 9 * k, c + {na} * k)"
        cost = timed(source, "kin", call, begins, (p, R.reshape(N, 9), out), start, args)
        rows.append(("ik", cost, float(np.abs(out - q).max())))
    return rows


def begin(program: KinematicsProgram) -> str:
    """Return C that sets the last configuration to where the motion begins."""
    if program.kind == "closed" or (not program.freedoms and program.inverse is not None):
        return ""
    if program.freedoms:
        return "kin_start(state);"
    return "; ".join(f"state[{k}] = {x!r}" for k, x in enumerate(away(program.robot).tolist())) + ";"


def away(robot) -> np.ndarray:
    """Return where the motion is about: home, but an arm bent, far from its singularities."""
    return robot.home if robot.loops or robot.na != 6 else np.array([0.0, 0.1, 0.2, 0.0, 1.2, 0.0])


def smooth(robot, args) -> np.ndarray:
    """Return positions (1000, na) along a motion about there at the controller's period."""
    t = np.arange(N)[:, None] * args.period
    phase = np.random.default_rng(args.seed).uniform(0, 6, robot.na)
    size = np.where(np.array(robot.joint_kinds) == "prismatic", 0.03, 0.08)
    return away(robot) + size * (np.sin(np.pi * t + phase) - np.sin(phase))


def filters(args) -> list[tuple[str, str, float]]:
    """Return what observers and a learning update cost [us]."""
    rng, dt = np.random.default_rng(args.seed), args.period
    rows = []
    for name, observer in (
        ("complementary, causal, 2 axes", ComplementaryToolObserver((4.5, 2.63), dt, causal=True)),
        ("Kalman, 22 states, 2 axes", KalmanToolObserver(model(dt), 1e-6 * np.eye(22), 0.01)),
    ):
        signals = rng.standard_normal((2, N, 2))
        call = "obs_step(state, a + 2 * k, b + 2 * k, c + 2 * k)"
        cost = timed(write_observer_source(observer, "obs"), "obs", call, "obs_start(state, a);", (*signals, np.zeros((N, 2))),
                     np.zeros(400), args)  # fmt: skip
        rows.append((name, "step", cost))
    side = MotorSide(stack_controlled_actuators([Actuator.from_discrete(0.2, 0.8, 2, dt)] * 3, dt))
    law = LearningLaw(side, (design_low_pass(10, dt),) * 3, TimeShift(0.9, 5, dt))
    trial = 1e-3 * rng.standard_normal((3, N, 3))
    call = f"ilc_update({N}, NULL, a, b, c)"
    cost = timed(write_learning_source(law, 1e6, "ilc"), "ilc", call, "", tuple(trial), np.zeros(1), args, calls=5)
    return [*rows, (f"learning, 3 drives, {N} samples", "update", cost)]


def model(dt: float) -> StateSpace:
    """Return a tool behind its actuators, two axes, nine resonances."""
    n = 18
    A, B, C = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((2, n))
    for k, f in enumerate(np.geomspace(8, 60, n // 2)):
        c, s = 0.98 * np.cos(2 * np.pi * f * dt), 0.98 * np.sin(2 * np.pi * f * dt)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, s], [-s, c]]
        B[2 * k, k % 2], C[k % 2, 2 * k] = 0.05, 1.0
    return StateSpace(A, B, C, np.zeros((2, 2)), np.zeros((n, 2)), dt, 0)


def timed(
    source: tuple[str, str], name: str, call: str, begins: str, arrays: tuple, state: np.ndarray, args, calls: int = N
) -> float:
    """Return us a call in a loop of C."""
    text = TIMED.replace("@NAME@", name).replace("@CALL@", call).replace("@BEGIN@", begins)
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        for file, content in ((f"{name}.c", source[0]), (f"{name}.h", source[1]), ("driver.c", text)):
            (at / file).write_text(content)
        files = [str(at / f"{name}.c"), str(at / "driver.c")]
        subprocess.run(["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", str(at / "b.so"), *files, "-lm"], check=True)
        code = ctypes.CDLL(str(at / "b.so"))
        code.bench.restype = ctypes.c_double
        bad = ctypes.c_int(0)
        pointers = [x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in (*arrays, state)]
        cost = code.bench(calls, args.repeats, *pointers, ctypes.byref(bad))
    if bad.value:
        sys.exit(f"{call}: {bad.value} calls did not end well")
    return cost / 1e3


if __name__ == "__main__":
    main()
