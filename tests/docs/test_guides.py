"""A reader who types what guides, explanations, references and the README say, in a folder with logs, meets no error."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, blocks, commands
from page_replay import play, replay

LANGUAGES = ("", "bash", "sh", "python")


@dataclass(frozen=True)
class Guide:
    """How a page is executed.

    Attributes:
        words: Words of the page and what stands for them.
        options: Beginnings of commands and options that shorten them.
        python: Code for the names that the page's Python takes for given.
        data: File of the data folder that the page needs.
    """

    words: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    python: str = ""
    data: str = ""


GANTRY = {"ROBOT": "gantry_tau", "MODEL.yaml": "model.yaml"}
GUIDES = {
    "README.md": Guide(),
    "docs/index.md": Guide(),
    "docs/explanation/architecture.md": Guide(
        python="""
import numpy as np
from tau_dyn.mechanism import build_kinematics, build_mechanism
from tau_dyn.robot import load_robot
robot = load_robot("gantry_tau")
q, v, a = robot.home[None] + 0.01, np.full((1, 3), 0.1), np.zeros((1, 3))
poses, parameters = build_kinematics(robot).forward(q).poses, build_kinematics(robot).geometry
"""
    ),
    "docs/how_to/calibrate.md": Guide(),
    "docs/how_to/check_a_log.md": Guide({"ROBOT": "gantry_tau", "LOG": "log.csv"}),
    "docs/how_to/compensate.md": Guide(
        options={"tau-dyn calibrate": "--model ideal"},
        python="""
from tau_dyn.calibrate import read_poses
from tau_dyn.robot import load_robot as load
load_robot = lambda name: load("gantry_tau")
robot = load("gantry_tau")
q = robot.home[None]
""",
    ),
    "docs/how_to/controller.md": Guide(
        GANTRY
        | {
            "MOTION.csv": "reference.csv",
            "C.csv": "correction.csv",
            "joints|tool": "joints",
            "--mode 1 3": "--mode 1 2",
        },
        python="""
from page_blocks import ROOT, blocks
from tau_dyn.cli import main
main("modes bench.csv --inputs force_x force_y --outputs x_tool y_tool --order 4 --method n4sid --json modes.json".split())
page = (ROOT / "docs" / "how_to" / "controller.md").read_text(encoding="utf-8")
exec(next(block.text for block in blocks(page) if block.language == "python"))  # writes reference and correction
""",
    ),
    "docs/how_to/diagnose.md": Guide(),
    "docs/how_to/estimators.md": Guide({"auto|wls|ml|iv|robust": "wls"}),
    "docs/how_to/exchange.md": Guide(
        {"monday.yaml": "model.yaml", "tuesday.yaml": "model.yaml"},
        python="""
from tau_dyn.cli import main
for log, result in (("monday.csv", "before.json"), ("tuesday.csv", "after.json")):
    main(["identify", "gantry_tau", log, "--json", result, "--quiet"])
""",
    ),
    "docs/how_to/excitation.md": Guide(
        {"ROBOT": "linear_axis", "MOTION.csv": "motion.csv"}, {"tau-dyn excite": "--duration 5 --trials 2 --time 5"}
    ),
    "docs/how_to/feedforward.md": Guide(
        GANTRY | {"CART.urdf": "cart.urdf", "MOTION.csv": "cart.csv"},
        python="""
import sys
from pathlib import Path
import numpy as np
import pandas as pd
from page_blocks import ROOT
sys.path.insert(0, str(ROOT / "tests"))
import redundant
Path("cart.urdf").write_text(redundant.write_cart())
moved = redundant.move_cart(np.arange(0, 2, 0.004))
pd.DataFrame({"t": moved.t, "q_ref_rail1": moved.q[:, 0]}).to_csv("cart.csv", index=False)
""",
    ),
    "docs/how_to/kinematics.md": Guide(
        {"ROBOT": "gantry_tau", "POSES.csv": "poses.csv", "POSITIONS.csv": "found.csv", "X Y Z W": "0 0 0 1"}
    ),
    "docs/how_to/lead_through.md": Guide(
        python="""
