"""The plant as compiled code: whole runs in one call, the same trajectories as `plant.py` to rounding, many times faster.

A model's equations are traced (`codegen/plant_equations.py`), written in C with the parameters as inputs, compared with the
simulator's at random states, built once and stored (`equations/compiler.py`). One library works for all values of the parameters:

    plant = CompiledPlant.find(model, n_samples)
    plant.apply_forces(q0, v0, dt, tau, parameters=theta)      # forces (N, na)
    plant.follow(q0, v0, servo, parameters=theta)              # a reference, through a cascade

A run that cannot be finished (a loop opens, a number is not finite, a condition differs from that during tracing) returns None;
`plant.py` then handles it. It also simulates models that cannot be traced, and all models without a compiler.

A library is built if that takes less time than it saves: one step of `plant.py` takes 0.2 to 0.5 ms, and a build half a second
to three, growing with the number of joints.

Encoders that round open the feedback below their step: without friction, differences of 1e-16 grow there until a rounding
changes, and two runs then differ by a step of the encoders, as those of two computers do.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from tau_dyn.codegen import Equations, build_equations, draw_random_states, write_plant_source
from tau_dyn.effects import DisplacementEffect, acts_on_recording
from tau_dyn.equations import LibraryCache, TracedFunction, evaluate_graph, find_compiler, is_compiling_allowed
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.simulate.controllers import Servo
from tau_dyn.simulate.forces import EffectSurroundings, SampledForces
from tau_dyn.simulate.sensors import EncoderErrors

MIN_SAMPLES, MIN_SAMPLES_PER_DRIVE, MIN_SAMPLES_PER_PASSIVE_JOINT = 1000, 500, 150
"""Shorter runs are over before a library is built (`experiments/benchmarks/compiled_plant.py`, friction: 1700 samples of EMPS,
2000 of L1, 4400 of a UR5, 5400 of a complete Gantry-Tau). Libraries from earlier runs do not change this: the same call takes
the same path each time, since the paths differ by rounding."""
AGREEMENT = 1e-9
"""How far equations and simulator may differ at random states, relative to the largest value."""

_STATES, _SEED = 15, 2
_LIBRARIES = LibraryCache()


class _TracedModels:
    """Equations and source of the models that were simulated last; models that differ in values alone share them."""

    _MAX = 8  # models; a study goes round a few

    def __init__(self) -> None:
        self._known: dict[tuple, tuple[Model, tuple[Equations, str] | None]] = {}

    def find(
        self, model: Model, shown: Sequence[DisplacementEffect], campaign: float | None
    ) -> tuple[Equations, str] | None:
        """Return a model's equations, traced if needed; None if it cannot be traced.

        The model is kept alive, by whose parts it is known.
        """
        key = _identify(model, shown, campaign)
        if key not in self._known:
            while len(self._known) >= self._MAX:
                self._known.pop(next(iter(self._known)))
            self._known[key] = model, _trace_model(model, shown, campaign)
        return self._known[key][1]


def _trace_model(
    model: Model, shown: Sequence[DisplacementEffect], campaign: float | None
) -> tuple[Equations, str] | None:
    try:
        equations = build_equations(model, encoders=shown, campaign=campaign)
        return equations, write_plant_source(equations)
    except InputError:  # it uses an operation that expressions do not have: Python simulates it
        return None
    except Exception:
        if all(type(effect).__module__.startswith("tau_dyn.") for effect in (*model.effects, *shown)):
            raise  # a defect of ours
        return None  # a law of the user's may do anything on expressions


def _identify(model: Model, shown: Sequence[DisplacementEffect], campaign: float | None) -> tuple:
    """Return a key that identifies a model except for its parameters' values."""
    robot = model.robot
    parts = (getattr(robot, f.name) for f in fields(robot) if f.name != "parameters")
    names = model.parameters.names
    return *map(id, parts), names, *map(id, (*model.effects, *shown)), campaign


_TRACED = _TracedModels()


