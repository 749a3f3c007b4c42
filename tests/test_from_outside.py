"""A robot by one xacro and a cause by one file, both from outside the package, in a folder of their own.

`tests/outside` holds the two files. They go into an empty folder, and all happens there in processes of its own, so that the
cause is registered there and nowhere else.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tau_dyn.effects import EFFECTS, Effect, JointwiseEffect, Stribeck, register
from tau_dyn.exceptions import InputError

FILES = Path(__file__).with_name("outside")
STIFFNESS = 150.0  # [N/m] of the bellows, the cause that is hidden
MACHINE = f"""effects:
  - {{effect: asymmetric_friction, parameters: {{coulomb_pos: 20, coulomb_neg: 21, viscous_pos: 60, viscous_neg: 70}}}}
  - {{effect: bellows, parameters: {{bellows: {STIFFNESS}}}}}
"""
SIMULATE = "--effects machine.yaml --duration 10 --rate 250 --force-noise 2 --quiet"
LOGS = "toggle.urdf.xacro monday.csv --holdout tuesday.csv"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with the robot, the cause, a machine in which the cause hides, and two recordings of it."""
    there = tmp_path_factory.mktemp("outside")
    for path in FILES.iterdir():
        if path.is_file():
            shutil.copy(path, there)
    (there / "machine.yaml").write_text(MACHINE, encoding="utf-8")
    for day, seed in (("monday", 1), ("tuesday", 2)):
        run(there, f"bellows.py simulate toggle.urdf.xacro {SIMULATE} --seed {seed} --out {day}.csv")
    return there


def run(folder: Path, command: str, status: int = 0) -> str:
    """Run Python on a line of arguments in a folder and return what it says; it has to end with this status."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *command.split()],
        cwd=folder,
        env=os.environ | one_thread,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == status, done.stderr
    return done.stdout + done.stderr


def test_a_hidden_cause_of_ones_own_is_named(folder):
    """The diagnosis names the bellows on the cart, sizes it, and the model is as good as the noise lets it be."""
    run(folder, f"bellows.py diagnose {LOGS} --json why.json --out extended.yaml --quiet")
    why = json.loads((folder / "why.json").read_text(encoding="utf-8"))
    first = why["findings"][0]
    assert (why["verdict"], first["cause"], first["joints"], first["status"]) == (
        "named",
        "bellows",
        ["cart"],
        "confirmed",
    )
    assert first["gain"]["reduction_percent"] > 70
    (value,) = [p for p in first["parameters"] if p["name"] == "cart.bellows"]
    assert abs(value["value"] - STIFFNESS) < 4 * value["stderr"] and value["stderr"] < 0.1 * STIFFNESS
    floor, after = (why[key]["relative_error_percent"] for key in ("noise_floor", "extended"))
    assert after < 1.1 * floor


USE = """
import tau_dyn as td
try:
    td.Model.load("extended.yaml")
except td.InputError as fault:
    print(fault)
import bellows
from tau_dyn.codegen import build_program, write_c_source
model = td.Model.load("extended.yaml")
print(model.effects[-1].name, model.parameters["cart.bellows"].unit)
print("bellows" in "".join(write_c_source(build_program(td.Feedforward(model, width=0.02)), "tau_ff")))
"""


def test_the_extended_model_is_a_model_like_any_other(folder):
    """With the file it is loaded, and exported to C without another line; without it a sentence says what is unknown."""
    (folder / "use.py").write_text(USE, encoding="utf-8")
    refused, loaded, exported = run(folder, "use.py").splitlines()
    assert "no effect" in refused and "bellows" in refused and "extended.yaml" in refused
    assert (loaded, exported) == ("bellows N/m", "True")


def test_without_the_file_it_has_no_name(folder):
    """The same recordings without the cause: structure that depends on the position, and no false name confirmed."""
    run(folder, f"-m tau_dyn.cli diagnose {LOGS} --json plain.json --quiet")
    why = json.loads((folder / "plain.json").read_text(encoding="utf-8"))
    assert why["verdict"] == "unexplained"
    assert not [f for f in why["findings"] if f["status"] == "confirmed"]
    assert [u["depends_on"] for u in why["unexplained"] if u["joint"] == "cart"] == [["q_cart"]]


def test_it_is_registered_there_and_nowhere_else():
    """This process knows nothing of it."""
    assert "bellows" not in EFFECTS


class Spring(JointwiseEffect):
    """An effect that may be registered."""

    name = "spring_of_a_test"
    equation = "tau += spring q"
    quantities = (("spring", "F/Q"),)

    def per_joint(self, joint):
        """Return the position."""
        return [joint.q]


def made(**changes) -> type[Effect]:
    """Return the spring with some things changed."""
    return type(changes.pop("called", "Spring"), (Spring,), changes)


@pytest.mark.parametrize(
    "wrong, why",
    [
        (made(name="Spring q"), "name of small letters"),
        (made(name=""), "name of small letters"),
        (made(name="stribeck"), "there is an effect 'stribeck' already"),
        (made(name="stribeck", called="Stribeck"), "there is an effect 'stribeck' already"),
        (made(cause=True), "no reveals"),
        (made(cause=True, equation="", reveals="strokes"), "no equation"),
        (JointwiseEffect, "is no effect"),
        (Motionless := type("Motionless", (), {"name": "motionless"}), "is no effect"),
    ],
)
def test_what_cannot_be_an_effect_is_refused(wrong, why):
    """A class without a law, a taken name, a cause that does not say what reveals it: one sentence, and nothing registered."""
    before = dict(EFFECTS)
    with pytest.raises(InputError, match=why):
        register(wrong)
    assert EFFECTS == before


def test_a_class_may_come_again(monkeypatch):
    """A notebook's cell that is run twice registers its class twice; the last one counts, and ours stay ours."""
    monkeypatch.setattr("tau_dyn.effects.catalogue.EFFECTS", known := dict(EFFECTS))
    again = made()
    assert register(Spring) is Spring and register(again) is again and register(Stribeck) is Stribeck
    assert known["spring_of_a_test"] is again and "spring_of_a_test" not in EFFECTS
