"""From logs to an answer: what counts, what is refused, and what is said about doubtful input."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import Choices, build_regression, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import Trajectory, build_named_motion

PARAMETER_KEYS = {
    "name", "value", "unit", "stderr", "ci95", "identifiable", "determined", "nominal", "nominal_stderr", "at_bound",
}  # fmt: skip


def still(motion: Trajectory, *joints: str) -> Trajectory:
    """Return a motion in which all but these joints rest where they start."""
    rest = np.array([j not in joints for j in motion.joints])
    q = np.where(rest, motion.q[0], motion.q)
    return replace(motion, q=q, v=np.where(rest, 0.0, motion.v), a=np.where(rest, 0.0, motion.a))


def values(found) -> dict[str, float]:
    return {p.name: p.value for p in found.parameters if p.free}


def test_result_has_the_contracts_keys(found, l1):
    """Literally the keys that other programs rely on (CONTRACT 5), as plain JSON."""
    result = json.loads(json.dumps(found.to_dict()))
    assert {
        "seed",
        "warnings",
        "parameters",
        "base_parameters",
        "train",
        "holdout",
        "condition_number",
        "rank",
        "n_samples",
    } <= set(result)
    assert len(result["parameters"]) == 19
    for row in result["parameters"]:
        assert set(row) == PARAMETER_KEYS
        low, high = row["ci95"]
        assert_allclose(
            [low, high], [row["value"] - 1.96 * row["stderr"], row["value"] + 1.96 * row["stderr"]], rtol=1e-4
        )
        assert row["determined"] == (row["stderr"] < 0.3 * abs(row["value"]))
        assert row["identifiable"] is True
        assert row["at_bound"] is False
    for row in result["base_parameters"]:
        assert set(row) >= (PARAMETER_KEYS - {"nominal_stderr", "at_bound"}) | {"expression"}
    for part in ("train", "holdout"):
        errors = result[part]
        assert {"relative_error_percent", "per_joint", "used_share", "all_samples"} <= set(errors)
        assert set(errors["per_joint"]) == set(l1.actuated)
        assert all(set(e) == {"rms", "relative_error_percent"} for e in errors["per_joint"].values())
        assert {"relative_error_percent", "per_joint"} <= set(errors["all_samples"])
    assert result["rank"] == 19
    assert result["n_samples"] == found.estimate.regression.n_samples


def test_nominal_values_are_trusted_for_masses_only(found, l1):
    """A nominal mass is trusted to 2 %; friction has no nominal, though it started at zero."""
    rows = {row["name"]: row for row in found.to_dict()["parameters"]}
    assert rows["plate_link.mass"]["nominal"] == l1.parameters["plate_link.mass"].value
    assert_allclose(rows["plate_link.mass"]["nominal_stderr"], 0.02 * rows["plate_link.mass"]["nominal"])
    assert rows["cart1.coulomb_pos"]["nominal"] is None
    assert rows["cart1.coulomb_pos"]["nominal_stderr"] is None


def test_relative_error_is_that_of_the_contract(found):
    """`100 norm(tau - tau_hat) / norm(tau)` over the used samples of all joints, and joint by joint."""
    W, y, index = found.estimate.regression.stacked()
    e = y - W @ found.estimate.theta
    assert_allclose(found.train.relative_error_percent, 100 * np.linalg.norm(e) / np.linalg.norm(y), rtol=1e-9)
    for k in range(3):
        mine = index == k
        assert_allclose(found.train.rms[k], np.sqrt(np.mean(e[mine] ** 2)), rtol=1e-9)
        assert_allclose(
            found.train.per_joint_percent[k], 100 * np.linalg.norm(e[mine]) / np.linalg.norm(y[mine]), rtol=1e-9
        )
    assert 0.3 < found.train.used_share < 1
    assert found.train.all_samples.relative_error_percent > found.train.relative_error_percent  # reversals and all


def test_held_out_logs_are_not_fitted(found, l1, monday, tuesday):
    """The estimate is the same without the held-out log, and the preparation is that of the training log."""
    alone = identify(l1, monday)
    assert values(alone) == values(found)
    assert found.held.preparation is found.estimate.regression.preparation
    assert "tuesday.csv" in found.holdout_how


def test_without_held_out_logs_the_last_part_is_predicted_by_the_first(l1, monday):
    """The errors called held-out come from a fit of the first 70 %, of data behind it, by a filter's memory apart."""
    alone = identify(l1, monday)
    whole, last = alone.estimate.regression.runs[0], alone.held.runs[0]
    assert "last 30 %" in alone.holdout_how
    assert last.t[0] > whole.t[0] + 0.7 * (whole.t[-1] - whole.t[0])
    W, y, _ = alone.held.stacked()
    with_everything = np.sqrt(np.mean((y - W @ alone.estimate.theta) ** 2))
    reported = np.sqrt(np.sum(alone.holdout.rms**2 * last.usable.sum(axis=0)) / last.usable.sum())
    assert reported > with_everything  # the fit of everything has seen these data


