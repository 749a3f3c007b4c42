"""A black-box model as a file: what the observers, learning filters and other programs read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.modes.state_space import StateSpace

_FORMAT = 1  # version of the model file's layout
_MATRICES = ("A", "B", "C", "D", "K")


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model, and the columns that it goes between.

    Attributes:
        model: The model; it speaks of deviations from the operating point.
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        provenance: Where it comes from.
    """

    model: StateSpace
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    provenance: dict[str, Any]


def save_state_space(path: str | Path, content: ModelFile) -> None:
    """Write a model as YAML, the whole file or none."""
    m = content.model
    rows = {name: getattr(m, name).tolist() for name in _MATRICES}
    entries = {
        "tau_dyn_state_space": _FORMAT,
        "equation": "x[k+1] = A x[k] + B u[k - delay] + K e[k],  y[k] = C x[k] + D u[k - delay] + e[k]",
        "dt": float(m.dt),
        "delay": int(m.delay),
        "inputs": list(content.inputs),
        "outputs": list(content.outputs),
        **rows,
        "noise": None if m.noise is None else m.noise.tolist(),
        "provenance": content.provenance,
    }
    write_whole(path, yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None))


def load_state_space(path: str | Path) -> ModelFile:
    """Read a model that `save_state_space` wrote.

    Raises:
        InputError: The file is missing, not YAML, or not such a model; the message names the entry.
    """
    entries = read_yaml(path)
    if not isinstance(entries, dict) or entries.get("tau_dyn_state_space") != _FORMAT:
        raise InputError(
            "file_format", f"{path}: not a state space model (its first key is 'tau_dyn_state_space: {_FORMAT}')"
        )
    for key, kind in (("inputs", list), ("outputs", list), ("A", list), ("provenance", dict)):
        if not isinstance(entries.get(key) or kind(), kind):
            raise InputError("file_format", f"{path}: '{key}' has to be a {kind.__name__}")
    inputs, outputs = (tuple(map(str, entries.get(k) or ())) for k in ("inputs", "outputs"))
    n, m, p = len(entries.get("A") or ()), len(inputs), len(outputs)
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "K": (n, p)}
    matrices = {name: _matrix(path, entries, name, shape) for name, shape in shapes.items()}
    noise = None if entries.get("noise") is None else _matrix(path, entries, "noise", (p, p))
    dt, delay = entries.get("dt"), entries.get("delay")
    if not isinstance(dt, int | float) or not 0 < dt < 1e9 or not isinstance(delay, int) or not 0 <= delay < 1e9:
        raise InputError(
            "file_format", f"{path}: 'dt' has to be a positive number and 'delay' a whole number from 0 up"
        )
    model = StateSpace(**matrices, dt=float(dt), delay=delay, noise=noise)
    return ModelFile(model, inputs, outputs, dict(entries.get("provenance") or {}))


def _matrix(path: str | Path, entries: dict[str, Any], name: str, shape: tuple[int, int]) -> np.ndarray:
    try:
        matrix = np.array(entries.get(name), dtype=float).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            "file_format", f"{path}: '{name}' has to be a matrix of {shape[0]} by {shape[1]} numbers"
        ) from None
    if not np.all(np.isfinite(matrix)):
        raise InputError("file_format", f"{path}: '{name}' holds a number that is not finite")
    return matrix