from types import SimpleNamespace
import numpy as np
handle_wrench, tool_wrench = np.zeros(6), np.zeros(6)
pose = SimpleNamespace(position=np.zeros(3), rotation=np.eye(3))
"""
    ),
    "docs/how_to/learning.md": Guide(
        {"ROBOT": "linear_axis", "--measured x_tool y_tool": "--measured x_gauge", "ax_tool ay_tool": "ax_tool"}
    ),
    "docs/how_to/notebooks.md": Guide(),
    "docs/how_to/observers.md": Guide(
        {"LOG": "t1.csv", "ROBOT": "linear_axis", "MODEL.yaml": "kalman.yaml"}
        | {"x_tool y_tool": "x_tool", "ax_tool ay_tool": "ax_tool", "4.5 2.6": "4.5"}
    ),
    "docs/how_to/payload_and_watch.md": Guide(
        GANTRY | {"monday.csv": "shift1.csv", "tuesday.csv": "shift2.csv"}, {"tau-dyn watch": "--patience 1"}
    ),
    "docs/how_to/runs.md": Guide(
        python="""
from tau_dyn.cli import main
main("identify gantry_tau log.csv --holdout tuesday.csv --out runs/wednesday/ --quiet".split())
"""
    ),
    "docs/how_to/samples_and_fleet.md": Guide(GANTRY),
    "docs/reference/files.md": Guide(),
    "docs/reference/robots.md": Guide(),
    "docs/how_to/accuracy.md": Guide(
        options={"tau-dyn accuracy": "--grid 3 --samples 5 --method linear parallelepiped"}
    ),
    "docs/how_to/camera.md": Guide(options={"tau-dyn calibrate": "--model ideal"}),
    "docs/how_to/modes.md": Guide(options={"tau-dyn modes bench.csv": "--order 4 --method n4sid"}),
    "docs/how_to/optimal_motion.md": Guide(
        {"ROBOT|MODEL.yaml": "gantry_tau", "ROBOT": "gantry_tau", "line|POINTS.csv": "line", "F ...": "900"}
        | {"X Y Z --to X Y Z": "1.6 -0.65 0.7 --to 1.8 -0.6 0.75", "W": "1e-9", "SHARE": "0.1", "S": "0.004"},
        python="""
from tau_dyn import Model, load_robot
from tau_dyn.simulate import CascadeLaw
model = Model.of(load_robot("gantry_tau"))
law = CascadeLaw.for_model(model)
""",
    ),
    "docs/how_to/viewer.md": Guide(
        {"why.json": "identified.json"},
        {"tau-dyn view": "--for 0.1"},
        """
import shutil
from tau_dyn.cli import main
shutil.copy("monday.csv", "monday_sim.csv")
main("identify gantry_tau monday.csv --json identified.json --quiet".split())
main("workspace gantry_tau --resolution 0.5 --what condition --json workspace.json --out points.csv --quiet".split())
main("accuracy gantry_tau --actuator-error 5e-5 --grid 3 --method linear --json accuracy.json --quiet".split())
""",
    ),
    "docs/how_to/without_torque.md": Guide(
        python="""
import page_inputs
import tau_dyn as td
robot = page_inputs.write_servo()
"""
    ),
    "docs/how_to/plan_poses.md": Guide(
        options={"tau-dyn plan-poses gantry_tau --camera camera.yaml --obstacles": "--n 12"}
    ),
    "docs/how_to/workspace.md": Guide(options={"tau-dyn workspace": "--resolution 0.4"}),
    "docs/reference/python.md": Guide(
        python="""
