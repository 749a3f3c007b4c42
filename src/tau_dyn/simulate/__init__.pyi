"""A model, a motion, a controller and sensors become a `Log`."""

from .compiled_plant import (
    CompiledPlant as CompiledPlant,
    PlantMotion as PlantMotion,
    compare_equations as compare_equations,
)
from .controllers import (
    CascadeController as CascadeController,
    CascadeLaw as CascadeLaw,
    Controller as Controller,
    Servo as Servo,
    read_law_file as read_law_file,
)
from .forces import SampledForces as SampledForces
from .limits import (
    compute_condition_bound as compute_condition_bound,
    describe_exceeded_limit as describe_exceeded_limit,
)
from .log_replay import Replay as Replay, StartPlant as StartPlant, SteppedPlant as SteppedPlant, replay as replay
from .motions import (
    ACCELERATION as ACCELERATION,
    MOTIONS as MOTIONS,
    RATE_HZ as RATE_HZ,
    build_exciting_motion as build_exciting_motion,
    build_fourier_motion as build_fourier_motion,
    build_multisine_on_stroke as build_multisine_on_stroke,
    build_named_motion as build_named_motion,
    build_random_binary_motion as build_random_binary_motion,
    build_slow_motion as build_slow_motion,
    build_stroke_motion as build_stroke_motion,
    compute_base_condition as compute_base_condition,
    compute_reach as compute_reach,
    compute_top_speed as compute_top_speed,
)
from .plant import free_motion as free_motion, run_plant as run_plant
from .plant_run import PlantRun as PlantRun
from .sensors import EncoderReadings as EncoderReadings, Sensors as Sensors, measure as measure
from .servo_law import (
    COMMANDS as COMMANDS,
    SERVO_ENTRIES as SERVO_ENTRIES,
    ServoLaw as ServoLaw,
    build_servo_law as build_servo_law,
    is_servo_law as is_servo_law,
    read_servo_law as read_servo_law,
)
from .simulation import read_effects_file as read_effects_file, simulate as simulate, simulate_drive as simulate_drive
from .trajectory import (
    MotionProfile as MotionProfile,
    Trajectory as Trajectory,
    concatenate as concatenate,
    move as move,
)
from .vibration_logs import (
    VibrationSensors as VibrationSensors,
    push_log as push_log,
    simulate_binary_log as simulate_binary_log,
    simulate_vibration_log as simulate_vibration_log,
)
