"""A feedforward as compiled code: the same forces as in Python to rounding, one state a call, in a few microseconds.

The model is traced and compared with Python at random states (`codegen/program.py`), written as the C of `feedforward export`,
built once and stored (`equations/compiler.py`). Python answers a state that the compiled code refuses (a status above zero).
"""

from __future__ import annotations

import ctypes
import threading
from typing import Self

import numpy as np

from tau_dyn.codegen import TraceableForces, build_program, write_c_source
from tau_dyn.equations import LibraryCache, find_compiler, is_compiling_allowed
from tau_dyn.exceptions import InputError

_NAME = "tau_ff"
_LIBRARIES = LibraryCache()
_VISIBLE = "#pragma GCC visibility push(default)\n"  # libraries are built with hidden symbols


class CompiledFeedforward:
    """Forces of one model from a library."""

    def __init__(self, library: ctypes.CDLL, joints: int, start: int) -> None:
        """Take a library of `write_c_source`.

        Args:
            library: The library.
            joints: Number of actuated joints.
            start: Size of the last configuration where loops are solved numerically, else 0.
        """
        self._joints = joints
        self._buffers = [np.zeros(joints) for _ in range(4)]
        self._start = np.zeros(start)
        held = [*([self._start] if start else []), *self._buffers]
        self._arguments = [ctypes.c_void_p(x.ctypes.data) for x in held]
        self._call, self._lock = getattr(library, _NAME), threading.Lock()  # arguments go through the buffers above
        if start:
            getattr(library, f"{_NAME}_start")(self._arguments[0])

    @classmethod
    def build(cls, feedforward: TraceableForces) -> Self:
        """Return the compiled forces of a feedforward whose effects a single state determines.

        Raises:
            InputError: There is no compiler, it is turned off, or the model cannot be written as C.
        """
        if not is_compiling_allowed() or find_compiler() is None:
            raise InputError("not_available", "there is no C compiler, or TAU_DYN_COMPILE turns it off")
        program = build_program(feedforward)
        source, header = write_c_source(program, _NAME, limited=False)
        library = _LIBRARIES.build(source.replace(f'#include "{_NAME}.h"', _VISIBLE + header, 1))
        if library is None:
            raise InputError("not_available", "the C compiler does not build the feedforward")
        joints = feedforward.model.robot.na
        return cls(library, joints, 0 if program.loops is None else joints + len(program.loops.passive))

    def __call__(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray | None:
        """Return forces (na,) [N or N m] at one state, each (na,); None where the code returns a status above zero."""
        q_in, v_in, a_in, tau = self._buffers
        with self._lock:
            q_in[:], v_in[:], a_in[:] = q, v, a
            return None if self._call(*self._arguments) else tau.copy()
