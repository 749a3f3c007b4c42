"""From poses to a named model: what is wrong is found, what is not wrong is left alone, bad poses are named."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from sampling import assert_variance_ratio
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import Spec, family_at, measured, rods_of, spoiled

from tau_dyn.calibrate import (
    PoseSet,
    calibrate,
    causes,
    compute_sensitivities,
    load_calibration,
    read_poses,
    save_calibration,
)
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.measured import MeasurementNoise, estimate_measurement_noise
from tau_dyn.calibrate.model_selection import Options, fit_and_cross_validate
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.simulated import TRACKER, format_csv, simulate_poses
from tau_dyn.calibrate.unknowns import collect
from tau_dyn.evidence import Gain
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.message_codes import get_code
from tau_dyn.render.kinds.calibration_words import describe_verdict
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def worn():
    """L1 with skew guideways, a cyclic error at cart 2 and backlash at cart 1, found by auto; one pose is wrong by 2 cm."""
    rods = rods_of()
    poses, theta = measured(
        rods,
        "nonparallel+periodic:cart2",
        240,
        1,
        periods={"cart2": 0.031},
        backlash=np.array([6e-5, 0, 0]),
        cart2__error_sin=8e-5,
    )
    poses.position[17] += 0.02
    return rods, poses, calibrate(rods.robot, poses, accuracy=(1e-5,)), theta


def test_auto_finds_what_is_wrong_and_nothing_else(worn):
    """The chosen model has the cyclic error and the backlash that are there, and no piecewise or compliant carts."""
    _, _, found, _ = worn
    assert found.chosen.spec.structure == "nonparallel"
    assert found.chosen.spec.additions == {"periodic": ("cart2",), "backlash": ("cart1",)}
    assert found.errors(found.chosen).position_size.rms < 2.1e-5


def test_auto_estimates_period_amplitude_and_backlash(worn):
    """Values of the laws lie within four standard errors of the truth."""
    _, _, found, _ = worn
    for name, true in (("cart2.error_period", 0.031), ("cart2.error_sin", 8e-5), ("cart1.backlash", 6e-5)):
        p = found.fit.parameters[name]
        assert p.stderr is not None and abs(p.value - true) < 4 * p.stderr


def test_causes_are_named_with_their_gain(worn):
    """Every cause that was put in is named and held-out poses confirm it."""
    _, _, found, _ = worn
    causes = {(f.cause, f.joints): f for f in found.findings}
    assert {("transmission_error", ("cart2",)), ("backlash", ("cart1",))} <= set(causes)
    assert {"guideway_nonparallel", "rod_length", "joint_placement"} <= {f.cause for f in found.findings}
    assert causes["transmission_error", ("cart2",)].status == "confirmed"
    assert causes["transmission_error", ("cart2",)].gain.reduction_percent > 30


def test_a_gross_outlier_is_named_and_left_out(worn):
    """The pose that is off by centimetres is named by its place and takes no part."""
    _, poses, found, _ = worn
    assert any("1 pose was left out as gross outlier: pose 18 (" in w for w in found.warnings)
    assert found.poses.n + found.holdout.n == poses.n - 1


def test_predicted_accuracy_is_what_unseen_poses_show(worn):
    """Noise and the parameters' uncertainty foretell the error at held-out poses within a fifth."""
    _, _, found, _ = worn
    assert found.errors(found.chosen).position_size.rms == pytest.approx(found.predicted_error(), rel=0.2)


def test_without_a_stated_accuracy_nothing_judges_the_error(worn):
    """What a fit leaves is no measure of the device; the answer says that it is unknown, not that all is well."""
    _, _, found, _ = worn
    assert describe_verdict(found).level == "good"
    unknown = replace(found, measured=MeasurementNoise("unknown"))
    said = describe_verdict(unknown)
    assert unknown.predicted_error() is None and unknown.to_dict()["predicted_rms"] is None
    assert said.level == "care" and "--accuracy" in said.sentence
    finer = replace(found, measured=MeasurementNoise("stated", 2e-6))
    assert "lacks an effect" in describe_verdict(finer).sentence


def test_an_error_of_millimetres_is_not_usable():
    """Two campaigns whose device moved by 40 mm, read as one, leave centimetres: the answer says not to use it."""
    rods = rods_of()
    poses, _ = measured(rods, "frames", 60, 8, size=0.0)
    poses.position[30:] += (0.04, 0.0, 0.0)
    found = calibrate(rods.robot, poses, model="frames", accuracy=(1e-5,))
    assert describe_verdict(found).level == "poor"


