"""Model, motion, controller and sensors in, a `Log` out; nothing after it knows that the robot was not real."""

from __future__ import annotations

from typing import Literal

import numpy as np

from tau_dyn.estimate import pseudo_inertia
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.simulate.controllers import CascadeController, CascadeLaw, Controller
from tau_dyn.simulate.limits import describe_exceeded_limit
from tau_dyn.simulate.log_effects import EncoderErrors, record_run
from tau_dyn.simulate.plant import PlantRun, Progress, run_plant
from tau_dyn.simulate.sensors import Sensors, broadcast_per_joint, measure
from tau_dyn.simulate.trajectory import Trajectory

Feedback = Literal["encoder", "ideal"]


def simulate(
    model: Model,
    motion: Trajectory,
    controller: Controller | None = None,
    sensors: Sensors | None = None,
    *,
    seed: int = 0,
    rate_hz: float = 1000.0,
    feedback: Feedback = "encoder",
    name: str = "simulated",
    progress: Progress | None = None,
) -> Log:
    """Simulate a recording.

    Args:
        model: The true robot, with all its effects.
        motion: Reference; it is resampled to the control rate.
        controller: By default a cascade with the robot's own gains, limited by its drives.
        sensors: By default perfect ones at the control rate.
        seed: Of all noise; the same seed gives the same log.
        rate_hz: Control rate, which is the plant's step [Hz].
        feedback: 'encoder' closes the loop through the encoders' noise and rounding, 'ideal' through true positions.
        name: What the log is called.
        progress: Is told the share that is done.

    Returns:
        A log with `q_J`, `tau_J`, `q_ref_J` and the tool's position; its warnings are the motion's notes and
        a sentence for each joint that was often at its force limit.

    Raises:
        InputError: The motion leaves the robot's limits, the log rate does not fit, or the feedback is unstable.
    """
    sensors = sensors or Sensors()
    sensors.step(1 / rate_hz)
    rng = np.random.default_rng(seed)
    run = simulate_drive(model, motion, controller, sensors, rng, rate_hz=rate_hz, feedback=feedback, progress=progress)
    return measure(run, sensors, rng, name)


def simulate_drive(
    model: Model,
    motion: Trajectory,
    controller: Controller | None,
    sensors: Sensors,
    rng: np.random.Generator,
    *,
    rate_hz: float = 1000.0,
    feedback: Feedback = "encoder",
    progress: Progress | None = None,
) -> PlantRun:
    """Return what really happens, to be measured by `measure`, if need be many times (`feedback='ideal'`)."""
    if motion.joints != model.robot.actuated:
        expected, got = ", ".join(model.robot.actuated), ", ".join(motion.joints)
        raise InputError(
            "mismatch", f"{motion.name} moves joints {got}; {model.robot.source} has {expected}, in this order"
        )
    _refuse_impossible_bodies(model)
    reference = motion.resampled(rate_hz)
    fault = describe_exceeded_limit(model, reference, condition=np.inf)
    if fault:
        raise InputError("unreachable", f"{motion.name}: {fault}")
    controller = controller or CascadeController(CascadeLaw.for_model(model), start=model.steady())
    if feedback == "ideal":
        return record_run(run_plant(model, reference, controller, progress=progress))
    if feedback != "encoder":
        raise InputError("invalid_value", f"feedback is 'encoder' or 'ideal', not '{feedback}'")
    noise = broadcast_per_joint(sensors.encoder_noise, model.robot.na, "encoder_noise") * rng.standard_normal(
        reference.q.shape
    )
    errors = EncoderErrors(model)

    def encoder(k: int, q: np.ndarray) -> np.ndarray:
        return sensors.rounded((errors.read(q) if errors.any else q) + noise[k])

    return record_run(run_plant(model, reference, controller, encoder=encoder, progress=progress))


def _refuse_impossible_bodies(model: Model) -> None:
    """Refuse inertial numbers that no distribution of mass has: such a plant can gain energy from nothing."""
    for link in model.robot.links:
        J = pseudo_inertia(link.map @ model.robot.parameters.select(link.names).values)
        if np.linalg.eigvalsh(J)[0] < -1e-9 * max(float(np.trace(J)), 1e-12):
            raise InputError(
                "unsupported", f"{model.robot.source}: no body has the mass, centre and inertia given for {link.link}"
            )
