r"""A model's forward dynamics as expressions: the equations of one simulation step, with the parameters as inputs.

    (M(q, theta) + added(q, v, theta)) a + h(q, v, theta) = tau - f,   lower(q, v, a, theta) <= f <= upper(..)

`M` and `h` are the mechanism's; `lower` and `upper` are the effects' forces at `sign` -1 and +1, as in `simulate/forces.py`,
and `added` is the effects' contribution to `M`. All are traced from the code of the simulation and compared with it.

The effects' internal state is a row of numbers: for each joint the travel since its last reversal and the direction of its
motion, then each bristle's state. `remember` updates it by one step of the joints. Temperatures are given from outside.
Encoders whose reading differs from the load's position have a state of their own.

A plant in C: its equations as functions, the simulator's step (`c/plant.c`), and whole runs of it (`c/plant_run.c`).

The source contains only the model's geometry and its effects' settings; parameters, gains, references and steps are given at
run time. So one library serves all values of a model's parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.codegen.c_writer import STEP, fill_template
from tau_dyn.codegen.feedforward_c import yield_closing_parts
from tau_dyn.codegen.forms import TracingInputs, find_loops
from tau_dyn.codegen.loops import Loops
from tau_dyn.effects import STATE, Bristle, DisplacementEffect, Effect, Motion, acts_on_recording, follow_reversal
from tau_dyn.equations import (
    ExpressionArray,
    Node,
    TracedFunction,
    as_expression_array,
    build_inputs,
    flatten_outputs,
    trace_function,
    yield_function,
)
from tau_dyn.exceptions import InputError
from tau_dyn.model import BY_STATE, COMPUTED, Model


@dataclass(frozen=True, eq=False)
class Equations:
    """The parts of one model.

    Attributes:
        model: The model, with the effects that are in the equations.
        dynamics: `M` (na * na,) and `h` (na,).
        friction: `lower` and `upper` (na,); None without effects.
        mass: `added` (na * na,) to the mass matrix; None if no effect depends on accelerations.
        memory: `next`, the internal state after the joints moved by `d` (na,); None if no effect has one.
        tool: `x` (3,), the tool's position [m]; None if the robot file has no tool.
        encoders: `shown` (na,), the encoders' readings of true positions; None if they read the true positions.
        encoder_memory: As `memory`, of the encoders.
        loops: The loops that are solved numerically before each part, or None.
        closure: With loops, `gap` and `J`.
        parameters: Indices in `model.parameters` of those that the equations use.
        warm: The effects that follow a temperature, in the order of the numbers given from outside.
    """

    model: Model
    dynamics: TracedFunction
    friction: TracedFunction | None
    mass: TracedFunction | None
    memory: TracedFunction | None
    tool: TracedFunction | None
    encoders: TracedFunction | None
    encoder_memory: TracedFunction | None
    loops: Loops | None
    closure: TracedFunction | None
    parameters: tuple[int, ...]
    warm: tuple[Effect, ...]


def build_equations(
    model: Model, *, encoders: Sequence[DisplacementEffect] = (), campaign: float | None = None
) -> Equations:
    """Return the equations of a model.

    Args:
        model: The model.
        encoders: The effects that the encoders' readings show.
        campaign: Number of the recording, for effects that need it.

    Raises:
        InputError: Something of the model cannot be written as expressions of a state.
    """
    try:
        return _trace_equations(model, tuple(encoders), campaign)
    except TypeError as fault:
        names = ", ".join(effect.name for effect in model.effects) or "no effects"
        raise InputError(
            "unsupported", f"{model.robot.source} with {names} cannot be written as an FMU: it uses {fault}"
        ) from fault


def list_unsupported_effects(model: Model) -> Sequence[tuple[Any, str]]:
    """Return the effects that a state alone does not determine, each with the first signal that is missing."""
    found = []
    for effect in model.effects:
        missing = [name for name in effect.needs if name not in BY_STATE - {"damping"}]
        if missing and not acts_on_recording(effect):
            found.append((effect, missing[0]))
    return found


class _Remembered:
    """Internal state of the effects, as inputs `m`, and the temperatures they follow, as inputs `r`."""

    def __init__(self, effects: Sequence[Effect], na: int, campaign: float | None = None) -> None:
        self.na, self._campaign = na, campaign
        self.bristles = [e for e in effects if isinstance(e, Bristle)]
        self.warm = tuple(e for e in effects if "temperature" in e.needs)
        remembers = any("reversal" in e.needs or isinstance(e, DisplacementEffect) for e in effects)
        self.size = (2 + len(self.bristles)) * na if remembers else 0
        self.sizes = {k: n for k, n in (("m", self.size), ("r", len(self.warm) * na)) if n}

    def signals(self, effect: Effect, given: Mapping[str, ExpressionArray]) -> dict[str, Any]:
        """Return the internal state of one effect, by signal, each (1, na)."""
        found: dict[str, Any] = {}
        if "reversal" in effect.needs:
            found["reversal"] = given["m"][None, : self.na]
        if isinstance(effect, Bristle):
            start = (2 + self.bristles.index(effect)) * self.na
            found[STATE] = given["m"][None, start : start + self.na]
        if effect in self.warm:
            start = self.warm.index(effect) * self.na
            found["temperature"] = given["r"][None, start : start + self.na]
        if "campaign" in effect.needs and self._campaign is not None:
            found["campaign"] = np.full((1, self.na), self._campaign)
        return found

    def heading(self, given: Mapping[str, ExpressionArray]) -> Any:
        """Return the direction of each joint's last motion (1, na)."""
        return given["m"][None, self.na : 2 * self.na] if self.size else np.zeros((1, self.na))

    def trace(self) -> TracedFunction | None:
        """Return how the memory moves on."""
        if not self.size:
            return None

        def move_on(m: Any, d: Any) -> dict[str, Any]:
            parts = np.split(m, 2 + len(self.bristles))
            bristles = [e.followed(z, d) for e, z in zip(self.bristles, parts[2:], strict=True)]
            return {"next": np.concatenate([*follow_reversal(parts[0], parts[1], d), *bristles])}

        return trace_function({"m": np.full(self.size, 0.5), "d": np.full(self.na, 0.1)}, move_on)


