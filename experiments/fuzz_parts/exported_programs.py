"""Calls of every exported program, for the driver beside this file: which numbers go in, which may come out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fuzz_parts.exported_driver import Call, Inputs, count_statuses, fill_chance, run_sanitized

from tau_dyn.codegen import (
    KinematicsProgram,
    build_equations,
    build_kinematics,
    build_program,
    write_c_source,
    write_fmu_source,
    write_kinematics_source,
    write_lead_through_source,
    write_learning_source,
    write_observer_source,
    write_python_source,
)
from tau_dyn.codegen.c_writer import MAX_NUMBER
from tau_dyn.control import (
    ComplementaryToolObserver,
    Feedforward,
    ForceSensor,
    KalmanToolObserver,
    LeadThrough,
    LeadThroughSettings,
    LearningLaw,
    MotorSide,
    TimeShift,
    design_low_pass,
)
from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.model import Model
from tau_dyn.modes import StateSpace
from tau_dyn.robot import Robot

N_TRIAL, DT = 20, 0.004  # samples and step [s] of a trial of the learning filters
MAX_DISTANCE = 4.0  # m or rad from home where a joint has no range
FILTERS = ("causal", "kalman", "trial", "update", "q", "l")


def build_model(robot: Robot, *causes: str) -> Model:
    """Return a model with asymmetric friction and effects, no parameter of them zero."""
    effects = [EFFECTS[cause](robot.actuated, robot.force_units) for cause in causes]
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *effects])
    return model.with_values({n: 0.3 * (1 + 0.1 * k) for k, n in enumerate(model.effect_parameters.names)})


def _take_positions(robot: Robot) -> Inputs:
    """Return positions: near home, or anywhere in the ranges and a tenth beyond them."""
    low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - MAX_DISTANCE)
    high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + MAX_DISTANCE)
    return Inputs(robot.home, 0.05, low - 0.1 * (high - low), high + 0.1 * (high - low))


def _take_states(robot: Robot) -> dict[str, Inputs]:
    """Return a feedforward's inputs."""
    na = robot.na
    v = np.where(robot.velocity_limit < 1e6, 1.5 * robot.velocity_limit, 10.0)
    return {
        "q": _take_positions(robot),
        "v": Inputs(np.zeros(na), 1.0, -v, v),
        "a": Inputs(np.zeros(na), 3.0, np.full(na, -100.0), np.full(na, 100.0)),
        "temperature": Inputs(np.full(na, 25.0), 5.0, np.full(na, -40.0), np.full(na, 120.0)),
    }


