"""A robot as a mechanism: loops closed, poses of the tool and back, forces and regressor in actuated coordinates."""

from .ball_joints import DEFAULT_ANGLE as DEFAULT_ANGLE, BallJoints as BallJoints, find_ball_joints as find_ball_joints
from .build import build_mechanism as build_mechanism
from .cache import get_cached as get_cached
from .chain_inverse import RootChain as RootChain, build_chains as build_chains
from .chains import Carried as Carried, ChainJoint as ChainJoint, list_path as list_path
from .commanded import CommandedCoordinates as CommandedCoordinates
from .drive import L1_DRIVES as L1_DRIVES, PositionDrives as PositionDrives
from .flexible import FlexibleModel as FlexibleModel
from .gantry_tau import GantryTauMechanism as GantryTauMechanism
from .joint_limits import SLACK as SLACK, unwind_turns as unwind_turns
from .kinematics import Kinematics as Kinematics, Singularity as Singularity
from .kinematics_result import (
    JOINT_LIMIT as JOINT_LIMIT,
    NOT_A_NUMBER as NOT_A_NUMBER,
    OK as OK,
    OUT_OF_REACH as OUT_OF_REACH,
    REASONS as REASONS,
    ForwardResult as ForwardResult,
    InverseResult as InverseResult,
    InverseSolutions as InverseSolutions,
)
from .linear_system import ContinuousModel as ContinuousModel, SampledModel as SampledModel, Stepper as Stepper
from .linearised import Linearised as Linearised, NaturalMode as NaturalMode
from .loop_arrays import LoopArrays as LoopArrays
from .loops import LoopSolver as LoopSolver, TreeState as TreeState
from .mechanism import SINGULAR as SINGULAR, Mechanism as Mechanism
from .plate_on_legs import PlateOnLegs as PlateOnLegs, Rods as Rods, build_rods as build_rods
from .poses import (
    Poses as Poses,
    convert_from_quaternions as convert_from_quaternions,
    convert_to_quaternions as convert_to_quaternions,
    require_poses as require_poses,
)
from .positions import require_positions as require_positions
from .pseudo_inverse import measure_column_lengths as measure_column_lengths
from .recognise import NotRods as NotRods
from .robot_kinematics import (
    build_kinematics as build_kinematics,
    compute_acceleration_bias as compute_acceleration_bias,
    compute_inverse_jacobian as compute_inverse_jacobian,
    find_all_solutions as find_all_solutions,
    find_nearest_configuration as find_nearest_configuration,
    forward_kinematics as forward_kinematics,
    get_home_configuration as get_home_configuration,
    get_robot as get_robot,
    get_rods as get_rods,
    get_solver as get_solver,
    inverse_kinematics as inverse_kinematics,
    jacobian as jacobian,
    list_configurations as list_configurations,
    measure_singularity as measure_singularity,
    solve_all_configurations as solve_all_configurations,
    solve_both_forward as solve_both_forward,
)
from .rod_dimensions import (
    AXES as AXES,
    RodDimensions as RodDimensions,
    compute_gap_columns as compute_gap_columns,
    compute_leg_lengths as compute_leg_lengths,
    compute_leg_rates as compute_leg_rates,
)
from .sliding_plate import SlidingPlate as SlidingPlate
from .tree import TreeMechanism as TreeMechanism
from .tree_arrays import (
    Frames as Frames,
    Joint as Joint,
    compute_cross_product as compute_cross_product,
    compute_frames as compute_frames,
    list_joints as list_joints,
    multiply_by_rotation as multiply_by_rotation,
    transform_point as transform_point,
)
from .tree_closure import (
    ClosedConfigurations as ClosedConfigurations,
    TreeClosure as TreeClosure,
    compute_open_rates as compute_open_rates,
    propagate_twists as propagate_twists,
)
from .tree_dimensions import (
    PRIORITY as PRIORITY,
    Knob as Knob,
    TreeNumbers as TreeNumbers,
    TreeShape as TreeShape,
    compute_dimensions_at as compute_dimensions_at,
    get_shape as get_shape,
)
from .tree_kinematics import TreeDimensions as TreeDimensions, TreeKinematics as TreeKinematics
from .tree_pose import TreePose as TreePose