class _Inputs(TracingInputs):
    """The inputs of a model's equations, with the internal state of its effects."""

    def __init__(
        self, model: Model, loops: Loops | None, remembered: _Remembered, *, open_parameters: bool = True
    ) -> None:
        super().__init__(model, loops, open_parameters=open_parameters)
        self.remembered = remembered
        self.beside = {k: build_inputs(self.graph, k, np.full(n, 0.5)) for k, n in remembered.sizes.items()}

    def collect(self, takes: str, made: dict[str, Any], *, remembers: bool = True) -> TracedFunction:
        """Return a function of positions, passive joints if there are loops, the effects' internal state, and further arrays."""
        na = self.model.robot.na
        sizes = {"v": na, "a": na, "theta": len(self.model.parameters)}
        arguments = {"q": na} | ({} if self.passive is None else {"p": len(self.passive)})
        beside = self.remembered.sizes if remembers else {}
        return TracedFunction(
            self.graph, arguments | beside | {x: sizes[x] for x in takes.split()}, flatten_outputs(made)
        )

    def parameters_of(self, effect: Effect) -> Any:
        """Return an effect's parameters (p,)."""
        return as_expression_array([self.value(name) for name in effect.parameters.names])

    def ask(self, effect: Effect, a: Any, sign: float, force: Any = None) -> Any:
        """Return an effect's force (na,) at accelerations (1, na), and at a force (na,) for effects that depend on it."""
        robot = self.model.robot
        felt = [] if isinstance(effect, Bristle) else [n for n in effect.needs if n in COMPUTED]
        signals = {n: COMPUTED[n](self.form, self.q, self.v, a) for n in felt}
        signals |= self.remembered.signals(effect, self.beside)
        if force is not None:
            signals["force"] = as_expression_array(force)[None]
        motion = Motion.of(robot.actuated, self.q, self.v, a, np.full((1, robot.na), sign), signals=signals)
        return as_expression_array(as_expression_array(effect.columns(motion))[0] @ self.parameters_of(effect))


