r"""A graph as a list of operations on rows of samples, done by NumPy or by one small C library for all graphs.

    row[target] = operation(row[first], row[second])

Rows are inputs, constants, outputs and scratch; a scratch row is used again once nothing reads its value any more. The C library
interprets the list on a few dozen samples at once, which stay in the processor's first cache. So nothing is compiled for a robot,
and a list of any length is ready at once. Reference: Griewank & Walther 2008, ch. 4 (evaluation procedures, tapes).

Both do the operations of the array code in its order, without contraction (`-ffp-contract=off`), and sines and cosines come from
NumPy. So tapes and array code give equal numbers: which of them computes a sample does not change a result. `ctypes` releases the
interpreter's lock during a call of the library, so threads run at the same time.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from tau_dyn.equations.compiler import LibraryCache, find_compiler, is_compiling_allowed
from tau_dyn.equations.graph import NUMPY, Graph, Node

TRACE_FROM, BUILD_FROM = 10_000, 100_000
"""Samples of one mechanism from which its columns are traced, and from which the library is built if it is missing.

Tracing takes as long as 5,000 to 12,000 samples save on robots of 3 to 30 joints. Building takes 0.15 s, once for all robots,
which 50,000 samples of six axes save."""
MAX_IN_NUMPY = 10_000
"""Operations up to which NumPy's tape is quicker than array code; it calls a function for each, and 6R have 2,000."""
_BLOCK = 1024  # samples that NumPy takes at once
_MAX_TAPES = 16  # computations that are remembered
_LIBRARIES = LibraryCache()

_OPERATIONS, _BINARY = ("add", "sub", "mul", "div", "neg", "copy"), 4  # the first four take two rows
_BEFORE = ("sin", "cos")  # functions of an input alone, which NumPy evaluates
_SOURCE = r"""
#include <stdint.h>
enum { LANES = 2, SAMPLES = 64 };
typedef double pack __attribute__((vector_size(16), aligned(8), may_alias));
#define ALL(T, m, value) \
    { T *t = (T *)at[op[1]]; const T *x = (const T *)at[op[2]], *y = (const T *)at[op[3]]; \
      (void)y; for (int64_t i = 0; i < (m); ++i) t[i] = value; break; }
#define DO(T, m) switch (op[0]) { \
    case 0: ALL(T, m, x[i] + y[i]) case 1: ALL(T, m, x[i] - y[i]) case 2: ALL(T, m, x[i] * y[i]) \
    case 3: ALL(T, m, x[i] / y[i]) case 4: ALL(T, m, -x[i]) default: ALL(T, m, x[i]) }

/* First n_in rows at `in`, n samples each; then n_out rows at places[..] of `out`; then n_kept rows at `kept`, SAMPLES each. */
__attribute__((visibility("default")))
void tape(int64_t n, int64_t n_ops, const int32_t *ops, double **at, int64_t n_in, double *in, int64_t n_kept, double *kept,
          int64_t n_out, const int64_t *places, double *out, int64_t stride) {
    for (int64_t k = 0; k < n_kept; ++k) at[n_in + n_out + k] = kept + k * SAMPLES;
    for (int64_t s = 0; s < n; s += SAMPLES) {
        for (int64_t k = 0; k < n_in; ++k) at[k] = in + k * n + s;
        for (int64_t k = 0; k < n_out; ++k) at[n_in + k] = out + places[k] * stride + s;
        const int64_t left = n - s;
        for (const int32_t *op = ops; op < ops + 4 * n_ops; op += 4)
            if (left >= SAMPLES) DO(pack, SAMPLES / LANES) else DO(double, left)
    }
}
"""
_SAMPLES = 64  # `SAMPLES` of the library


