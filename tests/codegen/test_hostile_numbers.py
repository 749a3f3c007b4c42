"""No exported program answers with a number that no drive would take, whatever it is given; nothing of it is undefined in C.

A driver in C calls a program many times with states near home in which numbers are replaced by NaN, infinities, denormals, huge
ones, and far or singular places. It is compiled with the address and undefined-behaviour sanitizers. Status 0 must come with
finite outputs within their limits, any other status with outputs as they were.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.codegen import (
    build_equations,
    build_kinematics,
    build_program,
    write_c_source,
    write_fmu_source,
    write_kinematics_source,
    write_learning_source,
    write_observer_source,
    write_python_source,
)
from tau_dyn.codegen.c_writer import MAX_NUMBER
from tau_dyn.control import (
    ComplementaryToolObserver,
    Feedforward,
    KalmanToolObserver,
    LearningLaw,
    MotorSide,
    TimeShift,
    design_low_pass,
)
from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.model import Model
from tau_dyn.modes import StateSpace
from tau_dyn.robot import load_robot, load_robot_from_urdf

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
CALLS = 3000
ODD = (
    np.nan,
    np.inf,
    -np.inf,
    5e-324,
    -1e-310,
    0.0,
    -0.0,
    1e200,
    -1e200,
    1e308,
    MAX_NUMBER,
    -1.1 * MAX_NUMBER,
    40.0,
    3.0,
)
SANITIZED = ("-std=c99", "-O1", "-g", "-Wall", "-Wextra", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
IRB140 = Path(__file__).parents[2] / "experiments" / "lead_through_parts" / "irb140.urdf"

DRIVER = """
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include "@NAME@.h"
static uint64_t seed = 1;
static double chance(void)
{
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 9007199254740992.0;
}
static double odd(double near, double spread, int calm)
{
    if (!calm && chance() < 0.15) {
        const char *words[] = {@ODD@};
        return strtod(words[(int)(chance() * @MANY@)], NULL);
    }
    return near + spread * (2.0 * chance() - 1.0);
}
int main(int count, char **given)
{
    const int calls = count > 1 ? atoi(given[1]) : 1;
    long counts[8] = {0};
@ARRAYS@
    for (int i = 0; i < calls; ++i) {
        const int calm = i % 3 == 0; /* a state like others, so that the last configuration moves on */
        if (i % 50 == 0) { @BEGIN@ }
@FILL@
        const int status = @CALL@;
        if (status < 0 || status > 7) return 1;
        ++counts[status];
@CHECK@
    }
    for (int k = 0; k < 8; ++k) printf("%ld ", counts[k]);
    return 0;
}
"""


@dataclass
class Call:
    """One function: inputs near places with a spread, outputs with the largest number that may come, a state.

    Attributes:
        text: The call, with arrays by name.
        inputs: Name -> places (n,) and spread.
        outputs: Name -> largest values (n,).
        state: Numbers of the state, 0 for none.
        begin: C that sets the state.
        kept: How many of the state's numbers must stay finite; by default all.
    """

    text: str
    inputs: dict[str, tuple[np.ndarray, float]]
    outputs: dict[str, np.ndarray]
    state: int = 0
    begin: str = ""
    kept: int | None = None


def count_statuses(sources: tuple[str, str], name: str, call: Call, folder: Path, calls: int = CALLS) -> list[int]:
    """Return how often each status came; the driver itself fails where a promise is broken."""

    def listed(values: np.ndarray) -> str:
        return ", ".join(repr(float(x)) for x in np.ravel(values))

    arrays = [f"    double state[{call.state or 1}] = {{0}}; (void)state;"]
    fill, check = [], []
    for x, (near, spread) in call.inputs.items():
        n = len(near)
        arrays.append(f"    static const double {x}_near[{n}] = {{{listed(near)}}}; double {x}[{n}];")
        fill.append(f"        for (int k = 0; k < {n}; ++k) {x}[k] = odd({x}_near[k], {spread!r}, calm);")
    for x, most in call.outputs.items():
        n = len(most)
        arrays.append(f"    static const double {x}_most[{n}] = {{{listed(most)}}}; double {x}[{n}];")
        fill.append(f"        for (int k = 0; k < {n}; ++k) {x}[k] = -7.0;")
        check.append(
            f"        for (int k = 0; k < {n}; ++k) if (status ? {x}[k] != -7.0 : !(fabs({x}[k]) <= {x}_most[k])) "
            f'{{ printf("call %d, status %d, {x}[%d] = %g", i, status, k, {x}[k]); return 1; }}'
        )
    check.append(
        f"        for (int k = 0; k < {call.state if call.kept is None else call.kept}; ++k) if (!isfinite(state[k])) return 1;"
    )
    words = ", ".join(f'"{x!r}"' for x in ODD)
    text = DRIVER.replace("@NAME@", name).replace("@ODD@", words).replace("@MANY@", str(len(ODD)))
    for blank, lines in (("@ARRAYS@", arrays), ("@FILL@", fill), ("@CHECK@", check)):
        text = text.replace(blank, "\n".join(lines))
    text = text.replace("@BEGIN@", call.begin).replace("@CALL@", call.text)
    for file, content in ((f"{name}.c", sources[0]), (f"{name}.h", sources[1]), ("driver.c", text)):
        (folder / file).write_text(content)
    return run_sanitized([folder / f"{name}.c", folder / "driver.c"], folder / f"{name}_driver", calls)


def run_sanitized(files: list[Path], program: Path, calls: int) -> list[int]:
    """Compile with sanitizers, run, and return the counts that are printed."""
    subprocess.run(["cc", *SANITIZED, *map(str, files), "-o", str(program), "-lm"], check=True)
    done = subprocess.run([str(program), str(calls)], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr[:2000]}"
    return [int(x) for x in done.stdout.split()]


def built(name: str, write) -> Model:
    """Return a model with friction by a short name."""
    if name == "four_bar":
        robot = load_robot_from_urdf(write.four_bar(), name)
    elif name == "arm":
        robot = load_robot(IRB140, actuated=[f"joint{k}" for k in range(1, 7)])
    else:
        robot = load_robot("gantry_tau", arms="complete") if name == "complete" else load_robot(name)
    more = ("stribeck", "load_friction", "thermal_drift", "quadratic_drag") if name == "gantry_tau" else ()
    effects = [EFFECTS[cause](robot.actuated, robot.force_units) for cause in more]
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *effects])
    return model.with_values({n: 0.3 * (1 + 0.1 * k) for k, n in enumerate(model.effect_parameters.names)})


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "four_bar", "complete", "arm"])
def test_feedforward(name, write, tmp_path) -> None:
    """Forces are finite and within the joints' limits, or stay as they were; in C and in Python."""
    model = built(name, write)
    program = build_program(Feedforward(model))
    robot, na = model.robot, model.robot.na
    names = ["q", "v", "a", *program.signals]
    near = {
        "q": (robot.home, 0.05),
        "v": (np.zeros(na), 1.0),
        "a": (np.zeros(na), 3.0),
        "temperature": (np.full(na, 25.0), 5.0),
    }
    state = "state, " if program.loops else ""
    call = Call(
        f"tau_ff({state}{', '.join(names)}, tau)",
        {x: near[x] for x in names},
        {"tau": np.minimum(robot.effort_limit, MAX_NUMBER)},
        0 if program.loops is None else na + len(program.loops.passive),
        "" if program.loops is None else "tau_ff_start(state);",
    )
    counts = count_statuses(write_c_source(program), "tau_ff", call, tmp_path)
    assert counts[0] > CALLS / 10 and counts[1] > CALLS / 20
    python: dict = {}
    exec(write_python_source(program), python)
    rng, refused = np.random.default_rng(3), 0
    for _ in range(60):
        given = [x + spread * rng.uniform(-1, 1, na) for x, spread in (near[n] for n in names)]
        if rng.uniform() < 0.7:
            given[rng.integers(len(given))][rng.integers(na)] = ODD[rng.integers(len(ODD))]
        try:
            assert np.all(np.abs(python["tau_ff"](*given)) <= call.outputs["tau"])
        except ValueError:
            refused += 1
    assert 0 < refused < 60


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "stewart", "four_bar", "arm"])
def test_kinematics(name, write, tmp_path) -> None:
    """Poses, Jacobians and positions are finite, or stay as they were."""
    robot = load_robot_from_urdf(four_bar_with_tool(write), name) if name == "four_bar" else built_robot(name)
    program = build_kinematics(robot)
    sources, na = write_kinematics_source(program, "kin"), robot.na
    home = forward_kinematics(robot, robot.home[None]).poses
    most = np.full(9, MAX_NUMBER)
    state, begin = ("state, ", "kin_start(state);") if program.freedoms else ("", "")
    q = {"q": (robot.home, 0.05)}
    size = len(program.home) if program.freedoms or program.inverse is None and not program.no_inverse else 0
    fk = Call(f"kin_fk({state}q, p, R)", q, {"p": most[:3], "R": most}, size, begin)
    J = Call(f"kin_jacobian({state}q, J)", q, {"J": np.full(program.rows * na, MAX_NUMBER)}, size, begin)
    for call in (fk, J):
        assert count_statuses(sources, "kin", call, tmp_path)[0] > CALLS / 10
    if not program.no_inverse:
        state, begin = ("state, ", "kin_start(state);") if program.inverse is None else ("", "")
        pose = {"p": (home.position[0], 0.02), "R": (home.rotation[0].ravel(), 1e-6)}
        ik = Call(f"kin_ik({state}p, R, q)", pose, {"q": np.full(na, MAX_NUMBER)}, size, begin)
        counts = count_statuses(sources, "kin", ik, tmp_path)
        assert counts[1] > CALLS / 10 and sum(counts) == CALLS


