"""(6.12), (6.13) and Figure 6.10: models from the tool's reference, and from the tool computed from the carts, to the tool.

The thesis adds a binary sequence to each cart's reference and uses x and y only. Then the tool's motion along z, which the carts
cause too, is an input that the models do not know. So there are two experiments: `carts`, as the thesis describes it, and
`plane`, where the tool's reference moves in the horizontal plane, as it does in the learning experiments.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tau_dyn.log import Log
from tau_dyn.mechanism import L1_DRIVES
from tau_dyn.modes import Mode, ModelFile, StateSpace, compress_subspace_data, refine, save_state_space
from tau_dyn.modes.state_space import simulate
from tau_dyn.simulate import VibrationSensors, simulate_binary_log, simulate_vibration_log
from thesis_6_3_parts.printed import DRIVE_SAMPLES, ORDER_KINEMATICS, ORDER_REFERENCE
from thesis_6_3_parts.robots import CARTS, fit_percent, kinematics, record, with_tool_side, with_wrist

OUTPUTS = ["x_tool", "y_tool"]
TRAIN_S, TEST_S, AMPLITUDE = 120.0, 40.0, 1e-3  # s, s, m


@dataclass(frozen=True, eq=False)
class BlackBox:
    """One identified model and how it simulates a log it was not fitted on."""

    name: str
    experiment: str
    inputs: tuple[str, ...]
    model: StateSpace
    modes: tuple[Mode, ...]
    fit: np.ndarray  # (2,) percent


def experiment(kind: str, duration: float, seed: int) -> Log:
    sensors = VibrationSensors.length_gauges()
    near = with_wrist()
    if kind == "carts":
        log = simulate_binary_log(
            near, duration=duration, amplitude=AMPLITUDE, drives=L1_DRIVES, sensors=sensors, seed=seed, name=kind
        )
    else:
        two = simulate_binary_log(near, duration=duration, amplitude=AMPLITUDE, joints=CARTS[:2], seed=seed)
        tool = two.joint("q_ref", CARTS) - near.q  # two sequences, now of x and y
        reference = tool @ np.linalg.inv(kinematics().tool_jacobian(near.q[None])[0]).T
        still = np.zeros_like(reference)
        log = simulate_vibration_log(
            near, reference, still, two.dt, drives=L1_DRIVES, sensors=sensors, seed=seed, name=kind
        )
    return with_tool_side(log)


def identify(train: Log, test: Log, side: str, order: int, axes: str = "xy") -> BlackBox:
    """Subspace method, then output-error refinement; the fit is that of a free simulation of the test log."""
    inputs = [f"{axis}_{side}" for axis in axes]
    delay = DRIVE_SAMPLES - 1 if side == "r" else 0  # sampling itself adds the fifth
    data, held = record(train, inputs, OUTPUTS), record(test, inputs, OUTPUTS)
    refined = refine(compress_subspace_data([data], delay=delay).model(order), [data])
    fit = fit_percent(held.y, simulate(refined.model, held))
    name = {"r": "(6.12)", "c": "(6.13)"}[side] + (" with z" if "z" in axes else "")
    return BlackBox(name, train.name, tuple(inputs), refined.model, refined.modes, fit)


def study(seed: int) -> list[BlackBox]:
    found = []
    for kind in ("plane", "carts"):
        train, test = experiment(kind, TRAIN_S, seed), experiment(kind, TEST_S, seed + 100)
        found += [
            identify(train, test, "r", ORDER_REFERENCE),
            identify(train, test, "c", ORDER_KINEMATICS),
        ]
    return [*found, identify(train, test, "r", 10, "xyz"), identify(train, test, "c", ORDER_KINEMATICS, "xyz")]


def keep(models: list[BlackBox], folder: Path, seed: int) -> None:
    """Write the two models of the plane experiment, for the observers."""
    names = {"(6.12)": "l1_reference_to_tool", "(6.13)": "l1_kinematics_to_tool"}
    folder.mkdir(parents=True, exist_ok=True)
    for found in models:
        if found.experiment == "plane":
            provenance = {
                "robot": "gantry_tau arms=complete flexible=true wrist=serial2, simulated, at home",
                "model": f"thesis {found.name}, order {found.model.order}",
                "made_by": f"experiments/thesis_6_3.py --seed {seed}",
                "inputs": {"r": "tool position reference", "c": "tool position computed from the carts"}[
                    found.inputs[0][-1]
                ],
                "outputs": "tool position at the wrist's block; all are deviations [m] from the operating point",
                "fit_percent": [round(float(x), 2) for x in found.fit],
            }
            content = ModelFile(found.model, found.inputs, tuple(OUTPUTS), provenance)
            save_state_space(folder / f"{names[found.name]}.yaml", content)


def true_response(side: str, frequency: np.ndarray) -> np.ndarray:
    """Return the flexible model's own response (F, 2, 2) from x, y of the tool's reference or computed tool."""
    near = with_wrist()
    inverse = np.linalg.inv(kinematics().tool_jacobian(near.q[None])[0])[:, :2]
    model = near.state_space(L1_DRIVES if side == "r" else None)
    prefix = "q_ref" if side == "r" else "q"
    carts = model.select([f"{prefix}_{j}" for j in CARTS], OUTPUTS)
    return carts.frequency_response(frequency) @ inverse


def held(frequency: np.ndarray, dt: float = 0.004) -> np.ndarray:
    """Return the response of a zero-order hold (F,), which a sampled model's response contains."""
    s = 2j * np.pi * frequency
    return (1 - np.exp(-s * dt)) / (s * dt)
