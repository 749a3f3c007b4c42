"""What leaves the tool in other programs: forces, half a second of free motion, replay of a held-out log, and what is lost.

    python experiments/exports.py [--robots l1 ur5 ...] [--seed 0] [--out docs/results/data/exports.csv]

In: nothing. Eight robots of the zoo, UR5 and Panda, with friction that differs by direction, Stribeck friction, friction of the
place and of the load, drag, a ripple, a drive's gain and late forces (`exports_parts/robots.py`). Out: a row a robot and target.

    forces   largest difference of rigid forces over random states, relative to the largest force
    motion   largest difference after half a second from home, relative to the longest stroke, from our own simulation of what the
             target holds; drives hold the weight, friction stops some joints, MuJoCo's speeds are half a step early as ours
    replay   force error of a simulated log that MuJoCo under the log's controller repeats, and ours of what the target holds [%]
    error    held-out force error of the whole model, and of what the target holds [%]: the price of what is lost

Drake knows no dry friction, so it is left out of its motion on both sides. Drives alone (BAM, mjlab, Isaac Lab) have a price.
"""

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from exports_parts.in_drake import compute_drake_forces, move_in_drake
from exports_parts.in_mujoco import MujocoPlant, compute_mujoco_forces, open_in_mujoco
from exports_parts.robots import ROBOTS, build_model, find_speed
from fmpy import simulate_fmu

from tau_dyn.exceptions import InputError
from tau_dyn.exchange import (
    Exported,
    build_drive_files,
    build_fmu,
    build_mjcf,
    build_sdf,
    build_urdf,
    compute_held_out_errors,
)
from tau_dyn.files import write_whole
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.simulate import (
    CascadeController,
    CascadeLaw,
    Sensors,
    build_named_motion,
    free_motion,
    replay,
    simulate,
)

SECONDS, DT = 0.5, 5e-4  # of free motion, s
LOG_SECONDS = 4.0
REPLAYED_SECONDS = 1.0  # a log's part that is repeated in closed loop
SUBSTEPS = 2  # of a millisecond, so that one is a step of the file's
STATES = 20
NOISE = Sensors(encoder_resolution=1e-6, force_noise_relative=0.01)


class Case:
    """One robot, with what all its targets are compared with."""

    def __init__(self, name: str, seed: int) -> None:
        """Build the model, random states, a push and a held-out log."""
        self.name, self.model = name, build_model(name)
        robot, rng = self.model.robot, np.random.default_rng(seed)
        room = np.where(
            np.isfinite(robot.upper - robot.lower), np.minimum(robot.upper - robot.home, robot.home - robot.lower), 1
        )
        spread = np.minimum(0.2 * room, 0.5 * find_speed(robot))
        self.q = robot.home + spread * rng.uniform(-1, 1, (STATES, robot.na))
        self.v, self.a = rng.standard_normal((2, STATES, robot.na))
        self.v0 = np.clip(find_speed(robot) * rng.standard_normal(robot.na), -room, room)
        self.law = CascadeLaw.for_model(self.model)
        motion = build_named_motion("exciting", self.model, LOG_SECONDS, seed)
        start = self.model.steady()
        self.log = simulate(self.model, motion, CascadeController(self.law, start=start), NOISE, seed=seed)

    def compare_forces(self, found: np.ndarray, expected: np.ndarray) -> float:
        """Return the largest difference, relative to the largest force."""
        return float(np.abs(found - expected).max() / np.abs(expected).max())

    def compare_motion(self, held: Model, end: np.ndarray) -> float:
        """Return how far an end (na,) is from ours of what a target holds, in shares of the longest stroke."""
        ours = free_motion(held, self.model.robot.home, self.v0, SECONDS, DT, find_weight(held)).q
        return float(np.abs(end - ours[-1]).max() / np.ptp(ours, axis=0).max())

    def price(self, held: Model) -> dict[str, float]:
        """Return the held-out force errors [%] of the whole model and of what a target holds."""
        whole, rest = compute_held_out_errors([self.model, held], [self.log])
        return {"error_whole": whole, "error": rest}

    @property
    def replayed(self) -> Log:
        """The part of the log that is repeated in closed loop."""
        rate = (self.log.n_samples - 1) / self.log.duration
        return self.log.window(round(rate), round((1 + REPLAYED_SECONDS) * rate))


def find_weight(held: Model) -> np.ndarray:
    """Return the forces (na,) that hold a robot at home."""
    return held.mechanism.mass_and_bias(held.robot.home, np.zeros(held.robot.na))[1]


def list_lost(made: Exported) -> str:
    """Return the effects that a target lacks, by name."""
    found = [s.split()[1] for s in made.left_out if s.startswith("effect ")]
    found += ["differences by direction"] if any("two directions" in s for s in made.left_out) else []
    found += ["mass that only gravity feels"] if any("only gravity" in s for s in made.left_out) else []
    found += ["drive inertia"] if any("drive inertia of" in s and "Gazebo" in s for s in made.left_out) else []
    return ", ".join(found)


