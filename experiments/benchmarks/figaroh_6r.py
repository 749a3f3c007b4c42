"""A six-axis arm with 84 columns, end to end, beside FIGAROH 1.0.2: regressor, base parameters, least squares.

    python experiments/benchmarks/figaroh_6r.py [--samples 5000] [--out DIR]

Needs `figaroh` in the same environment (it is no dependency of ours). In: the TX40's URDF. Both get the same positions, speeds,
accelerations and torques in memory and give base parameters: a synthetic run with noise, and the measured TX40 log as our
filters prepare it. FIGAROH's way is its own examples': `build_regressor_basic`, small columns out, `QRDecomposer`. Estimates are
compared by the torque they predict on fresh states, as the two choose different base columns.
"""

import argparse
import os
import warnings
from pathlib import Path

import numpy as np
from bench import show, stop_watch

from tau_dyn.effects import Motion, SymmetricFriction, TorqueOffset
from tau_dyn.estimate import SufficientStatistics, find_base
from tau_dyn.identify import choose_preparation, prepare_segment
from tau_dyn.identify.regression import compute_columns
from tau_dyn.log import read_log, resample_segments
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[2] / "shared" / "data")) / "tx40"
EVERYTHING = {name: True for name in ("has_friction", "has_actuator_inertia", "has_joint_offset", "is_joint_torques")}
BLOCK = 2048


def six_axes() -> Model:
    robot = load_robot(DATA / "tx40.urdf")
    effects = [SymmetricFriction(robot.actuated, robot.force_units), TorqueOffset(robot.actuated, robot.force_units)]
    return Model.of(robot, effects)


def ours(model: Model, data: tuple[np.ndarray, ...], fresh: tuple[np.ndarray, ...]) -> tuple[np.ndarray, float, float]:
    """Return the predicted torque (N, na), and wall and processor time [s] of the identification."""
    with stop_watch() as watch:
        total = SufficientStatistics.zero(model.robot.na, len(model.parameters))
        for start in range(0, len(data[0]), BLOCK):
            q, v, a, tau = (x[start : start + BLOCK] for x in data)
            total = total + SufficientStatistics.of(
                compute_columns(model, Motion.of(model.robot.actuated, q, v, a)), tau
            )
        rows = total.R.reshape(-1, total.R.shape[2])
        base = find_base(rows[:, :-1], model.parameters.names)
        beta = np.linalg.lstsq(rows[:, base.kept], rows[:, -1], rcond=None)[0]
    Y = compute_columns(model, Motion.of(model.robot.actuated, *fresh))
    return Y[:, :, base.kept] @ beta, watch.wall, watch.cpu


def theirs(
    model: Model, data: tuple[np.ndarray, ...], fresh: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, float, float]:
    """Return the same of FIGAROH."""
    from figaroh.identification.parameter import add_standard_additional_parameters, get_standard_parameters
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import build_regressor_basic, build_regressor_reduced, get_index_eliminate

    robot, decomposer = _Bare(model.robot), QRDecomposer()
    asked = {**EVERYTHING, "act_idxv": list(range(model.robot.na))}
    standard = get_standard_parameters(robot.model, asked) | add_standard_additional_parameters(robot.model, asked)
    with stop_watch() as watch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        W = build_regressor_basic(robot, *data[:3], asked)
        tau = data[3].T.ravel()
        small, names = get_index_eliminate(W, standard, 1e-6)
        found = decomposer.double_decomposition(tau, build_regressor_reduced(W, small), names)
    new = build_regressor_reduced(build_regressor_basic(robot, *fresh, asked), small)[:, decomposer.base_indices]
    return (new @ np.asarray(found[3])).reshape(model.robot.na, -1).T, watch.wall, watch.cpu


class _Bare:
    """What FIGAROH's regressor asks of a robot."""

    def __init__(self, robot: Robot) -> None:
        self.model = robot.model
        self.data = robot.model.createData()


def synthetic(model: Model, samples: int) -> tuple[np.ndarray, ...]:
    """Return a smooth random motion of all joints and its torque with noise of 1 % of its largest."""
    rng, na = np.random.default_rng(1), model.robot.na
    t = np.linspace(0, samples / 500, samples)[:, None, None]
    f, phase, size = rng.uniform(0.1, 1.0, (5, na)), rng.uniform(0, 6, (5, na)), rng.uniform(0.1, 0.4, (5, na))
    w = 2 * np.pi * f
    angle = w * t + phase
    q = model.robot.home + (size * np.sin(angle)).sum(axis=1)
    v, a = (size * w * np.cos(angle)).sum(axis=1), -(size * w**2 * np.sin(angle)).sum(axis=1)
    values = {
        p.name: rng.uniform(1, 5) for p in model.parameters if p.name.split(".")[1] in ("coulomb", "viscous", "offset")
    }
    tau = model.with_values(values).torque(q, v, a)
    return q, v, a, tau + 0.01 * np.abs(tau).max(axis=0) * rng.standard_normal(tau.shape)


def measured(model: Model) -> tuple[np.ndarray, ...]:
    """Return the TX40 log as our filters prepare it."""
    log = read_log(DATA, HERE.parents[1] / "identification" / "columns" / "tx40.yaml")
    (piece,) = resample_segments(log)
    ready = prepare_segment(model, piece, choose_preparation(model.robot, [piece]))
    return ready.motion.q, ready.motion.v, ready.motion.a, ready.force


def main(samples: int, out_dir: Path) -> None:
    model, rows = six_axes(), []
    fresh = synthetic(model, 200)[:3]
    for name, data in (
        ("synthetic 6R", synthetic(model, samples)),
        ("TX40 log", tuple(x[::10] for x in measured(model))),
    ):
        tau, wall, cpu = ours(model, data, fresh)
        also, wall_also, cpu_also = theirs(model, data, fresh)
        n, worst = len(data[0]), float(np.abs(tau - also).max() / np.abs(also).max())
        rows.append([name, n, len(model.parameters), wall, wall_also, cpu, cpu_also, cpu_also / cpu, f"{worst:.1e}"])
        print(rows[-1], flush=True)
    header = [
        "data",
        "samples",
        "columns",
        "wall s",
        "FIGAROH's",
        "cpu s",
        "FIGAROH's",
        "faster (cpu)",
        "torques differ",
    ]
    show("A six-axis arm, end to end, beside FIGAROH", header, rows, out_dir / "benchmark_figaroh.md")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=5000)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.samples, args.out)
