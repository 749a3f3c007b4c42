"""Springs of a planar arm from hammer tests at several poses: recovered within their errors, listed where nothing shows them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log
from tau_dyn.mechanism import FlexibleModel, state_springs, write_springs
from tau_dyn.modes import SpringFit, find_springs
from tau_dyn.modes.springs.problem import SpringProblem
from tau_dyn.robot import Robot, Spring, load_robot

LINK = """<link name="{name}_link"><inertial><origin xyz="0.25 0 0"/><mass value="{mass}"/>
<inertia ixx="0.01" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}" type="revolute"><origin xyz="{x} 0 0"/><parent link="{parent}"/><child link="{name}_link"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="100"/></joint>
<transmission name="{name}_drive"><joint name="{name}"/></transmission>"""
ARM = (
    '<robot name="arm"><link name="base_link"/>'
    + LINK.format(name="j1", mass=8, i=0.3, x=0, parent="base_link")
    + LINK.format(name="j2", mass=4, i=0.1, x=0.5, parent="j1_link")
    + '<link name="tool"/><joint name="tip" type="fixed"><origin xyz="0.5 0 0"/><parent link="j2_link"/>'
    + '<child link="tool"/></joint>'
    + "</robot>"
)
TRUE = (Spring("j1", 2e4, 12.0), Spring("j2", 6e3, 3.0))
POSES = ((0.3, 0.9), (-0.4, 1.6), (0.1, -0.8))
INPUTS, OUTPUTS = ["fx_tool", "fy_tool"], ["ax_tool", "ay_tool"]


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Robot:
    """A planar arm of two joints, whose file states no springs."""
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(ARM)
    return load_robot(path)


@pytest.fixture(scope="module")
def truth(arm) -> FlexibleModel:
    """The same arm with the springs of its drives."""
    return FlexibleModel(state_springs(arm, drives=dict.fromkeys(arm.actuated, 1.0))).with_springs(TRUE)


def strike(truth: FlexibleModel, q: tuple[float, float], seed: int, axes: str = "xy", noise: float = 0.01) -> Log:
    """Return a hammer test: smooth blows of 4 ms at the tool, accelerations by an inverse Laplace transform of receptances."""
    rng, rate, each = np.random.default_rng(seed), 800.0, 800
    near, a = truth.at(q), truth.robot.na
    J, M, D, K = near.tool[:2, a:], near.M[a:, a:], near.D[a:, a:], near.K[a:, a:]
    n = each * 2 * len(axes)
    t, u = np.arange(n) / rate, np.zeros((n, 2))
    for blow in range(2 * len(axes)):
        since = t - blow * each / rate - 0.1
        u[:, "xy".index(axes[blow // 2])] += 150 * np.where(
            abs(since - 0.01) < 0.01, np.sin(np.pi * since / 0.02) ** 4, 0.0
        )
    sigma = 9 * rate / n
    decay = np.exp(-sigma * t)[:, None]
    s = (sigma + 2j * np.pi * np.fft.rfftfreq(2 * n, 1 / rate))[:, None, None]
    H = s**2 * (J @ np.linalg.inv(s**2 * M + s * D + K) @ J.T)
    y = np.fft.irfft(np.einsum("fpm,fm->fp", H, np.fft.rfft(u * decay, 2 * n, axis=0)), 2 * n, axis=0)[:n] / decay
    u = u + 0.2 * rng.standard_normal(u.shape)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    channels = dict(zip([*INPUTS, *OUTPUTS], [*u.T, *y.T], strict=True))
    return Log(t, channels | {"q_j1": np.full(n, q[0]), "q_j2": np.full(n, q[1])}, f"at {q[0]:g} {q[1]:g}")


@pytest.fixture(scope="module")
def found(arm, truth) -> SpringFit:
    """The springs that hammer tests at three poses show."""
    logs = [strike(truth, q, seed) for seed, q in enumerate(POSES)]
    return find_springs(arm, logs, INPUTS, OUTPUTS, springs=["drives"])


def test_springs_are_recovered_within_their_errors(found) -> None:
    """Stiffness and damping of both drives are within four standard errors of the truth, which are below 1 and 10 %."""
    for spring, true in zip(found.springs, TRUE, strict=True):
        assert spring.spring.joint == true.joint and spring.of_drive and spring.identified
        assert abs(spring.spring.stiffness - true.stiffness) < 4 * spring.stiffness_stderr < 0.04 * true.stiffness
        assert abs(spring.spring.damping - true.damping) < 4 * spring.damping_stderr < 0.4 * true.damping
    assert found.converged and not found.warnings
    assert min(min(record.fit_percent) for record in found.records) > 90


def test_the_smallest_residual_of_all_starts_counts(arm, truth, found, monkeypatch) -> None:
    """A first start with springs 10^4 times too stiff ends in a wrong minimum; the second one has the springs."""
    starts = SpringProblem.start

    def with_a_wrong_one(self, has_value):
        (theta, problem), *others = starts(self, has_value)
        stiff = theta + np.log(1e4) * (np.arange(len(theta)) < self.n)
        return [(stiff, problem.move(stiff)), (theta, problem), *others]

    monkeypatch.setattr(SpringProblem, "start", with_a_wrong_one)
    again = find_springs(
        arm, [strike(truth, q, seed) for seed, q in enumerate(POSES)], INPUTS, OUTPUTS, springs=["drives"]
    )
    for spring, before in zip(again.springs, found.springs, strict=True):
        assert spring.spring.stiffness == pytest.approx(before.spring.stiffness, rel=1e-3)


def test_resonances_follow_at_other_poses(found, truth) -> None:
    """A robot with the fitted springs has the resonances of the true one at poses without a record."""
    fitted = FlexibleModel(found.build_robot())
    for q in ((0.0, 0.2), (1.0, 2.2), (-1.0, -1.5)):
        for seen, true in zip(fitted.at(q).natural_frequencies(), truth.at(q).natural_frequencies(), strict=True):
            assert seen == pytest.approx(true, rel=5e-3)


def test_the_out_file_states_stiffness_damping_and_errors(found) -> None:
    """The robot's file holds each spring with its standard error, as maps of the workspace read it."""
    springs = found.build_robot().drive_springs
    for written, fitted in zip(springs, found.springs, strict=True):
        assert written == fitted.spring and written.stiffness_stderr == fitted.stiffness_stderr > 0