import page_inputs
import tau_dyn as td
page_inputs.write_axis()
log = td.read_log("axis.csv")
found = td.identify("linear_axis", log)
why = td.diagnose(found)
""",
        data="emps/DATA_EMPS.csv",
    ),
}
"""Pages that are executed."""

UNRUN = {
    "python3 -m venv": "installs from a registry",
    "pip install": "installs from a registry",
    "tau-dyn demo": "a minute; tests/cli/test_demo.py runs it",
    "tau-dyn fk ur.urdf.xacro": "needs a checkout of the ROS package ur_description",
    "tau-dyn fk unitree_go1/go1.xml": "needs a checkout of mujoco_menagerie",
    "tau-dyn plan-poses gantry_tau --camera placed.yaml": "needs a photograph; tests/cli/test_plan_poses.py draws one",
    "tau-dyn see": "pictures of a camera; tests/cli/test_see.py draws and reads them",
    "tau-dyn modes at1.csv": "minutes; tests/modes fit springs at poses",
    "tau-dyn modes bench.unv": "needs a universal file; tests/log read such files",
    "tau-dyn identify go2.urdf": "needs a recording of a quadruped; tests/legged simulate one",
    "tau-dyn identify so101": "measured logs; experiments/without_torque.py runs it",
    "tau-dyn diagnose linear_axis emps.csv": "measured logs; tests/identification run it",
    "tau-dyn identify linear_axis $TAU_DYN_DATA": "measured logs; tests/identification run it",
    "python experiments/": "a study of minutes to hours; its page states what it measured",
    "python identification/": "measured logs; tests/identification run it",
}
"""Beginnings of lines that are not executed, with the reason."""


def adapt(guide: Guide, lines: list[str]) -> list[str]:
    """Return commands in the form in which they are executed: words replaced, brackets of options left out, shortened."""
    found = []
    for line in lines:
        if not line.startswith(("tau-dyn ", "python ")) or line.startswith(tuple(UNRUN)):
            continue
        for word, instead in guide.words.items():
            line = re.sub(rf"(?<![\w./-]){re.escape(word)}(?![\w.-])", instead, line)
        line = re.sub(r"(?<=\s)\[|\]", "", line)
        more = [options for start, options in guide.options.items() if line.startswith(start)]
        found.append(" ".join([line, *more]))
    return found


@pytest.fixture(scope="session")
def inputs(tmp_path_factory):
    """Return a folder with the files that guides take for given, simulated once."""
    folder = tmp_path_factory.mktemp("given")
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from page_inputs import write_inputs; write_inputs()"
    step = {"language": "python", "title": "", "text": code, "commands": [], "where": "inputs"}
    (answer,) = play([step], folder)
    assert not answer["status"], answer["text"]
    return folder


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", GUIDES)
def test_every_block_runs(name, inputs, measured):
    """Each command and each block of Python ends well, and shows what the page shows behind it."""
    guide = GUIDES[name]
    if guide.data:
        measured(guide.data)

    def prepare(folder: Path) -> str:
        shutil.copytree(inputs, folder, dirs_exist_ok=True)
        return guide.python or "pass"

    played = replay(ROOT / name, LANGUAGES, prepare, lambda lines: adapt(guide, lines))
    faults = [f"{name}, line {p.step.block.line}:\n{p.fault}" for p in played if p.fault]
    assert played and not faults, "\n\n".join(faults)


def test_every_page_with_a_block_is_executed():
    """A page with Python or a command that can be executed is in one of the lists, here or in test_tutorials.py."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    held = {
        str(page.relative_to(ROOT))
        for page in pages
        for block in blocks(page.read_text(encoding="utf-8"))
        if block.language == "python" or (block.language in LANGUAGES and adapt(Guide(), commands(block.text)))
    }
    assert {name for name in held if "tutorials/" not in name} == {*GUIDES}


def test_a_line_that_fails_is_seen_before_one_that_works(tmp_path):
    """The status of a block is the largest of its lines, and an error of Python is one of its block."""
    lines = ["tau-dyn robots nowhere.urdf", "tau-dyn robots delta"]
    shell = {"language": "sh", "title": "", "text": "", "commands": lines, "where": "here"}
    python = {"language": "python", "title": "", "text": "1 / 0", "commands": [], "where": "here"}
    first, second = play([shell, python], tmp_path)
    assert first["status"] == 2 and "nowhere.urdf" in first["text"]
    assert second["status"] == 1 and "ZeroDivisionError" in second["text"]
