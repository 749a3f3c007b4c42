"""The closed loop before and after a diagnosis."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.diagnose import add_simulation
from tau_dyn.effects import TorqueOffset, build_friction_model
from tau_dyn.evidence import Diagnosis, OutputErrors
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import CascadeController, CascadeLaw, Sensors, build_fourier_motion, simulate

LAW = CascadeLaw.of(20.0, 240.0, na=1, limit=500.0)
OFFSET = 30.0  # [N]


def _answer(model: Model, extended: Model) -> Diagnosis:
    robot, errors = model.robot, OutputErrors(model.robot.actuated, np.ones(1), np.ones((1, 2)), 5.0)
    return Diagnosis(
        verdict="named", sentence="An answer.", channel="force", outputs=robot.actuated, units=robot.force_units,
        baseline=errors, extended=errors, noise_floor=errors, waterfall=(), findings=(), unexplained=(), limits=(),
        untestable=(), model=model, extended_model=extended, traces=(), n_parts=(6.0, 2.0, 2.0), how="in blocks",
        warnings=(), seed=0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def models() -> tuple[Model, Model]:
    """A linear axis with friction, and the same with a constant push on it."""
    robot = load_robot("linear_axis")
    plain = build_friction_model("asymmetric", robot.actuated, robot.force_units)
    values = {"axis.coulomb_pos": 8.0, "axis.coulomb_neg": 8.0, "axis.viscous_pos": 30.0, "axis.viscous_neg": 30.0}
    model = Model.of(robot, plain).with_values(values)
    pushed = Model.of(robot, (*plain, TorqueOffset(robot.actuated, robot.force_units)))
    return model, pushed.with_values({**values, "axis.offset": OFFSET})


@pytest.fixture(scope="module")
def log(models):
    """Four seconds of the pushed axis under its cascade."""
    motion = build_fourier_motion(models[0], 4.0, 1)
    return simulate(models[1], motion, CascadeController(LAW), Sensors(), name="recorded")


def test_the_extended_model_repeats_what_the_baseline_does_not(models, log):
    """A push that the baseline lacks bends its simulated path; with it the recording is repeated."""
    found = add_simulation(_answer(*models), [log], LAW)
    assert found.simulation is not None and found.simulation["log"] == "recorded"
    before, after = (
        found.simulation[when]["errors"]["following"]["axis"]["relative_error_percent"] for when in ("before", "after")
    )
    assert before > 5 * after


def test_a_model_that_was_not_extended_is_simulated_once(models, log):
    """Without a cause there is nothing to compare: both are the same."""
    said = []
    found = add_simulation(_answer(models[0], models[0]), [log], LAW, said.append)
    assert found.simulation is not None and found.simulation["before"] == found.simulation["after"]
    assert said.count("simulating 0 %") == 1


def test_a_log_without_references_is_refused(models, log):
    """A closed loop needs what its controller was asked for."""
    bare = type(log)(log.t, {k: x for k, x in log.channels.items() if not k.startswith("q_ref")}, "bare")
    assert add_simulation(_answer(models[0], models[0]), [bare, log], LAW).simulation is not None
    with raises_code("missing_column", "q_ref"):
        add_simulation(_answer(*models), [bare], LAW)