def built_robot(name: str):
    """Return a robot by a short name."""
    if name == "arm":
        return load_robot(IRB140, actuated=[f"joint{k}" for k in range(1, 7)])
    return load_robot(name)


def four_bar_with_tool(write) -> str:
    """Return a four-bar linkage whose coupler carries a tool."""
    text = write.four_bar()
    tool = '<link name="tool"/><joint name="end" type="fixed"><parent link="coupler_link"/><child link="tool"/></joint>'
    return text.replace("</robot>", f"{tool}</robot>")


def swaying(dt: float) -> StateSpace:
    """Return a tool that sways at 11 Hz behind the actuators, one axis."""
    w = 2 * np.pi * 11 * dt
    A = 0.98 * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    B, C = np.array([[0.05], [0.0]]), np.array([[1.0, 0.0]])
    gain = C @ np.linalg.solve(np.eye(2) - A, B)
    return StateSpace(A, B / gain, C, np.zeros((1, 1)), np.zeros((2, 1)), dt, 0)


@pytest.mark.parametrize("kind", ["causal", "kalman", "trial", "update"])
def test_filters(kind, tmp_path) -> None:
    """Observers and learning pass no number on that is none; states and corrections stay numbers."""
    dt, n, at = 0.004, 20, (np.array([0.4]), 0.1)
    if kind in ("causal", "kalman"):
        kalman = KalmanToolObserver(swaying(dt), 1e-10, 0.01)
        sources = write_observer_source(
            kalman if kind == "kalman" else ComplementaryToolObserver((4.5,), dt, causal=True), "obs"
        )
        size = int(sources[1].partition("_STATE ")[2].split()[0])
        inputs = {"place": at, "felt": (np.zeros(1), 5.0)}
        call = Call(
            "obs_step(state, place, felt, z)",
            inputs,
            {"z": np.full(1, MAX_NUMBER)},
            size,
            "obs_start(state, place_near);",
        )
    elif kind == "trial":
        sources = write_observer_source(ComplementaryToolObserver((4.5,), dt), "obs")
        inputs = {"place": (np.full(n, 0.4), 0.1), "felt": (np.zeros(n), 5.0)}
        call = Call(f"obs_trial({n}, place, felt, z, state)", inputs, {"z": np.full(n, MAX_NUMBER)}, 2 * n)
    else:
        law = LearningLaw(MotorSide(swaying(dt)), (design_low_pass(10, dt),), TimeShift(0.9, 2, dt))
        sources = write_learning_source(law, 0.05, "obs")
        inputs = {"weight": (np.ones(n), 0.0), "error": (np.zeros(n), 0.05)}
        begin = f"for (int k = 0; k < {n}; ++k) state[k] = 0.0;"
        call = Call(f"obs_update({n}, weight, error, state, state + {n})", inputs, {}, 2 * n, begin, n)
    counts = count_statuses(sources, "obs", call, tmp_path)
    assert counts[0] > CALLS / 10 and counts[1] > CALLS / 20


