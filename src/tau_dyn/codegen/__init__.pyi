"""Code from models: expressions traced from the package's own formulas, written as C, Python and FMU."""

from .c_writer import (
    build_identifiers as build_identifiers,
    include_header as include_header,
    locate_header as locate_header,
)
from .command_filters import write_notch_source as write_notch_source, write_shaper_source as write_shaper_source
from .feedforward_c import write_c_source as write_c_source
from .filters import write_learning_source as write_learning_source, write_observer_source as write_observer_source
from .fmu_writer import (
    build_variables as build_variables,
    format_description as format_description,
    format_identifier as format_identifier,
    write_fmu_source as write_fmu_source,
)
from .forms import draw_random_states as draw_random_states, find_loops as find_loops
from .kinematics import KinematicsProgram as KinematicsProgram, build_kinematics as build_kinematics
from .kinematics_c import write_kinematics_source as write_kinematics_source
from .lead_through_c import (
    LeadThroughNumbers as LeadThroughNumbers,
    write_lead_through_source as write_lead_through_source,
)
from .loops import Loops as Loops
from .plant_equations import (
    Equations as Equations,
    build_equations as build_equations,
    list_unsupported_effects as list_unsupported_effects,
    trace_effect_bounds as trace_effect_bounds,
    write_plant_source as write_plant_source,
)
from .program import (
    ARGUMENTS as ARGUMENTS,
    Program as Program,
    TraceableForces as TraceableForces,
    build_program as build_program,
)
from .python_writer import (
    join_names as join_names,
    write_python_source as write_python_source,
    yield_assignments as yield_assignments,
)
from .ros2_control import write_ros2_control as write_ros2_control
