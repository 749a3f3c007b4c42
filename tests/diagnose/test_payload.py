"""What is off on an arm whose torques Pinocchio gives: a payload, a force scale, a rotor, gravity's direction, or nothing."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.diagnose import diagnose, nominal, payload
from tau_dyn.diagnose.nominal import describe_body_difference, find_parameter_changes
from tau_dyn.diagnose.payload import compare_with_trusted, compute_body_properties, find_explanation
from tau_dyn.evidence import Finding
from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.log import Log
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

JOINTS = ("turn", "lift", "bend", "roll")
MASS, CENTRE = 1.5, np.array([0.02, -0.03, 0.15])  # [kg], [m] in the last joint's frame
LINKS = (
    ("column", 4.0, "0.02 0.05 0.1", 0.05),
    ("upper", 6.0, "0.2 0.02 0", 0.08),
    ("fore", 3.0, "0.15 -0.02 0.01", 0.03),
    ("hand", 1.0, "0 0.01 0.05", 0.005),
)
PLACES = ("0 0 0.2", "0 0.1 0.1", "0.4 0 0", "0.3 0 0")
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0")


def written(folder: Path, rotor: float | None = None) -> Robot:
    """Return an arm of four hinges, whose file may give the rotors' inertia."""
    parts = ['<robot name="arm" xmlns:drake="http://drake.mit.edu"><link name="base_link"/>']
    parent = "base_link"
    for (link, mass, centre, inertia), joint, place, axis in zip(LINKS, JOINTS, PLACES, AXES, strict=True):
        parts.append(
            f'<link name="{link}_link"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>'
            f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial></link>'
            f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{link}_link"/>'
            f'<axis xyz="{axis}"/><origin xyz="{place}"/><limit lower="-3" upper="3" velocity="9" effort="900"/></joint>'
        )
        parent = f"{link}_link"
    inertia = "" if rotor is None else f'<drake:rotor_inertia value="{rotor}"/><drake:gear_ratio value="1"/>'
    for joint in JOINTS:
        parts.append(
            f'<transmission name="{joint}_drive"><type>transmission_interface/SimpleTransmission</type>'
            f'<joint name="{joint}"/><actuator name="{joint}_motor">{inertia}</actuator></transmission>'
        )
    path = folder / "arm.urdf"
    path.write_text("\n".join([*parts, "</robot>"]))
    return load_robot(path)


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    """The arm without a word about rotors."""
    return written(tmp_path_factory.mktemp("arm"))


def recorded(
    robot: Robot,
    seed: int,
    payload: float = 0.0,
    scale: tuple[int, float] = (0, 1.0),
    rotor: float | np.ndarray = 0.0,
    lean: Sequence[float] = (0.0, 0.0, 0.0),
) -> Log:
    """Return 30 s of smooth motion with Pinocchio's torques, friction, and noise."""
    rng = np.random.default_rng(seed)
    model = pin.Model(robot.model)
    if payload:
        model.inertias[4] = model.inertias[4] + pin.Inertia(payload, CENTRE, 2e-3 * payload * np.eye(3))
    model.gravity.linear = pin.exp3(np.array(lean)) @ model.gravity.linear
    data = model.createData()
    t = np.arange(0, 30, 0.01)
    q, v, a = np.zeros((3, len(t), 4))
    for k in range(4):
        for h in range(1, 6):
            w, size, phase = 2 * np.pi * 0.13 * h * rng.uniform(0.9, 1.1), rng.uniform(0.2, 0.5) / h, rng.uniform(0, 6)
            q[:, k] += size * np.sin(w * t + phase)
            v[:, k] += size * w * np.cos(w * t + phase)
            a[:, k] -= size * w**2 * np.sin(w * t + phase)
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q, v, a, strict=True)]) + rotor * a
    tau += 2 * np.sign(v) + 3 * v
    tau[:, scale[0]] *= scale[1]
    tau += 0.05 * rng.standard_normal(tau.shape)
    columns = {f"q_{j}": q[:, k] + 2e-6 * rng.standard_normal(len(t)) for k, j in enumerate(JOINTS)}
    return Log(t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(JOINTS)}, f"log{seed}")