class PlantMotion(NamedTuple):
    """A run: positions, velocities, accelerations, forces and whether friction held a joint (N, na), and the encoders' readings.

    `compute_tool` gives the tool's positions (N, 3) along positions (N, na), or None.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    stuck: np.ndarray
    read: np.ndarray | None
    compute_tool: Callable[[np.ndarray], np.ndarray | None]


class CompiledPlant:
    """One robot with its effects, as a library."""

    def __init__(
        self, model: Model, equations: Equations, library: ctypes.CDLL, surroundings: EffectSurroundings | None = None
    ) -> None:
        """Take the equations of a model and the library that was built from them."""
        self.model, self.na, self.equations = model, model.robot.na, equations
        self.library, self._surroundings = library, surroundings or EffectSurroundings()
        names, felt = model.parameters.names, equations.model.parameters.names
        self.places = [names.index(felt[k]) for k in equations.parameters]
        for name in ("size", "run", "inertia", *(["tool"] if equations.tool is not None else [])):
            getattr(library, f"plant_{name}").restype = ctypes.c_int64

    @classmethod
    def find(
        cls, model: Model, n_samples: int, surroundings: EffectSurroundings | None = None, *, encoders: bool = False
    ) -> CompiledPlant | None:
        """Return a model's compiled plant if compilation is possible and saves time for a run of this length, else None.

        Args:
            model: The model.
            n_samples: Number of plant steps to be simulated.
            surroundings: Surroundings; by default a room that warms up.
            encoders: Whether the encoders' errors are simulated.
        """
        robot = model.robot
        passive = robot.model.nv - robot.na if robot.loops and model.mechanism.equations == "tree" else 0
        if n_samples < MIN_SAMPLES + MIN_SAMPLES_PER_DRIVE * robot.na + MIN_SAMPLES_PER_PASSIVE_JOINT * passive:
            return None
        if not is_compiling_allowed() or find_compiler() is None:
            return None
        shown = EncoderErrors(model).effects if encoders else ()
        kept = model.only((*(e for e in model.effects if not acts_on_recording(e)), *shown))
        campaign = None if surroundings is None else surroundings.campaign
        traced = _TRACED.find(kept, shown, campaign)
        if traced is None:
            return None
        equations, source = traced
        library = _LIBRARIES.find(source)
        if library is None:
            try:
                compare_equations(equations, surroundings)
            except InputError:
                return None
            library = _LIBRARIES.build(source)
        return None if library is None else cls(model, equations, library, surroundings)

    def compute_inertia(self, law_model: Model, q: np.ndarray) -> np.ndarray | None:
        """Return the mass matrix (N, na, na) of a model of the same robot along positions (N, na), or None.

        None if the robots differ in more than values, or if a position cannot be reached.
        """
        names = law_model.parameters.names
        own = [self.model.parameters.names[k] for k in self.places]
        if law_model.robot.model is not self.model.robot.model:
            return None
        values = [law_model.parameters[x].value if x in names else 0.0 for x in own] or [0.0]
        q, theta = np.ascontiguousarray(q, float), np.array(values)
        out = np.empty((len(q), self.na, self.na))
        state = self.begin(q[0], np.zeros(self.na))
        done = self.library.plant_inertia(state, *(_point(x) for x in (theta, q, out)), ctypes.c_int64(len(q)))
        return out if done == len(q) else None

    def compute_tool(self, q: np.ndarray) -> np.ndarray | None:
        """Return the tool's positions (N, 3) [m] along positions (N, na), or None if one cannot be reached."""
        q = np.ascontiguousarray(q, float)
        out = np.empty((len(q), 3))
        if self.equations.tool is None or not len(q):
            return None
        state = self.begin(q[0], np.zeros(self.na))
        return out if self.library.plant_tool(state, _point(q), _point(out), ctypes.c_int64(len(q))) == len(q) else None

    def begin(self, q0: np.ndarray, v0: np.ndarray, *controller: np.ndarray) -> Any:
        """Return the library's state at positions, velocities (na,) and, if there is a controller, its numbers."""
        loops = self.equations.loops
        passive = np.zeros(0) if loops is None else loops.closed(q0)[loops.passive]
        given = [np.ascontiguousarray(x, float) for x in (q0, v0, passive, *controller)]
        state = ctypes.create_string_buffer(self.library.plant_size())
        self.library.plant_start_at(state, *(_point(x) for x in given), *[None] * (6 - len(given)))
        return state

    def apply_forces(
        self, q0: np.ndarray, v0: np.ndarray, dt: float, tau: np.ndarray, *, parameters: np.ndarray | None = None
    ) -> PlantMotion | None:
        """Return the motion under forces, each around its sample; None if the run cannot be finished.

        Args:
            q0: Positions at the start (na,) [m or rad].
            v0: Velocities at the start (na,).
            dt: Step [s].
            tau: Forces (N, na) [N or N m].
            parameters: Values of the model's parameters; by default its own.
        """
        run = _Run(self, q0, v0, dt, len(tau), parameters)
        run.take(tau=tau)
        return run.finish(None)

    def follow(
        self,
        q0: np.ndarray,
        v0: np.ndarray,
        servo: Servo,
        *,
        parameters: np.ndarray | None = None,
        often: int = 1,
        substeps: int = 1,
        hold: bool = False,
        watch: Callable[[int, np.ndarray], bool] | None = None,
    ) -> PlantMotion | None:
        """Return the motion along a reference; None if the run cannot be finished.

        Args:
            q0: Positions at the start (na,) [m or rad].
            v0: Velocities at the start (na,).
            servo: The cascade and its reference.
            parameters: Values of the model's parameters; by default its own.
            often: Samples of the loop for each that is returned.
            substeps: Steps of the plant a sample.
            hold: Whether a force acts from its sample to the next, and not around it.
            watch: Told about a hundred times which sample is done and the positions after it; False ends the run.
        """
        run = _Run(self, q0, v0, servo.period / substeps, len(servo.q_ref), parameters, often, substeps)
        run.follow(servo, hold)
        return run.finish(watch)

    def temperatures(self, n: int, dt: float) -> np.ndarray | None:
        """Return the lagged temperatures that effects follow (n, na * effects) at n steps [s]; see `forces.Memory`."""
        if not self.equations.warm:
            return None
        t = np.concatenate([[0.0], np.cumsum(np.full(n - 1, dt))])
        room = np.array([np.broadcast_to(self._surroundings.temperature(float(x)), self.na) for x in t], float)
        columns = []
        for effect in self.equations.warm:
            lag = effect.settings.get("lag", 0.0)
            keep = np.exp(-dt / lag) if lag > 0 else 0.0
            columns.append(room[0] + lfilter([1 - keep], [1, -keep], room - room[0], axis=0))
        return np.hstack(columns)


