"""Simulated logs of commands and positions: a model, a servo's law and a motion -> a `Log` without torque."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.servo.doubts import list_unsettled
from tau_dyn.servo.loads import InertialSpace
from tau_dyn.servo.prediction import simulate_coupled
from tau_dyn.servo.records import LoopRecord
from tau_dyn.servo.unknowns import JOINT_UNITS
from tau_dyn.simulate import ServoLaw, Trajectory

FINE_HZ = 500.0
"""Rate at which the loop is simulated [Hz], at least: servos themselves run at 200 to 1000 Hz."""
RAN_AWAY = 1e6
"""Position from which a simulation counts as diverged [rad or m]: no joint turns as far in an hour."""
STEP_S = 2.5e-4
"""Longest step of the simulated loops [s], a quarter of a millisecond, so that no fit has the step of its data."""


def simulate_loop_log(
    model: Model,
    law: ServoLaw,
    motion: Trajectory,
    *,
    rate_hz: float = 50.0,
    encoder_noise: float = 0.0,
    encoder_resolution: float = 0.0,
    seed: int = 0,
    name: str = "simulated",
) -> Log:
    """Return a log with `cmd_J` and `q_J`, sampled at the rate at which the commands are sent.

    Args:
        model: The true robot; friction that is `symmetric` or `asymmetric` and drive inertias count.
        law: The servo's law.
        motion: Its positions are the commands; its speeds or the model's torques along it, if the law takes those.
        rate_hz: Rate of commands and log [Hz].
        encoder_noise: Standard deviation of positions [rad].
        encoder_resolution: Step of the encoder [rad]; 0 for no rounding.
        seed: Seed of the noise.
        name: The log's name.

    Raises:
        InputError: The motion has other joints, an effect is not supported here, or the simulation diverges.
    """
    if motion.joints != model.robot.actuated:
        raise InputError(
            "mismatch", f"{motion.name} moves joints {', '.join(motion.joints)}, not those of {model.robot.source}"
        )
    commands = motion.resampled(rate_hz)
    often = max(1, int(np.ceil(FINE_HZ / rate_hz)))
    n = len(commands.t)
    t = np.arange((n - 1) * often + 1) / (rate_hz * often)
    space, values = InertialSpace.of(model), read_values(model, law)
    told = _build_commands(model, law, values, commands)
    q, held = (np.repeat(x, often, axis=0)[: len(t)] for x in (commands.q, told))
    on = np.ones(len(t))
    record = LoopRecord(name, t, q, held, on, on, on.astype(bool), law.in_log(name), told=law.command)
    (simulated,) = simulate_coupled(space, np.zeros(0), values, law, [record], step=STEP_S)
    q = simulated.q[::often]
    if not np.abs(q).max() < RAN_AWAY:
        k = int(np.argmax(~(np.abs(q) < RAN_AWAY).all(axis=1)))
        raise InputError(
            "unstable",
            f"{motion.name}: the simulated robot ran away before t = {commands.t[k]:.4g} s; the law's gains or torque are too "
            "large for its inertias",
        )
    rng = np.random.default_rng(seed)
    q = q + encoder_noise * rng.standard_normal(q.shape)
    if encoder_resolution > 0:
        q = encoder_resolution * np.round(q / encoder_resolution)
    channels = {}
    for j, joint in enumerate(motion.joints):
        channels |= {f"cmd_{joint}": told[:n, j], f"q_{joint}": q[:, j]}
    return Log(t[::often], channels, name=name, warnings=tuple(list_unsettled([(name, simulated.unsettled)])))


def _build_commands(model: Model, law: ServoLaw, values: Mapping[str, np.ndarray], motion: Trajectory) -> np.ndarray:
    """Return the commands (N, na) for which the robot approximately follows a motion."""
    if law.command in ("position", "speed"):
        return motion.q if law.command == "position" else motion.v
    resisting = values["coulomb"] * np.sign(motion.v) + values["viscous"] * motion.v + values["offset"]
    tau = model.mechanism.inverse_dynamics(motion.q, motion.v, motion.a) + resisting
    u = tau / values["force_per_unit"] + values["back_emf"] * motion.v
    return np.clip(u, -values["limit"], values["limit"])


def read_values(model: Model, law: ServoLaw) -> dict[str, np.ndarray]:
    """Return values of a model and a law for a loop, by kind (na,); friction of two directions becomes mean and offset.

    Raises:
        InputError: The model has an effect that a loop does not support.
    """
    odd = [
        e.name for e in model.effects if e.name not in ("symmetric_friction", "asymmetric_friction", "torque_offset")
    ]
    if odd:
        raise InputError("unsupported", f"effect {odd[0]} is not simulated in a servo's loop; the controller file has "
                         "load_friction, stiction, dead_band, command_delay and supply_sag")  # fmt: skip
    p = model.parameters

    def get(joint: str, kind: str) -> float:
        return p[f"{joint}.{kind}"].value if f"{joint}.{kind}" in p else 0.0

    values = {key: np.array(value) for key, value in law.values.items()}
    values |= {kind: np.array([get(j, kind) for j in law.joints]) for kind in JOINT_UNITS}
    for kind in ("coulomb", "viscous"):
        pos, neg = (np.array([get(j, f"{kind}_{way}") for j in law.joints]) for way in ("pos", "neg"))
        values[kind] = values[kind] + (pos + neg) / 2
        if kind == "coulomb":
            values["offset"] = values["offset"] + (pos - neg) / 2
    return values