@pytest.fixture(scope="module")
def judged(robot) -> Callable[..., list[Finding]]:
    """Return findings about a fit of a log, against the robot file or an identified model."""

    def judge(log: Log, baseline: Identification | None = None) -> list[Finding]:
        fit = identify(robot, [log], model="asymmetric" if baseline is None else baseline.model)
        return find_parameter_changes(fit.model, fit.nominal, fit.parameters, fit.estimate)

    return judge


def test_an_arm_as_its_file_says_has_no_payload(robot, judged) -> None:
    """With and without rotors that the file leaves out: their inertia is no body's."""
    assert judged(recorded(robot, 1)) == []
    assert judged(recorded(robot, 2, rotor=0.4)) == []


def test_bodies_that_need_the_nominal_force_are_suspected_at_most(robot, monkeypatch) -> None:
    """The size is the payload's force beside friction and rotors, as Pinocchio gives it, over the measured force's."""
    log = recorded(robot, 3, payload=MASS)
    fit = identify(robot, [log], model="asymmetric")
    share = compare_with_trusted(fit.model.robot, fit.nominal, fit.estimate).force_share
    q, tau = (np.column_stack([log.channels[f"{c}_{j}"] for j in JOINTS]) for c in ("q", "tau"))
    loaded = pin.Model(robot.model)
    loaded.inertias[4] = loaded.inertias[4] + pin.Inertia(MASS, CENTRE, 2e-3 * MASS * np.eye(3))
    v = np.gradient(q, log.t, axis=0)
    a = np.gradient(v, log.t, axis=0)
    with_it, without = (
        np.array([pin.rnea(m, m.createData(), *x) for x in zip(q, v, a, strict=True)]) for m in (loaded, robot.model)
    )
    left = np.zeros(4)
    for k in range(4):
        more, speed = with_it[:, k] - without[:, k], v[:, k]
        free = np.column_stack([speed > 0, speed < 0, np.maximum(speed, 0), np.minimum(speed, 0), a[:, k]])
        left[k] = np.sum((more - free @ np.linalg.lstsq(free, more)[0]) ** 2)
    assert share == pytest.approx(np.sqrt(left.sum() / np.sum(tau**2)), rel=0.05)
    weighed = identify(robot, [log], model="asymmetric", choices=Choices(fix=("column_link.mass=4+-0.1",)))
    assert compare_with_trusted(weighed.model.robot, weighed.nominal, weighed.estimate).force_share == pytest.approx(
        share, rel=1e-6
    )
    for level, status in ((0.9 * share, "parameter"), (1.1 * share, "suspected")):
        monkeypatch.setattr(nominal, "MIN_FORCE_SHARE", level)
        (found,) = find_parameter_changes(fit.model, fit.nominal, fit.parameters, fit.estimate)
        assert (found.cause, found.status) == ("payload", status)


@pytest.mark.parametrize("rotor", [0.0, 0.4])
def test_a_payload_is_one_body_with_mass_and_centre(robot, judged, rotor) -> None:
    """1.5 kg off the last axis, masses trusted to 2 %: one finding, within 5 % and 1 cm; the last link may be heavier as well."""
    (found,) = judged(recorded(robot, 3, payload=MASS, rotor=rotor))
    assert found.cause == "payload" and found.status == "parameter" and found.joints == ("hand_link",)
    values = {p.name: p for p in found.parameters}
    assert values["payload.mass"].value == pytest.approx(MASS, rel=0.05)
    centre = [values[f"payload.centre_{x}"].value for x in "xyz"]
    assert np.abs(centre - CENTRE).max() < 0.01
    assert found.indistinguishable_from == ("link_mass",)
    assert "kg at (" in found.sentence and "in the frame of roll" in found.sentence and "±" in found.sentence


def test_an_identified_model_tells_a_payload_within_its_errors(robot, judged) -> None:
    """Against the same arm unloaded: mass and centre within four standard errors, which are a tenth of those against a file."""
    empty = identify(robot, [recorded(robot, 4)])
    assert judged(recorded(robot, 5), empty) == []
    (found,) = judged(recorded(robot, 6, payload=MASS), empty)
    assert found.cause == "payload" and found.indistinguishable_from == ()
    truth = dict(zip(("mass", "centre_x", "centre_y", "centre_z"), (MASS, *CENTRE), strict=True))
    for p in found.parameters:
        assert p.stderr is not None
        assert abs(p.value - truth[p.name.removeprefix("payload.")]) < 4 * p.stderr
    assert (found.parameters[0].stderr or 1) < 0.02


