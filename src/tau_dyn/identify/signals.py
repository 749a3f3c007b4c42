"""What effects feel and a log says beyond positions and forces: temperatures, reversals, which recording it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import ROOM_TEMPERATURE, Log, find_reversals
from tau_dyn.model import Model


def get_measured_signals(
    log: Log, joints: tuple[str, ...], q: np.ndarray, v: np.ndarray, threshold: np.ndarray
) -> dict[str, np.ndarray]:
    """Return what a log says beyond positions and forces: temperatures, and travel since each joint's last reversal."""
    found = {"reversal": np.column_stack([compute_travel(q[:, k], v[:, k], threshold[k]) for k in range(q.shape[1])])}
    warmth = log.temperatures(joints)
    return found if warmth is None else {**found, "temperature": warmth}


def compute_travel(q: np.ndarray, v: np.ndarray, threshold: float) -> np.ndarray:
    """Return the distance (N,) since a joint last reversed, from the turning point of each stretch of one direction.

    Stretches are told apart where the speed is sure, above the threshold; where they turned lies a little before. The first one
    counts from there too, or from the first sample.
    """
    sure = np.flatnonzero(np.abs(v) > threshold)
    starts = np.concatenate([[0], find_reversals(v, threshold), [len(q)]])
    out, before = np.zeros(len(q)), 0
    for start, stop in zip(starts[:-1], starts[1:], strict=True):
        at = start if start or not sure.size else sure[0]
        heading = np.sign(v[at]) or 1.0
        turn = np.min(heading * q[before : at + 1])
        out[start:stop] = np.maximum(0.0, heading * q[start:stop] - turn)
        before = start
    return out


def refuse_missing_temperature(model: Model, log: Log, measured: Mapping[str, np.ndarray]) -> None:
    """Refuse a log without the temperatures that an effect of the model follows."""
    feeling = [effect.name for effect in model.effects if "temperature" in effect.needs]
    if not feeling:
        return
    columns = f"{ROOM_TEMPERATURE} or {', '.join(f'temp_{j}' for j in model.robot.actuated)}"
    if "temperature" not in measured:
        raise InputError(
            "missing_column", f"{log.name} has no column {columns}, which effect {feeling[0]} of the model needs"
        )
    if not np.all(np.isfinite(measured["temperature"])):
        raise InputError(
            "bad_sample", f"{log.name}: a sample of {columns}, which effect {feeling[0]} needs, is no finite number"
        )


def refuse_missing_campaign(model: Model, names: Sequence[str]) -> None:
    """Refuse fewer logs than an effect tells apart."""
    for effect in model.effects:
        number = int(effect.settings.get("number", 0))
        if "campaign" in effect.needs and number >= len(names):
            raise InputError(
                "unsupported",
                f"effect {effect.name} sets log {number + 1} apart from others, and there is only {len(names)}: give the logs "
                "in the order in which it was found, or fit the model without it",
            )