def _trace_equations(model: Model, encoders: tuple[DisplacementEffect, ...], campaign: float | None) -> Equations:
    loops, na = find_loops(model), model.robot.na
    effects = [effect for effect in model.effects if not acts_on_recording(effect)]
    felt, read = _Remembered(effects, na, campaign), _Remembered(encoders, na)
    given = _Inputs(model, loops, felt)
    M, h = given.form.mass_and_bias(given.q[0], given.v[0])
    dynamics = given.collect("v theta", {"M": M, "h": h}, remembers=False)
    friction = _trace_friction(_Inputs(model, loops, felt), effects) if effects else None
    mass = _trace_added_mass(_Inputs(model, loops, felt), effects) if effects else None
    tool = None
    if model.robot.tool_frame is not None:
        given = _Inputs(model, loops, felt)
        tool = given.collect("", {"x": given.form.tool_position(given.q)[0]}, remembers=False)
    start = np.array([x.value for x in given.q[0]])
    parts = [
        dynamics,
        friction,
        mass,
        tool,
        _trace_encoders(_Inputs(model, None, read), encoders) if encoders else None,
    ]
    used = {
        int(node.args[0].removeprefix("theta"))
        for part in parts
        if part is not None
        for node in part.graph.needed(part.values)
        if node.op == "input" and node.args[0].startswith("theta")
    }
    closure = None if loops is None else loops.trace_closure(start)
    order = tuple(sorted(used))
    return Equations(
        model, dynamics, friction, mass, felt.trace(), tool, parts[-1], read.trace(), loops, closure, order, felt.warm
    )


def trace_effect_bounds(model: Model, loops: Loops | None) -> TracedFunction:
    """Return the effects' forces at both signs with the parameters' values in them: `lower` and `upper` (na,).

    Raises:
        InputError: An effect has an internal state, or adds to the mass matrix.
        TypeError: An effect cannot be written as expressions of a state.
    """
    effects = [effect for effect in model.effects if not acts_on_recording(effect)]
    remembered = _Remembered(effects, model.robot.na)
    given = [_Inputs(model, loops, remembered, open_parameters=False) for _ in range(2)]
    if remembered.sizes or _trace_added_mass(given[0], effects) is not None:
        names = ", ".join(effect.name for effect in effects)
        raise InputError(
            "unsupported", f"{names}: an effect that remembers or adds to the mass matrix is no force of a state"
        )
    return _trace_friction(given[1], effects)


def _trace_friction(given: _Inputs, effects: Sequence[Effect]) -> TracedFunction:
    """Return the effects' forces at both signs; see `simulate/forces.py`."""
    n, rest = given.model.robot.na, as_expression_array(np.zeros((1, given.model.robot.na)))
    plain, scaled = _split_scaled(effects)
    both = []
    for sign in (-1.0, 1.0):
        force = sum(
            (given.ask(e, given.a if "load" in e.needs else rest, sign) for e in plain),
            start=as_expression_array(np.zeros(n)),
        )
        whole = given.form.inverse_dynamics(given.q, given.v, rest)[0] + force if scaled else None
        for effect in scaled:
            force = force + given.ask(effect, rest, sign, whole)
        both.append(force)
    return given.collect("v a theta", {"lower": both[0], "upper": both[1]})


def _trace_added_mass(given: _Inputs, effects: Sequence[Effect]) -> TracedFunction | None:
    """Return the effects' contribution to the mass matrix, or `None` if no effect depends on accelerations."""
    n, rest = given.model.robot.na, as_expression_array(np.zeros((1, given.model.robot.na)))
    plain, scaled = _split_scaled(effects)
    added = as_expression_array(np.zeros((n, n)))
    M = given.form.mass_and_bias(given.q[0], given.v[0])[0] if scaled else None
    for k, row in enumerate(np.eye(n)):
        unit = as_expression_array(row[None])
        for effect in plain:
            if "load" not in effect.needs:
                added[:, k] = added[:, k] + given.ask(effect, unit, 1.0) - given.ask(effect, rest, 1.0)
        if M is not None:
            whole = M[:, k] + added[:, k]
            for effect in scaled:
                added[:, k] = added[:, k] + given.ask(effect, unit, 1.0, whole)
    if not any(isinstance(x, Node) or x for x in np.ravel(np.asarray(added))):
        return None
    return given.collect("v theta", {"added": added})


def _split_scaled(effects: Sequence[Effect]) -> tuple[list[Effect], list[Effect]]:
    """Return the effects that do not depend on a force, and those that do."""
    return [e for e in effects if "force" not in e.needs], [e for e in effects if "force" in e.needs]


