"""A body on a walker's trunk or leg: its mass and place from walks without and with it, from torques alone."""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.log import Log
from tau_dyn.monitor import identify_payload
from tau_dyn.robot import INERTIAL, Robot

MASS, CENTRE = 0.6, np.array([0.05, -0.03, 0.08])  # [kg], [m] in the frame of the link that carries it
TORQUE_NOISE = 0.1  # [N m], far above the error of 100 samples a second where feet touch down
SECONDS, RATE_HZ = 30.0, 100.0


def load(robot: Robot, link: str) -> Robot:
    """Return the robot with a body on one of its links, added by Pinocchio."""
    names = [f"{link}.{quantity}" for quantity in INERTIAL]
    body = pin.Inertia(MASS, CENTRE, 2e-3 * np.eye(3))
    total = pin.Inertia.FromDynamicParameters(robot.parameters.select(names).values) + body
    values = dict(zip(names, total.toDynamicParameters().tolist(), strict=True))
    return robot.with_parameters(robot.parameters.with_values(values))


def add_noise(log: Log, robot: Robot, seed: int) -> Log:
    """Return a log with white noise on the torques."""
    rng = np.random.default_rng(seed)
    columns = {f"tau_{j}": log[f"tau_{j}"] + TORQUE_NOISE * rng.standard_normal(len(log)) for j in robot.driven}
    return log.with_channels(**columns)


@pytest.fixture(scope="module")
def empty(walker, walk) -> Log:
    """Return a walk without a load."""
    return add_noise(walk.record(walker, SECONDS, 1, rate_hz=RATE_HZ), walker, 1)


@pytest.mark.parametrize("link", ["trunk", "hl_shank"])
def test_a_body_on_trunk_or_leg_comes_back(walker, walk, empty, link):
    """Its mass to 5 % and its centre to 10 mm, within 4 standard errors; without a name it is on the trunk."""
    loaded = add_noise(walk.record(load(walker, link), SECONDS, 2, rate_hz=RATE_HZ), walker, 2)
    found = identify_payload(walker, [empty], [loaded], link=None if link == "trunk" else link)
    assert found.link == link and found.differs
    assert_allclose(found.mass.values, MASS, rtol=0.05)
    assert_allclose(found.centre.values, CENTRE, atol=0.01)
    off = np.concatenate([found.mass.values - MASS, found.centre.values - CENTRE])
    assert np.abs(off / np.concatenate([found.mass.stderr, found.centre.stderr])).max() < 4
    assert {row.joint for row in found.friction} == set(walker.driven)


def test_two_walks_of_one_robot_carry_nothing(walker, walk, empty):
    """Another walk without a load differs by noise alone."""
    found = identify_payload(walker, [empty], [add_noise(walk.record(walker, SECONDS, 2, rate_hz=RATE_HZ), walker, 2)])
    assert not found.differs and abs(found.plain_mass) < 4 * found.mass.stderr[0]


def test_the_command_takes_a_walker(walker, walker_file, walk, empty, tmp_path):
    """`payload --base floating` reads base and feet, and a walk without an orientation is refused."""
    loaded = add_noise(walk.record(load(walker, "trunk"), SECONDS, 2, rate_hz=RATE_HZ), walker, 2)
    paths = tmp_path / "empty.csv", tmp_path / "loaded.csv"
    for log, path in zip((empty, loaded), paths, strict=True):
        log.to_csv(path)
    feet = ["--base", "floating", "--contact", *(contact.frame for contact in walker.contacts)]
    out = tmp_path / "out.json"
    line = ["payload", str(walker_file), str(paths[0]), "--loaded", str(paths[1]), *feet, "--json", str(out), "--quiet"]
    assert main(line) == 0
    assert abs(json.loads(out.read_text())["payload"]["mass"]["value"] - MASS) < 0.03
    channels = {name: x for name, x in loaded.channels.items() if name != "q_base_qw"}
    with raises_code("missing_column", "q_base_qw"):
        identify_payload(walker, [empty], [Log(loaded.t, channels, "lost")])