def test_a_scaled_force_is_said_at_its_joint(robot, judged) -> None:
    """20 % too much at one joint is no body's mass: its factor within 10 %."""
    (found,) = judged(recorded(robot, 7, scale=(1, 1.2)))
    assert found.cause == "force_scale" and found.joints == ("lift",) and found.status == "parameter"
    (factor,) = found.parameters
    assert factor.name == "lift.force_scale" and factor.value == pytest.approx(1.2, rel=0.1)


def test_a_leaning_base_is_named_with_its_angles(robot) -> None:
    """Gravity turned by 20 mrad about x and -30 about y: both angles within three standard errors and 3 %, and no other cause."""
    found = diagnose(robot, [recorded(robot, 8, lean=(0.02, -0.03, 0.0))])
    (first,) = [f for f in found.findings if f.status == "confirmed"]
    assert first.cause == "gravity_direction"
    for p, truth in zip(first.parameters, (0.02, -0.03), strict=True):
        assert abs(p.value - truth) < 3 * (p.stderr or 0) + 0.03 * abs(truth)


def test_a_rotor_other_than_the_files_is_a_parameter(tmp_path) -> None:
    """The file gives 0.2 kg m^2 to every joint, one has 0.5: its error, as a finding about a number of the file."""
    given = written(tmp_path, rotor=0.2)
    plain = np.array([0.2, 0.2, 0.5, 0.2])  # Pinocchio's model holds no rotors here
    assert not given.model.armature.any()
    found = diagnose(given, [recorded(given, 9, rotor=plain)])
    (first,) = [f for f in found.findings if f.cause == "armature"]
    assert first.status == "parameter" and first.joints == ("bend",)
    (p,) = first.parameters
    assert p.value == pytest.approx(0.3, abs=4 * (p.stderr or 0) + 0.01) and p.unit == "N m s^2/rad"


def test_a_body_is_the_same_in_any_frame() -> None:
    """Two point masses on a bar: mass, middle and `m r^2` about it come back from the numbers about any origin and axes."""
    ends, turn = np.array([[0.3, 0.1, -0.2], [0.5, -0.1, 0.2]]), Rotation.from_rotvec([0.4, -0.2, 0.7]).as_matrix()
    pi = np.concatenate([[4.0], 2.0 * ends.sum(axis=0), _inertia(ends, 2.0)])
    place = np.array([0.1, 0.2, 0.3])
    found = compute_body_properties(pi, turn, place)
    assert_allclose(found[:4], [4.0, *(turn.T @ (ends.mean(axis=0) - place))], rtol=1e-12)
    assert_allclose(found[4:], _inertia((ends - ends.mean(axis=0)) @ turn, 2.0), atol=1e-12)


def _inertia(points: np.ndarray, mass: float) -> np.ndarray:
    """Return `ixx ixy iyy ixz iyz izz` of equal point masses (n, 3) about the origin."""
    J = sum(mass * (p @ p * np.eye(3) - np.outer(p, p)) for p in points)
    return J[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]


def test_trust_in_the_file_enters_as_its_square(robot) -> None:
    """Masses trusted to s, 2 s and 3 s: what that adds to the covariance of a difference grows as 1, 4, 9."""
    fit = identify(robot, [recorded(robot, 3)], model="asymmetric")
    added = []
    for factor in (1.0, 2.0, 3.0):
        known = {
            p.name: {"prior_stderr": 0.05 * factor * p.value}
            for p in fit.nominal
            if p.name.endswith(".mass") and p.value > 0
        }
        added.append(compare_with_trusted(robot, fit.nominal.update(known), fit.estimate).S)
    assert_allclose(added[2] - added[0], 8 / 3 * (added[1] - added[0]), rtol=1e-6, atol=1e-12)
    assert np.trace(added[1] - added[0]) > 0


