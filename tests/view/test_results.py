"""Results of the other commands become something to show, or one sentence that says why not."""

import hashlib
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot
from tau_dyn.view import read_cloud, read_result
from tau_dyn.view.results import Cloud, ErrorVectors, Findings, Uncertainty


@pytest.fixture(scope="module")
def robot():
    """The simplified L1."""
    return load_robot("gantry_tau")


@pytest.fixture
def told(tmp_path, robot):
    """Writes a result and reads it for the robot."""

    def tell(compute=False, **content):
        (tmp_path / "r.json").write_text(json.dumps(content))
        return read_result(tmp_path / "r.json", robot, compute=compute)

    return tell


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[]", "not a result"),
        ("{", "not a result"),
        ('{"findings": [1]}', "not a whole result"),
        ('{"command": "ik"}', "can be shown"),
        ('{"command": "workspace"}', "not a whole result"),
        ('{"command": ["view"], "findings": 3}', "not a whole result"),
        ("[" * 100_000, "not a result"),
    ],
)
def test_what_is_no_result_is_one_sentence(tmp_path, robot, text, says):
    """A broken result file names itself."""
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        read_result(tmp_path / "r.json", robot)
    assert "r.json" in str(caught.value)


def test_a_finding_without_joints_is_about_its_parameters_parts(told):
    """A calibration's `arm2.length` is cart 2 and its rod; a diagnosis' joints are taken as they stand."""
    row = {
        "cause": "rod_length",
        "status": "confirmed",
        "joints": [],
        "parameters": [{"name": "arm2.length"}],
        "equation": "|A - B| = L",
    }
    other = {"cause": "stribeck", "status": "suspected", "joints": ["cart1"], "sentence": "It sticks."}
    (found,) = told(command="diagnose", sentence="Both.", findings=[row | {"gain": {"reduction_percent": 88.2}}, other])
    assert isinstance(found, Findings) and found.headline == "Both."
    assert found.rows[0].parts == ("cart2", "rod2")
    assert "88 %" in found.rows[0].sentence
    assert found.rows[1].parts == ("cart1",) and found.rows[1].sentence == "It sticks."


def test_a_workspace_is_its_box_or_coarse_points_where_asked(tmp_path, robot):
    """The command's own result is shown with its size and points; those worked out when asked lie in the box and are numbered."""
    assert main(["workspace", "gantry_tau", "--resolution", "0.2", "--json", str(tmp_path / "w.json"), "--quiet"]) == 0
    (plain,) = read_result(tmp_path / "w.json", robot)
    content = json.loads((tmp_path / "w.json").read_text())
    del content["cloud"]  # as older results have none
    (tmp_path / "w.json").write_text(json.dumps(content))
    (full,) = read_result(tmp_path / "w.json", robot, compute=True)
    assert isinstance(plain, Cloud) and isinstance(full, Cloud) and full.box is not None
    assert "volume" in plain.note and len(plain.points) > 100
    assert len(full.points) > 100 and np.all(full.values["condition number"] >= 1)
    assert np.all((full.points > full.box[0] - 0.2) & (full.points < full.box[1] + 0.2))
    content["cloud"] = {"points": [[1.0, 2.0, 3.0]], "values": {"stiffness [N/m]": [5.0]}}
    (tmp_path / "w.json").write_text(json.dumps(content))
    (own,) = read_result(tmp_path / "w.json", robot)
    assert isinstance(own, Cloud)
    assert_allclose(own.points, [[1, 2, 3]])
    assert_allclose(own.values["stiffness [N/m]"], [5])


def test_maps_of_springs_are_a_cloud_of_their_own(tmp_path, robot):
    """Stiffness and resonance stand at the places where springs were linearised, with their units; none where unknown."""
    words = ["workspace", "gantry_tau", "--resolution", "0.2", "--what", "stiffness", "resonance", "--quiet"]
    stated = ["--rod-stiffness", "1e7", "--actuator-stiffness", "rigid"]
    assert main([*words, *stated, "--json", str(tmp_path / "w.json")]) == 0
    rows = {row["map"]: row for row in json.loads((tmp_path / "w.json").read_text())["maps"]}
    _, springs = read_result(tmp_path / "w.json", robot)
    assert isinstance(springs, Cloud) and "as given" in springs.note
    value = springs.values["stiffness [N/m]"]
    assert len(value) == len(springs.points) and "resonance_2 [Hz]" in springs.values
    assert_allclose([value.min(), value.max()], [rows["stiffness"]["min"], rows["stiffness"]["max"]])
    assert_allclose(springs.points[np.argmin(value)], rows["stiffness"]["min_at"])
    assert main([*words, "--json", str(tmp_path / "u.json")]) == 0
    assert len(read_result(tmp_path / "u.json", robot)) == 1


def test_accuracy_lies_on_its_section(tmp_path, robot):
    """Each answered pose of the map becomes a point of the plane x = 1.7 m, its value the map's in mm."""
    words = ["--actuator-error", "50e-6", "--section", "x=1.7", "--grid", "7", "--method", "linear", "--quiet"]
    assert main(["accuracy", "gantry_tau", *words, "--json", str(tmp_path / "a.json")]) == 0
    (found,) = read_result(tmp_path / "a.json", robot)
    content = json.loads((tmp_path / "a.json").read_text())
    assert isinstance(found, Cloud) and found.flat
    (value,) = found.values.values()
    assert_allclose(found.points[:, 0], 1.7)
    assert len(value) == content["n_poses"]
    assert_allclose(value.max(), 1e3 * content["methods"]["linear"]["max"])
    worst = found.points[np.argmax(value)]
    assert_allclose(worst, content["methods"]["linear"]["worst_pose"]["tool"], atol=1e-9)