def test_repeated_poses_tell_the_noise():
    """Six joints' positions measured five times each: 24 differences in three directions give 10 um and 20 urad."""
    rods = rods_of("gantry_tau_f1")
    rng = np.random.default_rng(2)
    geometry = family_at(rods).build(family_at(rods).spec("frames"))
    q = np.repeat(rods.robot.home + 0.3 * (2 * rng.random((6, 6)) - 1), 5, axis=0)
    poses = simulate_poses(geometry, geometry.parameters.values, q, rng)
    found = estimate_measurement_noise(poses)
    assert found.source == "repeats"
    assert_variance_ratio(np.square([found.position / 1e-5, found.orientation / 2e-5]), 3 * 24)
    assert estimate_measurement_noise(poses.take(np.arange(0, 30, 5))).source == "unknown"


def test_a_target_that_turned_between_campaigns_is_named():
    """The target turns by 0.3 mrad and stays in place: only orientations show it, and they decide."""
    rods = rods_of("gantry_tau_f1")
    rng = np.random.default_rng(4)
    geometry = family_at(rods).build(family_at(rods).spec("frames"))
    old = TRACKER.tool[0]
    turn = Rotation.from_rotvec([3e-4, 0.0, 0.0]).as_matrix()
    frames = DeviceFrames(TRACKER.device, (old, Frame(old.rotation @ turn, old.translation)))
    q = rods.robot.home + 0.3 * (2 * rng.random((80, 6)) - 1)
    campaign = np.repeat([0, 1], 40)
    poses = simulate_poses(geometry, geometry.parameters.values, q, rng, frames=frames, campaign=campaign)
    found = calibrate(rods.robot, poses)
    (finding,) = found.findings
    assert found.chosen.name == "frames+tool_frame" and finding.cause == "tool_frame" and finding.status == "confirmed"
    assert finding.gain.orientation_rms_after is not None and finding.gain.orientation_rms_before is not None
    assert finding.gain.orientation_rms_after < 0.6 * finding.gain.orientation_rms_before


def test_stated_standard_errors_weigh_the_poses(tmp_path):
    """Half of the poses are stated, and are, 500 times worse: the dimensions come out as from the good half alone."""
    rods = rods_of()
    poses, theta = measured(rods, "nonparallel", 120, 6)
    rng = np.random.default_rng(0)
    stated = np.full((120, 3), 1e-5)
    stated[::2] = 5e-3
    poses.position[::2] += 5e-3 * rng.standard_normal((60, 3))
    path = tmp_path / "poses.csv"
    header, *rows = format_csv(poses, rods.robot.actuated).splitlines()
    more = (f"{row},{e[0]:g},{e[1]:g},{e[2]:g}" for row, e in zip(rows, stated, strict=True))
    path.write_text("\n".join([header + ",x_tool_stderr,y_tool_stderr,z_tool_stderr", *more]) + "\n")
    read = read_poses(path, rods.robot.actuated)
    found = calibrate(rods.robot, read, model="nonparallel")
    good = calibrate(rods.robot, read.take(np.arange(1, 120, 2)), model="nonparallel")
    q = rods.robot.home + 0.3 * (2 * rng.random((50, 3)) - 1)
    truth = found.fit.geometry.forward(theta, q).poses.position

    def off(fitted):
        device = fitted.frames.device[0]
        seen = fitted.frames.measured(fitted.geometry.forward(fitted.theta, q).poses, np.zeros(50, int)).position
        true_seen = TRACKER.device[0].translation + truth @ TRACKER.device[0].rotation.T
        return float(
            np.sqrt(np.mean(np.sum((seen - true_seen - (seen - true_seen).mean(axis=0)) ** 2, axis=1)))
        ), device

    assert off(found.fit)[0] < 2 * off(good.fit)[0] < 1e-4
    assert found.measured.source == "columns" and not [w for w in found.warnings if "outlier" in w]


