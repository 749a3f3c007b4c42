"""A feedforward as one Python module that needs NumPy alone; the program's graph, a line a node.

`tau_ff(q, v, a)` takes one state (na,) or many (N, na). With loops that are solved numerically states are taken one after
another, each started from the one before, as in C. Inputs and forces that are no numbers or beyond a limit raise `ValueError`.
"""

from __future__ import annotations

import builtins
import keyword
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tau_dyn.codegen.c_writer import ITERATIONS, MAX_NUMBER, STEP, STEPS
from tau_dyn.codegen.program import Program, yield_description
from tau_dyn.equations import Graph, Node, TracedFunction
from tau_dyn.exceptions import InputError

_FORM = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}", "abs": "np.abs({})",
    "floor": "np.floor({})",
    "sqrt": "np.sqrt({})", "exp": "np.exp({})", "log": "np.log({})", "sin": "np.sin({})", "cos": "np.cos({})",
    "tan": "np.tan({})", "tanh": "np.tanh({})", "atan2": "np.arctan2({}, {})", "hypot": "np.hypot({}, {})",
    "sign": "np.sign({})", "min": "np.minimum({}, {})", "max": "np.maximum({}, {})", "select": "np.where({}, {}, {})",
    "lt": "{} < {}", "le": "{} <= {}", "eq": "{} == {}", "and": "np.logical_and({}, {})", "or": "np.logical_or({}, {})",
    "not": "np.logical_not({})",
}  # fmt: skip

_TAKEN = ("np", "HOME", "ROWS", "LIMIT")


def write_python_source(program: Program, name: str = "tau_ff") -> str:
    """Return a feedforward as the text of a Python module with one public function.

    Args:
        program: From `build_program`.
        name: Name of the function.

    Raises:
        InputError: The name is no identifier of Python, or means something else there.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name) or keyword.iskeyword(name):
        raise InputError(
            "invalid_value",
            f"'{name}' cannot name a function in Python; use letters, digits and underscores, a letter first",
        )
    if name in _TAKEN or hasattr(builtins, name):
        raise InputError(
            "invalid_value",
            f"'{name}' cannot name a function in Python, where it means something else; take another name",
        )
    words = "\n".join(yield_description(program)).replace("\\", "/").replace('"""', "'''")
    more = "".join(f", {signal}" for signal in program.signals)
    limit = ", ".join(repr(float(x)) for x in np.minimum(program.feedforward.model.robot.effort_limit, MAX_NUMBER))
    lines = [f'"""{words}', '"""', "", "import numpy as np", "", f"LIMIT = np.array([{limit}])"]
    if program.closure is not None:
        lines += [*_closing(program, program.closure), ""]
    lines += ["", f"def _forces(q, v, a{more}{', p' if program.loops is not None else ''}):"]
    lines += [*yield_assignments(program.graph, program.outputs)]
    guards = program.graph.guards.items()
    good = " & ".join(f"{'' if answer else '~'}np.asarray(t{k})" for k, answer in guards) or "True"
    lines += [f"    return np.stack(np.broadcast_arrays({join_names(program.outputs)}), axis=-1), {good}", "", ""]
    na = program.feedforward.model.robot.na
    public = _PUBLIC + (_STRAIGHT if program.loops is None else _FOLLOWED) + _CHECKED
    lines += [public.format(name=name, more=more, na=na, most=MAX_NUMBER)]
    return "\n".join([*lines, ""])


def _closing(program: Program, closure: TracedFunction) -> Iterator[str]:
    assert program.loops is not None
    loops, robot = program.loops, program.feedforward.model.robot
    n = len(loops.passive)
    home = ", ".join(repr(float(x)) for x in (*robot.home, *loops.home[loops.passive]))
    yield f"HOME = np.array([{home}])"
    yield f"ROWS = {loops.rows}"
    yield ""
    yield ""
    yield "def _closure(q, p):"
    yield from yield_assignments(closure.graph, closure.values)
    gap, J = closure.outputs["gap"], closure.outputs["J"]
    yield f"    return np.array([{join_names(gap)}]), np.array([{join_names(J)}]).reshape({n}, {n})"
    yield ""
    yield ""
    yield _CLOSED.format(na=robot.na, step=STEP, steps=STEPS, iterations=ITERATIONS)


