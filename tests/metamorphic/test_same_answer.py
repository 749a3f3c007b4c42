"""What physics does not know - order, names, units, the time of day, a mirror, where north is - must not change the answer.

Tolerances are relative to standard errors. 1e-6: the same sums in another order, whose rounding (1e-16) the condition number of
the columns (up to 1e4, squared in the covariance) enlarges. 1e-5: a clock that cannot hold the same instants, below.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.identify import identify
from tau_dyn.log import Log, read_log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot_from_urdf

ROUNDING = 1e-6


def test_columns_in_another_order_and_unknown_ones(case, make) -> None:
    """A file's columns have no order, and what nobody asked for says nothing of the robot: the same to the last bit."""
    extra = {"room": np.full(case.log.n_samples, 21.0), "v_max_all": np.arange(case.log.n_samples) * 1e9}
    channels = dict(reversed({**extra, **case.log.channels}.items()))
    again = identify(case.robot, Log(case.log.t, channels, case.log.name))
    assert again.to_dict() == case.found.to_dict()


def test_joints_in_another_order(case, make) -> None:
    """The laws of motion do not number the joints."""
    other = load_robot_from_urdf(case.robot.urdf, case.robot.name, actuated=case.robot.actuated[::-1])
    again = identify(other, case.log)
    make.same(case.found, again, ROUNDING)


def test_logs_in_another_order(case, make) -> None:
    """Two recordings are evidence alike, whichever was made first."""
    train, held = case.log.split(0.8)
    first, last = (make.remade(part, name=name) for part, name in zip(train.split(0.4), "ab", strict=True))
    one, other = (identify(case.robot, logs, holdout=held) for logs in ([first, last], [last, first]))
    make.same(one, other, ROUNDING)


@pytest.mark.parametrize(("origin", "rtol"), [(-37.5, ROUNDING), (86_400.0, 1e-5)])
def test_another_time_origin(case, make, origin: float, rtol: float) -> None:
    """Nothing in the equation of motion depends on when the clock was set; at a day's length it counts in steps of 1e-11 s."""
    again = identify(case.robot, make.remade(case.log, t=case.log.t + origin))
    make.same(case.found, again, rtol)


@pytest.mark.parametrize("name", ["mm_kN", "deg_A"])
def test_other_units_through_the_column_map(tmp_path, elbow, l1, arm_log, gantry_log, found, make, name: str) -> None:
    """A length is the same length in millimetres: the map takes the numbers back, and nothing after it sees a unit."""
    robot, log, before = (l1, gantry_log, found["gantry"]) if name == "mm_kN" else (elbow, arm_log, found["arm"])
    per = {"mm_kN": (1e3, 1e-3), "deg_A": (180 / np.pi, 1 / 0.73)}[name]  # their numbers for one of ours
    rows = {"time_ms": 1e3 * log.t}
    for joint in robot.actuated:
        rows |= {
            f"p {joint}": per[0] * log.channels[f"q_{joint}"] - 7,
            f"i {joint}": -per[1] * log.channels[f"tau_{joint}"],
        }
    lines = [",".join(rows), *(",".join(map(repr, map(float, row))) for row in zip(*rows.values(), strict=True))]
    (tmp_path / "theirs.csv").write_text("\n".join(lines) + "\n")
    entries = ["t: {column: time_ms, scale: 0.001}"]
    for joint in robot.actuated:
        entries += [
            f"q_{joint}: {{column: p {joint}, scale: {1 / per[0]!r}, offset: {7 / per[0]!r}}}",
            f"tau_{joint}: {{column: i {joint}, scale: {-1 / per[1]!r}}}",
        ]
    (tmp_path / "map.yaml").write_text("\n".join(entries))
    make.same(before, identify(robot, read_log(tmp_path / "theirs.csv", tmp_path / "map.yaml")), ROUNDING)


def test_renamed_joints_and_links(case, make) -> None:
    """A robot does not know what its parts are called."""

    def called(name: str) -> str:
        part, _, quantity = name.partition(".")
        return ("Ä" + part.removesuffix("_link") + "_link" if part.endswith("_link") else f"z{part}") + f".{quantity}"

    text = case.robot.urdf
    names = [link.link for link in case.robot.links] + list(case.robot.actuated)
    for part in names:
        text = text.replace(f'"{part}"', f'"{called(part + ".x")[:-2]}"')
    robot = load_robot_from_urdf(text, "renamed", actuated=[f"z{j}" for j in case.robot.actuated])
    renamed = {f"{k.partition('_')[0]}_z{k.partition('_')[2]}": x for k, x in case.log.channels.items()}
    make.same(case.found, identify(robot, Log(case.log.t, renamed, "log")), ROUNDING, called=called)


