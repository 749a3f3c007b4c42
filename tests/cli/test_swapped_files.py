"""A file of another kind in an argument's place: one sentence that is about the file, status 2 or 3, and nothing written."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pandas as pd
import pytest

from tau_dyn import Log, Model, load_robot
from tau_dyn.cli import main

KINDS = ("log.csv", "robot.urdf", "model.yaml", "result.json", "folder", "empty.csv", "binary.bin", "list.yaml")
R, L, M, J = "robot.urdf", "log.csv", "model.yaml", "result.json"
CALLS = {
    "check @": L,
    "check log.csv @": R,
    "check log.csv --columns @": "",
    "columns @ linear_axis": L,
    "columns log.csv @": R,
    "simulate @ --out s.csv": f"{R} {M}",
    "simulate linear_axis --motion @ --out s.csv": L,
    "simulate linear_axis --model @ --out s.csv": M,
    "simulate linear_axis --effects @ --out s.csv": "",
    "simulate linear_axis --controller @ --out s.csv": "",
    "excite @ --out m.csv": R,
    "excite linear_axis --noise-from @ --out m.csv": L,
    "identify @ log.csv": R,
    "identify linear_axis @": L,
    "identify linear_axis log.csv --holdout @": L,
    "identify linear_axis log.csv --model @": M,
    "identify linear_axis log.csv --columns @": "",
    "identify linear_axis commands.csv --controller @": "",
    "diagnose @ log.csv": R,
    "diagnose linear_axis @": L,
    "diagnose linear_axis log.csv --controller @": "",
    "modes @ --inputs tau_axis --outputs q_axis": L,
    "modes log.csv --holdout @ --inputs tau_axis --outputs q_axis": L,
    "modes log.csv --robot @ --springs drives --inputs tau_axis --outputs q_axis --out x.urdf": R,
    "modes log.csv --robot linear_axis --springs drives --poses @ --inputs tau_axis --outputs q_axis --out x.urdf": "",
    "calibrate @ poses.csv": R,
    "calibrate linear_axis @": "",
    "calibrate linear_axis poses.csv --holdout @": "",
    "calibrate linear_axis poses.csv --correct @ --corrected c.csv": L,
    "plan-poses @ --n 9 --out p.csv --fixtures list.yaml": R,
    "plan-poses linear_axis --n 9 --fixtures @ --out p.csv": "",
    "plan-poses linear_axis --n 9 --camera @ --out p.csv": "",
    "plan-poses linear_axis --n 9 --tracker @ --out p.csv": "",
    "plan-motion @ --from 0 0 0 --to 0.3 0 0 --out p.csv": f"{R} {M}",
    "plan-motion linear_axis --from-joints 0 --to-joints 0.3 --path @ --out p.csv": "",
    "feedforward export @ --to c --out ff.c": f"{R} {M}",
    "export @ --to urdf --out e.urdf": f"{R} {M}",
    "export @ --to shaper --period 0.001 --out s.c": "",
    "export model.yaml --to reference --motion @ --out r.csv": L,
    "export model.yaml --to reference --motion motion.csv --correction @ --out r.csv": "",
    "export model.yaml --to mjlab --actuators @ --out r.py": "",
    "export model.yaml --to playground --samples @ --out r.py": "",
    "actuators @": L,
    "learn @ log.csv --out c.csv": L,
    "learn log.csv @ --out c.csv": L,
    "learn log.csv --history @ --out c.csv": L,
    "learn log.csv log.csv --actuators @ --out c.csv": "",
    "learn log.csv log.csv --correction @ --out c.csv": "",
    "observe @ linear_axis --acceleration q_axis --cutoff 4": L,
    "observe log.csv @ --acceleration q_axis --cutoff 4": R,
    "observe log.csv --kinematic q_axis --acceleration tau_axis --model @": "",
    "lead-through @": "",
    "lead-through --stiffness 5e4 --settings @": "",
    "lead-through --stiffness 5e4 --actuators @": "",
    "payload @ log.csv --loaded log.csv": f"{R} {M}",
    "payload linear_axis @ --loaded log.csv": L,
    "payload linear_axis log.csv --loaded @": L,
    "watch @ log.csv": M,
    "watch model.yaml @": L,
    "fleet @ log.csv other.csv third.csv": f"{R} {M}",
    "fleet linear_axis a=@ b=other.csv c=third.csv": L,
    "fleet linear_axis a=log.csv b=other.csv c=third.csv --model @": M,
    "compare @ model.yaml": M,
    "compare model.yaml @": M,
    "view @ --for 0.1": f"{R} {M}",
    "view linear_axis @ --for 0.1": L,
    "view linear_axis --result @ --for 0.1": "",
    "view linear_axis --cloud @ --for 0.1": "",
    "fk @ --q 0.1": R,
    "fk linear_axis --poses @": L,
    "ik @ --position 0.1 0 0": R,
    "ik linear_axis --poses @": "",
    "accuracy @ --actuator-error 5e-5 --poses poses.csv": R,
    "accuracy linear_axis --errors @ --poses poses.csv": "",
    "accuracy linear_axis --measured @ --poses poses.csv": "",
    "accuracy linear_axis --actuator-error 5e-5 --poses @": L,
    "workspace @": R,
    "workspace linear_axis --obstacles @": "",
    "fk linear_axis --q 0.1 --srdf @": "",
    "fk linear_axis --q 0.1 --set @": "",
    "robots @": R,
    "causes @": "",
    "data @": "",
    "demo @ --out dd": R,
}
"""Commands with a file's place, and the kinds that belong there."""
FOREIGN = re.compile(
    r"Errno|NoneType|object is not|indices must|codec|Traceback|has no attribute|unexpected keyword|\bdict\b"
)
"""Words of Python's own errors."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a folder with one file of each kind."""
    folder, t = tmp_path_factory.mktemp("kinds"), np.arange(0.0, 5.0, 0.01)
    q = 0.1 * np.sin(5 * t) + 0.03 * np.sin(9 * t)
    channels = {"q_axis": q, "tau_axis": 95 * np.gradient(np.gradient(q, t), t), "q_ref_axis": q}
    Log(t, channels).to_csv(folder / "log.csv")
    Log(t, channels | {"q_axis": 0.9 * q}).to_csv(folder / "other.csv")
    Log(t, channels | {"q_axis": 0.8 * q}).to_csv(folder / "third.csv")
    share = np.clip((t[:500] - 1) / 3, 0, 1)
    Log(t[:500] * 0.4, {"q_ref_axis": 0.1 * share**3 * (10 - 15 * share + 6 * share**2)}).to_csv(folder / "motion.csv")
    Log(t, {"q_axis": q, "cmd_axis": q}).to_csv(folder / "commands.csv")
    (folder / "robot.urdf").write_text(load_robot("linear_axis").urdf, encoding="utf-8")
    Model.of(load_robot("linear_axis")).save(folder / "model.yaml")
    places = np.linspace(-0.4, 0.4, 12)
    zero = np.zeros(12)
    pd.DataFrame({"q_axis": places, "x_tool": places, "y_tool": zero, "z_tool": zero}).to_csv(
        folder / "poses.csv", index=False
    )
    (folder / "result.json").write_text('{"command": "fk", "status": "ok"}\n')
    (folder / "folder").mkdir()
    (folder / "empty.csv").write_bytes(b"")
    (folder / "binary.bin").write_bytes(np.random.default_rng(1).bytes(4000))
    (folder / "list.yaml").write_text("- 1\n- two\n")
    return folder


@pytest.mark.parametrize("call", CALLS)
def test_a_file_of_another_kind_is_a_sentence(call, files, tmp_path, monkeypatch, capsys):
    """A robot for a log, a log for a model, a folder, an empty or a binary file: named, without words of Python's own."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    wrong = {}
    for kind in (kind for kind in KINDS if kind not in CALLS[call].split()):
        try:
            status = main(call.replace("@", kind).split())
        except BaseException as fault:
            status = repr(fault)
        said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
        if status not in (2, 3) or len(said) != 1 or FOREIGN.search(said[0]) or sorted(tmp_path.rglob("*")) != before:
            wrong[kind] = (status, said)
    assert not wrong
