"""A model's forces as casadi expressions, for a solver that needs exact first and second derivatives.

The expressions are those of the C export (`codegen/program.py`): the code of mechanism and effects, run once on symbols and
compared with Python. If loops are solved numerically, the passive joints and the solution of every inner linear system become
separate unknowns, and their equations become constraints: the solver closes the loops while it optimises, and every expression
stays short and sparse (lifted; Albersmeyer & Diehl 2010).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from tau_dyn.codegen import Program, build_program
from tau_dyn.control.feedforward import Feedforward
from tau_dyn.equations import Graph, Node
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model

MISSING = "planning a motion needs casadi: pip install 'tau_dyn[motion]'"

_NEWTON = 8  # steps; the lifted equations are linear one after the other, so few are enough


def import_casadi() -> Any:
    """Return casadi; if it is missing, the error names the command that installs it."""
    try:
        import casadi as found
    except ImportError as fault:
        raise InputError("missing_package", MISSING) from fault
    return found


@dataclass(frozen=True, eq=False)
class ForceLaw:
    """Forces of a model on symbols.

    Attributes:
        feedforward: The same forces in Python, with the same smoothed sign of friction.
        forces: casadi function `(q, v, a, p, y) -> tau`, columns of (na,), (na,), (na,), (n_p,) and (n_y,).
        residual: casadi function `(q, v, a, p, y) -> r`, zero if loops are closed and inner systems are solved.
        n_passive: Number of passive joints that are solved for.
        n_inner: Number of further unknowns.
        warnings: Effects that the forces leave out, as sentences.
        program: Source of the expressions.
        unit: Units of the inner unknowns (n_y,).
    """

    feedforward: Feedforward
    forces: Any
    residual: Any
    n_passive: int
    n_inner: int
    warnings: tuple[str, ...]
    program: Program
    unit: np.ndarray

    def passive(self, q: np.ndarray) -> np.ndarray:
        """Return the passive joints (N, n_p) that close the loops at actuated positions (N, na)."""
        loops = self.program.loops
        if loops is None:
            return np.zeros((len(q), 0))
        return np.unwrap(np.array([loops.closed(x)[loops.passive] for x in q]), axis=0)

    def inner(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the further unknowns (N, n_y) along a motion (N, na) with its passive joints (N, n_p)."""
        y = np.zeros((self.n_inner, len(q)))
        if not self.n_inner:
            return y.T
        ca = import_casadi()
        symbols = [ca.SX.sym(name, n) for name, n in zip("qvapy", self._sizes, strict=True)]
        r = self.residual(*symbols)[-self.n_inner :]
        system = ca.Function("system", symbols, [r, ca.jacobian(r, symbols[4])])
        for k in range(len(q)):
            for _ in range(_NEWTON):
                gap, J = system(q[k], v[k], a[k], p[k], y[:, k])
                change = np.linalg.solve(np.array(J), np.array(gap))[:, 0]
                y[:, k] -= change
                if np.abs(change).max() <= 1e-12 * (1 + np.abs(y[:, k]).max()):
                    break
        return y.T

    def in_units(self, unit: np.ndarray) -> ForceLaw:
        """Return the same forces with inner unknowns in units `unit` (n_y,) times the present ones."""
        ca = import_casadi()
        q, v, a, p, y = symbols = [ca.SX.sym(name, n) for name, n in zip("qvapy", self._sizes, strict=True)]
        forces, residual = (
            ca.Function(name, symbols, [f(q, v, a, p, ca.DM(unit) * y)])
            for name, f in (("forces", self.forces), ("residual", self.residual))
        )
        return replace(self, forces=forces, residual=residual, unit=self.unit * unit)

    @property
    def _sizes(self) -> tuple[int, ...]:
        na = self.feedforward.model.robot.na
        return na, na, na, self.n_passive, self.n_inner


def build_force_law(model: Model, width: np.ndarray) -> ForceLaw:
    """Return a model's forces on symbols.

    Args:
        model: Robot and effects; those that need a history are left out and named.
        width: Speed within which the sign of friction is smoothed (na,) [m/s or rad/s].

    Raises:
        InputError: casadi is missing, or the rigid robot cannot be written out.
    """
    import_casadi()
    program, left_out = _traced(model, width)
    names = ", ".join(dict.fromkeys(effect.name for effect in left_out))
    warnings = (f"the plan leaves out {names}, whose force it cannot write out",) if left_out else ()
    return _on_symbols(program, warnings)


