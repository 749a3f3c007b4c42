"""The exported C of a lead-through controller as a law of the test bench."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np

from lead_through_parts.contact import ContactPose
from tau_dyn.codegen import write_lead_through_source
from tau_dyn.control.lead_through import LeadThrough, LeadThroughSettings


class ExportedLaw:
    """The C of some settings as a law of the test bench."""

    def __init__(self, settings: LeadThroughSettings, folder: Path) -> None:
        """Write, compile and load."""
        for name, text in zip(
            ("lead.c", "lead.h"), write_lead_through_source(LeadThrough(settings).list_numbers()), strict=True
        ):
            (folder / name).write_text(text)
        library = folder / f"lead_{len(list(folder.glob('*.so')))}.so"  # a loader may take a name for the one it has
        subprocess.run(
            ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", str(library), str(folder / "lead.c"), "-lm"], check=True
        )
        self._code, self._state = ctypes.CDLL(str(library)), np.zeros(37)
        self.sample_time = settings.loop.sample_time
        self._code.lead_start(self._pointer(self._state))

    @staticmethod
    def _pointer(x: np.ndarray):
        return np.ascontiguousarray(x, float).ctypes.data_as(ctypes.POINTER(ctypes.c_double))

    @property
    def in_contact(self) -> bool:
        """See `lead_through.c`."""
        return bool(self._state[27])

    @property
    def normal(self) -> np.ndarray:
        """See `lead_through.c`."""
        return self._state[18:21].copy()

    def __call__(self, handle: np.ndarray, tool: np.ndarray, pose: ContactPose, time: float | None = None):
        """Return the velocity of one step."""
        given = [np.ascontiguousarray(x, float) for x in (handle, tool, *pose)]
        out = np.zeros(6)
        assert self._code.lead_step(*(self._pointer(x) for x in (self._state, *given)), self._pointer(out)) == 0
        return out