@pytest.mark.parametrize(("ci95", "status"), [((5.0, 9.0), "confirmed"), ((-9.0, -2.0), "suspected")])
def test_what_held_out_poses_contradict_is_not_confirmed(monkeypatch, ci95, status: str):
    """Signed ranks may favour a cause whose squared errors grow at held-out poses: it is suspected only."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 60, 5)
    family, options = family_at(rods), Options()
    chosen = fit_and_cross_validate(family, family.spec("nonparallel"), poses, options)
    by_folds = Gain(2e-5, 1e-5, 50.0, (40.0, 60.0), 1e-9)
    held = Gain(8.1e-5, 10.6e-5, ci95[0], ci95, 1e-3)
    answers = iter([by_folds, held] * 20)
    monkeypatch.setattr(causes, "compare_paired", lambda *_: next(answers))
    found = causes.find_causes(family, chosen, poses, options)
    assert found and {f.status for f in found} == {status}


def test_saved_model_predicts_as_before(worn, tmp_path):
    """A calibrated robot read from its file predicts the same poses; its rods serve forward kinematics."""
    rods, poses, found, _ = worn
    save_calibration(tmp_path / "m.yaml", found)
    again = load_calibration(tmp_path / "m.yaml")
    q = poses.q[:20]
    np.testing.assert_allclose(
        again.seen(q).position,
        found.fit.frames.measured(found.fit.geometry.forward(found.fit.theta, q).poses, np.zeros(20, int)).position,
        atol=1e-12,
    )
    plain = forward_kinematics(again.rods, q).poses.position
    assert 1e-6 < np.linalg.norm(plain - again.forward(q).poses.position, axis=1).max() < 3e-4  # the law left out


def test_exact_robot_keeps_the_smallest_model():
    """Poses of a robot that is as its file says choose no larger model and name no cause."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 60, 3, size=0.0)
    found = calibrate(rods.robot, poses)
    assert found.chosen.name == "frames" and not found.findings


def test_a_base_that_moved_between_campaigns_is_named():
    """The device stands elsewhere in the second campaign: the cause is the base's frame, not geometry."""
    rods = rods_of("gantry_tau_f1")
    rng = np.random.default_rng(4)
    geometry = family_at(rods).build(family_at(rods).spec("frames"))
    moved = Frame(TRACKER.device[0].rotation, TRACKER.device[0].translation + np.array([0.0, 4e-4, 0.0]))
    campaign = np.repeat([0, 1], 40)
    q = rods.robot.home + 0.3 * (2 * rng.random((80, 6)) - 1)
    poses = simulate_poses(
        geometry,
        geometry.parameters.values,
        q,
        rng,
        frames=DeviceFrames((TRACKER.device[0], moved), TRACKER.tool),
        campaign=campaign,
    )
    found = calibrate(rods.robot, poses)
    assert found.chosen.name == "frames+base_frame"
    assert [f.cause for f in found.findings] == ["base_frame"]


