r"""The force of a hammer: zero out of contact, and known in contact to the noise of its channel.

Out of contact the channel measures only noise, which a simulation would treat as a force and amplify at every
resonance. So the force is windowed to the contact (Ewins 2000, 3.9) if that lowers the simulation error. In contact
each sample has the same noise, `u + eps`, `eps ~ N(0, s^2)`, and the outputs differ from a simulation by `G eps` in
addition to their own noise, with `G` the response to a force in one sample. The residual of the outputs without this
contribution is

    e - G eps_hat,    eps_hat = (G' W G + I / s^2)^-1 G' W e.

The samples of one contact are grouped in bins: their effects on a resonance far below the sampling rate differ little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.modes.methods import decompose_pulse_tests
from tau_dyn.modes.record import PreparedRecords, Record, truncate_records

_OF_PEAK, _OF_NOISE = 0.02, 6.0
"""Share of an input's largest force, and multiple of its noise, above which there is contact."""
_FLANK, _FLANK_SHARE = 4, 0.2
"""Samples around contact that belong to it, and the same as a share of the contact."""
_MAX_CONTACT = 0.3  # share of a record; with more contact the record is driven, not an impulse test
_ORDER = 12  # states of the models by which windows are judged
_SAMPLES, _LEAST = 6000, 500  # samples that these models are fitted to, in all and at least of each pulse
_BINS = 24  # of one contact's samples, at most


def window_forces(data: PreparedRecords) -> tuple[PreparedRecords, str]:
    """Return pulse tests with the force zero out of contact, and why, if they are simulated better so; else as they are."""
    forces = np.vstack([r.u for r in data.whole or data.train])
    least = find_least_force(forces)
    free = np.vstack([np.where(find_contact(r.u, least), np.nan, r.u) for r in data.whole or data.train])
    noise = np.sqrt(np.nanmean(free**2, axis=0))

    def window(records: Sequence[Record]) -> tuple[Record, ...]:
        found = [(r, find_contact(r.u, least)) for r in records]
        return tuple(
            r
            if np.mean(pushes.any(axis=1)) > _MAX_CONTACT
            else replace(r, u=np.where(pushes, r.u, 0.0), input_noise=noise if noise.any() else None)
            for r, pushes in found
        )

    few = truncate_records(data.train, _SAMPLES, _LEAST)
    before, after = (_measure_loss(records) for records in (few, window(few)))
    if not after < before:
        return data, ""
    share = 100 * (1 - np.exp((after - before) / (2 * data.train[0].y.shape[1])))
    gain = f"lowers the error of simulation by {share:.2g} %" if np.isfinite(before) else "is hidden by noise otherwise"
    windowed = replace(data, train=window(data.train), holdout=window(data.holdout), whole=window(data.whole))
    return windowed, f"the force counts as zero out of contact, which {gain}"


def _measure_loss(records: Sequence[Record]) -> float:
    """Return log det of the residual covariance on pulses; infinite if noise hides that the force comes to rest."""
    try:
        return decompose_pulse_tests(records).measure_loss(_ORDER)
    except CannotAnswer:
        return np.inf


def find_least_force(forces: np.ndarray) -> np.ndarray:
    """Return the force of each input (m,) above which there is contact, from those of all pulses (N, m)."""
    size = np.abs(forces)
    return np.maximum(_OF_PEAK * size.max(axis=0), _OF_NOISE * 1.4826 * np.median(size, axis=0))


def find_contact(u: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return where inputs (N, m) push (N, m) bool, with flanks.

    Args:
        u: Inputs as deviations from rest.
        least: Force of each input above which there is contact (m,).
    """
    strong = np.abs(u) > least
    touching = np.zeros_like(strong)
    for column in range(u.shape[1]):
        near = binary_dilation(strong[:, column], iterations=_FLANK)
        for first, last in np.flatnonzero(np.diff(near, prepend=False, append=False)).reshape(-1, 2):
            wider = int(_FLANK_SHARE * (last - first))
            touching[max(0, first - wider) : last + wider, column] = True
    return touching


def compute_noise_responses(record: Record, markov: np.ndarray) -> np.ndarray:
    """Return the effect of input noise in contact on the outputs (N, p, k), one standard deviation per column.

    Args:
        record: Its inputs are zero out of contact; without noise of the inputs there are no columns.
        markov: Response (N, p, m) to one sample of unit input.
    """
    n, p = record.y.shape
    columns = []
    for j, s in enumerate(np.zeros(record.u.shape[1]) if record.input_noise is None else record.input_noise):
        pushed = np.flatnonzero(record.u[:, j])
        if s == 0 or not len(pushed):
            continue
        for part in np.array_split(pushed, min(_BINS, len(pushed))):
            column = np.zeros((n, p))
            for t in part:
                column[t:] += markov[: n - t, :, j]
            columns.append(s / np.sqrt(len(part)) * column)
    return np.stack(columns, axis=2) if columns else np.zeros((n, p, 0))


def remove_input_noise(errors: Sequence[np.ndarray], records: Sequence[Record], markov: np.ndarray) -> list[np.ndarray]:
    """Return errors of simulations (N, p) without the part that the noise of the inputs in contact explains."""
    weight = np.linalg.pinv(np.cov(np.vstack(errors).T, bias=True).reshape(records[0].y.shape[1], -1))
    out = []
    for error, record in zip(errors, records, strict=True):
        g = compute_noise_responses(record, markov)
        weighed = np.einsum("op,npk->nok", weight, g)
        gram = np.einsum("nok,nol->kl", g, weighed) + np.eye(g.shape[2])
        out.append(error - g @ np.linalg.solve(gram, np.einsum("nok,no->k", weighed, error)))
    return out