def test_a_calibration_brings_its_errors_along(told):
    """Points and one set of vectors a model; another number of vectors than points is no whole result."""
    row = {"cause": "backlash", "status": "confirmed", "joints": ["cart1"]}
    at = {"points": [[0, 0, 0], [1, 1, 1]], "models": {"frames": [[1e-3, 0, 0], [0, 1e-3, 0]]}}
    findings, errors = told(command="calibrate", findings=[row], errors_at_poses=at)
    assert isinstance(findings, Findings) and isinstance(errors, ErrorVectors)
    assert_allclose(np.linalg.norm(errors.models["frames"], axis=1), 1e-3)
    with raises_code("file_format"):
        told(command="calibrate", findings=[row], errors_at_poses={"points": [[0, 0, 0]], "models": at["models"]})


def test_errors_of_the_uncalibrated_robot_are_worked_out_where_asked(tmp_path, robot, told):
    """Poses measured in a turned frame, one of them 1 mm off, give vectors that show that pose; a changed file is refused."""
    rng = np.random.default_rng(3)
    q = robot.home + rng.uniform(-0.3, 0.3, (12, 3))
    tool = forward_kinematics(robot, q).poses.position.copy()
    tool[4] += [1e-3, 0, 0]
    seen = tool @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T + [3, 2, 1]
    lines = [
        "q_cart1,q_cart2,q_cart3,x_tool,y_tool,z_tool",
        *(",".join(f"{x:.9f}" for x in (*a, *b)) for a, b in zip(q, seen, strict=True)),
    ]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n")
    inputs = [{"path": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}]
    _, errors = told(compute=True, command="calibrate", findings=[], inputs=inputs)
    size = np.linalg.norm(errors.models["robot file"], axis=1)
    assert np.argmax(size) == 4 and 5e-4 < size[4] < 1e-3
    assert_allclose(errors.points, tool, atol=1e-3)
    path.write_text(path.read_text() + "0,0,0,1,1,1\n")
    with raises_code("file_format"):
        told(compute=True, command="calibrate", findings=[], inputs=inputs)


def test_modes_swing_the_tool_as_they_were_measured(told, robot):
    """A mode along x moves what carries the tool along x; outputs that name no place are refused."""
    shape = {f"{a}_tool": {"re": r, "im": 0.0} for a, r in zip("xyz", (1.0, 0.0, 0.0), strict=True)}
    mode = {"frequency_hz": 7.4, "damping_ratio": 0.01, "shape": shape}
    (found,) = told(command="modes", outputs_used=list(shape), modes=[mode])
    moved = np.concatenate(found.pairs[0].measured.links)
    assert_allclose(np.abs(moved).max(axis=0), [1, 0, 0], atol=1e-12)
    with raises_code("file_format"):
        told(command="modes", outputs_used=["s"], modes=[mode | {"shape": {"s": {"re": 1.0, "im": 0.0}}}])


def test_an_identification_says_how_well_masses_are_known(told):
    """Standard error over value by link; one without is not determined."""
    rows = [
        {"name": "cart1_link.mass", "value": 10.0, "stderr": 0.1},
        {"name": "plate_link.mass", "value": 9.0, "stderr": None},
    ]
    (found,) = told(command="identify", parameters=rows)
    assert isinstance(found, Uncertainty)
    assert found.links["cart1_link"] == pytest.approx(0.01) and np.isnan(found.links["plate_link"])


def test_a_cloud_is_read_with_its_numbers(tmp_path):
    """Columns x y z place the points, further numeric ones colour them; points outside a workspace are left out."""
    (tmp_path / "c.csv").write_text("x,y,z,stiffness\n0,0,1,5\n1,nan,0,6\n2,2,2,7\n")
    found = read_cloud(tmp_path / "c.csv")
    assert_allclose(found.points, [[0, 0, 1], [2, 2, 2]])
    assert list(found.values["stiffness"]) == [5, 7]
    (tmp_path / "w.csv").write_text("x_tool,y_tool,z_tool,q_a,inside,reason,condition\n0,0,1,1,1,,5\n1,1,0,2,0,out,6\n")
    found = read_cloud(tmp_path / "w.csv")
    assert len(found.points) == 1 and next(iter(found.values)) == "condition"
    (tmp_path / "d.csv").write_text("a,b\n1,2\n")
    with raises_code("file_format"):
        read_cloud(tmp_path / "d.csv")


def test_the_command_shows_and_ends(tmp_path, capsys):
    """`view` prints its address, stays for as long as told, and leaves status 0; a ghost without a log is refused."""
    pytest.importorskip("viser")
    result = tmp_path / "r.json"
    result.write_text(json.dumps({"findings": [{"cause": "stribeck", "status": "confirmed", "joints": ["axis"]}]}))
    assert main(["view", "linear_axis", "--result", str(result), "--for", "0.2", "--port", "18090"]) == 0
    assert "linear_axis at http://127.0.0.1:" in capsys.readouterr().out
    assert main(["view", "linear_axis", "--simulated", "x.csv"]) == 2