def run_mujoco(case: Case) -> Iterator[dict[str, Any]]:
    """Yield a row of the file with its callback, and one of the file alone."""
    made, robot = build_mjcf(case.model), case.model.robot
    forces = compute_mujoco_forces(case.model, case.q, case.v, case.a)
    expected = case.model.mechanism.inverse_dynamics(case.q, case.v, case.a)
    for callback in (True, False):
        held = made.told if callback and made.told else made.carried
        with open_in_mujoco(made, callback=callback) as theirs:
            weight = find_weight(held)
            plant = MujocoPlant(theirs, held, robot.home, case.v0, DT)
            for _ in range(round(SECONDS / DT)):
                plant.step(weight)
            end = plant.q
        with open_in_mujoco(made, callback=callback) as theirs:
            again = replay(held, case.replayed, case.law, substeps=SUBSTEPS, start_plant=partial(MujocoPlant, theirs))
        yield {
            "target": "mjcf and callback" if callback else "mjcf alone",
            "forces": case.compare_forces(forces, expected),
            "motion": case.compare_motion(held, end),
            "replay_ours": measure_replay(replay(held, case.replayed, case.law, substeps=SUBSTEPS)),
            "replay": measure_replay(again),
            **case.price(held),
            "lost": list_lost(made) if callback else ", ".join([*_name_told(made), *filter(None, [list_lost(made)])]),
        }


def _name_told(made: Exported) -> list[str]:
    return [f"{s.split()[1]}" + (" beyond its mean" if "beyond" in s else "") for s in made.by_callback]


def measure_replay(found: Any) -> float:
    """Return the force error over all joints [%]."""
    residual, measured = found.residual("force"), found.measured["force"]
    return float(100 * np.linalg.norm(residual) / np.linalg.norm(measured))


def run_drake(case: Case) -> dict[str, Any]:
    """Return the row of the SDF, as Drake reads it, drive inertia included."""
    made = build_sdf(case.model)
    names, robot = case.model.effect_parameters.names, case.model.robot
    kept = {n: 0.0 for n in names if n.rsplit(".", 1)[-1].startswith("coulomb")}
    kept |= {f"{j}.armature": case.model.parameters[f"{j}.armature"].value for j in robot.actuated}
    smooth, still = made.carried.with_values(kept).steady(), np.zeros_like(case.q)
    forces = compute_drake_forces(smooth, made.text, case.q, case.v, case.a)
    end = move_in_drake(smooth, made.text, case.v0, find_weight(smooth), SECONDS)
    return {
        "target": "sdf",
        "forces": case.compare_forces(forces, smooth.torque(case.q, case.v, case.a, still)),
        "motion": case.compare_motion(smooth, end),
        **case.price(made.carried),
        "lost": list_lost(made),
    }


def run_urdf(case: Case) -> dict[str, Any]:
    """Return the row of the URDF, read back."""
    made = build_urdf(case.model)
    again = Model.of(load_robot_from_urdf(made.text, "again"))
    found = again.mechanism.inverse_dynamics(case.q, case.v, case.a)
    expected = case.model.mechanism.inverse_dynamics(case.q, case.v, case.a)
    row = {"target": "urdf", "forces": case.compare_forces(found, expected)}
    return {**row, **case.price(made.carried), "lost": list_lost(made)}


def run_fmu(case: Case) -> dict[str, Any]:
    """Return the row of the FMU; what it refuses is left out before."""
    robot, model, refused = case.model.robot, case.model, []
    try:
        made = build_fmu(model)
    except InputError:
        refused = ["load_friction"]
        model = model.only(e for e in model.effects if e.name not in refused)
        made = build_fmu(model)
    start = {f"tau_{j}": x for j, x in zip(robot.actuated, find_weight(model), strict=True)}
    start |= {f"q0_{j}": x for j, x in zip(robot.actuated, robot.home, strict=True)}
    start |= {f"v0_{j}": x for j, x in zip(robot.actuated, case.v0, strict=True)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.fmu"
        path.write_bytes(made.content)
        found: Any = simulate_fmu(str(path), stop_time=SECONDS, output_interval=DT, start_values={**start, "step": DT})
    end = np.array([found[f"q_{j}"][-1] for j in robot.actuated])
    lost = [*refused, *(s.split()[1] for s in made.left_out if s.startswith("effect "))]
    held = case.model.with_values({n: 0.0 for e in case.model.effects if e.name in lost for n in e.parameters.names})
    row = {"target": "fmu", "motion": case.compare_motion(held, end), "forces": made.difference}
    return {**row, **case.price(held), "lost": ", ".join(lost)}


def run_drives(case: Case) -> Iterator[dict[str, Any]]:
    """Yield the rows of drives alone."""
    for target in ("bam", "mjlab", "isaaclab"):
        try:
            made = next(iter(build_drive_files(case.model, target).values()))
        except InputError:
            continue
        yield {"target": target, **case.price(made.carried), "lost": list_lost(made)}


def run_robot(name: str, seed: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of one robot."""
    case = Case(name, seed)
    yield from run_mujoco(case)
    yield run_drake(case)
    yield run_urdf(case)
    yield run_fmu(case)
    yield from run_drives(case)


COLUMNS = ("robot", "target", "forces", "motion", "replay_ours", "replay", "error_whole", "error", "lost")


def main(robots: list[str], seed: int, out: Path | None) -> None:
    rows: list[dict[str, Any]] = []
    for name in robots:
        for row in run_robot(name, seed):
            rows.append({"robot": name, **row})
            print({k: f"{x:.3g}" if isinstance(x, float) else x for k, x in rows[-1].items()}, flush=True)
        if out is not None:
            write_whole(out, pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(index=False, float_format="%.3g"))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    main(args.robots, args.seed, args.out)