def _allow(most: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return -most, most


def fuzz_feedforward(model: Model, folder: Path, calls: int, seed: int = 1) -> list[int]:
    """Return the counts of statuses of a model's feedforward in C."""
    program, robot = build_program(Feedforward(model)), model.robot
    names = ["q", "v", "a", *program.signals]
    states = _take_states(robot)
    loops = program.loops
    call = Call(
        f"tau_ff({'state, ' if loops else ''}{', '.join(names)}, tau)",
        {x: states[x] for x in names},
        {"tau": _allow(np.minimum(robot.effort_limit, MAX_NUMBER))},
        0 if loops is None else robot.na + len(loops.passive),
        begin="" if loops is None else "tau_ff_start(state);",
    )
    return count_statuses(write_c_source(program), "tau_ff", call, folder, calls, seed)


def fuzz_python(model: Model, calls: int, seed: int = 1) -> list[int]:
    """Return how often a feedforward in Python answered and how often it raised ValueError, one state a call.

    Raises:
        AssertionError: A force is no number, or beyond its joint's limit.
    """
    program, robot, rng = build_program(Feedforward(model)), model.robot, np.random.default_rng(seed)
    module: dict = {}
    exec(write_python_source(program), module)
    states = _take_states(robot)
    odd = [eval(x, {"NAN": np.nan, "INFINITY": np.inf}) for x in fill_chance("@ODD@").split(", ")]
    counts, limit = [0, 0], np.minimum(robot.effort_limit, MAX_NUMBER)
    for k in range(calls):
        given = []
        for x in (states[n] for n in ("q", "v", "a", *program.signals)):
            wide = rng.uniform(x.low, x.high) if k % 5 in (1, 3) else x.near + x.spread * rng.uniform(-1, 1, robot.na)
            given.append(np.where(rng.random(robot.na) < 0.15 * (k % 5 == 2), rng.choice(odd, robot.na), wide))
            if k % 5 == 4:
                given[-1] = np.where(rng.random(robot.na) < 0.5, x.low, x.high)
        try:
            tau = module["tau_ff"](*given)
        except ValueError:
            counts[1] += 1
            continue
        assert np.all(np.abs(tau) <= limit), f"{given} -> {tau}"
        counts[0] += 1
    return counts


def fuzz_kinematics(robot: Robot, folder: Path, calls: int, seed: int = 1) -> dict[str, list[int]]:
    """Return the counts of statuses of fk, jacobian and ik; positions of ik are within their ranges and lead to the pose."""
    program = build_kinematics(robot)
    sources, na = write_kinematics_source(program, "kin"), robot.na
    q, most = _take_positions(robot), np.full(9, MAX_NUMBER)
    follows = "KIN_START" in sources[1] and "kin_fk(double start" in sources[1]
    searches = "KIN_START" in sources[1] and "kin_ik(double start" in sources[1]
    first, begin = ("state, ", "kin_start(state);") if follows else ("", "")
    size = len(program.home) if follows or searches else 0
    one = np.full(9, 1 + 1e-9)
    found = {
        "fk": Call(f"kin_fk({first}q, p, R)", {"q": q}, {"p": _allow(most[:3]), "R": _allow(one)}, size, begin=begin),
        "jacobian": Call(
            f"kin_jacobian({first}q, J)", {"q": q}, {"J": _allow(np.full(program.rows * na, MAX_NUMBER))}, size,
            begin=begin,
        ),
    }  # fmt: skip
    if not program.no_inverse:
        found["ik"] = _call_inverse(robot, program, follows, searches, size)
    return {name: count_statuses(sources, "kin", call, folder, calls, seed) for name, call in found.items()}


def _call_inverse(robot: Robot, program: KinematicsProgram, follows: bool, searches: bool, size: int) -> Call:
    """Return a call of the inverse: poses near home, anywhere near, and poses that forward kinematics give."""
    q, na = _take_positions(robot), robot.na
    home = forward_kinematics(robot, robot.home[None]).poses
    place, R = home.position[0], home.rotation[0].ravel()
    low, high = (", ".join(repr(float(x)) for x in np.ravel(v)) for v in (q.low, q.high))
    start = f"double other[{len(program.home)}]; kin_start(other);" if follows else ""
    prepare = (
        f"        if (mode == 3) {{ /* a pose that drives in their ranges give */\n            double at[{na}]; {start}\n"
        f"            static const double low[{na}] = {{{low}}}, high[{na}] = {{{high}}};\n"
        f"            for (int k = 0; k < {na}; ++k) at[k] = low[k] + (high[k] - low[k]) * chance();\n"
        f"            (void)kin_fk({'other, ' if follows else ''}at, p, R);\n        }}"
    )
    again = f"double other[{len(program.home)}]; memcpy(other, state, sizeof other);" if follows else ""
    turned = "for (int k = 0; k < 9; ++k) off = fmax(off, 0.01 * fabs(R2[k] - R[k]));" if program.rank == 6 else ""
    check = (
        f"            double p2[3], R2[9]; {again}\n            if (!kin_fk({'other, ' if follows else ''}q, p2, R2)) {{\n"
        f"                for (int k = 0; k < 3; ++k) off = fmax(off, fabs(p2[k] - p[k]));\n                {turned}\n"
        "            }"
    )
    return Call(
        f"kin_ik({'state, ' if searches else ''}p, R, q)",
        {
            "p": Inputs(place, 0.02, place - 1.5, place + 1.5),
            "R": Inputs(R, 1e-6, R - 1, R + 1, rotation=True),
        },
        {"q": (np.maximum(robot.lower, -MAX_NUMBER) - 1e-8, np.minimum(robot.upper, MAX_NUMBER) + 1e-8)},
        size,
        begin="kin_start(state);" if searches else "",
        prepare=prepare,
        check=check if follows == searches else "",  # from home, fk may end in another assembly mode than ik takes
    )


def build_sway(dt: float = DT) -> StateSpace:
    """Return a tool that sways at 11 Hz behind the actuators, one axis."""
    w = 2 * np.pi * 11 * dt
    A = 0.98 * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    B, C = np.array([[0.05], [0.0]]), np.array([[1.0, 0.0]])
    gain = C @ np.linalg.solve(np.eye(2) - A, B)
    return StateSpace(A, B / gain, C, np.zeros((1, 1)), np.zeros((2, 1)), dt, 0)


def fuzz_filter(kind: str, folder: Path, calls: int, seed: int = 1) -> list[int]:
    """Return the counts of statuses of an observer or of a learning filter, one of `FILTERS`."""
    n = N_TRIAL
    one, whole = ({"place": _spread(0.4, 0.1, k), "felt": _spread(0.0, 5.0, k)} for k in (1, n))
    sized = _allow(np.full(n, MAX_NUMBER))
    if kind in ("causal", "kalman"):
        observer = KalmanToolObserver(build_sway(), 1e-10, 0.01)
        causal = ComplementaryToolObserver((4.5,), DT, causal=True)
        sources = write_observer_source(observer if kind == "kalman" else causal, "obs")
        size = int(sources[1].partition("_STATE ")[2].split()[0])
        z, begin = _allow(np.full(1, MAX_NUMBER)), "obs_start(state, place_near);"
        call = Call("obs_step(state, place, felt, z)", one, {"z": z}, size, begin=begin)
    elif kind == "trial":
        sources = write_observer_source(ComplementaryToolObserver((4.5,), DT), "obs")
        call = Call(f"obs_trial({n}, place, felt, z, state)", whole, {"z": sized}, 2 * n, kept=0)
    else:
        law = LearningLaw(MotorSide(build_sway()), (design_low_pass(10, DT),), TimeShift(1.2, 2, DT))
        sources = write_learning_source(law, 0.05, "obs")
        begin = f"for (int k = 0; k < {n}; ++k) state[k] = 0.0;"
        weight, error = Inputs(np.ones(n), 0.0, np.zeros(n), np.ones(n)), _spread(0.0, 0.05, n)
        update = f"obs_update({n}, weight, error, state, state + {n})"
        copy = "        for (int k = 0; k < KEPT; ++k) state[k] = error[k];"
        call = {
            "update": Call(update, {"weight": weight, "error": error}, {}, 2 * n, kept=n, begin=begin),
            "l": Call(f"obs_l({n}, error, out)", {"error": error}, {"out": sized}),
            "q": Call(f"obs_q(0, {n}, state)", {"error": error}, {}, n, prepare=copy),
        }[kind]
    return count_statuses(sources, "obs", call, folder, calls, seed)


def _spread(near: float, spread: float, n: int) -> Inputs:
    return Inputs(np.full(n, near), spread, np.full(n, near - 1e3), np.full(n, near + 1e3))


def fuzz_lead_through(task: str, folder: Path, calls: int, seed: int = 1) -> list[int]:
    """Return the counts of statuses of a lead-through controller for a task; velocities stay within their limits."""
    more = {"turning_stiffness": 50.0, "locked_axis": np.array([0.0, 0.0, 1.0]), "press": 0.0} if task == "peg" else {}
    gain = np.repeat([0.005, 1.0], 3) if task == "peg" else 0.005
    sensor = ForceSensor(position=np.array([0, 0, -0.1]), mass=1.0, centre=np.array([0, 0, 0.05]))
    settings = LeadThroughSettings(20e3, force_gain=gain, task=task, tool_sensor=sensor, **more)
    sources = write_lead_through_source(LeadThrough(settings).list_numbers())
    reach = np.repeat([60.0, 5.0], 3)
    inputs = {
        "handle": Inputs(np.zeros(6), 5.0, -reach, reach),
        "tool": Inputs(np.zeros(6), 3.0, -reach, reach),
        "place": Inputs(np.zeros(3), 0.01, -np.ones(3), np.ones(3)),
        "R": Inputs(np.eye(3).ravel(), 1e-6, np.eye(3).ravel() - 1, np.eye(3).ravel() + 1, rotation=True),
    }
    fastest = np.repeat([settings.speed_limit, settings.turning_limit], 3) * (1 + 1e-12)
    size = int(sources[1].partition("_STATE ")[2].split()[0])
    call = Call(
        "lead_step(state, handle, tool, place, R, velocity)", inputs, {"velocity": _allow(fastest)}, size, kept=0,
        begin="lead_start(state);", stops=True,
    )  # fmt: skip
    return count_statuses(sources, "lead", call, folder, calls, seed)


_FMU_DRIVER = """
#include <stdint.h>
#include <stdio.h>
#include "fmu.c"
@CHANCE@
static double either(double calm, double share) { return chance() < share ? odd() : calm; }
int main(int count, char **given)
{
    const long calls = count > 1 ? atol(given[1]) : 1;
    long counts[2] = {0};
    seed = count > 2 ? (uint64_t)atol(given[2]) : 1;
    Component c = NULL;
    for (long i = 0; i < calls; ++i) {
        double x[3 * NA + 3], old[3 * NA + 3];
        Reference r[3 * NA + 3];
        for (unsigned k = 0; k < 3 * NA + NTOOL; ++k) r[k] = k;
        if (i % 40 == 0) {
            if (c) fmi2FreeInstance(c);
            c = fmi2Instantiate("one", 1, GUID, "", NULL, 0, 0);
            if (!c) return 1;
            for (int k = 0; k < 3; ++k) if (chance() < 0.1) {
                const Reference place = (Reference)(FIRST_T + chance() * (REFERENCES - FIRST_T));
                const double value = odd();
                if (place != STEP || !(value < 1e-4)) fmi2SetReal(c, &place, 1, &value);
            }
            fmi2EnterInitializationMode(c);
            fmi2ExitInitializationMode(c);
        }
        for (unsigned k = 0; k < NA; ++k) {
            const double force = either((i % 3 ? 20.0 : 5000.0) * (chance() - 0.5), 0.1);
            fmi2SetReal(c, &k, 1, &force);
        }
        const Status was = fmi2GetReal(c, r, 3 * NA, old);
        double length = chance() < 0.05 ? odd() * 1e-3 : 1e-3;
        if (length > 0.1 && length < 1e6) length = 0.1;
        const Status status = fmi2DoStep(c, 0.0, length, 1);
        ++counts[status != OK];
        const Status is = fmi2GetReal(c, r, 3 * NA + NTOOL, x);
        for (unsigned k = 0; k < 3 * NA + NTOOL; ++k)
            if (is == OK && !(fabs(x[k]) <= @MOST@)) { printf("call %ld: x[%u] = %g", i, k, x[k]); return 1; }
        const Status moved = fmi2GetReal(c, r, 3 * NA, x); /* also where the tool's place is none */
        for (unsigned k = NA; k < 3 * NA && status != OK && was == OK; ++k)
            if (moved != OK || x[k] != old[k]) { printf("call %ld: an error moves x[%u]", i, k); return 1; }
    }
    fmi2FreeInstance(c);
    printf("%ld %ld", counts[0], counts[1]);
    return 0;
}
"""


def fuzz_fmu(model: Model, folder: Path, calls: int, seed: int = 1) -> list[int]:
    """Return how often a step of an FMU succeeded and how often it ended in an error."""
    model = model.only(e for e in model.effects if "temperature" not in e.needs)
    (folder / "fmu.c").write_text(write_fmu_source(build_equations(model), "{}", "a robot"))
    (folder / "driver.c").write_text(fill_chance(_FMU_DRIVER))
    return run_sanitized([folder / "driver.c"], folder / "driver", calls, seed)