def test_a_mirrored_robot(case, make) -> None:
    """Mechanics knows no left and right: in a mirror the same motion takes the same forces, and numbers odd in y change sign."""
    robot = load_robot_from_urdf(make.mirrored(case.robot.urdf), "mirrored", actuated=case.robot.actuated)
    again = identify(robot, case.log)
    odd = {name: -1.0 if name.rpartition(".")[2] in ("my", "ixy", "iyz") else 1.0 for name in robot.parameters.names}
    signs = {sign for name, sign in odd.items() if name in {row["name"] for row in again.base_rows()}}
    assert signs == ({1.0, -1.0} if case.name == "arm" else {1.0})
    make.same(case.found, again, ROUNDING, factor=lambda name: odd.get(name, 1.0))


def agree(robot: Robot, other: Robot, signs: np.ndarray, rng: np.random.Generator) -> None:
    """Check that two robots' regressors agree up to the columns' signs (p,) at 20 states around home."""
    q = robot.home + 0.15 * rng.uniform(-1, 1, (20, robot.na))
    v, a = rng.normal(size=(2, 20, robot.na))
    ours, theirs = (build_mechanism(r).regressor(q, v, a) for r in (robot, other))
    np.testing.assert_allclose(theirs, ours * signs, rtol=0, atol=1e-9 * np.abs(ours).max())


def test_a_mirrored_machine_with_six_rods(complete, make, rng) -> None:
    """The complete L1, its plate free to turn: all columns, masses, centres and inertias."""
    other = load_robot_from_urdf(make.mirrored(complete.urdf), "mirrored", actuated=complete.actuated)
    signs = [-1.0 if name.rpartition(".")[2] in ("my", "ixy", "iyz") else 1.0 for name in complete.parameters.names]
    assert other.parameters.names == complete.parameters.names
    agree(complete, other, np.array(signs), rng)


@pytest.mark.parametrize("name", ["elbow", "l1", "complete"])
def test_a_turned_world(request, make, rng, name: str) -> None:
    """Bolted to a wall, with gravity turned along, a robot feels nothing of it: space has no preferred direction."""
    robot = request.getfixturevalue(name)
    turn = Rotation.from_euler("xyz", [0.7, -1.1, 2.3])
    agree(robot, make.turned(robot, turn), np.ones(len(robot.parameters)), rng)
    still = make.turned(robot, turn)
    still.model.gravity.linear = robot.model.gravity.linear
    with pytest.raises(AssertionError):
        agree(robot, still, np.ones(len(robot.parameters)), rng)


def test_turned_about_the_vertical_gravity_stays(elbow, elbow_turned_found, found, make) -> None:
    """Where north is does not matter: the same log, a robot turned by 2.3 rad about z, the same answer."""
    make.same(found["arm"], elbow_turned_found, ROUNDING)


@pytest.fixture
def elbow_turned_found(elbow, arm_log, make):
    """The arm turned about the vertical."""
    return identify(make.turned(elbow, Rotation.from_euler("z", 2.3)), arm_log)


def test_a_log_with_a_gap_is_two_logs(case, make) -> None:
    """What lies on the two sides of a gap in a file is what two files would hold: nothing is joined across it."""
    first, last = case.log.split(0.5)
    gap = 40 * case.log.dt + np.where(np.arange(case.log.n_samples) < first.n_samples, 0.0, 1.0)
    joined = identify(case.robot, make.remade(case.log, t=case.log.t + gap))
    apart = identify(case.robot, [make.remade(first, name="a"), make.remade(last, name="b")])
    make.same(joined, apart, ROUNDING)


def test_a_log_cut_in_two_says_the_same_but_for_its_borders(case, make) -> None:
    """Cut without a gap, only the filters' ends differ: a few of the samples, so a fraction of a standard error."""
    first, last = (make.remade(part, name=name) for part, name in zip(case.log.split(0.5), "ab", strict=True))
    again = identify(case.robot, [first, last], preparation=case.found.estimate.regression.preparation)
    rows = zip(case.found.base_rows(), again.base_rows(), strict=True)
    moved = [((b["value"] - a["value"]) / a["stderr"], b["stderr"] / a["stderr"]) for a, b in rows]
    z, ratio = np.array(moved).T
    used = [f.estimate.regression.n_samples for f in (case.found, again)]
    lost = abs(1 - used[1] / used[0]) + 0.01
    assert lost < 0.1
    # what differs in a share s of the samples moves an estimate by about sqrt(s) of its standard error; 4 times that in the worst
    assert np.abs(z).max() < 4 * np.sqrt(lost) and np.abs(ratio - 1).max() < 4 * lost + 0.05


def test_the_same_model_by_another_route(arm_truth: Model, tmp_path, elbow, arm_log, found, make) -> None:
    """A model saved and read back is the same model."""
    found["arm"].model.save(tmp_path / "m.yaml")
    back = Model.load(tmp_path / "m.yaml")
    q, v, a = np.random.default_rng(0).normal(size=(3, 10, 3)) * 0.3
    np.testing.assert_allclose(back.torque(q, v, a), found["arm"].model.torque(q, v, a), rtol=1e-12)