def _scaled(robot: Robot, factors: Sequence[float]) -> Robot:
    """Return the robot with each body as a whole times a factor."""
    model = pin.Model(robot.model)
    for k, factor in enumerate(factors, start=1):
        model.inertias[k] = pin.Inertia.FromDynamicParameters(factor * model.inertias[k].toDynamicParameters())
    return replace(robot, model=model)


@pytest.mark.parametrize(
    ("factors", "cause"),
    [
        ((1.09, 1.21, 1.08, 0.67), None),
        ((0.84, 0.96, 1.42, 1.16), None),
        ((1.0, 1.3, 1.0, 1.0), "link_mass"),
        ((1.05, 1.05, 1.05, 1.05), "drive_gain"),
    ],
)
def test_a_file_with_all_bodies_off_has_no_single_cause(robot, judged, factors, cause) -> None:
    """Four bodies that are off by different shares are no payload and no wrong link; one body, or one factor of all, is named."""
    found = judged(recorded(_scaled(robot, factors), 100))
    assert [finding.cause for finding in found] == ([] if cause is None else [cause])
    if cause == "link_mass":
        assert found[0].joints == ("upper_link",)
        assert_allclose(found[0].parameters[0].value, 0.3 * 6.0, rtol=0.1)


@pytest.mark.parametrize(
    ("body", "compared"),
    [
        ("", False),
        ('<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>', False),
        ('<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="0.9"/></inertial>', True),
    ],
)
def test_bodies_that_the_file_does_not_give_differ_from_nothing(robot, body, compared) -> None:
    """A log of a real arm contradicts stated bodies, but no file without masses, and no file with one sphere for all links."""
    bare = load_robot_from_urdf(re.sub("<inertial>.*?</inertial>", body, robot.urdf, flags=re.DOTALL), "arm")
    fit = identify(bare, [recorded(robot, 1)], model="asymmetric")
    remark = describe_body_difference(fit.model, fit.nominal, fit.estimate)
    assert bool(remark or find_parameter_changes(fit.model, fit.nominal, fit.parameters, fit.estimate)) is compared


@pytest.mark.parametrize(("angle", "places"), [(0.15, ("roll_link",)), (0.6, ())])
def test_two_links_that_explain_as_much_are_both_named(robot, judged, monkeypatch, angle, places) -> None:
    """Masses of neighbours change forces almost alike: 10 standard errors tell the two only beyond 16 degrees between them."""
    fit = identify(robot, [recorded(robot, 3)], model="asymmetric")
    tip, roll = np.array([1.0, 0.0]), np.array([np.cos(angle), np.sin(angle)])
    known = compare_with_trusted(robot, fit.nominal, fit.estimate)
    measured = replace(known, d=-10.0 * tip, S=np.eye(2), S_rough=None, select=known.select[:2])
    rows = [("link_mass", "tip_link", tip[:, None]), ("link_mass", "roll_link", roll[:, None])]
    monkeypatch.setattr(payload, "_candidates", lambda *_: rows)
    monkeypatch.setattr(nominal, "compare_with_trusted", lambda *_: measured)
    found = find_explanation(robot, measured)
    assert found is not None and found.place == "tip_link" and found.places == places
    [finding] = find_parameter_changes(fit.model, fit.nominal, fit.parameters, fit.estimate)
    assert finding.status == ("suspected" if places else "parameter")
    assert ("roll_link" in finding.why_not_confirmed) == bool(places)


@pytest.mark.parametrize(("margin", "named"), [(7.0, False), (9.0, True)])
def test_a_rough_file_is_a_rival_of_one_wrong_mass(robot, monkeypatch, margin, named) -> None:
    """Bodies that are all off a little explain a difference, too: one link is named where it is 50 times as likely."""
    fit = identify(robot, [recorded(_scaled(robot, (1.0, 1.3, 1.0, 1.0)), 100)], model="asymmetric")
    difference = compare_with_trusted(robot, fit.nominal, fit.estimate)
    found = find_explanation(robot, difference)
    assert found is not None and found.place == "upper_link"
    monkeypatch.setattr(type(difference), "rough_misfit", property(lambda _: found.penalised + margin))
    assert (find_explanation(robot, difference) is not None) == named
