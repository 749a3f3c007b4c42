"""How much faster is a simulation as compiled code, and does it move the same?

    python experiments/benchmarks/compiled_plant.py [--seconds 20] [--robots emps l1 complete ur5] [--causes]

In: nothing; UR5 from `example-robot-data`. Out: for each robot, rigid and with friction, CPU seconds a simulated second
in Python, as compiled code with an empty cache (the compiler's time counted) and with a full one, and the largest difference of
positions relative to their range. `--causes`: each cause that acts on the robot or its encoders, for 1.3 s.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable

import numpy as np

from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.simulate import (
    PlantRun,
    Sensors,
    Trajectory,
    build_fourier_motion,
    compiled_plant,
    concatenate,
    move,
    simulate_drive,
)

ROBOTS: dict[str, Callable[[], Robot]] = {
    "emps": lambda: load_robot("linear_axis"),
    "l1": lambda: load_robot("gantry_tau"),
    "complete": lambda: load_robot("gantry_tau", arms="complete"),
    "ur5": lambda: load_robot("ur5"),
}
SHARE = 0.02  # Coulomb and viscous friction of each drive's largest force, 5 N where it has none
SETTINGS = {"stribeck": {"speed": 0.1}, "thermal_drift": {"lag": 0.5}}


def build_model(robot: Robot, *causes: str) -> Model:
    """Return a robot with asymmetric friction, and causes of small amplitudes."""
    effects = list(build_friction_model("asymmetric", robot.actuated, robot.force_units))
    for cause in causes:
        joints = robot.actuated[:2] if cause == "reducer_coupling" else robot.actuated
        units = [robot.force_units[robot.actuated.index(joint)] for joint in joints]
        effects.append(EFFECTS[cause](joints, units, label=f"_{cause}", **SETTINGS.get(cause, {})))
    model = Model.of(robot, effects)
    most = dict(zip(robot.actuated, np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 250.0), strict=True))
    values = {}
    for p in model.effect_parameters:
        force = p.unit.startswith("N")
        values[p.name] = (
            SHARE * most.get(p.name.split(".")[0], 10.0) if force else 1e-5 if p.unit in ("m", "rad") else 0.02
        )
    return model.with_values(values)


def measure_cpu(run: Callable[[], PlantRun], compile_it: bool) -> tuple[float, PlantRun]:
    """Return CPU seconds of a run, its compiler's included, and the run."""
    os.environ["TAU_DYN_COMPILE"] = "1" if compile_it else "0"
    before = os.times()
    found = run()
    after = os.times()
    return sum(after[:4]) - sum(before[:4]), found


def compare(name: str, model: Model, motion: Trajectory) -> None:
    """Print a row."""

    def run() -> PlantRun:
        return simulate_drive(model, motion, None, Sensors(encoder_noise=1e-6), np.random.default_rng(0))

    run_long = motion.duration
    plain, expected = measure_cpu(run, False)
    cold, _ = measure_cpu(run, True)
    warm, found = measure_cpu(run, True)
    off = np.abs(found.q - expected.q).max() / np.ptp(expected.q)
    print(f"{name:32s} {plain / run_long:8.4f} {cold / run_long:8.4f} {warm / run_long:8.4f} {plain / warm:6.0f} {off:9.1e}",
          flush=True)  # fmt: skip


def main(robots: list[str], seconds: float, causes: bool) -> None:
    print(time.strftime("%H:%M:%S"), "CPU s a simulated second: Python, built, kept; Python over kept; difference")
    for key in robots:
        robot = ROBOTS[key]()
        if not causes:
            compare(f"{key}, rigid", Model.of(robot), build_fourier_motion(Model.of(robot), seconds))
            compare(f"{key}, friction", build_model(robot), build_fourier_motion(build_model(robot), seconds))
            continue
        for name in ("MIN_SAMPLES", "MIN_SAMPLES_PER_DRIVE", "MIN_SAMPLES_PER_PASSIVE_JOINT"):
            setattr(compiled_plant, name, 0)
        far = 0.02 * np.resize([1.0, -0.7, 0.4], robot.na)
        turns = [robot.home, robot.home + far, robot.home - far, robot.home]
        ways = [move(robot.actuated, a, b, 0.4) for a, b in zip(turns[:-1], turns[1:], strict=True)]
        for cause in (name for name, cls in EFFECTS.items() if cls.cause and "campaign" not in cls.needs):
            try:
                compare(f"{key}, {cause}", build_model(robot, cause), concatenate(ways, rest=0.02))
            except Exception as fault:
                print(f"{key}, {cause}: {fault}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--causes", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        main(args.robots, args.seconds, args.causes)