def test_a_log_both_trained_on_and_held_out_is_said_and_left_out(l1, monday, tuesday):
    """Its errors are not held-out errors; another held-out log still counts."""
    both = identify(l1, monday, holdout=monday)
    assert any("monday.csv is both trained on and held out" in text for text in both.warnings)
    assert both.holdout is None
    assert both.to_dict()["holdout"] is None
    mixed = identify(l1, monday, holdout=[monday, tuesday])
    assert any("monday.csv is both" in text for text in mixed.warnings)
    assert mixed.holdout_how == "held-out logs: tuesday.csv"
    copy = Log(monday.t, monday.channels, "copy.csv", "abc")
    again = identify(l1, copy, holdout=Log(monday.t, monday.channels, "other name.csv", "abc"))
    assert again.holdout is None  # the same file by another name


def test_friction_descriptions_that_fit_alike_are_said(found, l1, axis, axis_log):
    """Asymmetric Coulomb friction is symmetric friction with an offset: a sentence a joint, with the offset's size."""
    assert len(found.equivalent) == 3
    p = found.parameters
    for joint, text in zip(l1.actuated, found.equivalent, strict=True):
        half = (p[f"{joint}.coulomb_pos"].value - p[f"{joint}.coulomb_neg"].value) / 2
        assert text.startswith(f"{joint}: Coulomb friction")
        assert f"constant offset of {half:+.3g} N" in text
        assert "force logs cannot separate the two" in text
    symmetric = identify(axis, axis_log, model="symmetric")
    assert symmetric.equivalent == ()
    assert {"axis.coulomb", "axis.viscous", "axis.offset"} <= set(values(symmetric))


def test_equivalent_descriptions_predict_the_same(axis, true_axis, make):
    """With one viscous coefficient, both descriptions leave the same residual to the last digits, at offset (Fc+ - Fc-) / 2."""
    one = true_axis.with_values({"axis.viscous_pos": 200.0, "axis.viscous_neg": 200.0, "axis.coulomb_pos": 26.0})
    log = make.recorded(one, build_named_motion("fourier", one, 20.0, 0), force_noise=0.0, encoder_noise=0.0)
    a, s = identify(axis, log), identify(axis, log, model="symmetric")
    assert "one viscous coefficient is sufficient" in a.equivalent[0]
    p, q = a.parameters, s.parameters
    assert_allclose(q["axis.offset"].value, (p["axis.coulomb_pos"].value - p["axis.coulomb_neg"].value) / 2, atol=2e-3)
    assert_allclose(q["axis.coulomb"].value, (p["axis.coulomb_pos"].value + p["axis.coulomb_neg"].value) / 2, atol=2e-2)


