"""A feedforward as one Python module that needs NumPy alone; the program's graph, a line a node.

`tau_ff(q, v, a)` takes one state (na,) or many (N, na). With loops that are solved numerically states are taken one after
another, each started from the one before, as in C.
"""

from __future__ import annotations

import builtins
import keyword
import re
from collections.abc import Iterator, Sequence
from typing import Any

from tau_dyn.control.export_c_loops import CLOSED
from tau_dyn.control.export_c_newton import ITERATIONS, STEP, STEPS
from tau_dyn.control.export_model import Program
from tau_dyn.control.export_text import yield_description
from tau_dyn.control.graph import Graph, Node
from tau_dyn.exceptions import InputError

_FORM = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}", "abs": "np.abs({})",
    "sqrt": "np.sqrt({})", "exp": "np.exp({})", "log": "np.log({})", "sin": "np.sin({})", "cos": "np.cos({})",
    "tan": "np.tan({})", "tanh": "np.tanh({})", "atan2": "np.arctan2({}, {})", "hypot": "np.hypot({}, {})",
    "sign": "np.sign({})", "min": "np.minimum({}, {})", "max": "np.maximum({}, {})", "select": "np.where({}, {}, {})",
    "lt": "{} < {}", "le": "{} <= {}", "eq": "{} == {}", "and": "np.logical_and({}, {})", "or": "np.logical_or({}, {})",
    "not": "np.logical_not({})",
}  # fmt: skip

_TAKEN = ("np", "HOME", "ROWS")


def write_python_source(program: Program, name: str = "tau_ff") -> str:
    """Return a feedforward as the text of a Python module with one public function.

    Args:
        program: From `build_program`.
        name: Of the function.

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
    lines = [f'"""{words}', '"""', "", "import numpy as np", ""]
    if program.loops is not None:
        lines += [*_closing(program), ""]
    lines += ["", f"def _forces(q, v, a{more}{', p' if program.loops is not None else ''}):"]
    lines += [*_body(program.graph, program.outputs)]
    good = (
        " & ".join(f"{'' if answer else '~'}np.asarray(t{k})" for k, answer in program.graph.guards.items()) or "True"
    )
    lines += [f"    return np.stack(np.broadcast_arrays({_listed(program.outputs)}), axis=-1), {good}", "", ""]
    lines += _public(program, name, more)
    return "\n".join([*lines, ""])


def _public(program: Program, name: str, more: str) -> Iterator[str]:
    n = program.feedforward.model.robot.na
    yield f"def {name}(q, v, a{more}):"
    yield f'    """Return the forces of states ({n},) or (N, {n}); ValueError where a position is out of reach."""'
    yield f"    args = np.broadcast_arrays(*(np.asarray(x, float) for x in (q, v, a{more})))"
    yield f"    if args[0].shape[-1:] != ({n},):"
    yield f'        raise ValueError("q, v and a must end in {n} joints")'
    if program.loops is None:
        yield "    with np.errstate(all='ignore'):"
        yield "        tau, good = _forces(*args)"
        yield "    if not np.all(good):"
        yield '        raise ValueError("a position is out of reach")'
        yield "    return tau"
        return
    yield "    flat = [x.reshape(-1, x.shape[-1]) for x in args]"
    yield "    out, start = np.empty(flat[0].shape), HOME"
    yield "    for k, state in enumerate(zip(*flat)):"
    yield "        start = _closed(start, state[0])"
    yield f"        out[k] = _forces(*state, start[{n}:])[0]"
    yield "    return out.reshape(args[0].shape)"


def _closing(program: Program) -> Iterator[str]:
    loops, graph = program.loops, program.closure
    assert loops is not None and graph is not None
    robot = program.feedforward.model.robot
    flat = [x for row in program.jacobian for x in row]
    n = len(loops.passive)
    home = ", ".join(repr(float(x)) for x in (*robot.home, *loops.home[loops.passive]))
    yield f"HOME = np.array([{home}])"
    yield f"ROWS = {loops.rows}"
    yield ""
    yield ""
    yield "def _closure(q, p):"
    yield from _body(graph, [*program.gap, *flat])
    yield f"    return np.array([{_listed(program.gap)}]), np.array([{_listed(flat)}]).reshape({n}, {n})"
    yield ""
    yield ""
    yield from _CLOSED.format(
        na=robot.na, step=STEP, steps=STEPS, iterations=ITERATIONS, closed=CLOSED * 1e3
    ).splitlines()


def _body(graph: Graph, outputs: Sequence[Any]) -> Iterator[str]:
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


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(_named(x) for x in values)


_CLOSED = '''\
def _newton(q, p):
    for _ in range({iterations}):
        gap, J = _closure(q, p)
        step = np.linalg.solve(J, -gap[ROWS])
        most = np.abs(step).max()
        p = p + step * min(1.0, 0.5 / max(most, 1e-300))
        if np.abs(gap).max() < 1e-7:
            if most < {closed}:
                return p
            break
    raise ValueError("the loops could not be closed; the position is out of reach")


def _closed(start, q):
    """Follow the drives from the last configuration to positions q in bounded steps."""
    far = np.abs(q - start[:{na}]).max()
    if not far <= {step} * {steps}:
        raise ValueError("a position is too far from the last one, or not a number")
    count, p = max(1, int(np.ceil(far / {step}))), start[{na}:]
    for k in range(1, count + 1):
        p = _newton(start[:{na}] + (q - start[:{na}]) * k / count, p)
    return np.concatenate([q, p])'''
