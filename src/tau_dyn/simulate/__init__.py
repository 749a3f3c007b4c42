"""A model, a motion, a controller and sensors become a `Log`."""

from tau_dyn.simulate.contact import ContactRun, ContactSensors, run_contact
from tau_dyn.simulate.contact_arm import ServoArm
from tau_dyn.simulate.contact_hand import Hand
from tau_dyn.simulate.contact_work import CompliantSurface, Hole
from tau_dyn.simulate.controllers import CascadeController, CascadeLaw, Controller
from tau_dyn.simulate.effects_file import read_effects_file
from tau_dyn.simulate.flexible import VibrationSensors, binary_log, push_log, vibration_log
from tau_dyn.simulate.fourier import base_condition, exciting_motion, fourier_motion
from tau_dyn.simulate.law_file import read_law_file
from tau_dyn.simulate.learning_plant import LearningPlant, Trial, Unrepeatable
from tau_dyn.simulate.limits import broken_limit, condition_bound
from tau_dyn.simulate.motions import (
    MOTIONS,
    multisine_on_stroke,
    named_motion,
    random_binary_motion,
    slow_motion,
    stroke_motion,
)
from tau_dyn.simulate.plant import PlantRun, free_motion, run_plant
from tau_dyn.simulate.replay import replay
from tau_dyn.simulate.replay_result import Replay
from tau_dyn.simulate.sensors import Sensors, measure
from tau_dyn.simulate.simulate import drive, simulate
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
    "base_condition",
    "binary_log",
    "broken_limit",
    "concatenate",
    "condition_bound",
    "drive",
    "exciting_motion",
    "fourier_motion",
    "free_motion",
    "measure",
    "move",
    "multisine_on_stroke",
    "named_motion",
    "push_log",
    "random_binary_motion",
    "read_effects_file",
    "read_law_file",
    "replay",
    "run_contact",
    "run_plant",
    "simulate",
    "slow_motion",
    "square_path",
    "stroke_motion",
    "vibration_log",
]