def test_complete_arms_show_their_rods_sum(make):
    """Two parallel rods: each keeps its nominal mass, has no error, and names the other; their sum is estimated and right."""
    robot = load_robot("gantry_tau", prototype="l1", arms="complete")
    from tau_dyn.cli.demo import build_true_model

    truth = build_true_model(robot, 2)
    found = identify(robot, make.recorded(truth, build_named_motion("fourier", truth, 12.0, 1)))
    rows = {row["name"]: row for row in found.rows()}
    for name, other in (("rod2a_link.mass", "rod2b_link.mass"), ("rod2b_link.mass", "rod2a_link.mass")):
        row = rows[name]
        assert (row["identifiable"], row["determined"], row["stderr"], row["ci95"]) == (False, False, None, None)
        assert row["value"] == row["nominal"] == robot.parameters[name].value
        assert row["depends_on"] == [other]
    base = {row["expression"]: row for row in found.base_rows()}
    total = base["rod2a_link.mass + rod2b_link.mass"]
    true = truth.parameters["rod2a_link.mass"].value + truth.parameters["rod2b_link.mass"].value
    assert abs(total["value"] - true) < 4.5 * total["stderr"]
    assert rows["plate_link.mass"]["identifiable"]
    assert not any("not excited" in text for text in found.warnings)  # no motion could


def test_a_still_robot_cannot_answer(l1, truth, monday, make):
    """A log in which nothing moves leaves with status 3 and says what to move."""
    quiet = make.recorded(truth, still(build_named_motion("fourier", truth, 20.0, 1)))
    with raises_code("poor_excitation") as fault:
        identify(l1, quiet)
    assert fault.value.exit_status == 3
    assert "move cart1, cart2, cart3 in both directions" in str(fault.value)


def test_force_noise_alone_cannot_answer(axis, axis_log, make):
    """Forces that have nothing to do with the motion determine no parameter to 30 %, and that is said instead of numbers."""
    rng = np.random.default_rng(5)
    noisy = make.changed(axis_log, tau_axis=50 * rng.normal(size=axis_log.n_samples))
    with raises_code("not_identifiable", "30"):
        identify(axis, noisy)


def test_one_joint_alone_leaves_the_others_named(l1, truth, make):
    """Where only cart1 moves its friction is found, and a warning names what to move for the rest."""
    motion = still(build_named_motion("fourier", truth, 30.0, 1), "cart1")
    found = identify(l1, make.recorded(truth, motion))
    for quantity in ("coulomb_pos", "viscous_neg"):
        p = found.parameters[f"cart1.{quantity}"]
        assert abs(p.value - truth.parameters[p.name].value) < 4.5 * p.stderr
    (unseen,) = [text for text in found.warnings if "not excited" in text]
    assert "cart2.coulomb_pos" in unseen
    assert "to identify them, move cart2, cart3" in unseen
    rows = {row["name"]: row for row in found.rows()}
    assert rows["cart3.viscous_pos"]["identifiable"]  # by a better motion
    assert rows["cart3.viscous_pos"]["stderr"] is None
    assert not rows["cart3.viscous_pos"]["determined"]


def test_an_undetermined_parameter_is_said(axis, true_axis, make):
    """At constant slow speeds the mass hardly shows: its error is above 30 %, and a warning gives value and error."""
    fast, slower = build_named_motion("fourier", true_axis, 20.0, 0), 25.0
    path = Trajectory(fast.joints, slower * fast.t, fast.q, fast.v / slower, fast.a / slower**2)  # now at 40 Hz
    found = identify(axis, make.recorded(true_axis, path, force_noise=100.0, rate_hz=1000.0))
    assert any(text.startswith("poorly determined") and "carriage_link.mass" in text for text in found.warnings)
    row = {r["name"]: r for r in found.rows()}["carriage_link.mass"]
    assert row["identifiable"]
    assert not row["determined"]


def test_flagged_and_saturated_samples_are_left_out(l1, monday, found, make):
    """A second of absurd forces spoils the answer, unless a column flags it or the drive's limit shows it."""
    n = monday.n_samples
    bad = np.zeros(n)
    bad[3000:3250] = 1
    limit = l1.effort_limit[0]
    assert np.isfinite(limit)
    flagged = make.changed(monday, tau_cart1=monday.channels["tau_cart1"] + 300 * bad, fault=bad)
    saturated = make.changed(monday, tau_cart1=np.where(bad > 0, limit, monday.channels["tau_cart1"]))
    spoilt = identify(l1, flagged)
    for spared in (identify(l1, flagged, exclude=("fault",)), identify(l1, saturated)):
        shift = spared.estimate.beta - found.estimate.beta
        assert np.max(np.abs(shift) / found.estimate.stderr) < 2
        assert spared.estimate.regression.n_samples < found.estimate.regression.n_samples
    assert np.max(np.abs(spoilt.estimate.beta - found.estimate.beta) / found.estimate.stderr) > 10
    with raises_code("missing_column"):
        identify(l1, monday, exclude=("alarm",))


