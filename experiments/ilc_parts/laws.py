"""The laws of cases 1, 2A, 2B and 3, and a norm-optimal one: L = 0.9 q^5 for all, as the thesis has it."""

from dataclasses import replace

from ilc_parts.bench import AXES, DT, Models, printed_actuators
from ilc_parts.learning_plant import LearningPlant, Trial

from tau_dyn.control.iterative import (
    LearningLaw,
    MotorSide,
    NormOptimalLaw,
    TimeShift,
    ToolSide,
    UpdateLaw,
    design_low_pass,
    design_robust_filter,
    stack_controlled_actuators,
)
from tau_dyn.control.observers import ComplementaryToolObserver, tune_kalman

LEARNING = TimeShift(0.9, 5, DT)
MOTOR_CUTOFF, TOOL_CUTOFF = 10.0, 30.0  # Hz
GROWTH, TOLERANCE = 0.8, 0.01
COMPLEMENTARY = (4.50, 2.63)  # Hz, (7.18)


def motor_law() -> LearningLaw:
    """Case 1, on the printed (6.11)."""
    side = MotorSide(stack_controlled_actuators(printed_actuators(), DT))
    return LearningLaw(side, (design_low_pass(MOTOR_CUTOFF, DT),) * 3, LEARNING)


def tool_law(side: ToolSide) -> LearningLaw:
    Q = design_robust_filter(side, LEARNING, TOOL_CUTOFF, growth=GROWTH, tolerance=TOLERANCE)
    return LearningLaw(side, (Q,) * len(AXES), LEARNING)


def laws(robot: LearningPlant, found: Models, trial: Trial) -> dict[str, UpdateLaw]:
    """All laws; the Kalman filter is tuned on one trial without a correction."""
    kalman = tune_kalman(found.computed_to_tool, trial.kinematic[:, AXES], trial.acceleration[:, AXES]).observer
    measured = ToolSide(found.reference_to_tool, robot.actuators)
    seen = replace(measured, kinematic_model=found.reference_to_computed, observer=kalman)
    complementary = replace(seen, observer=ComplementaryToolObserver(COMPLEMENTARY, DT))
    return {
        "1": motor_law(),
        "2A": tool_law(complementary),
        "2B": tool_law(seen),
        "3": tool_law(measured),
        "3, norm-optimal": NormOptimalLaw(measured, effort=3e-2, change=0.1),
    }