def test_models_without_a_cause_keep_what_the_user_fixed(monkeypatch):
    """A cause's worth is told by a smaller model: a length that the user fixed stays fixed in it."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 40, 5)
    family, options = family_at(rods), Options(fix=("arm1.length",))
    chosen = fit_and_cross_validate(family, family.spec("nonparallel"), poses, options)
    smaller = []
    monkeypatch.setattr(causes, "cross_validate", lambda fitted, seed: smaller.append(fitted) or chosen.unseen)
    causes.find_causes(family, chosen, None, options)
    free = [dict(zip(f.unknowns.names, f.unknowns.free.tolist(), strict=True)) for f in smaller]
    assert any("arm1.length" in row and any(row.values()) for row in free)
    assert not any(row.get("arm1.length", False) for row in free)


def test_backlash_has_the_unit_of_its_joint():
    """Backlash of a cart is a length, of a turning joint an angle."""
    for name, unit in (("gantry_tau", "m"), ("delta", "rad")):
        geometry = get_family(load_robot(name), PoseSet(np.zeros((2, 3)), np.zeros((2, 3)))).build(Spec("complete"))
        unknowns = collect(geometry, DeviceFrames(), device=True, tool=True, turned=False, backlash=True)
        assert {row.unit for row in unknowns.rows if row.name.endswith(".backlash")} == {unit}


def test_sensitivity_is_what_moving_one_parameter_does(worn):
    """The accumulated displacement of the table is that of predictions with the parameter moved to both sides."""
    _, _, found, _ = worn
    fitted = found.fit
    k = fitted.geometry.parameters.names.index("arm2.length")
    step = 5e-5 * np.eye(len(fitted.theta))[k]
    at = fitted.state.base.position
    q = fitted.poses.q - 0.5 * fitted.state.slack[:-1] * fitted.poses.approach
    moved = sum(
        np.linalg.norm(
            fitted.geometry.forward(fitted.theta + sign * step, q, fitted.state.base).poses.position - at, axis=1
        ).sum()
        for sign in (1, -1)
    )
    assert compute_sensitivities(fitted)[k].position == pytest.approx(moved, rel=0.01)


def _poses(n: int, seed: int = 0) -> PoseSet:
    return measured(rods_of(), "nonparallel", n, seed)[0]


def test_too_few_poses_say_how_many_are_needed():
    """Five positions cannot tell a frame and 21 parameters; the sentence counts."""
    with raises_code("too_little_data", "5", "8"):
        calibrate(rods_of().robot, _poses(5), model="nonparallel")


def test_poses_in_a_plane_are_refused_with_the_experiment():
    """Positions in one plane cannot tell the robot across it."""
    rods = rods_of()
    q = rods.robot.home + 0.3 * (2 * np.random.default_rng(0).random((300, 3)) - 1)
    found = forward_kinematics(rods, q)
    near = np.abs(found.poses.position[:, 0] - rods.home.position[0, 0]) < 1e9
    flat = found.poses.position[near] * np.array([0.0, 1.0, 1.0])
    with raises_code("poor_excitation"):
        calibrate(rods.robot, PoseSet(q[near], flat))


def test_a_mirrored_device_is_read_with_two_axes_exchanged():
    """One mirrored axis fits no rotation; exchanged columns are the same for positions, and the answer is as exact as without."""
    poses = _poses(50)
    mirrored = replace(poses, position=poses.position * np.array([1.0, -1.0, 1.0]))
    found, plain = (calibrate(rods_of().robot, p, model="nonparallel") for p in (mirrored, poses))
    assert [f.cause for f in found.findings if f.cause == "columns_exchanged"] and "poses_reread" in map(
        get_code, found.warnings
    )
    assert found.errors(found.chosen).position_size.rms == pytest.approx(
        plain.errors(plain.chosen).position_size.rms, rel=0.05
    )


def test_duplicated_poses_count_once():
    """A pose that repeats another exactly brings no information, and is named."""
    poses = _poses(60)
    twice = poses.take(np.r_[np.arange(60), 3, 4])
    found = calibrate(rods_of().robot, twice, model="nonparallel")
    assert any("2 poses repeat another one exactly and count once (pose 4, pose 5)" in w for w in found.warnings)
    assert found.holdout is not None and found.poses.n + found.holdout.n == 60


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda t: t.replace("y_tool", "why", 1), "has no column y_tool"),
        (lambda t: t.replace("\n", ",1\n", 1).replace("z_tool", "z_tool", 1), "column|cells|commas|line"),
        (lambda t: _cell(t, 3, 4, "nan"), r"line 4.*x_tool.*not a number|x_tool"),
        (lambda t: _cell(t, 3, 4, "1800.0"), "m from the device; positions are in m, not in mm"),
    ],
)
def test_bad_files_are_told_in_a_sentence(tmp_path, spoil, sentence):
    """Missing columns, broken rows, empty numbers and wrong units each name the place."""
    rods = rods_of()
    path = tmp_path / "poses.csv"
    path.write_text(spoil(format_csv(_poses(12), rods.robot.actuated)))
    with pytest.raises(InputError, match=sentence):
        read_poses(path, rods.robot.actuated)


def _cell(text: str, row: int, column: int, value: str) -> str:
    lines = text.split("\n")
    cells = lines[row].split(",")
    cells[column - 1] = value
    lines[row] = ",".join(cells)
    return "\n".join(lines)


def test_poses_come_back_from_their_file(tmp_path):
    """Positions, orientations, approach and campaigns survive a round trip through CSV."""
    rods = rods_of("gantry_tau_f1")
    poses, _ = measured(rods, "complete", 10, 0, reach=0.2)
    poses = replace(poses, campaign=np.repeat([0, 1], [4, poses.n - 4]), campaigns=("1", "2"))
    (tmp_path / "p.csv").write_text(format_csv(poses, rods.robot.actuated))
    again = read_poses(tmp_path / "p.csv", rods.robot.actuated)
    np.testing.assert_allclose(again.q, poses.q, atol=1e-8)
    assert again.rotation is not None and poses.rotation is not None
    np.testing.assert_allclose(again.rotation, poses.rotation, atol=1e-8)
    assert again.campaign.tolist() == poses.campaign.tolist()
    assert np.array_equal(again.approach, poses.approach)


def test_a_calibration_takes_the_names_of_its_files(tmp_path):
    """Robot, poses and held-out poses as paths give what they give when read first; a number is no set of poses."""
    robot = load_robot("gantry_tau")
    poses, _ = measured(rods_of(), "ideal", 24, 0)
    paths = [tmp_path / "train.csv", tmp_path / "test.csv"]
    for path, index in zip(paths, (np.arange(16), np.arange(16, 24)), strict=True):
        path.write_text(format_csv(poses.take(index), robot.actuated))
    train, test = (read_poses(path, robot.actuated) for path in paths)
    found = calibrate("gantry_tau", paths[0], str(paths[1]), model="ideal")
    assert found.to_dict()["models"] == calibrate(robot, train, test, model="ideal").to_dict()["models"]
    with raises_code("invalid_value", "int"):
        calibrate(robot, 3)  # type: ignore[arg-type]


def test_model_names_that_do_not_exist_are_told():
    """An unknown structure, addition or joint lists those that there are."""
    for name in ("perfect", "nonparallel+magic", "nonparallel+periodic:cart9"):
        with raises_code("unknown_name"):
            calibrate(rods_of().robot, _poses(30), model=name)


def test_spoiled_parameters_differ():
    """The rig really is off nominal, or these tests would show nothing."""
    geometry = family_at(rods_of()).build(family_at(rods_of()).spec("nonparallel"))
    assert np.abs(spoiled(geometry, np.random.default_rng(0)) - geometry.parameters.values).min() > 0


@pytest.mark.parametrize(("moved", "said"), [(0.0, False), (1e-3, True), (0.5, True)])
def test_a_device_moved_before_the_held_out_poses_is_said_with_its_amount(moved, said):
    """A device shifted before the held-out poses shifts them all alike, so that no pose is an outlier of the others."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 60, 3)
    held = poses.take(np.arange(40, 60))
    held = replace(held, position=held.position + np.array([moved, 0.0, 0.0]))
    found = calibrate(rods.robot, poses.take(np.arange(40)), held, "nonparallel")
    assert found.holdout is not None and found.holdout.n == 20
    amounts = [float(w.partition(", by ")[2].split()[0]) for w in found.warnings if "seems to have moved" in w]
    assert amounts == (pytest.approx([1e3 * moved], abs=0.1) if said else []), found.warnings
    found.to_dict()