def test_flagged_samples_are_left_out_of_held_out_logs_too(l1, monday, tuesday, make):
    """What `exclude` names is excluded wherever errors are taken."""
    bad = np.zeros(tuesday.n_samples)
    bad[1000:1250] = 1
    spoilt = make.changed(tuesday, tau_cart1=tuesday.channels["tau_cart1"] + 300 * bad, fault=bad)
    clean = make.changed(monday, fault=np.zeros(monday.n_samples))
    spared = identify(l1, clean, holdout=spoilt, exclude=("fault",))
    assert spared.holdout.rms[0] < 2 * spared.train.rms[0]


def test_two_logs_are_not_joined(l1, truth, monday, make):
    """Two logs from different places are two runs; joined, the jump between them would be an acceleration of 1000 m/s^2."""
    other = make.recorded(truth, build_named_motion("fourier", truth, 15.0, 9), seed=4, name="wednesday.csv")
    both = identify(l1, [monday, other])
    assert [run.name for run in both.estimate.regression.runs] == ["monday.csv", "wednesday.csv"]
    for run, log in zip(both.estimate.regression.runs, (monday, other), strict=True):
        assert run.t[0] == log.t[0]
    off = [(p.value - truth.parameters[p.name].value) / p.stderr for p in both.parameters if p.stderr]
    assert np.max(np.abs(off)) < 4.5


def test_a_gap_cuts_the_log_and_is_said(l1, truth, monday):
    """Two seconds lost: the rest is two runs, the answer is still right, and a warning says where."""
    keep = np.ones(monday.n_samples, bool)
    keep[2000:2500] = False
    broken = Log(monday.t[keep], {k: x[keep] for k, x in monday.channels.items()}, "broken.csv")
    found = identify(l1, broken)
    assert len(found.estimate.regression.runs) == 2
    assert any("broken.csv has 1 gap in time" in text for text in found.warnings)
    off = [(p.value - truth.parameters[p.name].value) / p.stderr for p in found.parameters if p.stderr]
    assert np.max(np.abs(off)) < 4.5


def test_uneven_sampling_is_put_right_and_said(l1, truth, monday):
    """Steps that vary by 10 % are interpolated onto an even clock, with a warning, and the answer is still right."""
    rng = np.random.default_rng(8)
    fine = build_named_motion("fourier", truth, 30.0, 1)
    t = monday.t + 4e-4 * rng.uniform(-0.5, 0.5, monday.n_samples)
    t[0], t[-1] = monday.t[0], monday.t[-1]
    shift = t - monday.t
    path = fine.every(4)
    channels = {}
    for k, j in enumerate(l1.actuated):
        channels[f"q_{j}"] = monday.channels[f"q_{j}"] + path.v[:, k] * shift + path.a[:, k] * shift**2 / 2
        channels[f"tau_{j}"] = monday.channels[f"tau_{j}"]
    for k, slope in enumerate(np.gradient(truth.torque(path.q, path.v, path.a), monday.t, axis=0).T):
        smooth = np.abs(path.v[:, k]) > 0.05  # nobody can shift a force through a reversal
        channels[f"tau_{l1.actuated[k]}"] = channels[f"tau_{l1.actuated[k]}"] + np.where(smooth, slope * shift, 0.0)
    found = identify(l1, Log(t, channels, "uneven.csv"))
    assert any("uneven.csv: its steps vary" in text for text in found.warnings)
    off = [(p.value - truth.parameters[p.name].value) / p.stderr for p in found.parameters if p.stderr]
    assert np.max(np.abs(off)) < 4.5


