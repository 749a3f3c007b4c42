"""Robots, logs and what is compared: identifications by parameter name, robots in a mirror, worlds turned about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.identify import Identification, build_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf
from tau_dyn.simulate import Trajectory, build_named_motion

FRICTION = {"coulomb_pos": 1.0, "coulomb_neg": 0.8, "viscous_pos": 0.6, "viscous_neg": 0.5}
MIRROR = np.diag([1.0, -1.0, 1.0])
ODD = ("my", "ixy", "iyz")
"""Inertial numbers that change their sign in a mirror whose plane is y = 0."""


def elbow_text() -> str:
    """Return a 3R arm without any symmetry: axes along z, y and a slanted one, centres beside all planes."""
    rows = (
        ("0 0 0.3", "0.1 0.2 0.3", "0 0 1", 6, "0.02 0.03 -0.05", "0.08 0.07 0.05", 0.004),
        ("0.05 0.08 0.1", "-0.2 0.1 0.4", "0 1 0", 4, "0.15 -0.04 0.02", "0.02 0.06 0.05", 0.003),
        ("0.35 -0.06 0.04", "0.3 -0.1 -0.2", "0.6 0.64 0.48", 2, "0.1 0.05 -0.03", "0.008 0.012 0.011", 0.001),
    )
    parts, parent = ['<robot name="elbow"><link name="base_link"/>'], "base_link"
    for k, (xyz, rpy, axis, mass, centre, inertia, product) in enumerate(rows, 1):
        ixx, iyy, izz = inertia.split()
        parts.append(
            f'<link name="l{k}_link"><inertial><origin xyz="{centre}" rpy="0.3 0.2 0.1"/><mass value="{mass}"/>'
            f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="{product}" ixz="{product / 2}" iyz="{-product / 3}"/></inertial>'
            f'</link><joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}_link"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            '<limit lower="-1.5" upper="1.5" velocity="3" effort="200"/></joint>'
            f'<transmission name="t{k}"><joint name="j{k}"/></transmission>'
        )
        parent = f"l{k}_link"
    return "".join([*parts, "</robot>"])


def mirrored_text(urdf: str) -> str:
    """Return a robot as a mirror in the plane y = 0 shows it, moving by the same joint positions.

    With M = diag(1, -1, 1): points and slides map as vectors, M x; a turn about `a` is seen as one about -M a, as rotation is a
    pseudovector; a frame R is seen as M R M; products of inertia with one y change their sign.
    """
    root = ElementTree.fromstring(urdf)
    parents = {child: parent for parent in root.iter() for child in parent}
    for element in root.iter():
        for key in ("xyz", "value", "origin", "direction"):
            text = element.get(key, "").split()
            if len(text) == 3:
                slides = element.tag != "axis" or parents[element].get("type") == "prismatic"
                element.set(key, numbers((MIRROR if slides else -MIRROR) @ np.array(text, float)))
        if element.get("rpy"):
            roll, pitch, yaw = map(float, element.get("rpy", "").split())
            element.set("rpy", numbers([-roll, pitch, -yaw]))
        if element.tag == "inertia":
            for key in ("ixy", "iyz"):
                element.set(key, repr(-float(element.get(key, "0"))))
    return ElementTree.tostring(root, encoding="unicode")


def numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in values)


def turned(robot: Robot, turn: Rotation) -> Robot:
    """Return the robot bolted to a world that is turned about, gravity and all."""
    root = ElementTree.fromstring(robot.urdf)
    links = {e.get("name", "") for e in root.findall("link")}
    base = next(iter(links - {e.find("child").get("link") for e in root.findall("joint")}))  # type: ignore[union-attr]
    root.append(ElementTree.Element("link", name="ground_link"))
    joint = ElementTree.SubElement(root, "joint", name="bolts", type="fixed")
    ElementTree.SubElement(joint, "parent", link="ground_link")
    ElementTree.SubElement(joint, "child", link=base)
    ElementTree.SubElement(joint, "origin", xyz="0 0 0", rpy=numbers(turn.as_euler("xyz")))
    for arm in root.iter("{urn:tau_dyn}arm"):
        for key in ("origin", "direction"):
            arm.set(key, numbers(turn.apply(np.array(arm.get(key, "").split(), float))))
    found = load_robot_from_urdf(ElementTree.tostring(root, encoding="unicode"), robot.name, actuated=robot.actuated)
    found.model.gravity.linear = turn.apply(robot.model.gravity.linear)
    return found


def with_friction(robot: Robot, sizes: Sequence[float]) -> Model:
    """Return the true model: asymmetric friction in proportion to a size [N or N m] for each joint."""
    pairs = zip(robot.actuated, sizes, strict=True)
    return build_model(robot, "asymmetric").with_values(
        {f"{j}.{k}": x * s for j, s in pairs for k, x in FRICTION.items()}
    )


def recorded(
    truth: Model, motion: Trajectory, noise: Sequence[float], seed: int = 0, rate_hz: float = 200.0, name: str = "made"
) -> Log:
    """Return the log of a robot that follows a motion exactly, with white noise on positions and forces."""
    rng = np.random.default_rng([7, seed])
    path = motion.every(round(1000 / rate_hz))
    tau = truth.torque(path.q, path.v, path.a) + np.asarray(noise) * rng.normal(size=path.q.shape)
    q = path.q + 5e-6 * rng.normal(size=path.q.shape)
    columns = {f"{s}_{j}": x[:, k] for s, x in (("q", q), ("tau", tau)) for k, j in enumerate(motion.joints)}
    return Log(path.t, columns, name)


def remade(log: Log, *, t: np.ndarray | None = None, name: str | None = None, **channels: np.ndarray) -> Log:
    """Return a log with another clock, other channels, another name."""
    found = {**log.channels, **channels}
    return Log(log.t if t is None else t, found, log.name if name is None else name)


def same(
    one: Identification, other: Identification, rtol: float, *, called: Callable[[str], str] = lambda name: name,
    factor: Callable[[str], float] = lambda name: 1.0,
) -> None:  # fmt: skip
    """Check that base parameters agree to `rtol` of their standard errors, and standard errors and errors to `rtol`.

    Args:
        one: The first.
        other: The second.
        rtol: What may differ.
        called: From the first one's names to the second one's.
        factor: By which the second one's value of a parameter (of the first one's name) is larger.
    """
    theirs = {row["name"]: row for row in other.base_rows()}
    ours = one.base_rows()
    assert {called(row["name"]) for row in ours} == set(theirs)
    for row in ours:
        there, much = theirs[called(row["name"])], factor(row["name"])
        assert abs(there["stderr"] / abs(much) / row["stderr"] - 1) < rtol, row["name"]
        assert abs(there["value"] / much - row["value"]) < rtol * row["stderr"], row["name"]
    for a, b in ((one.train, other.train), (one.holdout, other.holdout)):
        assert a is not None and b is not None
        assert abs(b.relative_error_percent / a.relative_error_percent - 1) < rtol
        assert a.used_share == pytest.approx(b.used_share, rel=rtol)
    assert other.estimator == one.estimator


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """The makers above."""
    return SimpleNamespace(
        elbow=elbow_text,
        friction=with_friction,
        mirrored=mirrored_text,
        recorded=recorded,
        remade=remade,
        same=same,
        turned=turned,
    )


@pytest.fixture(scope="session")
def elbow() -> Robot:
    """The 3R arm."""
    return load_robot_from_urdf(elbow_text(), "elbow")


@pytest.fixture(scope="session")
def l1() -> Robot:
    """The simplified L1 Gantry-Tau."""
    return load_robot("gantry_tau", prototype="l1")


@pytest.fixture(scope="session")
def complete() -> Robot:
    """L1 with its six rods and a plate that may turn."""
    return load_robot("gantry_tau", prototype="l1", arms="complete")


@pytest.fixture(scope="session")
def arm_truth(elbow) -> Model:
    """The arm with friction."""
    return with_friction(elbow, (4.0, 3.0, 1.0))


@pytest.fixture(scope="session")
def gantry_truth(l1) -> Model:
    """L1 with friction."""
    return with_friction(l1, (180.0, 200.0, 220.0))


@pytest.fixture(scope="session")
def arm_log(arm_truth) -> Log:
    """Twelve seconds of the arm."""
    return recorded(arm_truth, build_named_motion("fourier", arm_truth, 12.0, 1), (0.2, 0.2, 0.1))


@pytest.fixture(scope="session")
def gantry_log(gantry_truth) -> Log:
    """Twelve seconds of L1."""
    return recorded(gantry_truth, build_named_motion("fourier", gantry_truth, 12.0, 2), (5.0, 5.0, 5.0))


CASES = ("arm", "gantry")


@pytest.fixture(scope="session")
def found(elbow, l1, arm_log, gantry_log) -> dict[str, Identification]:
    """What identification makes of each, undisturbed."""
    from tau_dyn.identify import identify

    return {"arm": identify(elbow, arm_log), "gantry": identify(l1, gantry_log)}


@pytest.fixture(params=CASES)
def case(request, elbow, l1, arm_log, gantry_log, found) -> SimpleNamespace:
    """A robot, its log, and what was found."""
    robot, log = {"arm": (elbow, arm_log), "gantry": (l1, gantry_log)}[request.param]
    return SimpleNamespace(name=request.param, robot=robot, log=log, found=found[request.param])
