"""A feedforward for ros2_control: its C, a C++ header for a controller plugin, and the parameter file of such a controller.

The header knows nothing of ROS: a class with the joints' names that a controller's `update` calls with the references of one
sample. The parameter file has the layout of `controller_manager`; a chainable controller claims `JOINT/effort` and exports the
reference interfaces `JOINT/position`, `JOINT/velocity` and `JOINT/acceleration` [REP 103 for units].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tau_dyn.codegen.c_writer import MAX_NUMBER, include_header
from tau_dyn.codegen.feedforward_c import write_c_source
from tau_dyn.codegen.program import Program, yield_description
from tau_dyn.exceptions import InputError
from tau_dyn.version import __version__

REFERENCES = ("position", "velocity", "acceleration")

_HEADER = """// @FIRST@
// For a ros2_control controller: one object a controller; call update once a sample, from one thread. No allocation.
#ifndef @GUARD@
#define @GUARD@

#include <array>
#include <cstddef>

#include "@C_HEADER@"

namespace @NAME@_ros2_control {

inline constexpr std::size_t kJoints = @NA@;
inline constexpr std::array<const char *, kJoints> kJointNames = {@JOINTS@};
using Values = std::array<double, kJoints>;

class Feedforward {
 public:
  Feedforward() { reset(); }

  // Forget the last forces and, where loops are solved, the last configuration: for a controller's on_activate.
  void reset() {
    effort_.fill(0.0);
    status_ = 0;
@RESET@  }

  // Forces [N or N m] at the references of one sample. A sample that the C function refuses leaves the last forces; see status.
  const Values &update(@ARGUMENTS@) {
    status_ = @CALL@;
    return effort_;
  }

  // Of the last update: 0, or the status of the C function.
  int status() const { return status_; }

 private:
  Values effort_{};
  int status_ = 0;
@STATE@};

}  // namespace @NAME@_ros2_control

#endif  // @GUARD@
"""


def write_ros2_control(program: Program, name: str, parameters: Path, plugin: str) -> dict[Path, str]:
    """Return the texts of a feedforward for ros2_control, by path: parameter file, C, its header and the C++ header.

    Args:
        program: From `build_program`.
        name: Name of the C function.
        parameters: The parameter file, `.yaml`; the other files go next to it, under its name.
        plugin: Type of the controller that includes the header, `PACKAGE/CLASS`.

    Raises:
        InputError: The name is no identifier of C, or the type is not `PACKAGE/CLASS`.
    """
    package, _, kind = plugin.partition("/")
    if not (package.isidentifier() and kind.replace("::", "_").isidentifier()):
        raise InputError("invalid_value", f"'{plugin}' is no type of a controller; it is PACKAGE/CLASS")
    source, header = write_c_source(program, name)
    c_header = parameters.with_suffix(".h")
    return {
        parameters: format_parameters(program, name, plugin),
        parameters.with_suffix(".c"): include_header(source, name, c_header),
        c_header: header,
        parameters.with_suffix(".hpp"): format_plugin_header(program, name, c_header.name),
    }


def format_parameters(program: Program, name: str, plugin: str) -> str:
    """Return the parameter file of a controller: its type, joints, interfaces, and the limits that the C function keeps."""
    robot, feedforward = program.feedforward.model.robot, program.feedforward
    most = np.minimum(robot.effort_limit, MAX_NUMBER)
    own: dict[str, Any] = {
        "joints": list(robot.actuated),
        "command_interface": "effort",
        "reference_interfaces": list(REFERENCES),
        "effort_limits": [float(x) for x in most],
        "smoothing_width": [float(x) for x in feedforward.width],
        "smoothing_shape": feedforward.shape,
    }
    if program.signals:
        own["signals"] = list(program.signals)
    controller = f"{name}_controller"
    content = {
        "controller_manager": {"ros__parameters": {controller: {"type": plugin}}},
        controller: {"ros__parameters": own},
    }
    said = "".join(f"# {line}".rstrip() + "\n" for line in yield_description(program))
    return said + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def format_plugin_header(program: Program, name: str, c_header: str) -> str:
    """Return the C++ header that a controller includes."""
    robot, arguments = program.feedforward.model.robot, ["q", "v", "a", *program.signals]
    start = program.loops is not None
    blanks = {
        "FIRST": f"Feedforward of {len(robot.actuated)} joints, written by tau-dyn {__version__}.",
        "GUARD": f"{name.upper()}_ROS2_CONTROL_HPP", "C_HEADER": c_header, "NAME": name, "NA": str(robot.na),
        "JOINTS": ", ".join(_quote(joint) for joint in robot.actuated),
        "ARGUMENTS": ", ".join(f"const Values &{x}" for x in arguments),
        "CALL": f"{name}({', '.join([*(['start_'] if start else []), *(f'{x}.data()' for x in arguments), 'effort_.data()'])})",
        "RESET": f"    {name}_start(start_);\n" if start else "",
        "STATE": f"  double start_[{name.upper()}_START] = {{}};\n" if start else "",
    }  # fmt: skip
    text = _HEADER
    for blank, value in blanks.items():
        text = text.replace(f"@{blank}@", value)
    return text


def _quote(joint: str) -> str:
    """Return a joint's name as a C++ literal in plain ASCII, its UTF-8 escaped."""
    bytes_ = joint.encode("utf-8")
    plain = "".join(chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in bytes_)
    return f'"{plain}"'