def test_millimetres_are_noticed(axis, axis_log, l1, monday, make):
    """Positions that read like millimetres: a warning where an answer is still possible, part of the refusal where not."""
    found = identify(axis, make.changed(axis_log, q_axis=1e3 * axis_log.channels["q_axis"]))
    assert any(
        "the unit is probably mm (a gear ratio looks alike): write `q_axis: {column: q_axis, scale: 0.001}`" in text
        for text in found.warnings
    )
    scaled = {f"q_{j}": 1e3 * monday.channels[f"q_{j}"] for j in l1.actuated}
    with raises_code("loop_not_closed"):
        identify(l1, make.changed(monday, **scaled))


def test_a_missing_column_is_named(l1, monday):
    """Without forces of a joint there is nothing to fit."""
    channels = {k: x for k, x in monday.channels.items() if k != "tau_cart2"}
    with raises_code("missing_column", "monday.csv", "tau_cart2"):
        identify(l1, Log(monday.t, channels, "monday.csv"))
    with raises_code("missing_input"):
        identify(l1, [])


def test_models_by_name_by_file_and_as_they_are(axis, axis_log, tmp_path):
    """A saved model identifies again to the same values, whether named as a file or given; unknown names list the known."""
    first = identify(axis, axis_log)
    path = tmp_path / "model.yaml"
    first.model.save(path)
    for model in (path, Model.load(path)):
        again = identify(axis, axis_log, model=model)
        assert_allclose(list(values(again).values()), list(values(first).values()), rtol=1e-9)
    assert first.model.provenance["trained_on"] == [{"path": "axis.csv", "sha256": ""}]
    with raises_code("unknown_name"):
        identify(axis, axis_log, model="assymetric")
    rigid = identify(axis, axis_log, model="rigid")
    assert list(values(rigid)) == ["carriage_link.mass"]
    assert rigid.train.relative_error_percent > 5 * first.train.relative_error_percent


def test_a_model_of_another_robot_is_refused(axis, l1, axis_log):
    """Its joints are not those of the robot."""
    with raises_code("mismatch", "cart1", "cart2", "cart3"):
        identify(axis, axis_log, model=Model.of(l1))


def test_a_bad_log_is_a_bad_fit_but_good_ones_bring_no_doubt(found):
    """A rich motion of a robot that is as modelled brings no warning at all."""
    assert found.warnings == ()


def test_columns_and_forces_pass_the_same_filter(l1, truth, monday):
    """`y - W theta_true` is the filtered noise: nowhere more than 6 of its deviations, at its rms by the filter's bandwidth.

    White noise of 5 N at 250 Hz keeps `sqrt(2 B / 250)` of its deviation; the gate raises it, at most by 1 / sqrt(share).
    """
    regression = build_regression(Model.of(truth.robot, truth.effects), [monday])
    e = np.concatenate(
        [r[run.usable] for r, run in zip(regression.residuals(truth.parameters.values), regression.runs, strict=True)]
    )
    preparation = regression.preparation
    floor = 5 * np.sqrt(2 * 0.9 * preparation.force_cutoff_hz / 250)
    assert 0.9 * floor < np.sqrt(np.mean(e**2)) < 1.3 * floor
    assert np.max(np.abs(e)) < 6 * floor


def test_what_the_low_pass_spreads_of_a_reversal_is_kept_out(axis, true_axis, make):
    """Around reversals nothing is used, so a friction step of 40 N leaves less than 1 % of itself in a clean residual."""
    log = make.recorded(
        true_axis, build_named_motion("fourier", true_axis, 20.0, 0), force_noise=0.0, encoder_noise=0.0
    )
    regression = build_regression(Model.of(true_axis.robot, true_axis.effects), [log])
    run = regression.runs[0]
    e = regression.residuals(true_axis.parameters.values)[0]
    assert np.max(np.abs(e[run.usable])) < 0.4
    everything = regression.residuals_all(true_axis.parameters.values)[0]
    assert np.max(np.abs(everything)) > 2.0


def test_encoder_noise_does_not_fold_through_the_gate(axis, true_axis, make):
    """With 5 um of encoder noise and nothing else wrong the residual of a 93 kg axis stays below 0.2 N rms.

    Differentiated, that noise is an acceleration of 0.04 m/s^2 up to 60 Hz, 4 N; sharp gates let 0.43 N of it into the band.
    """
    squares = []
    for seed in range(3):
        log = make.recorded(true_axis, build_named_motion("fourier", true_axis, 20.0, 0), force_noise=0.0, seed=seed)
        regression = build_regression(Model.of(true_axis.robot, true_axis.effects), [log])
        (residual,), (run,) = regression.residuals(true_axis.parameters.values), regression.runs
        squares.append(np.mean(residual[run.usable] ** 2))
    assert np.sqrt(np.mean(squares)) < 0.2