def test_a_spring_that_no_record_moves_is_listed(arm, truth) -> None:
    """A drive that is a hundred thousand times too stiff to yield measurably has no stiffness; the other one keeps its own."""
    held = FlexibleModel(state_springs(arm, drives={"j1": 1.0, "j2": 1.0})).with_springs(
        (Spring("j1", 2e9, 0.0), TRUE[1])
    )
    logs = [strike(held, q, seed) for seed, q in enumerate(POSES)]
    found = find_springs(arm, logs, INPUTS, OUTPUTS, springs=["drives"])
    assert found.list_not_identified() == ["j1"] and found.list_identified() == ["j2"]
    assert "j1" in found.warnings[0] and found.warnings[0].code == "springs_not_identified"  # type: ignore[attr-defined]


def test_records_of_noise_determine_nothing(arm, truth) -> None:
    """Responses that are noise alone end with the springs refused, not with values."""
    logs = [strike(truth, POSES[0], 0, noise=1e4)]
    with pytest.raises(CannotAnswer, match="no spring"):
        find_springs(arm, logs, INPUTS, OUTPUTS, springs=["drives"])


def test_records_that_no_springs_explain_give_no_stiffness(arm, truth) -> None:
    """Accelerations against the force from the first sample on are no robot's response: no value, no interval."""
    logs = []
    for seed, q in enumerate(POSES[:2]):
        log = strike(truth, q, seed)
        logs.append(log.with_channels(**{name: -log.channels[name] for name in OUTPUTS}))
    with pytest.raises(CannotAnswer, match="no springs were found that explain") as fault:
        find_springs(arm, logs, INPUTS, OUTPUTS, springs=["drives"])
    assert fault.value.code == "no_solution"