def _traced(model: Model, width: np.ndarray) -> tuple[Program, list]:
    """Return the program of the model, or of the model without the effects that depend on internals of the mechanism."""
    steady = model.steady()
    simple = steady.only(effect for effect in steady.effects if not effect.needs)
    try:
        kept, program = steady, build_program(Feedforward(steady, width=width, shape="tanh"))
    except InputError:
        if len(simple.effects) == len(steady.effects):
            raise
        kept, program = simple, build_program(Feedforward(simple, width=width, shape="tanh"))
    return program, [effect for effect in model.effects if effect not in kept.effects]


def _on_symbols(program: Program, warnings: tuple[str, ...]) -> ForceLaw:
    ca = import_casadi()
    na = program.feedforward.model.robot.na
    n_p = 0 if program.loops is None else len(program.loops.passive)
    q, v, a, p = (ca.SX.sym(name, n) for name, n in zip("qvap", (na, na, na, n_p), strict=True))
    known = {"q": q, "v": v, "a": a, "p": p}
    values, inner, rows = _walked(program.graph, program.outputs, known)
    gap: list[Any] = []
    if program.loops is not None and program.closure is not None:
        every = program.closure.outputs["gap"]
        closed, _, _ = _walked(program.closure.graph, every, known)
        gap = [_of(every[k], closed) for k in program.loops.rows]
    y = ca.vertcat(*inner) if inner else ca.SX(0, 1)
    arguments = [q, v, a, p, y]
    tau = ca.vertcat(*(_of(x, values) for x in program.outputs))
    forces = ca.Function("forces", arguments, [tau])
    residual = ca.Function("residual", arguments, [ca.vertcat(*gap, *rows) if gap or rows else ca.SX(0, 1)])
    n_y = int(y.numel())
    return ForceLaw(cast(Feedforward, program.feedforward), forces, residual, n_p, n_y, warnings, program, np.ones(n_y))


def _walked(graph: Graph, outputs: Any, known: dict[str, Any]) -> tuple[dict[int, Any], list[Any], list[Any]]:
    """Return every needed node's expression, the unknowns that replace solved systems, and their equations."""
    ca = import_casadi()
    values: dict[int, Any] = {}
    inner: list[Any] = []
    rows: list[Any] = []
    for node in graph.needed([x for x in outputs if isinstance(x, Node)]):
        args = [values[k] for k in node.before]
        if node.op == "const":
            values[node.index] = node.args[0]
        elif node.op == "input":
            name = node.args[0].rstrip("0123456789")
            values[node.index] = known[name][int(node.args[0][len(name) :])]
        elif node.op == "factor":
            n = round(math.sqrt(len(args)))
            values[node.index] = ca.vertcat(*args).reshape((n, n)).T
        elif node.op in ("solve", "solve_t"):
            b = ca.vertcat(*args[1:])
            y = ca.SX.sym(f"y{node.index}_", b.numel())
            inner.append(y)
            rows.append(ca.mtimes(args[0] if node.op == "solve" else args[0].T, y) - b)
            values[node.index] = y
        elif node.op == "item":
            values[node.index] = args[0][node.args[1]]
        else:
            values[node.index] = _operations()[node.op](*args)
    return values, inner, rows


def _of(x: Any, values: dict[int, Any]) -> Any:
    return values[x.index] if isinstance(x, Node) else x


def _operations() -> dict[str, Callable[..., Any]]:
    ca = import_casadi()
    return {
        "add": lambda x, y: x + y, "sub": lambda x, y: x - y, "mul": lambda x, y: x * y, "div": lambda x, y: x / y,
        "neg": lambda x: -x, "abs": ca.fabs, "sqrt": ca.sqrt, "exp": ca.exp, "log": ca.log, "sin": ca.sin, "cos": ca.cos,
        "tan": ca.tan, "tanh": ca.tanh, "atan2": ca.atan2, "hypot": lambda x, y: ca.sqrt(x * x + y * y), "sign": ca.sign,
        "min": ca.fmin, "max": ca.fmax, "select": ca.if_else, "lt": lambda x, y: x < y, "le": lambda x, y: x <= y,
        "eq": lambda x, y: x == y, "and": ca.logic_and, "or": ca.logic_or, "not": ca.logic_not,
    }  # fmt: skip