def test_the_filters_do_not_see_beyond_a_logs_ends(l1, monday):
    """A log cut in mid motion: within a filter's length of its ends nothing is used."""
    regression = build_regression(Model.of(l1), [monday.window(1000, 6000)])
    (run,) = regression.runs
    length = 1 / regression.preparation.force_cutoff_hz
    near = (run.t < run.t[0] + 0.7 * length) | (run.t > run.t[-1] - 0.7 * length)
    assert near.sum() >= 4
    assert not run.usable[near].any()


def test_a_log_full_of_holes_is_said_once(axis, axis_log, rng):
    """Of a dozen jittery pieces two are described and the rest counted: nobody reads sixty warnings."""
    kept = np.ones(axis_log.n_samples, bool)
    for k in range(1, 13):
        kept[380 * k : 380 * k + 20] = False
    t = axis_log.t + rng.uniform(-2e-4, 2e-4, axis_log.n_samples)
    holed = Log(t[kept], {name: x[kept] for name, x in axis_log.channels.items()}, "holed.csv")
    about = [w for w in identify(axis, holed).warnings if w.startswith("holed.csv")]
    assert len(about) == 3 and "more warnings like these" in about[-1]


def test_the_same_log_twice_is_no_more_evidence(axis, axis_log):
    """A log given twice counts once, with a warning: otherwise every standard error would shrink by the square root of two."""
    once, twice = identify(axis, axis_log), identify(axis, [axis_log, axis_log])
    assert any("given twice" in w for w in twice.warnings)
    assert twice.estimate.regression.n_samples == once.estimate.regression.n_samples


def test_with_everything_fixed_nothing_is_left_to_estimate(axis, axis_log):
    """Fixing all parameters is the user's fault, not the data's."""
    with raises_code("bad_option"):
        identify(axis, axis_log, choices=Choices(fix=("*",)))


def test_a_path_is_read(axis):
    """A path of a file that is not there is named."""
    with raises_code("file_not_found", "monday.csv"):
        identify(axis, "monday.csv")


def test_parts_of_one_file_may_be_held_out(axis, axis_log):
    """The first 70 % of a file and its rest are different data, though they share the file's hash."""
    whole = Log(axis_log.t, dict(axis_log.channels), "one.csv", "a" * 64)
    train, rest = whole.split(0.7)
    found = identify(axis, train, holdout=rest)
    assert found.holdout is not None and not any("both trained on" in w for w in found.warnings)


def test_a_robot_file_without_masses_is_identified():
    """Of a sliding body that its file gives no mass, forces of 12 kg and 3 N of friction say both."""
    robot = load_robot_from_urdf(
        '<robot name="slider"><link name="base_link"/><link name="cart_link"/>'
        '<joint name="cart" type="prismatic"><parent link="base_link"/><child link="cart_link"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" velocity="9" effort="99"/></joint>'
        '<transmission name="t"><joint name="cart"/></transmission></robot>',
        "slider",
    )
    t, rng = np.arange(0, 30, 0.004), np.random.default_rng(8)
    q = sum(0.2 / k * np.sin(2 * np.pi * f * t + k) for k, f in enumerate((0.3, 0.71, 1.3), 1))
    v, a = (np.gradient(q, t), np.gradient(np.gradient(q, t), t))
    force = 12 * a + 3 * np.sign(v) + 2 * v + 0.2 * rng.standard_normal(len(t))
    found = identify(robot, Log(t, {"q_cart": q, "tau_cart": force}, "log.csv"))
    told = {p.name: p for p in found.parameters}
    moved = [p for name, p in told.items() if name.endswith((".mass", ".armature")) and p.stderr]
    assert sum(p.value for p in moved) == pytest.approx(12, abs=0.1)