FMU_DRIVER = """
#include <stdint.h>
#include <stdio.h>
#include "fmu.c"
static uint64_t seed = 1;
static double chance(void)
{
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 9007199254740992.0;
}
int main(int count, char **given)
{
    static const double odds[] = {@ODD@};
    const int calls = count > 1 ? atoi(given[1]) : 1, many = sizeof odds / sizeof *odds;
    long counts[2] = {0};
    Component c = NULL;
    for (int i = 0; i < calls; ++i) {
        double x[3 * NA + 3];
        Reference r[3 * NA + 3];
        if (i % 40 == 0) {
            if (c) fmi2FreeInstance(c);
            c = fmi2Instantiate("one", 1, GUID, "", NULL, 0, 0);
            if (!c) return 1;
            for (int k = 0; k < 3; ++k) if (chance() < 0.1) {
                const Reference place = (Reference)(FIRST_T + chance() * (REFERENCES - FIRST_T));
                const double value = odds[(int)(chance() * many)];
                fmi2SetReal(c, &place, 1, &value);
            }
            fmi2EnterInitializationMode(c);
            fmi2ExitInitializationMode(c);
        }
        for (unsigned k = 0; k < NA; ++k) {
            const double force = chance() < 0.1 ? odds[(int)(chance() * many)] : 20.0 * (chance() - 0.5);
            fmi2SetReal(c, &k, 1, &force);
        }
        const Status status = fmi2DoStep(c, 0.0, chance() < 0.05 ? odds[(int)(chance() * many)] * 1e-3 : 1e-3, 1);
        ++counts[status != OK];
        for (unsigned k = 0; k < 3 * NA + NTOOL; ++k) r[k] = k;
        for (unsigned k = 0; k < 3 * NA + NTOOL; ++k)
            if (fmi2GetReal(c, r + k, 1, x + k) == OK && !isfinite(x[k])) return 1;
    }
    fmi2FreeInstance(c);
    printf("%ld %ld", counts[0], counts[1]);
    return 0;
}
"""


@pytest.mark.parametrize("name", ["linear_axis", "gantry_tau", "four_bar"])
def test_fmu(name, write, tmp_path) -> None:
    """Forces, parameters, starts and step sizes that are odd end in an error of the FMU or in a finite motion."""
    model = built(name, write)
    model = model.only(e for e in model.effects if "temperature" not in e.needs)
    (tmp_path / "fmu.c").write_text(write_fmu_source(build_equations(model), "{}", "a robot"))
    odds = ", ".join(
        {"nan": "NAN", "inf": "INFINITY", "-inf": "-INFINITY"}.get(repr(x), repr(x)) for x in ODD if abs(x) != 40.0
    )
    (tmp_path / "driver.c").write_text(FMU_DRIVER.replace("@ODD@", odds))
    counts = run_sanitized([tmp_path / "driver.c"], tmp_path / "driver", CALLS // 3)
    assert counts[0] > CALLS / 10 and counts[1] > 0
