"""What follows from a mechanism's kinematics: paths, workspace, accuracy, assembly modes."""

from .dexterity import Rates as Rates
from .obstacles import (
    Obstacle as Obstacle,
    PlacedSolid as PlacedSolid,
    Surroundings as Surroundings,
    add_limits as add_limits,
    build_capsule as build_capsule,
    build_standing_solid as build_standing_solid,
    find_collisions as find_collisions,
    read_surroundings as read_surroundings,
)
from .path_following import FollowedPath as FollowedPath, follow_path as follow_path
from .pose_table import (
    PoseTable as PoseTable,
    build_forward_table as build_forward_table,
    build_inverse_table as build_inverse_table,
    pick_columns as pick_columns,
    place_home_orientation as place_home_orientation,
    read_poses as read_poses,
    read_positions as read_positions,
)
from .solids import Box as Box, Capsule as Capsule, Cylinder as Cylinder, HalfSpace as HalfSpace
