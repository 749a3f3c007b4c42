"""A robot as a mechanism: loops closed, poses of the tool and back, forces and regressor in actuated coordinates."""

from .batched import WeightArms as WeightArms
from .chain_inverse import RootChain as RootChain, build_chains as build_chains
from .flexible import (
    L1_DRIVES as L1_DRIVES,
    ContinuousModel as ContinuousModel,
    FlexibleModel as FlexibleModel,
    Linearised as Linearised,
    NaturalMode as NaturalMode,
    PositionDrives as PositionDrives,
    SampledModel as SampledModel,
    name_rod_spring as name_rod_spring,
    state_springs as state_springs,
    write_springs as write_springs,
)
from .frames import (
    Carried as Carried,
    ChainJoint as ChainJoint,
    Frames as Frames,
    Joint as Joint,
    compute_cross_product as compute_cross_product,
    compute_frames as compute_frames,
    compute_joint_frames as compute_joint_frames,
    compute_motion as compute_motion,
    compute_points as compute_points,
    compute_velocities as compute_velocities,
    list_joints as list_joints,
    list_path as list_path,
    multiply_by_constant as multiply_by_constant,
    multiply_by_rotation as multiply_by_rotation,
    remove_rounding as remove_rounding,
    transform_point as transform_point,
    yield_columns as yield_columns,
)
from .gantry_tau import GantryTauMechanism as GantryTauMechanism
from .kinematics import (
    CommandedCoordinates as CommandedCoordinates,
    Kinematics as Kinematics,
    Singularity as Singularity,
)
from .legs import (
    DEFAULT_ANGLE as DEFAULT_ANGLE,
    BallJoints as BallJoints,
    Legs as Legs,
    find_ball_joints as find_ball_joints,
)
from .loop_arrays import (
    ClosedLoops as ClosedLoops,
    LoopArrays as LoopArrays,
    compute_actuated_positions_from as compute_actuated_positions_from,
    list_loop_joints as list_loop_joints,
)
from .loops import (
    LoopSolver as LoopSolver,
    TreeState as TreeState,
    compute_turning_rates as compute_turning_rates,
    find_passive_pairs as find_passive_pairs,
)
from .mechanism import (
    SINGULAR as SINGULAR,
    Mechanism as Mechanism,
    build_kinematics as build_kinematics,
    compute_perpendicular_axes as compute_perpendicular_axes,
    find_all_solutions as find_all_solutions,
    forward_kinematics as forward_kinematics,
    get_cached as get_cached,
    get_robot as get_robot,
    get_rods as get_rods,
    get_solver as get_solver,
    inverse_kinematics as inverse_kinematics,
    jacobian as jacobian,
    solve_all_configurations as solve_all_configurations,
)
from .newton_euler import (
    compute_tree_forces as compute_tree_forces,
    list_inertial_numbers as list_inertial_numbers,
    list_weights as list_weights,
)
from .plate_on_legs import PlateOnLegs as PlateOnLegs, Rods as Rods, build_rods as build_rods
from .poses import (
    JOINT_LIMIT as JOINT_LIMIT,
    NOT_A_NUMBER as NOT_A_NUMBER,
    OK as OK,
    OUT_OF_REACH as OUT_OF_REACH,
    REASONS as REASONS,
    SLACK as SLACK,
    ForwardResult as ForwardResult,
    InverseResult as InverseResult,
    InverseSolutions as InverseSolutions,
    Poses as Poses,
    StraightWay as StraightWay,
    convert_from_quaternions as convert_from_quaternions,
    convert_to_quaternions as convert_to_quaternions,
    require_poses as require_poses,
    require_positions as require_positions,
    unwind_turns as unwind_turns,
)
from .recognise import NotRods as NotRods
from .rod_dimensions import (
    AXES as AXES,
    Plate as Plate,
    RodDimensions as RodDimensions,
    compute_closure_by_q as compute_closure_by_q,
    compute_equation_rows as compute_equation_rows,
    compute_gap_columns as compute_gap_columns,
    compute_leg_lengths as compute_leg_lengths,
    compute_leg_rates as compute_leg_rates,
    compute_squared_lengths as compute_squared_lengths,
    set_dimensions as set_dimensions,
)
from .sliding_plate import SlidingPlate as SlidingPlate, intersect_spheres as intersect_spheres
from .small_systems import (
    Move as Move,
    NewtonRules as NewtonRules,
    iterate_newton as iterate_newton,
    measure_column_lengths as measure_column_lengths,
)
from .tree import LoadedTree as LoadedTree, TreeMechanism as TreeMechanism, build_mechanism as build_mechanism
from .tree_geometry import (
    PRIORITY as PRIORITY,
    ClosedConfigurations as ClosedConfigurations,
    Knob as Knob,
    TreeClosure as TreeClosure,
    TreeNumbers as TreeNumbers,
    TreeShape as TreeShape,
    compute_dimensions_at as compute_dimensions_at,
    compute_open_rates as compute_open_rates,
    get_shape as get_shape,
    propagate_twists as propagate_twists,
)
from .tree_kinematics import TreeDimensions as TreeDimensions, TreeKinematics as TreeKinematics
from .tree_pose import TreePose as TreePose
