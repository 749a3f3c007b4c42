"""At the edges of what can be measured: the right answer, or a refusal that says what to do; never a wrong mass believed."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import Identification, build_model, identify
from tau_dyn.log import Log
from tau_dyn.mechanism import LoopSolver
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf
from tau_dyn.simulate import Trajectory, build_named_motion

FRICTION = {"coulomb_pos": 20.0, "coulomb_neg": 16.0, "viscous_pos": 120.0, "viscous_neg": 100.0}


def truth_of(robot: Robot, size: float = 1.0) -> Model:
    values = {f"{j}.{k}": size * x for j in robot.actuated for k, x in FRICTION.items()}
    return build_model(robot, "asymmetric").with_values(values)


def recorded(
    truth: Model, path: Trajectory, force: float | Sequence[float] = 2.0, encoder: float = 5e-6, seed: int = 0
) -> Log:
    """Return the log of a robot that follows a motion exactly, with white noise."""
    rng = np.random.default_rng([8, seed])
    tau = truth.torque(path.q, path.v, path.a) + np.asarray(force) * rng.normal(size=path.q.shape)
    q = path.q + encoder * rng.normal(size=path.q.shape)
    columns = {f"{s}_{j}": x[:, k] for s, x in (("q", q), ("tau", tau)) for k, j in enumerate(path.joints)}
    return Log(path.t, columns, "edge.csv")


def off(found: Identification, truth: Model) -> np.ndarray:
    """Return how far base parameters are from the truth, in their standard errors (r,)."""
    base = found.estimate.base
    return (found.estimate.beta - base.combine(truth.parameters.select(base.names).values)) / found.estimate.stderr


def strict(found: Identification) -> None:
    """Check that the result is strict JSON with every standard error a finite number above zero, or none."""
    rows = json.loads(json.dumps(found.to_dict(), allow_nan=False))["base_parameters"]
    assert all(row["stderr"] is None or row["stderr"] > 0 for row in rows)


@pytest.fixture(scope="module")
def axis() -> Robot:
    """One drive of 95 kg on a guideway."""
    return load_robot("linear_axis")


@pytest.fixture(scope="module")
def truth(axis) -> Model:
    return truth_of(axis)


@pytest.fixture(scope="module")
def motion(truth) -> Trajectory:
    return build_named_motion("fourier", truth, 15.0, 0)


@pytest.fixture(scope="module")
def log(truth, motion) -> Log:
    return recorded(truth, motion.every(5))


def test_without_friction_none_is_found(axis, motion) -> None:
    """Zero friction is zero within its errors, or held at zero; the mass is right; that it is not determined is said."""
    rigid = build_model(axis, "asymmetric")
    found = identify(axis, recorded(rigid, motion.every(5)))
    strict(found)
    assert np.abs(off(found, rigid)).max() < 4
    assert any("poorly determined" in sentence for sentence in found.warnings)


def test_without_noise_the_truth_is_found(axis, truth, motion) -> None:
    """Perfect sensors: 1e-4, which is what filters and differences make of a sharp friction; errors stay finite and small."""
    found = identify(axis, recorded(truth, motion.every(5), force=0.0, encoder=0.0))
    strict(found)
    for row in found.base_rows():
        assert_allclose(row["value"], truth.parameters[row["name"]].value, rtol=1e-3)
        assert row["stderr"] < 1e-3 * row["value"]


@pytest.mark.parametrize("seconds", [5.0])
def test_ten_kilohertz(axis, truth, seconds: float) -> None:
    """Differences of positions 0.1 ms apart are all noise; the filters see to that."""
    found = identify(axis, recorded(truth, build_named_motion("fourier", truth, seconds, 1).resampled(10_000.0)))
    strict(found)
    assert np.abs(off(found, truth)).max() < 4


def test_ten_hertz(axis, truth) -> None:
    """A logger of 10 Hz sees a slow motion, or says that it does not."""
    path = build_named_motion("fourier", truth, 60.0, 0)
    with raises_code("poor_excitation"):
        identify(axis, recorded(truth, path.every(100)))
    t = np.arange(0, 200, 0.1)
    w = 2 * np.pi * 0.11
    q = 0.3 * np.sin(w * t)
    slow = Trajectory(("axis",), t, q[:, None], (0.3 * w * np.cos(w * t))[:, None], (-(w**2) * q)[:, None])
    found = identify(axis, recorded(truth, slow, force=1.0))
    strict(found)
    assert np.abs(off(found, truth)).max() < 4


def test_a_hundred_samples(axis, truth) -> None:
    """Two seconds at 50 Hz: an answer whose errors hold the truth, or a refusal that names what is missing."""
    path = build_named_motion("fourier", truth, 6.0, 2)
    few = recorded(truth, path, force=1.0).window(1000, 3000)
    t, channels = few.t[::20], {k: x[::20] for k, x in few.channels.items()}
    assert len(t) == 100
    try:
        found = identify(axis, Log(t, channels, "few.csv"))
    except CannotAnswer as refusal:
        assert "record" in str(refusal) or "move" in str(refusal)
        return
    strict(found)
    assert np.abs(off(found, truth)).max() < 5


def still(path: Trajectory, *joints: int) -> Trajectory:
    """Return a motion in which some joints rest where they start."""
    rest = np.isin(np.arange(len(path.joints)), joints)
    return replace(
        path, q=np.where(rest, path.q[0], path.q), v=np.where(rest, 0.0, path.v), a=np.where(rest, 0.0, path.a)
    )


@pytest.mark.parametrize("silent", [False, True], ids=["noisy", "to the last bit"])
def test_one_joint_stands_still(two_link, silent: bool) -> None:
    """What the others show is found; the friction of the one that rests is not, and keeps its nominal value."""
    truth = truth_of(two_link, 0.02)
    path = still(build_named_motion("fourier", truth, 12.0, 1), 1)
    log = recorded(truth, path.every(5), force=0.1)
    if silent:
        log = Log(
            log.t, {**log.channels, "q_elbow": path.every(5).q[:, 1], "tau_elbow": np.zeros(log.n_samples)}, "edge.csv"
        )
    found = identify(two_link, log)
    strict(found)
    rows = {row["name"]: row for row in found.rows()}
    for name in ("coulomb_pos", "coulomb_neg", "viscous_pos", "viscous_neg"):
        assert (
            abs(rows[f"shoulder.{name}"]["value"] - truth.parameters[f"shoulder.{name}"].value)
            < 5 * rows[f"shoulder.{name}"]["stderr"]
        )
        assert rows[f"elbow.{name}"]["stderr"] is None
    assert any("not excited" in s and "elbow.coulomb_pos" in s and "shoulder.c" not in s for s in found.warnings)


def test_columns_that_hardly_differ(two_link) -> None:
    """Joints that move in step hide who does what: errors grow until they hold the truth, and the condition is said."""
    truth = truth_of(two_link, 0.02)
    path = build_named_motion("fourier", truth, 12.0, 1)
    step = replace(
        path, q=path.q[:, [0, 0]] * [1, -0.5], v=path.v[:, [0, 0]] * [1, -0.5], a=path.a[:, [0, 0]] * [1, -0.5]
    )
    found = identify(two_link, recorded(truth, step.every(5), force=0.1))
    strict(found)
    assert np.abs(off(found, truth)).max() < 4
    assert any("ill-conditioned" in s or "correlated" in s for s in found.warnings)
    free = identify(two_link, recorded(truth, path.every(5), force=0.1))
    shared = set(found.estimate.base.names[k] for k in found.estimate.base.kept)
    ratio = [r["stderr"] / s["stderr"] for r in found.base_rows() for s in free.base_rows() if r["name"] == s["name"]]
    assert shared and max(ratio) > 5


def test_masses_six_orders_apart() -> None:
    """A cart of a tonne that carries a pendulum of a gram: the light one's errors are honest, the heavy one's are small."""
    text = (
        '<robot name="odd"><link name="base_link"/><link name="cart_link"><inertial><mass value="1000"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<link name="bob_link"><inertial><origin xyz="0 0 -0.2"/><mass value="0.001"/>'
        '<inertia ixx="1e-7" iyy="1e-7" izz="1e-7" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="cart" type="prismatic"><parent link="base_link"/><child link="cart_link"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" velocity="2" effort="20000"/></joint><joint name="swing" type="revolute">'
        '<parent link="cart_link"/><child link="bob_link"/><axis xyz="0 1 0"/>'
        '<limit lower="-1.5" upper="1.5" velocity="5" effort="1"/></joint>'
        '<transmission name="a"><joint name="cart"/></transmission>'
        '<transmission name="b"><joint name="swing"/></transmission></robot>'
    )
    robot = load_robot_from_urdf(text, "odd")
    sizes = {"cart": 1.0, "swing": 1e-6}
    truth = build_model(robot, "asymmetric").with_values(
        {f"{j}.{k}": s * x for j, s in sizes.items() for k, x in FRICTION.items()}
    )
    log = recorded(truth, build_named_motion("fourier", truth, 15.0, 1).every(5), force=(2.0, 2e-5), encoder=1e-6)
    found = identify(robot, log)
    strict(found)
    assert np.abs(off(found, truth)).max() < 4.5
    value = {row["name"]: row["value"] for row in found.base_rows()}
    assert_allclose(next(x for name, x in value.items() if name == "cart_link.mass"), 1000, rtol=1e-3)
    assert_allclose(-next(x for name, x in value.items() if name == "bob_link.mz"), 2e-4, rtol=0.05)


@pytest.mark.parametrize("factor", [1e-6, 1e4])
def test_a_robot_file_of_placeholders(two_link, factor: float) -> None:
    """A file whose masses are off by orders of magnitude does not pull the answer; units are doubted."""
    truth = truth_of(two_link, 0.02)
    log = recorded(truth, build_named_motion("fourier", truth, 12.0, 1).every(5), force=0.1)
    text = re.sub(r'(mass value|i[xyz]{2})="([^"]*)"', lambda m: f'{m[1]}="{factor * float(m[2])!r}"', two_link.urdf)
    found = identify(load_robot_from_urdf(text, "placeholders"), log)
    strict(found)
    assert np.abs(off(found, truth)).max() < 4
    assert any("times those of the robot file" in sentence for sentence in found.warnings)
    assert not any("times those of the robot file" in sentence for sentence in identify(two_link, log).warnings)


def changed(log: Log, *, t: np.ndarray | None = None, **channels: np.ndarray) -> Log:
    return Log(log.t if t is None else t, {**log.channels, **channels}, log.name)


def test_a_force_that_never_changes(axis, log) -> None:
    """A constant is no measurement of a force that moves a mass to and fro."""
    with raises_code("poor_excitation"):
        identify(axis, changed(log, tau_axis=np.full(log.n_samples, 3.0)))


@pytest.mark.parametrize("force", [True, False])
def test_samples_all_alike(axis, log, force: bool) -> None:
    """A robot that stands still shows neither mass nor friction."""
    channels = {"q_axis": np.full(log.n_samples, 0.3)} | ({"tau_axis": np.full(log.n_samples, 1.0)} if force else {})
    with raises_code("poor_excitation"):
        identify(axis, changed(log, **channels))


@pytest.mark.parametrize("n", [2, 3, 9])
def test_hardly_any_samples(axis, log, n: int) -> None:
    """Two samples are said to be two."""
    with raises_code("too_little_data", "edge.csv", f"{n}", "10"):
        identify(axis, log.window(0, n))


def test_two_samples_in_a_file(tmp_path: Path, capsys) -> None:
    """The command line says so as well, with status 2 and nothing written."""
    (tmp_path / "two.csv").write_text("t,q_axis,tau_axis\n0,0,1\n0.1,0.2,3\n")
    assert main(["identify", "linear_axis", str(tmp_path / "two.csv"), "--json", str(tmp_path / "r.json")]) == 2
    assert "2 sample" in capsys.readouterr().err and not (tmp_path / "r.json").exists()


def test_milliseconds_by_mistake(axis, truth, log) -> None:
    """A clock in ms makes 200 Hz 0.2 Hz, which is refused; one of 10 kHz passes for 10 Hz, and its mass is doubted."""
    with raises_code("wrong_unit", "0.2"):
        identify(axis, changed(log, t=1e3 * log.t))
    fast = recorded(truth, build_named_motion("fourier", truth, 4.0, 0).resampled(10_000.0), force=0.0, encoder=0.0)
    found = identify(axis, changed(fast, t=1e3 * fast.t))
    assert any("about 1e+06 times those of the robot file" in s and "units of t" in s for s in found.warnings)


@pytest.mark.parametrize("origin", [1e9, 1.7e9, -1e9])
def test_a_clock_that_counts_from_1970(axis, log, origin: float) -> None:
    """At 1e9 s a stamp holds 1e-7 s, 2e-5 of a step: less than a hundredth of a standard error."""
    before, after = identify(axis, log), identify(axis, changed(log, t=log.t + origin))
    moved = (after.estimate.beta - before.estimate.beta) / before.estimate.stderr
    assert np.abs(moved).max() < 0.01
    assert_allclose(after.estimate.stderr, before.estimate.stderr, rtol=0.01)


@pytest.fixture(scope="module", params=["simplified", "complete"])
def gantry(request) -> Robot:
    """L1, whose plate cannot follow when its carts drive apart."""
    return load_robot("gantry_tau", prototype="l1", arms=request.param)


def test_into_a_singularity(gantry) -> None:
    """Carts driven apart: forces stay finite and the condition grows up to the border, which is warned of; beyond, a sentence."""
    model, solver = build_model(gantry, "rigid"), LoopSolver(gantry)
    apart = np.array([1.0, 0.0, -1.0])
    inside, outside = 0.0, 3.0
    for _ in range(40):  # the border, to rounding
        middle = 0.5 * (inside + outside)
        inside, outside = (
            (middle, outside) if model.mechanism.reachable(gantry.home + middle * apart) else (inside, middle)
        )
    assert 0.2 < inside < 3.0
    shares = inside * np.array([0.0, 0.5, 0.9, 0.99, 0.999])
    q = gantry.home + shares[:, None] * apart
    tau = model.torque(q, np.zeros(q.shape), np.zeros(q.shape))
    assert np.isfinite(tau).all()
    condition = model.mechanism.condition(q)
    assert np.isfinite(condition).all() and condition[-1] > 3 * condition[0]
    with raises_code("loop_not_closed", "cart1"):
        solver.close(gantry.home + 1.2 * outside * apart)
    with raises_code("loop_not_closed"):
        model.torque(gantry.home[None] + 1.2 * outside * apart, np.zeros((1, 3)), np.zeros((1, 3)))


def test_at_a_dead_centre(write) -> None:
    """A four-bar driven at its rocker cannot pass where crank and coupler are in line: near it a warning, beyond it a refusal."""
    robot = load_robot_from_urdf(write.four_bar(driven="rocker"), "four_bar")
    model = build_model(robot, "rigid")
    inside, outside = 0.0, 2.5
    for _ in range(50):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if model.mechanism.reachable(robot.home + middle) else (inside, middle)
    assert 0.1 < inside < 2.4
    near = robot.home + np.array([[0.0], [inside * (1 - 1e-8)]])
    assert model.mechanism.singularity_warnings(near[:1]) == ()
    said = model.mechanism.singularity_warnings(near)
    assert len(said) == 1 and "near a singularity at rocker = " in said[0]
    with raises_code("loop_not_closed", "rocker"):
        model.torque(robot.home[None] + outside + 0.1, np.zeros((1, 1)), np.zeros((1, 1)))
