"""Causes at drives beyond the robot's freedoms."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import redundant

from tau_dyn import by_measurement
from tau_dyn.by_measurement import diagnose
from tau_dyn.robot import Robot, load_robot_from_urdf


def test_hidden_friction_of_a_redundant_drive_is_named_at_that_drive() -> None:
    """A Stribeck peak of 2 N m at the drive that follows the two others; a search at those alone names one of them."""
    robot = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf")
    (joint,) = robot.redundant_joints
    motion = redundant.move_three_arms(np.arange(0, 40, 0.01))
    friction = redundant.COULOMB * np.sign(motion.v) + redundant.VISCOUS * motion.v
    v = motion.v[:, redundant.ARMS.index(joint)]
    friction[:, redundant.ARMS.index(joint)] += 2.0 * np.sign(v) * np.exp(-np.abs(v) / 0.1)
    found = diagnose(robot, redundant.write_log(motion, redundant.ARMS, friction, {joint: 4.0}, 0.05, "arms.csv"))
    assert found.verdict == "named"
    (cause,) = [f for f in found.findings if f.status == "confirmed"]
    assert cause.cause == "stribeck" and tuple(cause.joints) == (joint,)
    (peak,) = [p for p in cause.parameters if p.name == f"{joint}.stribeck"]
    assert peak.stderr is not None and abs(peak.value - 2.0) < 3 * peak.stderr
    assert any("causes were looked for at" in w for w in found.warnings)


def test_the_search_with_the_largest_score_is_reported(monkeypatch) -> None:
    """Test data judge the reported model, so they may not choose it: the drive with the smaller test error is not taken."""
    robot = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf")
    scores = {robot.actuated: (50.0, 0.1), ("shoulder2", "shoulder3"): (900.0, 0.2)}

    def search(machine: Robot, logs: list, **options: object) -> Found:
        score, left = scores[machine.actuated]
        cause = SimpleNamespace(status="confirmed", score=score)
        return Found(machine, (cause,), SimpleNamespace(relative_error_percent=left))

    monkeypatch.setattr(by_measurement, "diagnose_forces", search)
    assert by_measurement.diagnose_drives(robot, []).model.robot.actuated == ("shoulder2", "shoulder3")


@dataclass(frozen=True)
class Found:
    """The fields of a diagnosis by which searches are compared."""

    machine: Robot
    findings: tuple
    extended: SimpleNamespace
    verdict: str = "named"
    warnings: tuple = ()

    @property
    def model(self) -> SimpleNamespace:
        """The model, with its robot."""
        return SimpleNamespace(robot=self.machine)
