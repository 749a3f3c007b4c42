"""Effects that distort a recording and not the robot: late forces, encoders that read beside their load, a thermometer.

    q_shown = q + displacement @ parameters,     tau_shown(t) = tau(t - delay),     tool_shown = T(q) + shift @ parameters

The plant moves the loads; encoders read in front of them. Where the displacement follows from the load's own path (a periodic
error, a scale, a play, a loop), the controller reads it too. A `joint_compliance` reaches the log alone: its quasi-static law
knows no resonance, which a feedback through it would excite. Carts off their guideways move the tool's position alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.effects import (
    GUIDE_ACROSS,
    SENSITIVITY,
    SIDE_FORCE,
    CartShift,
    Delay,
    DisplacementEffect,
    Motion,
    TimingEffect,
    acts_on_recording,
    apply_first_order_lowpass,
)
from tau_dyn.exceptions import InputError
from tau_dyn.log import ROOM_TEMPERATURE
from tau_dyn.model import COMPUTED, Model
from tau_dyn.simulate.memory import Memory, compute_warm_up, repeat_signals
from tau_dyn.simulate.plant import PlantRun

_FOR_FORCES = frozenset(DisplacementEffect.needs)
_PATH = _FOR_FORCES | {"reversal"}
"""Signals that a load's path gives, and those that only matter for forces."""


class EncoderErrors:
    """What encoders read beyond their loads, from sample to sample."""

    def __init__(self, model: Model) -> None:
        """Look up the displacements that follow from each joint's path."""
        self._joints, self._na = model.robot.actuated, model.robot.na
        self._effects = [(e, x) for e, x in _displacements(model) if set(e.needs) <= _PATH]
        self._memory, self._last = Memory([e for e, _ in self._effects], self._na), None

    @property
    def any(self) -> bool:
        """Whether there are such effects."""
        return bool(self._effects)

    def read(self, q: np.ndarray) -> np.ndarray:
        """Return what perfect encoders show of the next true positions (na,) [m or rad]."""
        if self._last is not None:
            self._memory.advance(q - self._last, 0.0)
        self._last = np.array(q)
        shown, none = np.array(q), np.zeros((1, self._na))
        for effect, values in self._effects:
            signals = repeat_signals(self._memory.signals(effect), 1)
            motion = Motion.of(self._joints, q[None], none, none, self._memory.heading[None], signals=signals)
            shown += effect.displacement(motion)[0] @ values
        return shown


def record_run(run: PlantRun) -> PlantRun:
    """Return a run with what perfect sensors show of it beside what happened; see `PlantRun`.

    Raises:
        InputError: An effect is neither of the robot nor of its sensors.
    """
    model = run.model
    odd = [e for e in model.effects if acts_on_recording(e) and not isinstance(e, DisplacementEffect | TimingEffect)]
    if odd:
        raise InputError("unsupported", f"effect {odd[0].name} cannot be simulated")
    yielding = _yielding(run)
    shown, read = None, run.q_read
    if read is not None:
        read = read + yielding
    elif _displacements(model):
        errors = EncoderErrors(model)
        shown = yielding + (np.array([errors.read(q) for q in run.q]) if errors.any else run.q)
    return replace(run, q_shown=shown, q_read=read, tau_shown=_late(run), tool_shown=_shifted_tool(run))


def get_temperatures(run: PlantRun) -> dict[str, np.ndarray]:
    """Return the room's temperature (N,) as a log's channel, where an effect follows it."""
    feels = any("temperature" in effect.needs for effect in run.model.effects)
    return {ROOM_TEMPERATURE: compute_warm_up(run.t - run.t[0])} if feels else {}


def _displacements(model: Model) -> list[tuple[DisplacementEffect, np.ndarray]]:
    effects = [e for e in model.effects if isinstance(e, DisplacementEffect) and acts_on_recording(e)]
    found = [e for e in effects if not isinstance(e, CartShift)]
    return [(e, model.effect_parameters.select(e.parameters.names).values) for e in found]


def _yielding(run: PlantRun) -> np.ndarray:
    """Return displacements (N, na) that follow from forces."""
    out, mechanism = np.zeros_like(run.q), run.model.mechanism
    for effect, values in _displacements(run.model):
        if set(effect.needs) <= _PATH:
            continue
        wanted = [name for name in effect.needs if name in COMPUTED and name not in _FOR_FORCES]
        signals = {name: COMPUTED[name](mechanism, run.q, run.v, run.a) for name in wanted}
        motion = Motion.of(
            run.model.robot.actuated, run.q, run.v, run.a, t=run.t, signals={**signals, "force": run.tau}
        )
        out += np.einsum("nip,p->ni", effect.displacement(motion), values)
    return out


def _late(run: PlantRun) -> np.ndarray | None:
    """Return forces (N, na) as they are logged where they are low-passed, late or early; the ends keep the last known ones."""
    late, lag = np.zeros((2, run.model.robot.na))
    for effect in run.model.effects:
        if isinstance(effect, TimingEffect):
            index = [run.model.robot.actuated.index(j) for j in effect.joints]
            total = late if isinstance(effect, Delay) else lag
            total[index] += run.model.effect_parameters[effect.parameters.names[0]].value
    if not (late.any() or lag.any()):
        return None
    shown = [apply_first_order_lowpass(force, run.t, x) for x, force in zip(lag, run.tau.T, strict=True)]
    return np.column_stack([np.interp(run.t - d, run.t, force) for d, force in zip(late, shown, strict=True)])


def _shifted_tool(run: PlantRun) -> np.ndarray | None:
    """Return where the tool is (N, 3) [m] with its carts shifted, or None where they are not or there is no tool."""
    robot, mechanism = run.model.robot, run.model.mechanism
    effects = [e for e in run.model.effects if isinstance(e, CartShift)]
    if not effects or robot.tool_frame is None:
        return None
    across = mechanism.guide_across()
    signals = {
        SENSITIVITY: mechanism.cart_sensitivity(run.q),
        SIDE_FORCE: mechanism.guide_force(run.q, run.v, run.a),
        GUIDE_ACROSS: np.broadcast_to(across, (len(run.q), *across.shape)),
    }
    motion = Motion.of(robot.actuated, run.q, run.v, run.a, signals=signals)
    tool, still = run.tool, np.zeros((len(run.q), 3, robot.na))
    for effect in effects:
        tool = (
            tool
            + effect.tool_columns(motion, still) @ run.model.effect_parameters.select(effect.parameters.names).values
        )
    return tool