class Tape:
    """One graph as a list of operations.

    Attributes:
        before: The functions that NumPy evaluates, as rows after the inputs: name, and the row of its argument.
        places: Row of `out` of each output (k,).
    """

    def __init__(self, graph: Graph, inputs: Sequence[Node], outputs: Sequence[Any]) -> None:
        """Write the list.

        Args:
            graph: The graph.
            inputs: Its inputs, in the order of the rows.
            outputs: Its outputs in the order of the rows: nodes, or numbers; rows of zeros are left alone.

        Raises:
            TypeError: The graph has a condition, or an operation that tapes do not have.
        """
        if graph.guards:
            raise TypeError("a condition on the inputs")
        self.places = np.array([k for k, x in enumerate(outputs) if isinstance(x, Node) or x], np.int64)
        shown = [x if isinstance(x, Node) else graph.constant(x) for x in (outputs[k] for k in self.places)]
        needed, self._n_in = _order(graph, shown), len(inputs)
        rows = {node.index: k for k, node in enumerate(inputs)}
        self.before = []
        for node in needed:
            if node.op in _BEFORE and node.args[0] in rows:
                self.before.append((node.op, rows[node.args[0]]))
                rows[node.index] = self._n_in
                self._n_in += 1
        constants = [node for node in needed if node.op == "const"]
        self._constants = np.array([node.args[0] for node in constants])
        rows |= {node.index: self._n_in + len(shown) + k for k, node in enumerate(constants)}
        self._list([node for node in needed if node.index not in rows], rows, shown)

    def _list(self, work: Sequence[Node], rows: dict[int, int], shown: Sequence[Node]) -> None:
        """Give every value a row, its output's or one of scratch until its last reader, and list the operations."""
        first = {node.index: self._n_in + k for k, node in reversed(list(enumerate(shown)))}
        last = {k: place for place, node in enumerate(work) for k in node.before}
        scratch = self._n_in + len(shown) + len(self._constants)
        free, end, listed = [], scratch, []
        for place, node in enumerate(work):
            if node.op not in _OPERATIONS:
                raise TypeError(f"the operation {node.op} on a tape")
            sources = [rows[k] for k in node.before]
            free += [rows[k] for k in set(node.before) if last[k] == place and rows[k] >= scratch]
            if node.index in first:
                rows[node.index] = first[node.index]
            elif free:
                rows[node.index] = free.pop()
            else:
                rows[node.index], end = end, end + 1
            listed.append((_OPERATIONS.index(node.op), rows[node.index], sources[0], sources[-1]))
        for row, node in enumerate(shown, start=self._n_in):
            if rows[node.index] != row:
                listed.append((_OPERATIONS.index("copy"), row, rows[node.index], rows[node.index]))
        self._n_scratch = end - scratch
        self._operations = np.array(listed, np.int32).reshape(-1, 4)

    @property
    def n_operations(self) -> int:
        """Number of operations a sample."""
        return len(self._operations)

    def run(self, rows: np.ndarray, out: np.ndarray, library: ctypes.CDLL | None = None) -> None:
        """Write the outputs into `out` (..., N), of inputs `rows` (m, N).

        The samples of a row of `out` follow each other in memory, and its rows are equally far apart.
        """
        m, n = rows.shape
        given = np.empty((self._n_in, n))
        given[:m] = rows
        for k, (name, of) in enumerate(self.before, start=m):
            NUMPY[name](rows[of], out=given[k])
        if library is not None:
            self._run_library(library, given, out)
            return
        for start in range(0, n, _BLOCK):
            part = slice(start, start + _BLOCK)
            self._run_numpy(given[:, part], out.reshape(-1, n)[:, part])

    def _run_numpy(self, given: np.ndarray, out: np.ndarray) -> None:
        n = given.shape[1]
        at = [*given, *(out[k] for k in self.places), *self._constants, *np.empty((self._n_scratch, n))]
        functions: list[Callable[..., Any]] = [np.positive if name == "copy" else NUMPY[name] for name in _OPERATIONS]
        for op, target, x, y in self._operations.tolist():
            if op < _BINARY:
                functions[op](at[x], at[y], at[target])
            else:
                functions[op](at[x], at[target])

    def _run_library(self, library: ctypes.CDLL, given: np.ndarray, out: np.ndarray) -> None:
        kept = np.empty((len(self._constants) + self._n_scratch, _SAMPLES))
        kept[: len(self._constants)] = self._constants[:, None]
        at = np.empty(len(given) + len(kept) + len(self.places), np.intp)

        def point(x: np.ndarray) -> ctypes.c_void_p:
            return ctypes.c_void_p(x.ctypes.data)

        numbers = (given.shape[1], len(self._operations), len(given), len(kept), len(self.places))
        n, n_ops, n_in, n_kept, n_out = (ctypes.c_int64(x) for x in numbers)
        stride = ctypes.c_int64(out.strides[-2] // out.itemsize)
        library.tape(
            n, n_ops, point(self._operations), point(at), n_in, point(given), n_kept, point(kept), n_out,
            point(self.places), point(out), stride,
        )  # fmt: skip


def _order(graph: Graph, outputs: Sequence[Node]) -> list[Node]:
    """Return the nodes that outputs need, each as late as its first reader allows, so that few values wait for theirs."""
    found: list[Node] = []
    state: dict[int, bool] = {}  # False: its arguments are in the list's making; True: it is in the list
    open_ = sorted({x.index for x in outputs}, reverse=True)
    while open_:
        index = open_[-1]
        if index in state:
            open_.pop()
            if not state[index]:
                state[index] = True
                found.append(graph.nodes[index])
        else:
            state[index] = False
            open_ += [k for k in graph.nodes[index].before if k not in state]
    return found


_TAPES: dict[Hashable, Tape | None] = {}
_LOCK = threading.Lock()


def find_tape(key: Hashable, samples: int, trace: Callable[[], Tape]) -> tuple[Tape, ctypes.CDLL | None] | None:
    """Return a computation's tape, and the library if it is there or worth building; None where array code is better.

    Args:
        key: Identifies the computation by its content.
        samples: Number of samples that the caller has computed, with those that are to be computed now.
        trace: Returns the tape; it may raise `TypeError` where the computation cannot be written.
    """
    with _LOCK:
        if key not in _TAPES:
            if samples < TRACE_FROM:
                return None
            while len(_TAPES) >= _MAX_TAPES:
                _TAPES.pop(next(iter(_TAPES)))
            try:
                _TAPES[key] = trace()
            except TypeError:
                _TAPES[key] = None
        tape = _TAPES[key]
    if tape is None:
        return None
    library = _get_library(samples >= BUILD_FROM)
    return None if library is None and tape.n_operations > MAX_IN_NUMPY else (tape, library)


def _get_library(build: bool) -> ctypes.CDLL | None:
    """Return the library, built if asked for; None without one."""
    if not is_compiling_allowed() or find_compiler() is None:
        return None
    return (_LIBRARIES.build if build else _LIBRARIES.find)(_SOURCE)