def test_held_out_records_judge(arm, truth) -> None:
    """A held-out record at its own pose is explained as well as those of the fit, and at a wrong pose it is not."""
    logs, other = [strike(truth, q, seed) for seed, q in enumerate(POSES[:2])], strike(truth, POSES[2], 7)
    wrong = {"j1": 0.1, "j2": 1.6}
    at = {"j1": POSES[2][0], "j2": POSES[2][1]}
    right, off = (
        find_springs(arm, logs, INPUTS, OUTPUTS, springs=["drives"], holdout=[other], holdout_poses=[pose]).records[-1]
        for pose in (at, wrong)
    )
    assert right.held_out and min(right.fit_percent) > 90 > 50 > max(off.fit_percent)


@pytest.mark.parametrize(
    ("inputs", "outputs", "springs", "says"),
    [
        (["fx_elbow"], OUTPUTS, ["drives"], "elbow"),
        (["push"], OUTPUTS, ["drives"], "fx_PLACE"),
        (INPUTS, ["gauge"], ["drives"], "x_PLACE"),
        (INPUTS, ["q_j1"], ["drives"], "held drive"),
        (INPUTS, OUTPUTS, ["mount"], "there are file, drives, rods"),
    ],
)
def test_wrong_names_are_refused(arm, truth, inputs, outputs, springs, says) -> None:
    """A column without a place on the robot and a spring that it does not have are named."""
    log = strike(truth, POSES[0], 0)
    extra = {name: log.channels["ax_tool"] for name in ("fx_elbow", "push", "gauge")}
    with pytest.raises(InputError, match=says):
        find_springs(arm, log.with_channels(**extra), inputs, outputs, springs=springs)


def test_a_record_without_a_pose_is_refused(arm, truth) -> None:
    """The pose of a record is not guessed."""
    log = strike(truth, POSES[0], 0)
    bare = Log(log.t, {k: v for k, v in log.channels.items() if k != "q_j2"}, "bare")
    with pytest.raises(InputError, match="q_j2, or a --poses file"):
        find_springs(arm, bare, INPUTS, OUTPUTS, springs=["drives"])


def test_one_command_writes_the_robot_with_springs(arm, truth, tmp_path, capsys) -> None:
    """`modes LOG.. --robot --springs --poses --out` writes a robot that loads with its springs, a result and a page."""
    (tmp_path / "arm.urdf").write_text(ARM)
    for k, q in enumerate(POSES[:2]):
        log = strike(truth, q, k)
        names = ["t", *INPUTS, *OUTPUTS]
        rows = np.column_stack([log.t, *(log.channels[n] for n in names[1:])])
        np.savetxt(tmp_path / f"pose{k}.csv", rows, "%.9g", ",", header=",".join(names), comments="")
    (tmp_path / "poses.yaml").write_text(
        "".join(f"pose{k}.csv: {{j1: {q[0]}, j2: {q[1]}}}\n" for k, q in enumerate(POSES[:2]))
    )
    logs = [str(tmp_path / f"pose{k}.csv") for k in range(2)]
    files = {
        "--robot": "arm.urdf",
        "--poses": "poses.yaml",
        "--out": "soft.urdf",
        "--json": "r.json",
        "--report": "r.html",
    }
    options = [word for name, file in files.items() for word in (name, str(tmp_path / file))]
    argv = ["modes", *logs, "--inputs", *INPUTS, "--outputs", *OUTPUTS, "--springs", "drives", *options]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert "2 of 2 springs identified from 2 records" in printed
    soft = load_robot(tmp_path / "soft.urdf")
    result = json.loads((tmp_path / "r.json").read_text())
    assert [s.stiffness for s in soft.drive_springs] == [row["stiffness"] for row in result["springs"]]
    assert "identified" in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert main(["modes", "a.csv", "--inputs", "f", "--outputs", "x", "--springs", "drives"]) == 2
    assert main([*argv, "--method", "era"]) == 2


def test_a_negative_damping_is_written_as_zero(arm) -> None:
    """No spring drives a vibration: an estimate below zero leaves the file without damping."""
    soft = write_springs(arm, (), (Spring("j1", 1e4, -3.0, 50.0),))
    assert soft.drive_springs == (Spring("j1", 1e4, 0.0, 50.0),)
