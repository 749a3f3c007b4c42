"""What it costs that a file cannot carry all of a model: the force error with and without, on the logs that the model names.

A model file names its held-out logs and their hashes. On these both predictions are compared with the measured force, filtered
and masked as `identify` does it. Where it names training logs alone, what is left out is measured as a force, over their motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import compute_sha256
from tau_dyn.identify import build_force_errors, build_regression
from tau_dyn.log import ColumnMap, Log, read_log
from tau_dyn.model import Model


def describe_price(model: Model, versions: Sequence[Model], folder: Path) -> str:
    """Return one sentence about what a file costs that holds less than `model`.

    Args:
        model: The model, with the provenance of its file.
        versions: What the file carries of it; then, where there is a callback, what both carry.
        folder: Where the model file lies; its logs are looked for there and where the program runs.
    """
    try:
        held, trained = (_find_logs(model, use, folder) for use in ("held_out", "trained_on"))
        if held:
            whole, *rest = compute_held_out_errors([model, *versions], held)
            with_each = ", ".join(f"{x:.3g} % with {what}" for x, what in zip(rest, _WHAT, strict=False))
            return f"the held-out force error is {whole:.3g} % with the whole model, {with_each}"
        if trained:
            forces = [_describe_force(model, carried, trained) for carried in versions]
            told = f", with the callback {forces[1]}" if len(forces) > 1 else ""
            return f"what is left out is {forces[0]}{told} (RMS over the training logs' motion)"
    except OSError as fault:
        return f"what that costs is unknown: a log cannot be read ({fault.strerror or fault})"
    except (InputError, CannotAnswer) as fault:
        return f"what that costs is unknown: {fault}"
    return "what that costs is unknown: the model's logs are not here"


_WHAT = ("what the file carries", "the callback beside it")


def _describe_force(model: Model, carried: Model, logs: Sequence[Log]) -> str:
    """Return the RMS of the force that is left out, joint by joint."""
    lost = compute_lost_force(model, carried, logs)
    rows = zip(model.robot.actuated, lost, model.robot.force_units, strict=True)
    return ", ".join(f"{x:.3g} {unit} at {joint}" for joint, x, unit in rows)


def compute_held_out_errors(models: Sequence[Model], logs: Sequence[Log]) -> list[float]:
    """Return the relative force error [%] of versions of one model, all on the same filtered samples."""
    regression = build_regression(models[0], logs)
    return [build_force_errors(regression, m.parameters.values).relative_error_percent for m in models]


def compute_lost_force(model: Model, carried: Model, logs: Sequence[Log]) -> np.ndarray:
    """Return the RMS (na,) [N or N m] of the force that is left out, along the logs' motion."""
    change = model.parameters.values - carried.parameters.values
    rows = [(run.W @ change, run.usable) for run in build_regression(model, logs).runs]
    lost, usable = (np.concatenate(part) for part in zip(*rows, strict=True))
    return np.sqrt((lost**2 * usable).sum(axis=0) / np.maximum(usable.sum(axis=0), 1))


def _find_logs(model: Model, use: str, folder: Path) -> list[Log]:
    """Return a model's logs where all of them are here and are unchanged, each read by its column map."""
    found = []
    for row in model.provenance.get(use, []):
        log = _find_log(row, folder)
        if log is None:
            return []
        found.append(log)
    return found


def _find_log(row: Mapping[str, Any], folder: Path) -> Log | None:
    """Return the log of a row of provenance, or None where no file here has its hash."""
    columns = row.get("columns") if isinstance(row, Mapping) else None
    if not isinstance(row, Mapping) or not isinstance(row.get("path"), str) or not isinstance(columns, dict | None):
        return None
    map_ = None if columns is None else ColumnMap.from_dict(columns, "the model's column map")
    several = map_ is not None and bool(map_.files)  # whose hash is that of all their bytes
    name = Path(row["path"])
    for path in dict.fromkeys((name, folder / name, folder / name.name)):
        if path.is_file() and (several or compute_sha256(path) == row.get("sha256")):
            log = read_log(path, map_)
            if log.sha256 == row.get("sha256"):
                return log
    return None
