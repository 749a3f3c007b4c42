"""What a call of the exported C feedforward costs, beside Pinocchio's own RNEA in C++ on the same tree.

In: nothing but the robots that come along. The feedforward of each (asymmetric friction) is exported and compiled; a driver
calls it in a loop over 1000 states, and Pinocchio's `rnea` over as many states of the whole tree, both by the same compiler with
the same flags, best of `--repeats` rounds. Pinocchio's headers come with its wheel; Eigen's are looked for in `--eigen`, in
/usr/include/eigen3 and in $CONDA_PREFIX (`pip download cmeel-eigen` has them). Without Eigen or a C++ compiler, `pin.rnea` called
from Python stands in, less the cost of a call that does next to nothing, and the table says so.

`Feedforward(model, compiled=True)` is called from Python at the same states, one a call, best of `--repeats` rounds.

Prints a table: robot, ns a call of C, ns a call of rnea, their ratio, largest difference between C and Python, and us a call of
the compiled feedforward from Python with its ratio to the bare call of C.

    python experiments/benchmarks/feedforward_c.py [--eigen DIR] [--repeats 20] [--seed 0]
"""

from __future__ import annotations

import argparse
import ctypes
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.codegen import Program, build_program, draw_random_states, write_c_source
from tau_dyn.control import Feedforward
from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot

STATES = 1000
FLAGS = ("-O3", "-DNDEBUG")
ROBOTS = {"gantry_tau, closed form": {}, "gantry_tau, 1-2-3 rods": {"arms": "complete"}, "linear_axis": None}

DRIVER = """
#include <time.h>
#include "tau_ff.h"
double bench(int n, int rounds, const double *q, const double *v, const double *a, double *tau @START@)
{
    struct timespec t0, t1;
    double best = 1e30;
    for (int r = 0; r < rounds; ++r) {
        clock_gettime(CLOCK_MONOTONIC, &t0);
        for (int k = 0; k < n; ++k) tau_ff(@STATE@ q + k * TAU_FF_JOINTS, v + k * TAU_FF_JOINTS, a + k * TAU_FF_JOINTS,
                                           tau + k * TAU_FF_JOINTS);
        clock_gettime(CLOCK_MONOTONIC, &t1);
        const double s = (t1.tv_sec - t0.tv_sec) * 1e9 + (t1.tv_nsec - t0.tv_nsec);
        if (s < best) best = s;
    }
    return best / n;
}
"""

RNEA = """
#include <chrono>
#include <cstdio>
#include <vector>
#if __has_include("pinocchio/multibody.hpp")
#include "pinocchio/multibody.hpp"
#else
#include "pinocchio/multibody/model.hpp"
#include "pinocchio/multibody/data.hpp"
#endif
#include "pinocchio/algorithm/rnea.hpp"
#include "pinocchio/algorithm/joint-configuration.hpp"
using namespace pinocchio;
int main(int, char **argv)
{
    Model model;
    @JOINTS@
    Data data(model);
    const int n = 1000, rounds = std::atoi(argv[1]);
    std::vector<Eigen::VectorXd> q, v, a;
    for (int k = 0; k < n; ++k) {
        q.push_back(neutral(model) + 0.1 * Eigen::VectorXd::Random(model.nq));
        v.push_back(Eigen::VectorXd::Random(model.nv));
        a.push_back(Eigen::VectorXd::Random(model.nv));
    }
    double best = 1e30, sum = 0;
    for (int r = 0; r < rounds; ++r) {
        const auto t0 = std::chrono::steady_clock::now();
        for (int k = 0; k < n; ++k) sum += rnea(model, data, q[k], v[k], a[k])[0];
        const double s = std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - t0).count();
        if (s < best) best = s;
    }
    std::printf("%.1f %d %g\\n", best / n, model.nv, sum);
}
"""