def _point(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class _Fields(ctypes.Structure):
    """`Run` of `c/plant_run.c`."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("often", "substeps", "inertia_every", "hold")),
        *((name, ctypes.c_double) for name in ("dt", "period")),
        *((name, ctypes.c_void_p) for name in (
            "theta", "felt", "q_ref", "v_ref", "forward", "law", "inertia", "noise", "resolution", "q", "read", "v", "a",
            "tau", "stuck",
        )),
    ]  # fmt: skip


class _Run:
    """One run: its arrays, which have to live as long as the library works on them."""

    def __init__(
        self,
        plant: CompiledPlant,
        q0: np.ndarray,
        v0: np.ndarray,
        dt: float,
        n: int,
        parameters: np.ndarray | None,
        often: int = 1,
        substeps: int = 1,
    ) -> None:
        na = plant.na
        self._library, self._n, self._na, self._tool = plant.library, n, na, plant.compute_tool
        values = plant.model.parameters.values if parameters is None else np.asarray(parameters, float)
        self._fields = _Fields(often=often, substeps=substeps, inertia_every=1, dt=dt, period=dt)
        self._arrays: dict[str, Any] = {}
        self._put("theta", values[plant.places] if plant.places else np.zeros(1))
        self._put("felt", plant.temperatures(n * substeps, dt))
        self._begin = partial(plant.begin, np.asarray(q0, float), v0)
        rows = (len(range(0, n, often)), na)
        for name in ("q", "v", "a"):
            self._put(name, np.empty(rows))
        self._put("stuck", np.zeros(rows, np.uint8), np.uint8)

    def take(self, tau: np.ndarray) -> None:
        """Have forces (N, na) drive the robot."""
        self._put("tau", tau)
        self._state = self._begin()

    def follow(self, servo: Servo, hold: bool) -> None:
        """Have a cascade drive the robot."""
        law, na, fields = servo.law, self._na, self._fields
        gains = (law.position_gain, law.velocity_gain, law.integral_rate, law.speed_feedforward, law.force_per_unit)
        fields.period, fields.hold, fields.inertia_every = servo.period, hold, servo.inertia_every
        self._put("law", np.concatenate([*gains, law.limit]))
        for name in ("q_ref", "v_ref", "forward", "inertia", "noise"):
            self._put(name, getattr(servo, name))
        self._put("resolution", None if servo.resolution is None else np.broadcast_to(servo.resolution, (na,)))
        for name in ("read", "tau"):
            self._put(name, np.empty_like(self._arrays["q"]))
        self._state = self._begin(servo.before, servo.v_before, servo.integral)

    def finish(self, watch: Callable[[int, np.ndarray], bool] | None) -> PlantMotion | None:
        """Run to the end, about a hundredth at once."""
        q, done = np.frombuffer(self._state, float, self._na), 0
        for end in (*range(1, self._n, max(1, self._n // 100)), self._n):
            done = self._library.plant_run(
                self._state, ctypes.byref(self._fields), ctypes.c_int64(done), ctypes.c_int64(end)
            )
            if done != end or watch is not None and not watch(end - 1, q):
                return None
        found = self._arrays
        return PlantMotion(
            found["q"],
            found["v"],
            found["a"],
            found["tau"],
            found["stuck"].astype(bool),
            found.get("read"),
            self._tool,
        )

    def _put(self, name: str, values: np.ndarray | None, kind: Any = float) -> None:
        """Pass an array to the compiled code; skip `None`."""
        if values is None:
            return
        self._arrays[name] = array = np.ascontiguousarray(values, kind)
        setattr(self._fields, name, array.ctypes.data)


def compare_equations(equations: Equations, surroundings: EffectSurroundings | None = None) -> float:
    """Return how far a model's equations are from the simulator's at random states, relative to the largest value.

    Raises:
        InputError: They disagree: some effect decides in a way that tracing did not see.
    """
    model, worst = equations.model, 0.0
    q, v, a = draw_random_states(model, _STATES, np.random.default_rng(_SEED))
    n, room = len(q), (surroundings or EffectSurroundings()).temperature(0.0)
    known = {"q": q, "v": v, "a": a, "theta": np.tile(model.parameters.values, (n, 1))}
    if equations.loops is not None:
        known["p"] = np.array([equations.loops.closed(x) for x in q])[:, equations.loops.passive]
    known["r"] = np.tile(np.broadcast_to(room, model.robot.na), (n, len(equations.warm)))
    for part, outputs, expected in _list_expected(equations, surroundings, q, v, a):
        found, fine = evaluate_graph(part.graph, outputs, known | {"m": np.zeros((n, part.arguments.get("m", 0)))})
        difference = np.max(np.abs(found - expected)) / max(float(np.max(np.abs(expected))), 1e-300)
        if not difference < AGREEMENT or not fine.all():
            raise InputError(
                "unsupported",
                f"{model.robot.source}: the traced {' and '.join(part.outputs)} differ from the simulator's by {difference:.2g}, "
                "so no FMU is written",
            )
        worst = max(worst, float(difference))
    return worst


def _list_expected(
    equations: Equations, surroundings: EffectSurroundings | None, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> list[tuple[TracedFunction, tuple[Any, ...], np.ndarray]]:
    """Return each part with its outputs and the simulator's values of them."""
    model, n = equations.model, equations.model.robot.na
    pairs = [model.mechanism.mass_and_bias(x, y) for x, y in zip(q, v, strict=True)]
    found = [(equations.dynamics, equations.dynamics.values, np.array([[*M.ravel(), *h] for M, h in pairs]))]
    if equations.tool is not None:
        found.append((equations.tool, equations.tool.values, model.mechanism.tool_position(q)))
    if equations.friction is not None:
        forces, part = SampledForces(model, surroundings), equations.friction
        bounds = np.array([np.ravel(forces.bounds(*state)) for state in zip(q, v, a, strict=True)])
        found.append((part, (*_sort_bounds(part, True), *_sort_bounds(part, False)), bounds))
        added = [forces.mass(x, y) for x, y in zip(q, v, strict=True)]
        if equations.mass is not None:
            rows = [np.zeros(n * n) if x is None else np.ravel(x) for x in added]
            found.append((equations.mass, equations.mass.values, np.array(rows)))
    if equations.encoders is not None:
        shown = np.array([EncoderErrors(model).read(x) for x in q])
        found.append((equations.encoders, equations.encoders.values, shown))
    return found


def _sort_bounds(part: TracedFunction, low: bool) -> tuple[Any, ...]:
    """Return the friction's lower or upper bound as the simulator gives it where an effect pushes forwards."""
    graph, out = part.graph, []
    for k, (x, y) in enumerate(zip(part.outputs["lower"], part.outputs["upper"], strict=True)):
        now = graph.apply("select", graph.apply("lt", 0.0, graph.input(f"v{k}", 0.0)), y, x)
        out.append(graph.apply("select", graph.apply("lt", y, x), now, x if low else y))
    return tuple(out)
