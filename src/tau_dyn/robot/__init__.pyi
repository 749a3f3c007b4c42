"""Robots: from a xacro file to a tree with loops, actuated joints and nominal parameters."""

from .annotations import (
    JointFriction as JointFriction,
    Mimic as Mimic,
    Spring as Spring,
    read_annotations as read_annotations,
)
from .body_prior import (
    ACCURATE_FILE as ACCURATE_FILE,
    LENGTH_POWERS as LENGTH_POWERS,
    ROUGH_FILE as ROUGH_FILE,
    BodyPrior as BodyPrior,
    compute_body_radius as compute_body_radius,
    compute_body_size as compute_body_size,
    compute_nominal_stderr as compute_nominal_stderr,
    find_placeholders as find_placeholders,
)
from .dimensions import read_dimensions_file as read_dimensions_file
from .expand import (
    describe_robot as describe_robot,
    find_robot as find_robot,
    list_dimensions as list_dimensions,
    list_robot_names as list_robot_names,
    list_robots as list_robots,
)
from .floating_base import (
    BASE_COORDINATES as BASE_COORDINATES,
    FLAT as FLAT,
    POINT as POINT,
    ContactFrame as ContactFrame,
    remove_base_coordinates as remove_base_coordinates,
)
from .gazebo import write_gazebo_mimics as write_gazebo_mimics
from .load import as_robot as as_robot, load_robot as load_robot, load_robot_from_urdf as load_robot_from_urdf
from .packages import find_package as find_package, list_stock_robots as list_stock_robots, resolve_mesh as resolve_mesh
from .robot import (
    INERTIAL as INERTIAL,
    NOT_GIVEN as NOT_GIVEN,
    LinkInertia as LinkInertia,
    Loop as Loop,
    Robot as Robot,
    compute_inertia_matrix as compute_inertia_matrix,
    find_end_link as find_end_link,
)
from .visuals import (
    Mesh as Mesh,
    Visual as Visual,
    list_missing_meshes as list_missing_meshes,
    read_visuals as read_visuals,
)