def test_a_robot_all_of_whose_frames_are_known_has_nothing_to_fit_but_its_dimensions():
    """With both frames known the smallest model has no unknown: its error is what 3 mm of a rod do, and rods explain it."""
    rng, robot = np.random.default_rng(0), load_robot("gantry_tau")
    built = load_robot("gantry_tau", **{"simplified.arms.1.rods.1.length": 2.053})
    q = robot.home + rng.uniform(-0.3, 0.3, (20, 3))
    poses = PoseSet(q, forward_kinematics(built, q).poses.position + 1e-5 * rng.standard_normal((20, 3)))
    plain, fitted = (calibrate(robot, poses, model=m, device=False, tool=False) for m in ("frames", "ideal"))
    assert plain.fit.n_estimated == 0 and plain.parameter_rows() == []
    assert plain.errors(plain.chosen).position_size.rms > 2e-3 > 100 * fitted.errors(fitted.chosen).position_size.rms


def test_a_figure_compares_the_robot_file_with_the_chosen_model():
    """Position errors at unseen poses [mm]: one point a pose and model, with the rms that the result reports."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 60, 0)
    found = calibrate(load_robot("gantry_tau"), poses, model="nonparallel")
    (axis,) = found.plot().axes
    before, after = axis.lines[0].get_ydata(), axis.lines[2].get_ydata()
    assert len(after) == found.at().n and np.median(before) > 3 * np.median(after)
    assert axis.lines[3].get_ydata()[0] == pytest.approx(1e3 * found.errors(found.chosen).position_size.rms, rel=1e-6)
