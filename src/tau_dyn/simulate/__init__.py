"""A model, a motion, a controller and sensors become a `Log`."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.simulate.contact import ContactRun, ContactSensors, run_contact
from tau_dyn.simulate.contact_arm import ServoArm
from tau_dyn.simulate.contact_hand import Hand
from tau_dyn.simulate.contact_work import CompliantSurface, Hole
from tau_dyn.simulate.controllers import CascadeController, CascadeLaw, Controller
from tau_dyn.simulate.effects_file import read_effects_file
from tau_dyn.simulate.flexible import VibrationSensors, push_log, simulate_binary_log, simulate_vibration_log
from tau_dyn.simulate.fourier import build_exciting_motion, build_fourier_motion, compute_base_condition
from tau_dyn.simulate.law_file import read_law_file
from tau_dyn.simulate.learning_plant import LearningPlant, Trial, Unrepeatable
from tau_dyn.simulate.limits import compute_condition_bound, describe_exceeded_limit
from tau_dyn.simulate.motions import (
    MOTIONS,
    build_multisine_on_stroke,
    build_named_motion,
    build_random_binary_motion,
    build_slow_motion,
    build_stroke_motion,
)
from tau_dyn.simulate.plant import PlantRun, free_motion, run_plant
from tau_dyn.simulate.replay import replay
from tau_dyn.simulate.replay_result import Replay
from tau_dyn.simulate.sensors import Sensors, measure
from tau_dyn.simulate.simulate import simulate, simulate_drive
from tau_dyn.simulate.square_path import square_path
from tau_dyn.simulate.trajectory import Trajectory, concatenate, move

__all__ = [
    "MOTIONS",
    "CascadeController",
    "CascadeLaw",
    "CompliantSurface",
    "ContactRun",
    "ContactSensors",
    "Controller",
    "Hand",
    "Hole",
    "LearningPlant",
    "PlantRun",
    "Replay",
    "Sensors",
    "ServoArm",
    "Trajectory",
    "Trial",
    "Unrepeatable",
    "VibrationSensors",
    "build_exciting_motion",
    "build_fourier_motion",
    "build_multisine_on_stroke",
    "build_named_motion",
    "build_random_binary_motion",
    "build_slow_motion",
    "build_stroke_motion",
    "compute_base_condition",
    "compute_condition_bound",
    "concatenate",
    "describe_exceeded_limit",
    "free_motion",
    "measure",
    "move",
    "push_log",
    "read_effects_file",
    "read_law_file",
    "replay",
    "run_contact",
    "run_plant",
    "simulate",
    "simulate_binary_log",
    "simulate_drive",
    "simulate_vibration_log",
    "square_path",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
