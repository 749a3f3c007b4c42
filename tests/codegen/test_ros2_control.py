"""A feedforward for ros2_control: a header that a controller includes, and the parameters of such a controller."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.codegen import build_program, write_ros2_control
from tau_dyn.control import Feedforward
from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

DRIVER = """
#include <cstdio>
#include <cmath>
#include "ff.hpp"
int main() {
  tau_ff_ros2_control::Feedforward feedforward;
  tau_ff_ros2_control::Values q = {@Q@}, v = {@V@}, a = {@A@}@MORE@;
  for (int step = 0; step < 3; ++step) {
    if (step == 1) v[0] = NAN;
    if (step == 2) feedforward.reset();
    const auto &tau = feedforward.update(q, v, a@GIVEN@);
    std::printf("%d", feedforward.status());
    for (double x : tau) std::printf(" %.17g", x);
    std::printf("\\n");
  }
  for (const char *name : tau_ff_ros2_control::kJointNames) std::printf("%s ", name);
}
"""


def build_model(name: str) -> Model:
    """Return a robot with asymmetric friction; the axis also with friction that falls with the temperature."""
    robot = load_robot("gantry_tau", arms="complete") if name == "complete" else load_robot(name)
    more = [EFFECTS["thermal_drift"](robot.actuated, robot.force_units)] if name == "linear_axis" else []
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *more])
    return model.with_values({n: 5.0 + k for k, n in enumerate(model.effect_parameters.names)})


@pytest.mark.skipif(shutil.which("c++") is None or shutil.which("cc") is None, reason="there is no C++ compiler here")
@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "complete"])
def test_a_controller_that_includes_the_header_gets_the_model_s_forces(name: str, tmp_path: Path) -> None:
    """C++17 with every warning an error: the forces are Python's, a refused sample keeps them, and reset clears them."""
    model = build_model(name)
    feedforward = Feedforward(model, width=0.02)
    program = build_program(feedforward)
    for path, text in write_ros2_control(program, "tau_ff", tmp_path / "ff.yaml", "my_controllers/Own").items():
        path.write_text(text)
    q, v, a = model.robot.home + 0.01, np.full(model.robot.na, 0.05), np.full(model.robot.na, 0.5)
    numbers = {key: ", ".join(map(repr, x.tolist())) for key, x in (("Q", q), ("V", v), ("A", a))}
    signals = {signal: np.full(model.robot.na, 31.0) for signal in program.signals}
    more = "".join(f", {s} = {{{', '.join(map(repr, x.tolist()))}}}" for s, x in signals.items())
    text = DRIVER.replace("@MORE@", more).replace("@GIVEN@", "".join(f", {s}" for s in signals))
    for key, value in numbers.items():
        text = text.replace(f"@{key}@", value)
    (tmp_path / "driver.cpp").write_text(text)
    flags = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O0"]
    subprocess.run(["cc", "-std=c99", *flags, "-c", str(tmp_path / "ff.c"), "-o", str(tmp_path / "ff.o")], check=True)
    files = [str(tmp_path / "driver.cpp"), str(tmp_path / "ff.o")]
    subprocess.run(["c++", "-std=c++17", *flags, *files, "-o", str(tmp_path / "driver")], check=True)
    lines = subprocess.run([str(tmp_path / "driver")], capture_output=True, text=True, check=True).stdout.splitlines()
    rows = [np.array(line.split(), float) for line in lines[:3]]
    expected = feedforward(q, v, a, signals=signals)
    assert rows[0][0] == 0 and rows[1][0] == 1 and rows[2][0] == 1
    np.testing.assert_allclose(rows[0][1:], expected, rtol=1e-10)
    np.testing.assert_array_equal(rows[1][1:], rows[0][1:])
    assert not rows[2][1:].any()
    assert lines[3].split() == list(model.robot.actuated)


def test_the_parameter_file_is_one_of_a_controller_manager(tmp_path: Path) -> None:
    """Type, joints in the order of the code, interfaces and limits; the command writes all four files."""
    model, out = build_model("gantry_tau"), tmp_path / "ff.yaml"
    model.save(tmp_path / "model.yaml")
    words = ["feedforward", "export", str(tmp_path / "model.yaml"), "--to", "ros2_control", "--out", str(out)]
    assert main([*words, "--plugin", "my_controllers/Own", "--width", "0.02"]) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"model.yaml", "ff.yaml", "ff.c", "ff.h", "ff.hpp"}
    content = yaml.safe_load(out.read_text())
    assert content["controller_manager"]["ros__parameters"]["tau_ff_controller"]["type"] == "my_controllers/Own"
    own = content["tau_ff_controller"]["ros__parameters"]
    assert own["joints"] == list(model.robot.actuated) and own["command_interface"] == "effort"
    assert own["effort_limits"] == pytest.approx(model.robot.effort_limit)
    assert own["reference_interfaces"] == ["position", "velocity", "acceleration"]
    assert own["smoothing_width"] == [0.02] * 3


def test_a_type_that_is_none_is_refused(tmp_path: Path) -> None:
    """A plugin is named by package and class."""
    program = build_program(Feedforward(build_model("linear_axis").steady()))
    for plugin in ("Own", "my controllers/Own", "/Own", "a/b c"):
        with raises_code("invalid_value", "PACKAGE/CLASS"):
            write_ros2_control(program, "tau_ff", tmp_path / "ff.yaml", plugin)
