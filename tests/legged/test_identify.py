"""Identification of a walker: exact without noise, whatever is known of feet and base, and what it cannot use is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.cli import main
from tau_dyn.identify import Identification, identify
from tau_dyn.legged import ANGULAR, LINEAR, POSITION, QUATERNION, check_robot_log, complete_base, list_base_warnings
from tau_dyn.log import Log


@pytest.fixture(scope="module")
def log(walker, walk) -> Log:
    """Return an exact log of a crawl."""
    return walk.record(walker)


@pytest.fixture(scope="module")
def found(walker, log) -> Identification:
    """Return what is identified from the exact log."""
    return identify(walker, log, model="symmetric")


def compare(found: Identification, walk) -> tuple[np.ndarray, np.ndarray]:
    """Return the base parameters found and true."""
    e, robot = found.estimate, found.model.robot
    friction = {"coulomb": walk.coulomb, "viscous": walk.viscous}
    truth = [
        found.nominal[name].value if name in robot.parameters else friction.get(name.rsplit(".", 1)[1], 0.0)
        for name in e.base.names
    ]
    return e.beta, e.base.combine(np.array(truth))


def without(log: Log, *names: str) -> Log:
    return replace(log, channels={name: x for name, x in log.channels.items() if name not in names})


def add_velocity(log: Log, *, of_world: bool = False) -> Log:
    """Return a log with the base's velocity, in axes of the base or of the world."""
    turn = Rotation.from_quat(np.column_stack([log[name] for name in QUATERNION]))
    world = np.gradient(np.column_stack([log[name] for name in POSITION]), log.dt, axis=0)
    step = (turn[:-1].inv() * turn[1:]).as_rotvec() / log.dt
    spin = np.concatenate([step, step[-1:]])
    moved = world if of_world else turn.inv().apply(world)
    turned = turn.apply(spin) if of_world else spin
    return log.with_channels(**dict(zip(LINEAR, moved.T, strict=True)), **dict(zip(ANGULAR, turned.T, strict=True)))


def test_exact_logs_give_the_exact_robot(walker, walk, found):
    """All 142 base parameters, from torques alone, with ground forces that nobody measured: 11.6 kg to 5 g."""
    estimated, true = compare(found, walk)
    assert found.estimate.base.rank == 142
    bodies = [k for k, name in enumerate(found.estimate.base.names) if name in walker.parameters]
    rigid = np.isin(found.estimate.base.kept, bodies)
    assert_allclose(estimated[rigid], true[rigid], atol=2e-3)
    assert_allclose(estimated[~rigid], true[~rigid], atol=0.01)
    assert_allclose(estimated[0], 11.6, atol=5e-3)
    assert found.parameters.select("*.coulomb").names == tuple(f"{joint}.coulomb" for joint in walker.driven)
    assert found.holdout is not None and found.holdout.relative_error_percent < 0.1
    assert found.estimator == "wls"


def test_feet_without_flags_count_as_touching(walker, walk, log):
    """The six equations of the base hold without knowing which foot is in the air, and are enough."""
    bare = without(log, *(f"contact_{contact.frame}" for contact in walker.contacts))
    found = identify(walker, bare, model="symmetric")
    estimated, true = compare(found, walk)
    assert_allclose(estimated, true, atol=0.03)
    assert any(getattr(w, "code", "") == "contact_unknown" for w in found.warnings)


def test_forces_of_feet_are_flags_as_well(walker, log, found):
    """A foot with more than a hundredth of the weight on it touches the ground."""
    loads = {f"contact_{c.frame}": 30 * log[f"contact_{c.frame}"] + 0.3 for c in walker.contacts}
    by_force = identify(walker, log.with_channels(**loads), model="symmetric")
    assert_allclose(by_force.estimate.beta, found.estimate.beta)


