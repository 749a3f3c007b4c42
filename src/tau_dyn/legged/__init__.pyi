"""Robots that walk: the motion of their base from logs, and the forces of the ground taken out of their equations."""

from .contacts import (
    ContactElimination as ContactElimination,
    compute_contact_jacobian as compute_contact_jacobian,
    eliminate_contacts as eliminate_contacts,
    find_contacts as find_contacts,
    find_usual_flight as find_usual_flight,
)
from .log_check import (
    ANGULAR as ANGULAR,
    LINEAR as LINEAR,
    POSITION as POSITION,
    QUATERNION as QUATERNION,
    DrivenJoints as DrivenJoints,
    check_robot_log as check_robot_log,
    complete_base as complete_base,
    list_base_warnings as list_base_warnings,
    propose_robot_columns as propose_robot_columns,
)
from .misalignment import compute_imu_turn as compute_imu_turn