def yield_assignments(graph: Graph, outputs: Sequence[Any]) -> Iterator[str]:
    """Yield one line a node, indented as a function's body."""
    for node in graph.needed(outputs):
        shown = [_named(graph.nodes[k]) for k in node.before]
        if node.op in ("input", "const", "item"):
            continue
        if node.op == "factor":
            n = round(len(shown) ** 0.5)
            text = f"np.array([{', '.join(shown)}]).reshape({n}, {n})"
        elif node.op in ("solve", "solve_t"):
            A = shown[0] + (".T" if node.op == "solve_t" else "")
            text = f"np.linalg.solve({A}, np.array([{', '.join(shown[1:])}]))"
        else:
            text = _FORM[node.op].format(*shown)
        yield f"    t{node.index} = {text}"


def _named(x: Any) -> str:
    if not isinstance(x, Node):
        return repr(float(x))
    if x.op == "const":
        return repr(x.args[0]) if x.args[0] >= 0 else f"({x.args[0]!r})"
    if x.op == "input":
        name = x.args[0].rstrip("0123456789")
        return f"{name}[..., {x.args[0][len(name) :]}]"
    return f"t{x.args[0]}[{x.args[1]}]" if x.op == "item" else f"t{x.index}"


def join_names(values: Sequence[Any]) -> str:
    """Return the names of nodes, and the numbers, as they appear in the code, separated by commas."""
    return ", ".join(_named(x) for x in values)


_PUBLIC = """\
def {name}(q, v, a{more}):
    \"\"\"Return the forces of states ({na},) or (N, {na}); ValueError where they could not be given to a drive.\"\"\"
    args = np.broadcast_arrays(*(np.asarray(x, float) for x in (q, v, a{more})))
    if args[0].shape[-1:] != ({na},):
        raise ValueError("q, v and a must end in {na} joints")
    if not all(np.all(np.abs(x) <= {most}) for x in args):
        raise ValueError("an input is no number, or beyond {most:g}")
"""

_STRAIGHT = """\
    with np.errstate(all='ignore'):
        tau, good = _forces(*args)
    if not np.all(good):
        raise ValueError("a position is out of reach")
"""

_FOLLOWED = """\
    flat = [x.reshape(-1, x.shape[-1]) for x in args]
    tau, start = np.empty(flat[0].shape), HOME
    for k, state in enumerate(zip(*flat)):
        start = _closed(start, state[0])
        tau[k], good = _forces(*state, start[{na}:])
        if not np.all(good):
            raise ValueError("a position is out of reach")
    tau = tau.reshape(args[0].shape)
"""

_CHECKED = """\
    if not np.all(np.abs(tau) <= LIMIT):
        raise ValueError("a force is no number, or beyond its joint's limit")
    return tau"""

_CLOSED = """\
def _newton(q, p):
    for _ in range({iterations}):
        gap, J = _closure(q, p)
        try:
            step = np.linalg.solve(J, -gap[ROWS])
        except np.linalg.LinAlgError:
            break
        most = np.abs(step).max()
        p = p + step * min(1.0, 0.3 / max(most, 1e-300))
        if np.abs(gap).max() < 1e-7 and most < 1e-6:
            return p
    raise ValueError("the loops could not be closed; the position is out of reach")


def _closed(start, q):
    \"\"\"Follow the drives from the last configuration to positions q in bounded steps.\"\"\"
    far = np.abs(q - start[:{na}]).max()
    if not far <= {step} * {steps}:
        raise ValueError("a position is too far from the last one, or not a number")
    count, p = max(1, int(np.ceil(far / {step}))), start[{na}:]
    for k in range(1, count + 1):
        p = _newton(start[:{na}] + (q - start[:{na}]) * k / count, p)
    return np.concatenate([q, p])"""