def test_a_velocity_in_axes_of_the_base_replaces_the_position(walker, log):
    """Its integral differs from the position by a constant, which no equation feels."""
    (whole,) = complete_base(walker, [log])
    (moved,) = complete_base(walker, [without(add_velocity(log), *POSITION)])
    for name in POSITION:
        assert_allclose(moved[name] - moved[name][0], whole[name] - whole[name][0], atol=1e-4)


def test_coordinates_of_the_base_are_angles_without_jumps(walker, walk, log):
    """Quaternions of both signs are the same rotations, and turns go on beyond half a turn."""
    flipped = log.with_channels(**{name: np.where(log.t > 3, -1, 1) * log[name] for name in QUATERNION})
    (found,) = complete_base(walker, [flipped])
    _, q, _, _ = walk.move(walker, 12.0, 1)
    assert_allclose(found.joint("q", walker.base_coordinates), q[:, :6], atol=1e-9)
    assert not found.joint("tau", walker.base_coordinates).any()


def test_a_velocity_in_axes_of_the_world_is_told_from_one_of_the_base(walker, log):
    """Both look plausible; the pose says which it is, for motion and turning."""
    assert not list_base_warnings(walker, [add_velocity(log)])
    said = list_base_warnings(walker, [add_velocity(log, of_world=True)])
    assert [w.code for w in said] == ["base_velocity_frame"] * 2
    assert not check_robot_log(add_velocity(log, of_world=True), walker).fit_for_use
    assert check_robot_log(add_velocity(log), walker).fit_for_use


def test_a_walk_without_its_base_is_refused(walker, log):
    """Orientation says where gravity points; without position and velocity there is no acceleration."""
    with raises_code("missing_column", "q_base_qx"):
        identify(walker, without(log, "q_base_qx"))
    with raises_code("missing_column", "v_base_x"):
        identify(walker, without(log, "q_base_x"))
    assert not check_robot_log(without(log, "q_base_qx"), walker).fit_for_use
    upright = Rotation.from_euler("y", np.pi / 2).as_quat()
    with raises_code("unsupported", "pitches"):
        complete_base(
            walker, [log.with_channels(**{n: np.full(len(log), x) for n, x in zip(QUATERNION, upright, strict=True)})]
        )
    with raises_code("bad_sample", "length"):
        complete_base(walker, [log.with_channels(q_base_qw=2 * log["q_base_qw"])])


def test_what_takes_no_floating_base_says_so(walker, log, found):
    """Predictions from motion alone would take the ground's forces for faults of the model."""
    with raises_code("unsupported", "fixed base"):
        found.model.predict(log)
    with raises_code("bad_option", "wls"):
        identify(walker, log, estimator="ml")


def test_the_command_line_takes_base_and_feet(walker, walker_file, log, tmp_path):
    """`identify`, `check` and `columns` read a floating base; other commands say that they do not."""
    path, feet = tmp_path / "walk.csv", [contact.frame for contact in walker.contacts]
    log.to_csv(path)

    def run(*words: object, status: int = 0) -> dict:
        out = tmp_path / "out.json"
        out.unlink(missing_ok=True)
        line = [*map(str, words), "--base", "floating", "--contact", *feet, "--json", str(out), "--quiet"]
        assert main(line) == status
        return json.loads(out.read_text()) if out.is_file() else {}

    whole = path
    assert run("check", path, walker_file)["fit_for_use"]
    proposed = run("columns", path, walker_file)["columns"]
    assert {name for name in log.channels} <= set(proposed) and proposed["q_base_qw"] == "q_base_qw"
    without(log, "q_base_qw").to_csv(path := tmp_path / "lost.csv")
    assert "# q_base_qw: COLUMN" in run("columns", path, walker_file)["template"]
    found = {p["name"]: p for p in run("identify", walker_file, whole, "--model", "symmetric")["parameters"]}
    assert abs(found["fl_knee.coulomb"]["value"] - 0.15) < 0.005
    run("workspace", walker_file, status=2)
