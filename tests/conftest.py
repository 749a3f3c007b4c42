"""What several rooms' tests share: seeded randomness, small robots written as URDF text, the measured data."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cpu_limit import pytest_runtest_call  # noqa: F401
from tiers import pytest_collection_modifyitems  # noqa: F401
from witnesses import (  # noqa: F401
    pytest_make_collect_report,
    pytest_runtest_makereport,
    pytest_sessionstart,
)

from tau_dyn.robot import Robot, load_robot_from_urdf

gc.set_threshold(
    50_000, 20, 20
)  # trees of syntax and of XML are thousands of objects, and none of them is garbage soon
ROOT = Path(__file__).resolve().parents[1]
FOUR_BAR = SimpleNamespace(base=0.8, crank=0.3, coupler=0.9, rocker=0.6)  # [m], a crank-rocker by Grashof's rule


def link(name: str, mass: float = 0.0, centre: str = "0 0 0", inertia: str = "0 0 0") -> str:
    """Return a link; inertia about its centre, `ixx iyy izz`."""
    if not mass:
        return f'<link name="{name}"/>'
    ixx, iyy, izz = inertia.split()
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial></link>'
    )


def rod(name: str, mass: float, length: float) -> str:
    """Return a uniform rod along x of a link's frame."""
    across = mass * length**2 / 12
    return link(name, mass, f"{length / 2} 0 0", f"1e-4 {across} {across}")


def joint(
    name: str, kind: str, parent: str, child: str, axis: str = "0 0 1", xyz: str = "0 0 0", yaw: float = 0
) -> str:
    """Return a joint with wide limits."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        f'<origin xyz="{xyz}" rpy="0 0 {yaw}"/><limit lower="-3" upper="3" velocity="10" effort="100"/></joint>'
    )


def drive(name: str, inertia: str = "") -> str:
    """Return a transmission, which makes a joint actuated; `inertia` may hold Drake's elements for the rotor."""
    actuator = f'<actuator name="{name}_motor">{inertia}</actuator>'
    kind = "<type>transmission_interface/SimpleTransmission</type>"
    return f'<transmission name="{name}_drive">{kind}<joint name="{name}"/>{actuator}</transmission>'


def ball(a: str, point_a: str, b: str, point_b: str) -> str:
    """Return a loop: a point of one link coincides with a point of another."""
    c = "drake:ball_constraint"
    bodies = f'<{c}_body_A name="{a}"/><{c}_body_B name="{b}"/>'
    return f'<{c}>{bodies}<{c}_p_AP value="{point_a}"/><{c}_p_BQ value="{point_b}"/></{c}>'


def text(name: str, *parts: str) -> str:
    """Return URDF text around the parts."""
    spaces = 'xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"'
    return f'<robot name="{name}" {spaces}><link name="base_link"/>' + "".join(parts) + "</robot>"


def pendulum_text(mass: float = 2.0, length: float = 0.5, *more: str) -> str:
    """Return a point mass on a massless rod that turns about y and hangs along -z at zero."""
    parts = link("rod_link", mass, f"0 0 {-length}"), joint("pivot", "revolute", "base_link", "rod_link", "0 1 0")
    return text("pendulum", *parts, *(more or (drive("pivot"),)))


def two_link_text() -> str:
    """Return two uniform rods that turn about y, 0.4 and 0.3 m long, 3 and 2 kg."""
    upper = rod("upper_link", 3, 0.4) + joint("shoulder", "revolute", "base_link", "upper_link", "0 1 0")
    lower = rod("lower_link", 2, 0.3) + joint("elbow", "revolute", "upper_link", "lower_link", "0 1 0", "0.4 0 0")
    return text("two_link", upper, lower, drive("shoulder"), drive("elbow"))


def block_text() -> str:
    """Return a block of 5 kg on a level guideway along x, whose parameters are its mass alone."""
    slide = joint("axis", "prismatic", "base_link", "block_link", "1 0 0")
    return text(
        "block", link("block_link", 5), slide, drive("axis"), '<tau_dyn:link name="block_link" parameters="mass"/>'
    )


def four_bar_text(kind: str = "revolute", driven: str = "crank") -> str:
    """Return a crank-rocker in the xy plane, at zero as `FOUR_BAR` closes it with the crank at 60 degrees.

    `kind` is the crank's joint type; `driven` the actuated joint, or nothing.
    """
    d, a, b, c = FOUR_BAR.base, FOUR_BAR.crank, FOUR_BAR.coupler, FOUR_BAR.rocker
    crank = np.pi / 3
    to_ground = np.array([d, 0]) - a * np.array([np.cos(crank), np.sin(crank)])
    diagonal = np.hypot(*to_ground)
    coupler = np.arctan2(to_ground[1], to_ground[0]) + np.arccos((b**2 + diagonal**2 - c**2) / (2 * b * diagonal))
    tip = b * np.array([np.cos(coupler), np.sin(coupler)]) - to_ground
    rocker = np.arctan2(tip[1], tip[0])
    bend = coupler - crank
    return text(
        "four_bar",
        rod("crank_link", 1, a) + joint("crank", kind, "base_link", "crank_link", yaw=crank),
        rod("coupler_link", 2, b) + joint("coupler", "revolute", "crank_link", "coupler_link", xyz=f"{a} 0 0", yaw=bend),
        rod("rocker_link", 3, c) + joint("rocker", "revolute", "base_link", "rocker_link", "0 0 1", f"{d} 0 0", rocker),
        ball("coupler_link", f"{b} 0 0", "rocker_link", f"{c} 0 0"),
        drive(driven) if driven else "",
    )  # fmt: skip


def pytest_collection_finish() -> None:
    """Leave what collection made out of every later search for garbage, which would walk through all of it."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def rng() -> np.random.Generator:
    """A seeded generator."""
    return np.random.default_rng(6307)


@pytest.fixture(scope="session")
def write() -> SimpleNamespace:
    """The writers of URDF text above, for tests that need a robot of their own."""
    parts = {f.__name__: f for f in (link, rod, joint, drive, ball, text)}
    robots = {"pendulum": pendulum_text, "two_link": two_link_text, "block": block_text, "four_bar": four_bar_text}
    return SimpleNamespace(**parts, **robots, sizes=FOUR_BAR)


@pytest.fixture
def pendulum() -> Robot:
    """A point mass of 2 kg on 0.5 m."""
    return load_robot_from_urdf(pendulum_text(), "pendulum")


@pytest.fixture
def two_link() -> Robot:
    """Two uniform rods in a vertical plane."""
    return load_robot_from_urdf(two_link_text(), "two_link")


@pytest.fixture
def four_bar() -> Robot:
    """A crank-rocker, driven at the crank."""
    return load_robot_from_urdf(four_bar_text(), "four_bar")


@pytest.fixture
def block() -> Robot:
    """A sliding block of 5 kg."""
    return load_robot_from_urdf(block_text(), "block")


@pytest.fixture(scope="session")
def measured() -> Callable[[str], Path]:
    """Return a function from a data file's name, such as `tx40/tx40.urdf`, to its path; absent data skip the test."""
    folder = Path(os.environ.get("TAU_DYN_DATA", ROOT.parent / "shared" / "data"))

    def path_of(name: str) -> Path:
        path = folder / name
        if not path.exists():
            sentence = f"{path} is absent; set TAU_DYN_DATA to the folder with the measured data"
            if os.environ.get("TAU_DYN_REQUIRE_DATA") == "1":
                pytest.fail(f"{sentence} (TAU_DYN_REQUIRE_DATA=1 demands them)")
            pytest.skip(sentence)
        return path

    return path_of
