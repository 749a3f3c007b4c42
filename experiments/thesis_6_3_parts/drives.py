"""(6.11) and Figure 6.9: first-order models with delay of the controlled carts, from steps of 1, 1.5 and 2 mm."""

from dataclasses import dataclass

import numpy as np

from tau_dyn.log import Log
from tau_dyn.mechanism import L1_DRIVES
from tau_dyn.modes import Record
from tau_dyn.modes.actuators import ActuatorFit, fit_actuators
from tau_dyn.simulate import VibrationSensors, simulate_vibration_log
from thesis_6_3_parts.printed import STEPS
from thesis_6_3_parts.robots import CARTS, fit_percent, with_wrist

DT = 0.004  # s
HALF = 500  # samples between a step and the step back


@dataclass(frozen=True, eq=False)
class DriveStudy:
    """Fits of the three carts, and the log they were not fitted on."""

    fits: tuple[ActuatorFit, ...]
    held_out: Log
    modelled: np.ndarray  # (N, 3) m
    fit_percent: np.ndarray  # (3,)


def steps(amplitude: float, seed: int) -> Log:
    """All carts step together, so that the tool moves along x; and back."""
    reference = np.zeros((2 * HALF + 100, 3))
    reference[100 : 100 + HALF] = amplitude
    still = np.zeros_like(reference)
    sensors = VibrationSensors.length_gauges()
    return simulate_vibration_log(with_wrist(), reference, still, DT, drives=L1_DRIVES, sensors=sensors, seed=seed)


def study(seed: int) -> DriveStudy:
    """Fit on the first steps of all three logs; the way back of the 1.5 mm log is held out."""
    logs = [steps(amplitude, seed + k) for k, amplitude in enumerate(STEPS)]
    cut = 100 + HALF
    both = [(log.joint("q_ref", CARTS), log.joint("q", CARTS)) for log in logs]
    names = tuple(f"q_ref_{j}" for j in CARTS), tuple(f"q_{j}" for j in CARTS)
    fits = fit_actuators([Record(r[:cut], q[:cut], DT, *names) for r, q in both])
    reference, measured = (x[cut - 50 :] - with_wrist().q for x in both[1])
    modelled = np.column_stack([f.actuator.simulate(reference[:, k], DT) for k, f in enumerate(fits)])
    return DriveStudy(fits, logs[1].window(cut - 50, 2 * HALF + 100), modelled, fit_percent(measured, modelled))