def _trace_encoders(given: _Inputs, effects: Sequence[DisplacementEffect]) -> TracedFunction:
    """Return the encoders' readings of true positions; see `simulate/sensors.py`."""
    rest = as_expression_array(np.zeros((1, given.model.robot.na)))
    shown, heading = given.q[0], given.remembered.heading(given.beside)
    for effect in effects:
        signals = given.remembered.signals(effect, given.beside)
        motion = Motion.of(given.model.robot.actuated, given.q, rest, rest, heading, signals=signals)
        shown = shown + as_expression_array(effect.displacement(motion))[0] @ given.parameters_of(effect)
    return given.collect("theta", {"shown": shown})


_FURTHER = ("memory", "tool", "encoders", "encoder_memory")


def write_plant_source(equations: Equations) -> str:
    """Return C99 that steps a plant from sample to sample; see `c/plant_run.c` for its interface."""
    return "\n\n".join(_yield_parts(equations)) + "\n"


def _yield_parts(equations: Equations) -> Iterator[str]:
    na = equations.model.robot.na
    read = equations.encoder_memory
    sizes = {
        "NA": na,
        "NP": len(equations.loops.passive) if equations.loops is not None else 0,
        "NTHETA": max(1, len(equations.parameters)),
        "NM": max(1, 0 if equations.memory is None else equations.memory.arguments["m"]),
        "NR": max(1, na * len(equations.warm)),
        "NS": max(1, 0 if read is None else read.arguments["m"]),
    }
    yield "#include <math.h>\n#include <stdint.h>\n#include <string.h>"
    yield f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};"
    yield fill_template("checks")
    yield from yield_plant_parts(equations, _FURTHER)
    flags = {name.upper() for name in _FURTHER if getattr(equations, name) is not None}
    flags |= {"WARM"} if equations.warm else set()
    shown = "s->shown, " if read is not None else ""
    yield fill_template("plant_run", flags | (set() if equations.encoders else {"TRUE"}), SHOWN=shown)


def yield_plant_parts(equations: Equations, further: Sequence[str]) -> Iterator[str]:
    """Yield a plant's equations, some further parts by name, and its step; `PASSIVE`, `REMEMBERED` and `CLOSED` are defined."""
    loops, remembers = equations.loops, equations.memory is not None or bool(equations.warm)
    felt = ("(s)->memory, " if equations.memory is not None else "") + ("(s)->felt," if equations.warm else "")
    yield "\n".join(
        (
            f"#define PASSIVE(s) {'(s)->start + NA,' if loops is not None else ''}",
            f"#define REMEMBERED(s) {felt}",
            f"#define CLOSED(s) {'(close_loops(s) ? 0 : 2)' if loops is not None else '0'}",
        )
    )
    named = {name: getattr(equations, name) for name in ("dynamics", "friction", "mass", *further)}
    parts: dict[str, TracedFunction] = {name: part for name, part in named.items() if part is not None}
    if loops is not None and equations.closure is not None:
        transposed = any(part.graph.uses("solve_t", part.values) for part in parts.values())
        yield from yield_closing_parts(loops, equations.closure, "plant", transposed=transposed)
    moved = {f"theta[{k}]": f"theta[{i}]" for i, k in enumerate(equations.parameters)}
    yield from (_write_part(name, part, moved) for name, part in parts.items())
    flags = {"FRICTION": equations.friction, "MASS": equations.mass, "REMEMBERS": remembers or None, "LOOPS": loops}
    yield fill_template("plant", {flag for flag, part in flags.items() if part is not None}, STEP=repr(STEP))


def _write_part(name: str, part: TracedFunction, moved: dict[str, str]) -> str:
    """Return one part as a function that returns 0, or 1 at an unreachable state; parameters by their indices."""
    takes = ", ".join(f"const double *{array}" for array in part.arguments)
    gives = ", ".join(f"double {array}[{len(values)}]" for array, values in part.outputs.items())
    head = f"static int {name}({takes}, {gives})"
    text = "\n".join(yield_function(head, part.graph, list(part.arguments), part.outputs))
    pieces = text.split("theta[")
    for k, piece in enumerate(pieces[1:], start=1):
        index, _, rest = piece.partition("]")
        pieces[k] = moved[f"theta[{index}]"] + rest
    return "".join(pieces)