def main(argv: list[str] | None = None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--eigen", type=Path, help="folder that holds Eigen/")
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    if shutil.which("cc") is None:
        sys.exit("there is no C compiler (cc) here")
    with tempfile.TemporaryDirectory() as folder:
        rows, how = measured(Path(folder), args.repeats, args.seed, args.eigen)
    print(
        f"machine: {platform.processor() or platform.machine()}, {_compiler()}, {' '.join(FLAGS)}; Pinocchio {pin.__version__}"
    )
    print(
        f"rnea: {how}\n\n{'robot':28s} {'C [ns]':>8s} {'rnea [ns]':>10s} {'C / rnea':>9s} {'difference':>11s} "
        f"{'Python [us]':>12s} {'Python / C':>11s}"
    )
    for name, own, theirs, difference, python in rows:
        print(f"{name:28s} {own:8.0f} {theirs:10.0f} {own / theirs:9.2f} {difference:11.1e} {python / 1e3:12.2f} "
              f"{python / own:11.1f}")  # fmt: skip


def measured(
    folder: Path, repeats: int, seed: int, eigen: Path | None
) -> tuple[list[tuple[str, float, float, float, float]], str]:
    """Return name, cost of C, cost of rnea [ns], largest relative difference and cost from Python [ns] of each robot.

    And how rnea was called.
    """
    rows, how = [], "C++ from the wheel's headers, over the whole tree"
    for k, (name, arguments) in enumerate(ROBOTS.items()):
        robot = load_robot("linear_axis") if arguments is None else load_robot("gantry_tau", **arguments)
        plain = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
        sizes = np.random.default_rng(seed).uniform(20, 120, len(plain.effect_parameters))
        model = plain.with_values(dict(zip(plain.effect_parameters.names, sizes, strict=True)))
        own, difference = _own(build_program(Feedforward(model)), folder / str(k), repeats, seed)
        theirs = _theirs_cpp(robot, folder / str(k), repeats, eigen)
        if theirs is None:
            theirs, how = (
                _theirs_python(robot, repeats, seed),
                "from Python, less an empty call (no Eigen or C++ compiler)",
            )
        rows.append((name, own, theirs, difference, _from_python(model, repeats, seed)))
    return rows, how


def _own(program: Program, folder: Path, repeats: int, seed: int) -> tuple[float, float]:
    """Compile the feedforward and call it in a loop of C; return ns a call and the largest difference from Python."""
    folder.mkdir()
    source, header = write_c_source(program)
    looped = program.loops is not None
    driver = DRIVER.replace("@START@", ", double *start" if looped else "").replace(
        "@STATE@", "start," if looped else ""
    )
    for name, text in (("tau_ff.c", source), ("tau_ff.h", header), ("driver.c", driver)):
        (folder / name).write_text(text)
    library = folder / "bench.so"
    names = [str(folder / name) for name in ("tau_ff.c", "driver.c")]
    subprocess.run(["cc", "-std=gnu99", *FLAGS, "-shared", "-fPIC", "-o", str(library), *names, "-lm"], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.bench.restype = ctypes.c_double
    model = program.feedforward.model
    q, v, a = _smooth(model, seed) if looped else draw_random_states(model, STATES, np.random.default_rng(seed))
    tau = np.zeros_like(q)
    arrays = [np.ascontiguousarray(x) for x in (q, v, a, tau)]
    start = np.zeros(model.robot.na + len(program.loops.passive)) if program.loops is not None else np.zeros(1)
    if looped:
        loaded.tau_ff_start(_pointer(start))
        arrays.append(start)
    cost = loaded.bench(len(q), repeats, *(_pointer(x) for x in arrays))
    expected = program.feedforward(q, v, a)
    within = np.all(np.abs(expected) <= model.robot.effort_limit, axis=1)  # beyond it the function keeps the last force
    return float(cost), float(np.abs(arrays[3] - expected)[within].max() / np.abs(expected).max())


def _from_python(model: Model, repeats: int, seed: int) -> float:
    """Return ns a call of the compiled feedforward from Python, one state a call; NaN where it cannot be compiled."""
    feedforward = Feedforward(model, compiled=True)
    if feedforward.compiled is None:
        return float("nan")
    states = [tuple(np.ascontiguousarray(x) for x in state) for state in zip(*_smooth(model, seed), strict=True)]
    best = float("inf")
    for _ in range(repeats):
        t = time.perf_counter()
        for state in states:
            feedforward(*state)
        best = min(best, (time.perf_counter() - t) / len(states))
    return 1e9 * best


def _smooth(model: Model, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (1000, na) along a motion at 1 kHz that ends where it starts, as a controller meets them."""
    s = 2 * np.pi * np.arange(STATES)[:, None] / STATES + np.random.default_rng(seed).uniform(0, 6, model.robot.na)
    return model.robot.home + 0.05 * np.sin(s), 0.05 * 2 * np.pi * np.cos(s), -0.05 * (2 * np.pi) ** 2 * np.sin(s)


def _pointer(x: np.ndarray):
    return x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _theirs_cpp(robot: Robot, folder: Path, repeats: int, eigen: Path | None) -> float | None:
    """Return ns a call of Pinocchio's rnea in a loop of C++; None where headers or a compiler are missing."""
    prefix = Path(pin.__file__).parents[4]
    places = [eigen, Path("/usr/include/eigen3"), Path(os.environ.get("CONDA_PREFIX", "/")) / "include/eigen3"]
    found = next((p for p in places if p is not None and (p / "Eigen").is_dir()), None)
    if shutil.which("c++") is None or found is None or not (prefix / "include/pinocchio").is_dir():
        return None
    # the library's own compiled rnea, as the wheel ships it, not a second one from templates
    source, out, lib = folder / "rnea.cpp", folder / "rnea", prefix / "lib"
    source.write_text(
        RNEA.replace("@JOINTS@", "\n    ".join(_joint_text(robot.model, j) for j in range(1, robot.model.njoints)))
    )
    limits = [f"-DBOOST_{x}" for x in ("MPL_LIMIT_LIST_SIZE=30", "MPL_LIMIT_VECTOR_SIZE=30",
              "MPL_CFG_NO_PREPROCESSED_HEADERS", "FUSION_INVOKE_MAX_ARITY=12")]  # fmt: skip
    links = [f"-L{lib}", f"-Wl,-rpath,{lib}", f"-Wl,-rpath-link,{lib}", "-lpinocchio_default"]
    command = [
        "c++",
        "-std=c++17",
        *FLAGS,
        *limits,
        f"-I{prefix / 'include'}",
        f"-I{found}",
        "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION",
        str(source),
        "-o",
        str(out),
        *links,
    ]
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode:
        print(f"the C++ loop did not compile: {made.stderr.strip().splitlines()[:3]}", file=sys.stderr)
        return None
    return float(subprocess.run([str(out), str(repeats)], capture_output=True, text=True, check=True).stdout.split()[0])


def _joint_text(model: pin.Model, j: int) -> str:
    """Return C++ that adds one joint of a model and its link to another."""
    place, pi = model.jointPlacements[j], model.inertias[j].toDynamicParameters()
    number = lambda values: ", ".join(repr(float(x)) for x in np.ravel(values))  # noqa: E731
    kind = model.joints[j].shortname()
    return (
        f"{{ Eigen::Matrix3d R; R << {number(place.rotation)}; Eigen::VectorXd pi(10); pi << {number(pi)};"
        f" const SE3 place(R, Eigen::Vector3d({number(place.translation)}));"
        f' const auto j = model.addJoint({model.parents[j]}, {kind}(), place, "j{j}");'
        f" model.appendBodyToJoint(j, Inertia::FromDynamicParameters(pi), SE3::Identity()); }}"
    )


def _theirs_python(robot: Robot, repeats: int, seed: int) -> float:
    model, rng = robot.model, np.random.default_rng(seed)
    data, q = model.createData(), pin.neutral(model)
    v, a = rng.standard_normal((2, model.nv))
    calls = (lambda: pin.rnea(model, data, q, v, a), lambda: model.getJointId("universe"))
    best = []
    for call in calls:
        times = []
        for _ in range(repeats):
            t = time.perf_counter()
            for _ in range(STATES):
                call()
            times.append((time.perf_counter() - t) / STATES)
        best.append(min(times))
    return 1e9 * (best[0] - best[1])


def _compiler() -> str:
    return subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]


if __name__ == "__main__":
    main()
